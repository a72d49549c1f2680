"""The task that trains the policy NoMaD, by imitation of recorded walks.

A clip has the earlier images, the present one and those of as many later steps as a goal may be
away. The waypoints are the positions after the next steps. The goal is the image some steps later
or, in one of that many cases, an image of another clip of the batch, whose distance counts as the
largest and whose waypoints do not count (Sridhar et al. 2023, as in ``visualnav-transformer``).
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import (
    ActionConfig,
    BatchSpec,
    ClipConfig,
    StageConfig,
    Task,
    TrainSettings,
    register,
)
from pewm_jax.diffusion import squared_cosine
from pewm_jax.errors import require, require_fields
from pewm_jax.geometry import actions, cameras
from pewm_jax.models.nomad import model as nomad
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds.stages import TRAIN, Stage

SMALL = 1e-2
"""Added to the shares by which losses are divided, as in the reference."""


@dataclasses.dataclass(frozen=True)
class NomadTrainConfig(TrainSettings):
    """Training of the policy by imitation of recorded walks."""

    ZERO: ClassVar[dict[str, str]] = {
        "preview_every": "a policy imagines nothing",
        "denoised_lpips": "it is for models that imagine",
    }

    run: str = "runs/nomad"
    """Folder of this run: checkpoints, logs, numbers."""
    preview_every: int = 0
    """Steps between sample images; must be 0, because a policy imagines none."""
    policy: StageConfig = StageConfig(steps=2000, batch=32, learning_rate=1e-4)
    """The policy is trained to imitate the recorded walks."""
    goal_hidden: float = 0.5
    """Share of clips whose goal is hidden, so that the policy also explores without one."""
    distance_weight: float = 1e-4
    """Weight of the squared error of the distance, in steps; 1 minus it is that of the noise."""
    nearest: int = 3
    """Goals up to this many steps away train only the distance: the walk went past them."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        clips = self.policy.batch // self.policy.micro_batches
        name = "train.policy.batch" if self.policy.micro_batches == 1 else "A micro-batch"
        require(
            clips >= 2,
            f"{name} is {clips}: a goal that cannot be reached is taken from another clip of the "
            "batch, use 2 or more.",
        )
        names = ("goal_hidden", "distance_weight")
        require_fields(self, "train", lambda value: 0 <= value <= 1, "a share in [0, 1]", *names)
        require(self.nearest >= 0, f"train.nearest is {self.nearest}: use 0 or more steps.")


@register("world", "nomad")
@dataclasses.dataclass(frozen=True)
class NomadTask(Task):
    """A policy by itself: a training task, by imitation of recorded walks."""

    TRAIN: ClassVar[type[TrainSettings]] = NomadTrainConfig
    EXPORTED: ClassVar[bool] = False
    INSTEAD: ClassVar[str] = (
        "trained a policy, which imagines nothing: have it propose ways by "
        "pewm_jax.planning.nomad_policy, and imagine them with a world model"
    )

    clip: ClipConfig = ClipConfig(frames=24)
    """Shape of the loaded clips: earlier images, the present one, and as many later ones as a goal
    may be away."""
    actions: ActionConfig = ActionConfig()
    """Effect of an action in the walks."""
    policy: NomadConfig = NomadConfig()
    """The policy that is trained."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute precision; master weights stay float32."""

    @property
    def batch_spec(self) -> BatchSpec:
        """The clip's frames and their poses."""
        return BatchSpec(context=False, depth=False)

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

    def init(self, key: Array) -> Params:
        """Return random parameters, under ``policy``."""
        return {"policy": nomad.init(self.policy, key)}

    def waypoints(self, clip: Clip) -> Array:
        """Return (B, N, 2): the positions after the next N steps, metres forward and left."""
        now, count = self.policy.context, self.policy.waypoints
        pose = jnp.asarray(clip.frames.camera.world_from_camera)
        here = pose[:, now]
        away = pose[:, now + 1 : now + 1 + count, :3, 3] - here[:, None, :3, 3]
        turned = cameras.einsum("bji,bnj->bni", actions.rotation_z(actions.heading(here)), away)
        return turned[..., :2]

    def imitate(
        self, train: TrainSettings, params: Params, clip: Clip, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the loss: squared error of the noise and, with a small weight, of the distance.

        The noise counts where the goal is of the same walk, farther than ``train.nearest`` and
        nearer than the farthest; the distance where the goal is not hidden. (The reference averages
        the error of the distance over hidden goals too.)

        Returns:
            ``(loss, measured)``: ``noise``, the mean squared error, and ``steps_off``, the root
            mean square error of the distance.
        """
        assert isinstance(train, NomadTrainConfig)
        policy, weights = self.policy, params["policy"]
        rgb = as_signal(clip.frames).rgb_THWC
        batch, now, farthest = len(rgb), self.policy.context, self.farthest
        keys = jax.random.split(key, 5)
        far = jax.random.randint(keys[0], (batch,), 0, farthest + 1)  # 0: of another clip
        any_frame = jax.random.randint(keys[1], (batch,), 0, rgb.shape[1])
        other = far == 0
        picked = _frame(rgb, jnp.where(other, any_frame, now + far))
        negative_goal = jnp.roll(_frame(rgb, any_frame), 1, 0)
        goal = jnp.where(other[:, None, None, None], negative_goal, picked)
        steps = jnp.where(other, farthest, far).astype(jnp.float32)
        hidden = jax.random.bernoulli(keys[2], train.goal_hidden, (batch,))

        seen = rgb[:, : now + 1]
        seen = nomad.preprocess(policy, seen.reshape(-1, *seen.shape[2:])).astype(self.dtype)
        seen = seen.reshape(batch, now + 1, *seen.shape[1:])
        goal = nomad.preprocess(policy, goal).astype(self.dtype)
        condition = nomad.encode(policy, weights, seen, goal, hidden)

        clean = nomad.normalise(policy, self.waypoints(clip))
        noise = jax.random.normal(keys[3], clean.shape)
        time = jax.random.randint(keys[4], (batch,), 0, policy.noise_steps)
        noisy = squared_cosine.corrupt(policy.noise_steps, clean, noise, time)
        made = nomad.denoise(policy, weights, noisy.astype(self.dtype), time, condition)
        follows = (~other & (far > train.nearest) & (far < farthest)).astype(jnp.float32)
        error = jnp.square(made.astype(jnp.float32) - noise).mean((1, 2))
        error = (error * follows).mean() / (follows.mean() + SMALL)

        shown = 1 - hidden.astype(jnp.float32)
        off = nomad.distance(policy, weights, condition).astype(jnp.float32) - steps
        off = (jnp.square(off) * shown).mean() / (shown.mean() + SMALL)
        share = train.distance_weight
        return (1 - share) * error + share * off, {"noise": error, "steps_off": jnp.sqrt(off)}

    def stages(self) -> tuple[Stage, ...]:
        """Return the one stage."""
        return (Stage("policy", 1, ((r"policy/.*", TRAIN),), NomadTask.init, NomadTask.imitate),)


def _frame(rgb_BTHWC: Array, number_B: Array) -> Array:
    """Return one frame of each clip."""
    return jnp.take_along_axis(rgb_BTHWC, number_B[:, None, None, None, None], 1)[:, 0]
