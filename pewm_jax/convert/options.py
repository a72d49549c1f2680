"""The settings of each command of ``pewm-jax convert``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from pewm_jax.config import ConfigError
from pewm_jax.convert import stablehlo
from pewm_jax.models.cogvideox.config import Learned

Dtype = Literal["float32", "bfloat16", "float16"]


@dataclasses.dataclass(frozen=True)
class ImportCogVideoX:
    """Import a CogVideoX checkpoint in the layout of diffusers.

    With --rgbd --camera the patch embedding and the output layer are widened for a world model:
    depth, the observed frame and the camera become inputs, depth becomes an output; --memory adds
    the blocks that read the map. The result is a folder that `pewm_jax.load` reads and that can be
    trained by its name (`pewm-jax train DST`), with the settings of the presets pewm_2b and
    pewm_5b. Before training it predicts the colours of the original. With --actions an
    image-to-video checkpoint becomes a world model controlled by actions, as by `import svd`, with
    the settings of the preset egowm_cogvideox; before training, actions have no effect. Without
    these flags the networks are only converted to our layout.
    """

    REPEATED: ClassVar[tuple[str, ...]] = ("--prompt",)
    """Flags with several values that may also be given several times."""

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The pipeline's folder, or its name on a hub (org/name or org/name@revision): transformer/,
    vae/, scheduler/ and, if prompts are to be encoded, text_encoder/ and tokenizer/."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    dtype: Dtype | None = None
    """Store weights in this precision; by default the stored one."""
    prompt: tuple[str, ...] = ("",)
    """Prompts to encode and store, by default the empty one; a world model takes one."""
    rgbd: bool = False
    """Widen for depth; needs --camera."""
    camera: bool = False
    """Widen for the camera; needs --rgbd."""
    memory: bool = False
    """Add memory blocks; they have no effect until they are trained."""
    actions: bool = False
    """Make a world model controlled by actions, without depth, camera and memory."""
    frames: int | None = None
    """Frames of the world model's clips: 8k + 1; by default 9, with --actions 17, or the size of
    learned positions."""
    positions: Learned | None = None
    """Treatment of learned positions (5b-I2V) for clips of other sizes than 49 × 480 × 720:
    `interpolate` resizes their table, `drop` removes it, `reference` replaces it with a fixed
    sinusoid for other numbers of frames, `exact` raises an error. By default `exact`."""
    height: int | None = None
    """Height of its images in pixels; by default 512, with --actions 480, or the size of learned
    positions."""
    width: int | None = None
    """Width of its images in pixels; by default 512, with --actions 720, or the size of learned
    positions."""
    encoder: Path | None = None
    """Folder of `import dinov2`, the encoder of the map's image features; by default the colours of
    patches."""
    config: Path | None = None
    """JSON file of other settings of the world model, such as {"memory": {"tokens": 1024}}."""
    seed: int = 0
    """Seed of the memory blocks' random weights."""

    def __post_init__(self):
        """Validate."""
        if self.rgbd != self.camera:
            given, lacking = ("rgbd", "camera") if self.rgbd else ("camera", "rgbd")
            raise ConfigError(
                f"--{given} was given without --{lacking}: a world model needs both depth and "
                f"camera; add --{lacking}."
            )
        if not self.prompt:
            raise ConfigError('--prompt was given no prompt; the empty one is --prompt "".')
        if self.actions:
            self._require_no_map()
        if self.world:
            if len(set(self.prompt)) > 1:
                raise ConfigError(
                    f"--prompt names {len(self.prompt)} prompts: a world model takes one."
                )
            return
        if self.memory:
            raise ConfigError("--memory was given without --rgbd --camera; add them.")
        for name in ("frames", "height", "width", "positions", "encoder", "config"):
            if getattr(self, name) is not None:
                raise ConfigError(
                    f"--{name} is a setting of a world model; add --rgbd --camera, or --actions."
                )

    @property
    def world(self) -> bool:
        """Whether the result is a world model."""
        return self.rgbd or self.actions

    def _require_no_map(self) -> None:
        for name in ("rgbd", "memory", "encoder"):
            if getattr(self, name):
                raise ConfigError(
                    f"--actions was given with --{name}: it makes a world model without a map; "
                    "omit one of the two."
                )


