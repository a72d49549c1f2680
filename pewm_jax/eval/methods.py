"""Who imagines: the model with its map and without, models that have none, and two without a net.

============= ====================================================================================
memory        the model with its map
empty         the same weights with an empty map
model         in the place of both, a model that was trained without a memory
none          another model, trained for as many steps without a memory (if one is given)
reproject     no network: what was observed, moved to where the camera looks now
copy          no network: the last observed frame, repeated
============= ====================================================================================
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval.imagine import Imagination, copy_last
from pewm_jax.eval.reproject import ReprojectSettings, reproject_batch
from pewm_jax.report.labels import OWN_METHODS
from pewm_jax.types import Array, Camera, Frames

METHODS = ("memory", "empty", "model", "none", "reproject", "copy")
"""All methods, in the order of the tables."""
SAMPLED = ("memory", "empty", "model", "none")
"""Those that draw noise, and so are scored with every seed."""


@dataclasses.dataclass(frozen=True)
class Methods:
    """The methods of one evaluation.

    Attributes:
        model: the model that is scored.
        reproject: settings of the reprojection.
        none: a model trained without a memory, or None.
        none_weights: hash of its weights.
        remembers: whether the model that is scored has a memory.
    """

    model: Imagination
    reproject: ReprojectSettings
    none: Imagination | None = None
    none_weights: str = ""
    remembers: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """The methods that there are."""
        left_out = {"model"} if self.remembers else {"memory", "empty"}
        left_out |= {"none"} if self.none is None else set()
        return tuple(name for name in METHODS if name not in left_out)

    @property
    def own(self) -> str:
        """The method that is the model itself: ``memory``, or ``model`` if it has none."""
        return "memory" if self.remembers else "model"

    def piece(self, method: str) -> str:
        """Return the method's name in partial results: with all that only its scores depend on."""
        extra = {"none": self.none_weights[:16], "reproject": self.reproject.name}
        return "-".join(filter(None, (method, extra.get(method))))

    def seeds(self, method: str, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Return the sampling seeds that a method is scored with."""
        return seeds if method in SAMPLED else (0,)

    def prepare(self, methods: Iterable[str]) -> None:
        """Compile what some methods need."""
        methods = set(methods)
        known = ("empty", "memory", "model")
        self.model.prepare([name in OWN_METHODS for name in known if name in methods])
        if self.none is not None and "none" in methods:
            self.none.prepare([False])

    def imagine(
        self,
        method: str,
        context: Frames,
        control: Array | Camera,
        camera: Camera,
        seeds_B2: np.ndarray,
        watch: Callable[[Any], Any] | None = None,
    ) -> tuple[Any, Any, Frames]:
        """Imagine N frames for every clip of a batch.

        Args:
            method: one of ``names``.
            context: (B, S) observed frames, the present last, colours uint8.
            control: what drives the model, see ``Imagination.run``.
            camera: (B, N) the cameras of the frames to imagine, where the control leads.
            seeds_B2: sampling seed and clip number.
            watch: of a network, see ``Imagination.run``.

        Returns:
            ``(first, last, frames)``: the states before and after, None without a network, and
            (B, N) frames.

        Raises:
            UserError: the model's output is not finite.
        """
        if method == "copy":
            return None, None, copy_last(context, camera.intrinsics_4.shape[1])
        if method == "reproject":
            return None, None, reproject_batch(self.reproject, context, camera)
        given: dict[str, Any] = {} if watch is None else {"watch": watch}
        model = self.none if method == "none" and self.none is not None else self.model
        first, last, frames = model.run(
            context, control, seeds_B2, memory=method in OWN_METHODS, **given
        )
        if not all(np.isfinite(leaf).all() for leaf in (frames.rgb_THWC, frames.depth_THW)):
            raise UserError(
                "the model imagines values that are not finite: its weights are damaged or its "
                "training diverged; train it again."
            )
        return first, last, frames
