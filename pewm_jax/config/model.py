"""The model: all settings that inference needs, and no others."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.clip import ActionConfig, ClipConfig
from pewm_jax.config.codec import PixelConfig
from pewm_jax.config.control import CameraConfig
from pewm_jax.config.dit import DiTConfig
from pewm_jax.config.memory import VoxelConfig
from pewm_jax.config.parts import Backbone, Codec, Conditioner, Memory, Noise, World
from pewm_jax.config.training import TrainConfig, TrainSettings
from pewm_jax.errors import require
from pewm_jax.registry import part, require_section


@dataclasses.dataclass(frozen=True)
class ModelConfig(World):
    """A video diffusion model with a memory (PEWM)."""

    TRAIN: ClassVar[type[TrainSettings]] = TrainConfig

    clip: ClipConfig = ClipConfig()
    """Shape of a clip."""
    actions: ActionConfig = ActionConfig()
    """Effect of an action."""
    codec: Codec = PixelConfig()
    """Codec: pixels to latents and back."""
    backbone: Backbone = DiTConfig()
    """Backbone: the denoiser."""
    control: Conditioner = CameraConfig()
    """Control: what steers a clip."""
    memory: Memory = VoxelConfig()
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
