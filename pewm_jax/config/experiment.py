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
        require(
            self.codec.kind == "pixel" or (self.clip.frames - 1) // self.codec.temporal % 2 == 0,
            f"clip.frames {self.clip.frames}: the VAE decodes an even number of latent frames "
            "without its first-frame rule (2 latent frames become 8 frames, not 5); use 8k + 1 "
            "frames (9, 17, 25, …).",
        )
        cameras = self.codec.temporal * self.dit.patch_t
        require(
            self.memory.positions == "sinusoid" or self.memory.heads >= cameras,
            f"memory.heads is {self.memory.heads}: with projective positions head k looks through "
            f"camera k mod {cameras} (codec.temporal × dit.patch_t) of a token's frames; use at "
            f"least {cameras} heads, or memory.positions sinusoid.",
        )
        self._require_channels()
        patch = self.memory.encoder_patch
        require(
            self.memory.encoder != "patch_colours"
            or (self.clip.height % patch == 0 and self.clip.width % patch == 0),
            f"memory.encoder_patch {patch} does not divide the clip "
            f"{self.clip.height}×{self.clip.width}.",
        )

    def _require_channels(self) -> None:
        """Refuse channels of the denoiser that are not those of codec and camera."""
        codec = self.codec
        if codec.kind == "vae":
            latent = 2 * codec.vae.latent_channels
        else:
            latent = 4 * codec.temporal * codec.spatial**2
        wanted = {"in_channels": 2 * latent + 6 * codec.temporal, "out_channels": latent}
        for name, value in wanted.items():
            require(
                getattr(self.dit, name) in (0, value),
                f"dit.{name} is {getattr(self.dit, name)}: codec and camera need {value}; leave it "
                "at 0 to have it follow them.",
            )
