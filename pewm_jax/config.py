"""Every setting of the library: frozen dataclasses, validated when built, to and from JSON.

A field's docstring is its ``--help`` text. A value that cannot work is refused when the
configuration is built, with a sentence that names the fix; nothing is checked deeper down.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

T = TypeVar("T")
SMALLEST = 12
"""Fewest pixels of a clip's side: the evaluation's SSIM slides a window of 11 over the image."""


class UserError(ValueError):
    """Bad input from a user, in one sentence: what is wrong, where, and what to do."""


class ConfigError(UserError):
    """A setting that cannot work; the message says what is wrong, where, and what to do."""


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise ConfigError(sentence)


def _require_positive(section: Any, where: str, *names: str) -> None:
    """Refuse sizes and counts below 1, each by its own name."""
    for name in names:
        value = getattr(section, name)
        _require(value >= 1, f"{where}.{name} is {value}: use at least 1.")


@dataclasses.dataclass(frozen=True)
class ClipConfig:
    """The shape of what is imagined at once."""

    frames: int = 9
    """Frames of a clip: the first is observed, the rest are generated. Must be 4k + 1."""
    height: int = 64
    """Image height in pixels."""
    width: int = 64
    """Image width in pixels."""
    near_m: float = 0.1
    """Depth that maps to −1, metres; nearer depths are clipped."""
    far_m: float = 12.0
    """Depth that maps to +1, metres; farther depths are clipped."""
    depth_scale: Literal["linear", "log"] = "log"
    """How metres map to [−1, 1] between near and far."""

    def __post_init__(self):
        """Validate."""
        _require(
            self.frames >= 5 and self.frames % 4 == 1,
            f"clip.frames is {self.frames}: a clip has 4k + 1 frames (5, 9, 13, …) because the "
            "codec folds every 4 frames after the first into one; use 9.",
        )
        _require(
            0 < self.near_m < self.far_m,
            f"clip.near_m {self.near_m} and clip.far_m {self.far_m}: near must be above 0 and "
            "below far.",
        )
        _require(
            min(self.height, self.width) >= SMALLEST,
            f"clip.height {self.height} and clip.width {self.width} must be at least {SMALLEST} "
            "pixels: the structural similarity of the evaluation looks through a window of 11; "
            "use 16 or more.",
        )


@dataclasses.dataclass(frozen=True)
class ActionConfig:
    """What one discrete action does to the agent."""

    step_m: float = 0.25
    """Length of one forward step, metres."""
    turn_deg: float = 30.0
    """Angle of one turn, degrees."""

    def __post_init__(self):
        """Validate."""
        _require(self.step_m > 0, f"actions.step_m is {self.step_m}: it must be above 0 metres.")
        _require(
            0 < self.turn_deg <= 180,
            f"actions.turn_deg is {self.turn_deg}: use an angle above 0 and up to 180 degrees.",
        )


@dataclasses.dataclass(frozen=True)
class CodecConfig:
    """How pixels become latents and back."""

    kind: Literal["pixel"] = "pixel"
    """`pixel`: space-to-depth and temporal fold, no parameters, exactly invertible."""
    spatial: int = 4
    """Pixels per latent cell, each way."""
    temporal: int = 4
    """Frames per latent frame after the first."""

    def __post_init__(self):
        """Validate."""
        _require_positive(self, "codec", "spatial", "temporal")


@dataclasses.dataclass(frozen=True)
class DiTConfig:
    """The diffusion transformer in CogVideoX's form."""

    layers: int = 4
    """Transformer blocks."""
    heads: int = 6
    """Attention heads."""
    head_dim: int = 32
    """Width of a head; a multiple of 16 (the rotary embedding splits it 1/4, 3/8, 3/8)."""
    patch: int = 2
    """Latent cells per token, each way."""
    text_length: int = 4
    """Text tokens; with no prompt they are zeros, so that the text path learns a constant."""
    text_dim: int = 32
    """Channels of a text token."""
    time_dim: int = 192
    """Width of the time embedding."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""
    remat: bool = False
    """Recompute activations in the backward pass: less memory, about a third more time."""

    @property
    def width(self) -> int:
        """Model width D."""
        return self.heads * self.head_dim

    def __post_init__(self):
        """Validate."""
        _require_positive(self, "dit", "layers", "heads", "head_dim", "patch")
        _require_positive(self, "dit", "text_length", "text_dim", "time_dim", "mlp_ratio")
        _require(
            self.head_dim % 16 == 0,
            f"dit.head_dim is {self.head_dim}: use a multiple of 16 (16, 32, 48, 64), the rotary "
            "embedding splits a head into time, height and width parts.",
        )


@dataclasses.dataclass(frozen=True)
class MemoryConfig:
    """What is remembered, and how the denoiser reads it."""

    cell_m: tuple[float, float, float] = (0.25, 0.25, 0.25)
    """Size of a map cell along x, y, z (z is up), metres. The paper: 0.25 0.25 1.0."""
    cells: tuple[int, int, int] = (128, 128, 16)
    """Cells of the grid along x, y, z; the extent in metres is cells × cell size."""
    capacity: int = 4096
    """Occupied cells a map can hold; what does not fit is counted."""
    tokens: int = 512
    """Occupied cells that condition one clip, in view and nearest first."""
    looks: int = 128
    """Of these, how many each frame's camera looks at with projective positions."""
    positions: Literal["projective", "sinusoid"] = "projective"
    """How attention knows where a cell is: `projective` (seen through each frame's camera) or
    `sinusoid` (the paper: 3D sinusoid of the position in the first frame's camera)."""
    encoder: Literal["patch_colours"] = "patch_colours"
    """Image features kept in the map; `patch_colours` has no weights."""
    encoder_patch: int = 2
    """Pixels per feature patch, each way."""
    heads: int = 6
    """Heads of the memory attention."""
    head_dim: int = 32
    """Width of a memory head; a multiple of 8."""
    mlp_ratio: int = 4
    """Feed-forward width over model width in the memory blocks."""

    def __post_init__(self):
        """Validate."""
        _require(all(size > 0 for size in self.cell_m), "memory.cell_m must be positive.")
        _require(all(count > 0 for count in self.cells), "memory.cells must be positive.")
        _require_positive(self, "memory", "capacity", "tokens", "looks", "encoder_patch")
        _require_positive(self, "memory", "heads", "head_dim", "mlp_ratio")
        _require(
            self.tokens <= self.capacity,
            f"memory.tokens {self.tokens} exceeds memory.capacity {self.capacity}: a clip cannot "
            "attend to more cells than the map holds; raise capacity or lower tokens.",
        )
        _require(
            self.head_dim % 8 == 0,
            f"memory.head_dim is {self.head_dim}: use a multiple of 8, the projective rotary "
            "embedding splits a head in two times two halves.",
        )


