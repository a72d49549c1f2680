"""The settings of a world that is assembled from parts."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from pewm_jax.config.parts import Backbone, Codec, Conditioner, Draft, Memory, Noise
from pewm_jax.config.world import (
    PLANAR,
    ActionConfig,
    ArraySpec,
    BatchSpec,
    Capabilities,
    ClipConfig,
    Facts,
    World,
)
from pewm_jax.errors import require
from pewm_jax.registry import of, part, require_section

if TYPE_CHECKING:
    import numpy as np

    from pewm_jax.types import Array


WhereObserved: TypeAlias = Literal["first", "every", "warped", "drafted"]
"""Where the observed frame conditions a clip: at its own latent frame alone; at every latent frame,
as it is; at every one, rendered from the camera of that frame by its depth; or at every one, as the
draft of that frame (``worlds.draft``)."""


@dataclasses.dataclass(frozen=True)
class AssembledModel(World):
    """Base class of the worlds that are assembled from parts.

    A backbone denoises the latents of a codec, steered by a control; a reader reads a memory.

    Attributes:
        own_m: observed pixels nearer than this show the agent's own body and are not warped; a
            setting of the world, metres.
        observed: where the observed frame conditions a clip, a ``WhereObserved``; a setting of the
            worlds that declare this field.
        draft: the network whose frames the model refines; a setting of the worlds that declare it.
    """

    observed = "first"  # without an annotation this is no field
    draft = Draft()
    own_m = 0.0

    clip: ClipConfig = ClipConfig()
    """Shape of a clip."""
    actions: ActionConfig = ActionConfig()
    """Effect of an action."""
    codec: Codec = part("codec", "pixel")
    """Codec: pixels to latents and back."""
    backbone: Backbone = part("backbone", "dit")
    """Backbone: the denoiser."""
    control: Conditioner = part("control", "camera")
    """Control: what steers a clip."""
    memory: Memory = part("memory", "voxel")
    """Memory: what is remembered, as which features, and how it is read."""
    noise: Noise = part("noise", "ddpm")
    """Noise, prediction target, sampler."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of computation and of frozen weights; weights in training stay float32."""

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """(t, h, w) of one clip's latents."""
        return self.codec.latent_shape(self.clip)

    @property
    def in_channels(self) -> int:
        """Input channels of the denoiser: of noisy latents, observed frames and control."""
        shown = self.backbone.shown_channels(self) + self.everywhere_channels
        return self.codec.channels + shown + self.control.channels(self)

    @property
    def everywhere_channels(self) -> int:
        """Input channels of the observed frame at every latent frame: its latents and a mask."""
        return 0 if self.observed == "first" else self.codec.channels + 1

    @property
    def batch_spec(self) -> BatchSpec:
        """Context for the memory, what the control needs, and cached features of the context."""
        features = None
        if self.memory.encoder.WEIGHTS == "encoder":
            shape = (*self.memory.encoder.grid(self.clip), self.memory.encoder.channels)
            features = ArraySpec(shape, "float16")
        depth = self.clip.depth or self.memory.REMEMBERS
        state = self.control.state
        extras = (("state_A", ArraySpec((state,))),) if state else ()
        return BatchSpec(
            actions=self.control.actions, extras=extras, features=features, depth=depth
        )

    @property
    def capabilities(self) -> Capabilities:
        """The capabilities of the memory and the control."""
        memory = self.memory
        return Capabilities(
            memory=memory.REMEMBERS,
            memory_parameters="memory" if memory.READ_BY_BLOCKS else "",
            depth=self.clip.depth,
            actions=self.control.actions in (0, PLANAR),
            body=self.control.body,
            cameras=not self.control.actions,
            points=memory.REMEMBERS,
            edits=memory.EDITABLE and type(self).erase is not World.erase,
            coverage=memory.REMEMBERS
            and memory.READ_BY_BLOCKS
            and type(self).coverage is not World.coverage,
            stage_without_memory=True,
            silent_actions=self.control.MODULATES,
        )

    @property
    def facts(self) -> Facts:
        """Properties of the parts for reports."""
        memory = self.memory
        read = f", {memory.tokens} read per clip" if memory.READ_BY_BLOCKS else ""
        return Facts(
            memory=of(memory).name,
            encoder=of(memory.encoder).name,
            reader=of(memory.reader).name,
            positions=getattr(memory.reader, "positions", ""),
            capacity=f"{memory.room} cells of {memory.cell_m} m{read}",
            room=memory.room,
            cell_m=memory.cell_m,
            codec=of(self.codec).name,
            control=of(self.control).name,
            noise=of(self.noise).name,
            sampler=getattr(self.noise, "sampler", ""),
            guidance=self.noise.guidance,
        )

    @property
    def sample_steps(self) -> int:
        """Steps of the noise's sampler."""
        return int(getattr(self.noise, "sample_steps", 0))

    def with_sample_steps(self, steps: int) -> AssembledModel:
        """Return the same model with another number of the sampler's steps."""
        noise: Any = dataclasses.replace(self.noise, sample_steps=steps)  # type: ignore[call-arg]
        return dataclasses.replace(self, noise=noise)

    def sharding(self) -> tuple[tuple[str, Any], ...]:
        """Return the sharding rules of all parts, and of the stored prompt."""
        memory = self.memory
        parts = (self.backbone, memory.reader, self.codec, memory.encoder, self.control)
        rules = [rule for part in parts for rule in part.SHARDING]
        return (*rules, (r"text/(prompt|negative)_LC", (None, "fsdp")))

    def split_heads(self, stage: Any) -> dict[str, int]:
        """Return the head counts that ``train.mesh.tensor`` must divide."""
        heads = {"backbone.heads": self.backbone.split_heads}
        if stage.memory:
            heads["memory.reader.heads"] = self.memory.reader.split_heads
        return heads

    def memory_points(self, memory: Any) -> tuple[Array, Array, Array, Array | None]:
        """Return the memory as points; see ``World.memory_points``."""
        return *self.memory.to_points(self, memory), getattr(memory, "observed_V", None)

    def point_colours(self, features_VF: Array) -> np.ndarray:
        """Return the (V, 3) colours in [−1, 1] in which the memory's points are drawn."""
        import numpy as np  # noqa: PLC0415 - reading settings does not need it

        values = np.asarray(features_VF)
        if not self.memory.KEEPS_FEATURES or not len(values):
            return values[..., :3]
        return self.memory.encoder.colours(values)

    def __post_init__(self):
        """Validate each section, and settings that depend on each other."""
        require_section(self, "world", "model")
        for name, kind in (("clip", ClipConfig), ("actions", ActionConfig)):
            found = getattr(self, name)
            require(
                isinstance(found, kind),
                f"model.{name} is {type(found).__name__}: give it a {kind.__name__}.",
            )
        parts: tuple[Any, ...] = (self.backbone, self.codec, self.control, self.memory, self.noise)
        for settings in parts:
            settings.check(self)
        require(
            self.observed in get_args(WhereObserved),
            f"model.observed is {self.observed!r}; choose one of "
            f"{', '.join(get_args(WhereObserved))}.",
        )
        require(
            self.observed != "warped" or self.clip.depth,
            "model.observed is warped, which needs the depth of the observed frame, and clip.depth "
            "is false, so imagined frames have none: use model.observed every.",
        )
        require(
            (self.observed == "drafted") == self.draft.PREDICTS,
            f"model.observed is {self.observed} and model.draft.kind {of(self.draft).name}: "
            "model.observed drafted and model.draft.kind network go together.",
        )
        self.draft.check(self)
