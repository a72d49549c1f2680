"""One experiment, from pixels to scores: all sections together."""

from __future__ import annotations

import dataclasses

from pewm_jax.config.clip import ActionConfig, ClipConfig
from pewm_jax.config.codec import CodecConfig
from pewm_jax.config.diffusion import DiffusionConfig
from pewm_jax.config.dit import DiTConfig
from pewm_jax.config.errors import require
from pewm_jax.config.memory import MemoryConfig
from pewm_jax.config.training import DataConfig, EvalConfig, TrainConfig


@dataclasses.dataclass(frozen=True)
class Config:
    """One experiment, from pixels to scores."""

    clip: ClipConfig = ClipConfig()
    """The shape of a clip."""
    actions: ActionConfig = ActionConfig()
    """What an action does."""
    codec: CodecConfig = CodecConfig()
    """Pixels to latents."""
    dit: DiTConfig = DiTConfig()
    """The denoiser."""
    memory: MemoryConfig = MemoryConfig()
    """The 3D map and the blocks that read it."""
    diffusion: DiffusionConfig = DiffusionConfig()
    """Noise, target, sampler."""
    data: DataConfig = DataConfig()
    """What training reads."""
    train: TrainConfig = TrainConfig()
    """How it learns."""
    evaluate: EvalConfig = EvalConfig()
    """How it is scored."""

    def __post_init__(self):
        """Validate what spans several sections."""
        step = self.codec.spatial * self.dit.patch
        require(
            self.clip.height % step == 0 and self.clip.width % step == 0,
            f"clip {self.clip.height}×{self.clip.width}: height and width must be multiples of "
            f"codec.spatial × dit.patch = {step}; change the clip's size or the patch.",
        )
        require(
            (self.clip.frames - 1) % self.codec.temporal == 0,
            f"clip.frames {self.clip.frames} − 1 is not a multiple of codec.temporal "
            f"{self.codec.temporal}.",
        )
        per_latent = self.codec.temporal
        require(
            self.memory.positions == "sinusoid" or self.memory.heads >= per_latent,
            f"memory.heads is {self.memory.heads}: with projective positions head k looks through "
            f"camera k mod {per_latent} (codec.temporal) of a latent frame; use at least "
            f"{per_latent} heads, or memory.positions sinusoid.",
        )
        patch = self.memory.encoder_patch
        require(
            self.clip.height % patch == 0 and self.clip.width % patch == 0,
            f"memory.encoder_patch {patch} does not divide the clip "
            f"{self.clip.height}×{self.clip.width}.",
        )