@dataclasses.dataclass(frozen=True)
class DiffusionConfig:
    """The noise schedule, the prediction target and the sampler."""

    train_steps: int = 1000
    """Noise levels of the schedule."""
    beta_start: float = 0.00085
    """First β of the scaled-linear schedule."""
    beta_end: float = 0.012
    """Last β of the scaled-linear schedule."""
    snr_shift: float = 1.0
    """CogVideoX's SNR shift s: ᾱ → ᾱ / (s + (1 − s) ᾱ). 3 for its 2B model, 1 for 5B."""
    zero_terminal_snr: bool = True
    """Rescale the schedule so that the last step is pure noise."""
    target: Literal["x0", "v", "eps"] = "x0"
    """What the network predicts. x0 for the pixel codec, v for VAE latents."""
    max_weight: float = 5.0
    """Upper bound of the loss weight 1 / (1 − ᾱ) on the squared error of x0 (= MSE in v)."""
    sample_steps: int = 10
    """DDIM steps."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory: 1 = off, above 1 pushes away from 'no memory'."""
    image_noise_mean: float = -3.0
    """Mean of log σ of the noise put on the observed first frame in training."""
    image_noise_std: float = 0.5
    """Spread of log σ of the noise put on the observed first frame in training."""

    def __post_init__(self):
        """Validate."""
        _require(
            0 < self.beta_start < self.beta_end < 1,
            "diffusion.beta_start and beta_end need 0 < start < end < 1.",
        )
        _require(
            1 <= self.sample_steps <= self.train_steps,
            f"diffusion.sample_steps is {self.sample_steps}: use 1 to {self.train_steps} "
            "(diffusion.train_steps).",
        )
        _require(
            self.train_steps >= 2,
            f"diffusion.train_steps is {self.train_steps}: a schedule needs at least 2 noise "
            "levels; use 1000.",
        )
        _require(self.snr_shift > 0, "diffusion.snr_shift must be above 0.")
        _require(self.max_weight > 0, "diffusion.max_weight must be above 0.")
        _require(self.image_noise_std >= 0, "diffusion.image_noise_std must be at least 0.")
        _require(
            not (self.target == "eps" and self.zero_terminal_snr),
            "diffusion.target eps cannot be used with zero_terminal_snr: at the last step the "
            "input is pure noise and x0 cannot be recovered from ε; use v or x0, or switch "
            "zero_terminal_snr off.",
        )


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """What training reads."""

    path: str = "data/demo"
    """Folder made by `python -m pewm_jax.data collect` or `import` (with train/ inside)."""
    stride_min: int = 1
    """Smallest number of actions between two frames of a clip."""
    stride_max: int = 3
    """Largest number of actions between two frames of a clip."""
    context: int = 24
    """Earlier frames of the same episode given to the memory."""
    workers: int = 0
    """Threads that read and decode ahead of training; 0 means one."""

    def __post_init__(self):
        """Validate."""
        _require(
            1 <= self.stride_min <= self.stride_max,
            f"data.stride_min {self.stride_min} and data.stride_max {self.stride_max}: need "
            "1 ≤ min ≤ max.",
        )
        _require(self.context >= 1, "data.context must be at least 1 frame.")
        _require(self.workers >= 0, f"data.workers is {self.workers}: use 0 or more threads.")


