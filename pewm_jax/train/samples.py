"""Samples while training: when they are made, what they are worth, and that training outlives them.

What makes them is handed to the loop (``evaluation.preview`` by train.py), not imported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from pewm_jax.config import Config, UserError
from pewm_jax.train import processes
from pewm_jax.train.stages import Stage
from pewm_jax.types import Params

IMAGINED = {"model": "model", "memory": "with its map", "empty": "empty map"}
"""Who imagines: a model without a memory, one with its map, the same weights with an empty map."""


@dataclasses.dataclass(frozen=True)
class Previewed:
    """What a preview made.

    Attributes:
        files: pictures and videos.
        psnr: key of ``IMAGINED`` → decibels against what was recorded.
    """

    files: tuple[Path, ...]
    psnr: Mapping[str, float] = dataclasses.field(default_factory=dict)


Preview = Callable[[Params, Stage, int], Previewed]
"""Called with inference weights, stage and step; writes samples and measures them."""


class Samples:
    """Makes a stage's samples, shows and measures them.

    Args:
        config: the experiment.
        stage: the stage.
        preview: makes them; None for none.
        say: prints what is compiled and made.
        unless_stopped: does what a stop signal may break off, ``Stop.unless_requested``.
    """

    def __init__(
        self,
        config: Config,
        stage: Stage,
        preview: Preview | None,
        *,
        say: Callable[[str], Any],
        unless_stopped: Callable[[Callable[[], Previewed]], Previewed | None],
    ):
        self._every = config.train.preview_every
        self._steps = stage.settings(config).steps
        self._stage, self._preview = stage, preview
        self._say, self._unless_stopped = say, unless_stopped
        self._made = False

    def due(self, step: int) -> bool:
        """Tell whether a step has samples: every ``train.preview_every``-th and the last."""
        wanted = self._preview is not None and self._every > 0
        return wanted and (step % self._every == 0 or step == self._steps)

    def make(self, params: Params, step: int) -> dict[str, float]:
        """Make samples, unless a signal breaks that off or they do not fit into memory.

        All processes come here; the first one, which gets the weights of all, makes them.

        Args:
            params: inference weights.
            step: the number of the step.

        Returns:
            Their PSNR in decibels, by names for the log.
        """
        params, preview = processes.gather(params), self._preview
        if preview is None or not processes.is_primary():
            return {}
        if not self._made:
            self._say(f"{self._stage.title}: compiling the sampler for pictures …")
        self._made = True
        try:
            made = self._unless_stopped(lambda: preview(params, self._stage, step))
        except (jax.errors.JaxRuntimeError, UserError) as error:
            reason = " ".join(str(error).split())[:160]
            self._say(f"{self._stage.title}: no sample pictures of step {step} ({reason})")
            return {}
        if made is None:
            return {}
        scores = ", ".join(f"{IMAGINED[name]} {value:.1f} dB" for name, value in made.psnr.items())
        files = f"sample pictures {' and '.join(map(str, made.files))}"
        self._say(f"{self._stage.title}: {f'{scores}; {files}' if scores else files}")
        return {f"psnr_{name}": value for name, value in made.psnr.items()}
