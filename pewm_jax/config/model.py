"""The model: all settings that inference needs, and no others."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.clip import ActionConfig, ClipConfig
from pewm_jax.config.parts import Backbone, Codec, Conditioner, Memory, Noise
from pewm_jax.config.training import TrainConfig, TrainSettings
from pewm_jax.config.world import ArraySpec, BatchSpec, Capabilities, Facts, World
from pewm_jax.errors import require
from pewm_jax.registry import of, part, require_section


@dataclasses.dataclass(frozen=True)
class ModelConfig(World):
    """A video diffusion model with a memory (PEWM)."""

    TRAIN: ClassVar[type[TrainSettings]] = TrainConfig

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
        """Input channels of the denoiser: noisy latents, the observed frames', the control's."""
        shown = self.backbone.shown_channels(self)
        return self.codec.channels + shown + self.control.channels(self)

    @property
    def batch_spec(self) -> BatchSpec:
        """Context for the memory, the control's actions, and cached features of the context."""
        features = None
        if self.memory.encoder.WEIGHTS == "encoder":
            shape = (*self.memory.encoder.grid(self.clip), self.memory.encoder.channels)
            features = ArraySpec(shape, "float16")
        return BatchSpec(actions=self.control.actions, features=features)

    @property
    def capabilities(self) -> Capabilities:
        """What the memory and the control can do."""
        memory = self.memory
        return Capabilities(
            memory=memory.REMEMBERS,
            memory_parameters="memory" if memory.READ_BY_BLOCKS else "",
            depth=self.clip.depth,
            cameras=not self.control.actions,
            points=memory.REMEMBERS,
            edits=memory.EDITABLE,
            coverage=memory.REMEMBERS and memory.READ_BY_BLOCKS,
            stage_without_memory=True,
            silent_actions=self.control.MODULATES,
        )

    @property
    def facts(self) -> Facts:
        """What reports say of the parts."""
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

    def with_sample_steps(self, steps: int) -> ModelConfig:
        """Return the same model with another number of the sampler's steps."""
        noise: Any = dataclasses.replace(self.noise, sample_steps=steps)  # type: ignore[call-arg]
        return dataclasses.replace(self, noise=noise)

    def __post_init__(self):
        """Validate what is in each section, and settings that depend on each other."""
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