@dataclasses.dataclass(frozen=True)
class StageConfig:
    """One stage of training."""

    steps: int = 500
    """Optimizer steps."""
    batch: int = 16
    """Clips per step."""
    learning_rate: float = 1e-3
    """Peak learning rate of Adam."""
    warmup: int = 50
    """Steps of linear warm-up."""
    decay: Literal["constant", "cosine"] = "cosine"
    """What the learning rate does after the warm-up."""

    def __post_init__(self):
        """Validate."""
        _require(self.steps >= 0 and self.batch >= 1, "steps ≥ 0 and batch ≥ 1 are needed.")
        _require(self.learning_rate > 0, "learning_rate must be above 0.")
        _require(self.warmup >= 0, f"warmup is {self.warmup}: use 0 (none) or more steps.")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How the model learns: two stages, as the paper trains."""

    run: str = "runs/demo"
    """Folder of this run: checkpoints, logs, pictures, report."""
    stage1: StageConfig = StageConfig()
    """The backbone learns without memory: domain, camera control, RGB-D."""
    stage2: StageConfig = StageConfig()
    """Only the memory blocks learn; all else stays bit-identical."""
    weight_decay: float = 0.0
    """Decoupled weight decay on matrices."""
    clip_norm: float = 1.0
    """Gradient norm above which gradients are scaled down."""
    ema: float = 0.995
    """Decay of the exponential moving average that inference uses."""
    seed: int = 0
    """Seed of weights, noise and data order."""
    save_every: int = 100
    """Steps between checkpoints."""
    keep: int = 2
    """Checkpoints kept."""
    log_every: int = 10
    """Steps between log lines."""
    preview_every: int = 250
    """Steps between sample pictures; 0 for none."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute precision; master weights stay float32."""

    def __post_init__(self):
        """Validate."""
        _require(0 <= self.ema < 1, f"train.ema is {self.ema}: use a decay in [0, 1).")
        _require(self.clip_norm > 0, "train.clip_norm must be above 0.")
        _require(
            min(self.save_every, self.log_every, self.keep) >= 1,
            "train.save_every, train.log_every and train.keep must be at least 1.",
        )
        _require(self.seed >= 0, f"train.seed is {self.seed}: use 0 or a positive number.")
        _require(
            self.weight_decay >= 0, f"train.weight_decay is {self.weight_decay}: use 0 or more."
        )
        _require(
            self.preview_every >= 0,
            f"train.preview_every is {self.preview_every}: use 0 (no pictures) or more steps.",
        )
        _require(
            self.stage1.steps > 0 or self.stage2.steps == 0,
            f"train.stage1.steps is 0 and train.stage2.steps is {self.stage2.steps}: stage 2 "
            "freezes the backbone, whose output starts at zero, so nothing would be learnt; give "
            "train.stage1.steps at least 1.",
        )


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """What is measured on held-out scenes."""

    split: str = "revisit"
    """Folder inside data.path with the held-out revisit episodes."""
    clips: int = 48
    """Clips scored per seed."""
    chain: int = 1
    """Clips generated one after the other from one start in what the table scores."""
    stride: int = 1
    """Recorded actions between two frames of a scored clip."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the sampling noise."""
    videos: int = 4
    """Long rollouts shown side by side in the report."""
    video_clips: int = 4
    """Clips generated one after the other in a long rollout (long rollouts show drift)."""
    batch: int = 16
    """Clips sampled at once."""

    def __post_init__(self):
        """Validate."""
        _require(len(self.seeds) >= 1, "evaluate.seeds needs at least one seed.")
        _require(min(self.seeds) >= 0, "evaluate.seeds must be 0 or positive numbers.")
        _require(
            min(self.clips, self.chain, self.stride, self.videos, self.video_clips, self.batch)
            >= 1,
            "evaluate.clips, chain, stride, videos, video_clips and batch must be at least 1.",
        )


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
        _require(
            self.clip.height % step == 0 and self.clip.width % step == 0,
            f"clip {self.clip.height}×{self.clip.width}: height and width must be multiples of "
            f"codec.spatial × dit.patch = {step}; change the clip's size or the patch.",
        )
        _require(
            (self.clip.frames - 1) % self.codec.temporal == 0,
            f"clip.frames {self.clip.frames} − 1 is not a multiple of codec.temporal "
            f"{self.codec.temporal}.",
        )
        per_latent = self.codec.temporal
        _require(
            self.memory.positions == "sinusoid" or self.memory.heads >= per_latent,
            f"memory.heads is {self.memory.heads}: with projective positions head k looks through "
            f"camera k mod {per_latent} (codec.temporal) of a latent frame; use at least "
            f"{per_latent} heads, or memory.positions sinusoid.",
        )
        patch = self.memory.encoder_patch
        _require(
            self.clip.height % patch == 0 and self.clip.width % patch == 0,
            f"memory.encoder_patch {patch} does not divide the clip "
            f"{self.clip.height}×{self.clip.width}.",
        )


