"""NoMaD, a policy that proposes waypoints: its network, and the world in which it is trained."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from pewm_jax.config.clip import ActionConfig, ClipConfig
from pewm_jax.config.training import StageConfig, TrainSettings
from pewm_jax.config.world import BatchSpec, Task
from pewm_jax.errors import require, require_positive

PLANE = 2
"""Numbers of a waypoint: metres forward and metres left of the present place."""


@dataclasses.dataclass(frozen=True)
class NomadConfig:
    """The network; by default as published (Sridhar et al. 2023, arXiv 2310.07896)."""

    height: int = 96
    """Height of the pictures it sees, pixels; others are resized."""
    width: int = 96
    """Width of the pictures it sees, pixels."""
    context: int = 3
    """Earlier pictures that it sees beside the present one."""
    trunk_width: float = 1.0
    """Channels of the two EfficientNets, as a multiple of B0's."""
    trunk_depth: float = 1.0
    """Blocks of the two EfficientNets, as a multiple of B0's."""
    trunk_stages: int = 7
    """Stages of blocks of the two EfficientNets; B0 has seven."""
    dim: int = 256
    """Width of the tokens and of the condition."""
    layers: int = 4
    """Transformer layers over the pictures' tokens."""
    heads: int = 4
    """Attention heads."""
    waypoints: int = 8
    """Waypoints of a proposal."""
    channels: tuple[int, ...] = (64, 128, 256)
    """Channels of the denoiser at each resolution; each has half as many points as the one
    before."""
    time_dim: int = 256
    """Width of the embedding of the noise level."""
    kernel: int = 3
    """Waypoints under a kernel of the denoiser."""
    groups: int = 8
    """Groups of the denoiser's norms."""
    noise_steps: int = 10
    """Noise levels, in training and in sampling."""
    spacing_m: float = 0.25
    """Metres that count as 1 in a step between waypoints."""
    lowest: tuple[float, float] = (-2.5, -4.0)
    """Step forward and left, in spacings, that maps to −1."""
    highest: tuple[float, float] = (5.0, 4.0)
    """Step forward and left, in spacings, that maps to +1; no longer ones are proposed."""

    def __post_init__(self):
        """Validate."""
        sizes = ("height", "width", "context", "trunk_stages", "dim", "layers", "heads")
        more = ("waypoints", "time_dim", "kernel", "groups", "noise_steps")
        require_positive(self, "policy", *sizes, *more)
        for name in ("trunk_width", "trunk_depth", "spacing_m"):
            value = getattr(self, name)
            require(value > 0, f"policy.{name} is {value}: use more than 0.")
        require(
            self.trunk_stages <= 7,
            f"policy.trunk_stages is {self.trunk_stages}: an EfficientNet has 7 stages.",
        )
        require(
            self.dim % (2 * self.heads) == 0 and self.dim >= 16,
            f"policy.dim is {self.dim}: use a multiple of twice policy.heads ({self.heads}), from "
            "16 on.",
        )
        require(
            self.time_dim % 2 == 0 and self.time_dim >= 4,
            f"policy.time_dim is {self.time_dim}: use an even number from 4 on.",
        )
        require(self.kernel % 2 == 1, f"policy.kernel is {self.kernel}: use an odd number.")
        require(
            len(self.channels) >= 1
            and all(n > 0 and n % self.groups == 0 for n in self.channels)
            and self.waypoints % 2 ** (len(self.channels) - 1) == 0,
            f"policy.channels is {self.channels}: use multiples of policy.groups ({self.groups}), "
            f"and so few that policy.waypoints ({self.waypoints}) can be halved for each but one.",
        )
        require(
            all(low < high for low, high in zip(self.lowest, self.highest, strict=True)),
            f"policy.lowest {self.lowest} and policy.highest {self.highest}: the first must be "
            "below the second.",
        )


@dataclasses.dataclass(frozen=True)
class NomadTrainConfig(TrainSettings):
    """How the policy learns: by imitation of recorded walks."""

    run: str = "runs/nomad"
    """Folder of this run: checkpoints, logs, numbers."""
    preview_every: int = 0
    """Steps between sample pictures; 0, since a policy imagines none."""
    policy: StageConfig = StageConfig(steps=2000, batch=32, learning_rate=1e-4)
    """The policy learns to walk as the recorded walks do."""
    goal_hidden: float = 0.5
    """Share of clips whose goal is hidden, so that the policy also explores without one."""
    distance_weight: float = 1e-4
    """Weight of the squared error of the distance, in steps; that of the noise is the rest to
    1."""
    nearest: int = 3
    """A goal this near, or nearer, in steps, teaches its distance alone: the walk went past it."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.preview_every == 0,
            f"train.preview_every is {self.preview_every}: a policy imagines nothing to be shown, "
            "use 0.",
        )
        require(
            self.policy.batch >= 2,
            "train.policy.batch is 1: a goal that cannot be reached is taken from another clip of "
            "the batch, use 2 or more.",
        )
        for name in ("goal_hidden", "distance_weight"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"train.{name} is {value}: use a share in [0, 1].")
        require(self.nearest >= 0, f"train.nearest is {self.nearest}: use 0 or more steps.")


@dataclasses.dataclass(frozen=True)
class NomadWorldConfig(Task):
    """A policy by itself: a training task, by imitation of recorded walks."""

    TRAIN: ClassVar[type[TrainSettings]] = NomadTrainConfig
    EXPORTED: ClassVar[bool] = False
    INSTEAD: ClassVar[str] = (
        "trained a policy, which imagines nothing: have it propose ways by "
        "pewm_jax.planning.nomad_policy, and imagine them with a world model"
    )

    clip: ClipConfig = ClipConfig(frames=24)
    """What the loader reads: earlier pictures, the present one, and as many later ones as a goal
    may be away."""
    actions: ActionConfig = ActionConfig()
    """Effect of an action in the walks."""
    policy: NomadConfig = NomadConfig()
    """The policy that is trained."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute precision; master weights stay float32."""

    @property
    def batch_spec(self) -> BatchSpec:
        """The clip's frames alone."""
        return BatchSpec(context=False)

    @property
    def farthest(self) -> int:
        """Steps to the farthest goal."""
        return self.clip.frames - self.policy.context - 1

    def __post_init__(self):
        """Validate."""
        require(
            self.farthest >= self.policy.waypoints,
            f"clip.frames is {self.clip.frames}: {self.policy.context} earlier pictures, the "
            f"present one and {self.policy.waypoints} waypoints need "
            f"{self.policy.context + 1 + self.policy.waypoints}, and goals farther away need more.",
        )