@dataclasses.dataclass(frozen=True)
class ImportDINOv2:
    """Import DINOv2, the encoder of the map's image features."""

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """A folder of transformers (config.json, model.safetensors), its name on a hub, or the original
    repository's state dict (.pth or .safetensors)."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    dtype: Dtype | None = None
    """Store weights in this precision; by default the stored one."""


@dataclasses.dataclass(frozen=True)
class ImportSVD:
    """Import a checkpoint of Stable Video Diffusion as a world model controlled by actions.

    The result is a folder that `pewm_jax.load` reads and that can be trained by its name (`pewm-jax
    train DST`), with the settings of the preset egowm_svd. Before training, actions have no effect.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The pipeline's folder, or its name on a hub: unet/, vae/, image_encoder/ and scheduler/."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    dtype: Dtype | None = None
    """Store weights in this precision; by default the stored one."""
    height: int = 512
    """Height of its images in pixels."""
    width: int = 512
    """Width of its images in pixels."""


@dataclasses.dataclass(frozen=True)
class ImportCosmos2:
    """Import a checkpoint of Cosmos-Predict2 for video as a world model controlled by actions.

    The result is a folder that `pewm_jax.load` reads and that can be trained by its name (`pewm-jax
    train DST`), with the settings of the preset egowm_cosmos2b. Before training, actions have no
    effect.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The pipeline's folder, or its name on a hub: transformer/, vae/, scheduler/ and, if a prompt
    is to be encoded, text_encoder/ and tokenizer/."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    dtype: Dtype | None = None
    """Store weights in this precision; by default the stored one."""
    prompt: str = ""
    """Prompt to encode and store; by default the empty one."""
    negative: str = ""
    """Negative prompt for guidance, if `noise.guidance` is above 1; the reference pipeline has a
    long one, which describes bad videos."""
    frames: int = 17
    """Frames of a clip, including the observed one: 4k + 1."""
    height: int = 480
    """Height of its images in pixels."""
    width: int = 640
    """Width of its images in pixels."""


@dataclasses.dataclass(frozen=True)
class ImportLoRA:
    """Import LoRA adapters that peft or diffusers wrote, for CogVideoX, SVD or Cosmos-Predict2.

    The result is a folder of adapters that refers to its base: `pewm_jax.load` reads it, `pewm-jax
    convert merge` writes it as plain weights, and `train.start` accepts it. If the base is a folder
    of `import cogvideox` without --rgbd --camera, the result is a copy of it with merged weights.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The file of the adapters, or a folder with pytorch_lora_weights.safetensors or
    adapter_model.safetensors."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    base: Path
    """Folder of the weights that they adapt, made by `pewm-jax convert import`."""


@dataclasses.dataclass(frozen=True)
class Merge:
    """Merge the adapters of a run into the weights that they adapt.

    The result is a plain folder, with the same predictions, which `pewm_jax.load` reads and
    `train.start` accepts.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The run's folder, or a folder made by `pewm-jax convert import lora`."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""


@dataclasses.dataclass(frozen=True)
class ExportDiffusers:
    """Write a folder for the from_pretrained of diffusers.

    For a world model only the video model is written, without memory blocks and the channels of
    depth and camera. Text encoder and tokenizer are copied from the original pipeline, or
    omitted.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """An imported folder, a widened one, or a training run that started from one."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    dtype: Dtype | None = None
    """Store weights in this precision; by default the stored one."""
    base: Path | None = None
    """Folder with base.json; by default SRC, or the folder that the training started from."""
    original: Path | None = None
    """The original pipeline's folder: its text_encoder/ and tokenizer/ are copied, so that the
    whole pipeline loads. Without them it loads with text_encoder=None, tokenizer=None."""


@dataclasses.dataclass(frozen=True)
class ExportInference:
    """Export a training run for inference: averaged weights in 16 bits, settings, a model card.

    The folder is read by `pewm_jax.load`; the card states what it is, its training data and
    steps, and the licence of the weights that the training started from.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """A run's folder, made by train.py."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    dtype: Literal["bfloat16", "float16", "int8"] = "bfloat16"
    """Precision of the weights: float16 has smaller rounding errors, bfloat16 a larger range. int8
    is for small files: kernels in 8 bits, with one scale for each output channel, and those of
    codecs and encoders in float16, as all other weights."""


@dataclasses.dataclass(frozen=True)
class ExportStableHLO:
    """Export the world model as programs that need jax and NumPy but not this library.

    The programs are verified in a fresh process.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """A run's folder with `weights.safetensors`, or a folder of `export inference`."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create."""
    what: Literal["rollout", "denoise"] = "rollout"
    """`rollout`: start a world and imagine clips; `denoise`: one step of the denoiser."""
    clips: int = 1
    """Number of clips imagined per call of the rollout."""
    frames: int | None = None
    """Number of observed frames from which a world starts; by default data.context."""
    platforms: tuple[str, ...] = stablehlo.PLATFORMS
    """Platforms for which the programs are lowered."""
    check: bool = True
    """Run the programs on the CPU afterwards and compare; for a large model this takes long."""