def to_dict(config: Any) -> dict[str, Any]:
    """Turn a configuration into plain dictionaries, lists, numbers and strings."""
    return dataclasses.asdict(config)


def from_dict(kind: type[T], values: dict[str, Any], where: str = "config") -> T:
    """Build a configuration dataclass from plain dictionaries, strictly.

    Args:
        kind: the dataclass to build, e.g. ``Config``.
        values: nested plain values; absent fields take their defaults.
        where: name of this place in error messages.

    Raises:
        ConfigError: a key that does not exist, a value of the wrong type, or one that is refused.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} must be a table of settings, got {type(values).__name__}.")
    fields = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - fields)
    if unknown:
        raise ConfigError(
            f"{where} has no setting {', '.join(unknown)}; it has {', '.join(sorted(fields))}."
        )
    hints = typing.get_type_hints(kind)
    return kind(**{k: _coerce(hints[k], v, f"{where}.{k}") for k, v in values.items()})


def _coerce(hint: Any, value: Any, where: str) -> Any:
    """Check one plain value against a type hint; lists become tuples."""
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast("type", hint), value, where)
    args = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        return _coerce_tuple(args, value, where)
    if typing.get_origin(hint) is Literal:
        choices = ", ".join(map(repr, args))
        _require(value in args, f"{where} is {value!r}; choose one of {choices}.")
        return value
    number = isinstance(value, int) and not isinstance(value, bool)
    if hint is float and number:
        return float(value)
    fits = number if hint is int else isinstance(value, hint)
    _require(fits, f"{where} must be {hint.__name__}, got {value!r}.")
    return value


def _coerce_tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """Check a list against the element types of a tuple."""
    _require(isinstance(value, (list, tuple)), f"{where} must be a list, got {value!r}.")
    inner = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
    _require(len(inner) == len(value), f"{where} needs {len(inner)} values, got {len(value)}.")
    return tuple(_coerce(h, v, where) for h, v in zip(inner, value, strict=True))


def save(config: Any, path: Path) -> None:
    """Write a configuration as JSON, aside and then renamed."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(to_dict(config), indent=2) + "\n")
    partial.replace(path)


def load(path: Path, kind: type[T] = Config) -> T:
    """Read a configuration from JSON.

    Raises:
        ConfigError: the file is absent or unreadable, is not JSON, or holds settings that do not
            fit.
    """
    try:
        values = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(
            f"{path} does not exist: is this a run folder made by train.py?"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}); allow reading it.") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid JSON ({error}); restore it.") from None
    return from_dict(kind, values, path.name)
