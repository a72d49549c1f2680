"""A model: all that inference needs to know, and nothing else."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.backbone import BackboneSettings
from pewm_jax.config.clip import ActionConfig, ClipConfig
from pewm_jax.config.codec import CodecSettings, PixelConfig
from pewm_jax.config.control import CameraConfig, ControlSettings
from pewm_jax.config.dit import DiTConfig
from pewm_jax.config.kinds import Settings
from pewm_jax.config.memory import MemorySettings, VoxelConfig
from pewm_jax.config.noise import DDPMConfig, NoiseSettings
from pewm_jax.config.training import TrainConfig, TrainSettings


class WorldSettings(Settings):
    """What the settings of every world say; ``pewm_jax.worlds`` says what a world does.

    Attributes:
        TRAIN: its training settings: ``TrainSettings`` with a ``StageConfig`` for each stage, named
            as ``pewm_jax.worlds.stages`` names them.
        TRAINS: parts that other worlds take from ``train.start`` and this one trains itself.
        dtype: compute precision, in which frozen weights are kept too.
    """

    SECTION: ClassVar[str] = "world"
    TRAIN: ClassVar[type[TrainSettings]] = TrainSettings
    TRAINS: ClassVar[tuple[str, ...]] = ()
    dtype: Any = "float32"


@dataclasses.dataclass(frozen=True)
class ModelConfig(WorldSettings):
    """A video diffusion model with a memory (PEWM): what it imagines and how it is built."""

    TRAIN: ClassVar[type[TrainSettings]] = TrainConfig

    clip: ClipConfig = ClipConfig()
    """The shape of a clip."""
    actions: ActionConfig = ActionConfig()
    """What an action does."""
    codec: CodecSettings = PixelConfig()
    """Pixels to latents."""
    backbone: BackboneSettings = DiTConfig()
    """The denoiser."""
    control: ControlSettings = CameraConfig()
    """What steers it."""
    memory: MemorySettings = VoxelConfig()
    """What is remembered, as which features, and how it is read."""
    noise: NoiseSettings = DDPMConfig()
    """Noise, target, sampler."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute precision; master weights of what trains stay float32, frozen weights are kept in
    this precision."""

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """(t, h, w) of one clip's latents."""
        return self.codec.latent_shape(self.clip)

    @property
    def in_channels(self) -> int:
        """Channels that go into the denoiser: noisy latents, observed latents, the control's."""
        return 2 * self.codec.channels + self.control.channels(self)

    def __post_init__(self):
        """Validate what spans several sections."""
        parts: tuple[Any, ...] = (self.backbone, self.codec, self.control, self.memory, self.noise)
        for part in parts:
            part.check(self)
