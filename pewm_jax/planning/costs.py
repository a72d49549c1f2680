"""Costs: the distance of frames from the goal; lower is better.

A cost is any function ``cost(frames, goal) -> costs_K`` of (K, N) frames and the goal, one frame.
The costs here compare the last frame, or all frames with ``weights``::

    cost = costs.perceptual()                          # LPIPS, as the paper's
    cost = costs.with_depth(costs.Pixels(), weight=0.1)
    cost = costs.Features(config.model, params)        # features of the memory's encoder
    cost = costs.Distance(my_distance)                 # ground truth of the last pose: an oracle

Images with NaN have a NaN cost, for which ``plan.plan`` raises an error.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import AssembledModel, Encoder, UserError
from pewm_jax.errors import require
from pewm_jax.geometry.actions import heading
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.models.lpips.model import Net
from pewm_jax.types import Array, Frames, Params

FrameCost: TypeAlias = Callable[[Frames, Frames], Any]
"""``cost(frames, goal) -> costs_K`` of (K, N) frames and a goal of one frame."""
AT_ONCE = 2**18
"""Pixels in one batch of a network, or one image if it has more."""


@dataclasses.dataclass(frozen=True)
class PictureCost:
    """A cost of single images, computed for the last frame or for all.

    ``weights`` are those of each of the N frames in the mean, or None for the last frame only.
    """

    weights: tuple[float, ...] | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self):
        """Validate."""
        weights = self.weights
        require(
            weights is None or (min(weights, default=-1) >= 0 and sum(weights) > 0),
            f"the weights of a cost are {weights}: give one number per frame, not negative and "
            "not all 0.",
        )

    def __call__(self, frames: Frames, goal: Frames) -> Array:
        """Return (K,) costs; frames and goal have one size, and each frame has a weight."""
        frames, goal = as_signal(frames), as_signal(goal)
        count = _require_alike(frames, goal)
        if self.weights is not None and len(self.weights) != count:
            raise UserError(
                f"a cost has {len(self.weights)} weights and there are {count} frames: give one "
                "weight for each frame of a plan, and a rollout that returns all (last=False)."
            )
        weights = np.asarray(self.weights or (0,) * (count - 1) + (1,), np.float32)
        seen = np.flatnonzero(weights)
        chosen = jax.tree.map(lambda x: jnp.asarray(x)[:, seen], frames)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), chosen)
        each = self.pictures(flat, goal).reshape(-1, len(seen))
        return each @ (weights[seen] / weights.sum())

    def pictures(self, frames: Frames, goal: Frames) -> Array:
        """Return the cost of each of P frames, (P,)."""
        raise NotImplementedError


def _require_alike(frames: Frames, goal: Frames) -> int:
    """Return N; raise an error if frames and goal have different sizes."""
    shape, wanted = frames.rgb_THWC.shape, goal.rgb_THWC.shape
    if len(shape) != 5 or len(wanted) != 4 or wanted[0] != 1 or shape[2:] != wanted[1:]:
        raise UserError(
            f"frames of shape {shape} cannot be compared with a goal of shape {wanted}: give "
            "(K, N, H, W, 3) and (1, H, W, 3), of one size."
        )
    return shape[1]


@dataclasses.dataclass(frozen=True)
class Pixels(PictureCost):
    """Mean squared difference of colours in [0, 1]."""

    def pictures(self, frames: Frames, goal: Frames) -> Array:
        """See ``PictureCost``."""
        return jnp.square((frames.rgb_THWC - goal.rgb_THWC) / 2).mean((1, 2, 3))


@dataclasses.dataclass(frozen=True)
class Depth(PictureCost):
    """Mean |log d − log d_goal| where both have a depth, NaN where no pixel has."""

    def pictures(self, frames: Frames, goal: Frames) -> Array:
        """See ``PictureCost``."""
        a, b = jnp.broadcast_arrays(jnp.asarray(frames.depth_THW), jnp.asarray(goal.depth_THW))
        both = (a > 0) & (b > 0)
        apart = jnp.abs(jnp.log(jnp.where(both, a, 1)) - jnp.log(jnp.where(both, b, 1)))
        apart = jnp.where(jnp.isnan(a), jnp.nan, apart).sum((1, 2))
        return apart / both.sum((1, 2))


@dataclasses.dataclass(frozen=True, eq=False)
class Perceptual(PictureCost):
    """LPIPS distance to the goal; ``perceptual`` loads its weights."""

    net: Net
    params: Params = dataclasses.field(repr=False)

    def pictures(self, frames: Frames, goal: Frames) -> Array:
        """See ``PictureCost``."""
        lpips.require_size(self.net, *goal.rgb_THWC.shape[1:3])
        return _lpips(self.net, self.params, frames.rgb_THWC, goal.rgb_THWC)


def perceptual(
    path: str | Path | None = None, net: Net = "alex", weights: tuple[float, ...] | None = None
) -> Perceptual:
    """Return LPIPS as a cost, with weights from a file (``models.lpips.convert``) or the package's.

    ``weights``: see ``PictureCost``.

    Raises:
        UserError: there are no weights, or they are damaged or of another network.
    """
    _, params = lpips_weights.read(lpips_weights.find(net, path), net)
    return Perceptual(net, jax.device_put(params), weights=weights)


@functools.partial(jax.jit, static_argnums=0)
def _lpips(net: Net, params: Params, rgb_PHWC: Array, goal_1HWC: Array) -> Array:
    goal = lpips.describe(net, params, goal_1HWC)

    def one(picture: Array) -> Array:
        return lpips.distance(params, lpips.describe(net, params, picture[None]), goal)[0]

    return jax.lax.map(one, rgb_PHWC, batch_size=_batch_size(rgb_PHWC))


def _batch_size(rgb_PHWC: Array) -> int:
    return max(1, AT_ONCE // (rgb_PHWC.shape[1] * rgb_PHWC.shape[2]))


@dataclasses.dataclass(frozen=True, eq=False)
class Features(PictureCost):
    """Mean squared difference of an image encoder's features.

    ``settings`` is an encoder (``models.encoders``), with its parameters; or a model, whose
    memory's encoder is used, with the model's.
    """

    settings: Encoder | AssembledModel
    params: Params = dataclasses.field(repr=False)

    def pictures(self, frames: Frames, goal: Frames) -> Array:
        """See ``PictureCost``."""
        params = self.params
        if not isinstance(self.settings, Encoder):
            params = self.settings.memory.encoder.weights(params)
        return _features(self.settings, params, frames.rgb_THWC, goal.rgb_THWC)


@functools.partial(jax.jit, static_argnums=0)
def _features(
    settings: Encoder | AssembledModel, params: Params, rgb_PHWC: Array, goal_1HWC: Array
) -> Array:
    def encoded(picture_HWC: Array) -> Array:
        if isinstance(settings, Encoder):
            settings.require_own("cannot be made without the model")
            return settings.encode(params, picture_HWC[None])[0]
        return settings.memory.encoder.features(settings, params, picture_HWC[None])[0]

    wanted = encoded(goal_1HWC[0])
    each = jax.lax.map(encoded, rgb_PHWC, batch_size=_batch_size(rgb_PHWC))
    return jnp.square(each - wanted).mean((1, 2, 3))


@dataclasses.dataclass(frozen=True)
class Distance:
    """The true distance of the last pose from the goal: an oracle, to evaluate planners alone.

    ``function`` maps poses (K, 4, 4) and the goal's pose (4, 4), ``world_from_camera``, to (K,)
    distances (inf if unreachable), such as metres along the shortest path, in NumPy or JAX; for
    example ``straight``.
    """

    function: Callable[[Any, Any], Any]

    def __call__(self, frames: Frames, goal: Frames) -> Any:
        """Return (K,) costs."""
        poses = frames.camera.world_from_camera[:, -1]
        return self.function(poses, goal.camera.world_from_camera[-1])


def straight(poses_K44: Any, goal_44: Any, metres_per_radian: float = 0.25) -> Array:
    """Return the Euclidean distance plus the weighted difference of yaw, metres.

    ``poses_K44`` are (K, 4, 4) poses, ``goal_44`` the goal's.
    """
    poses, goal = jnp.asarray(poses_K44), jnp.asarray(goal_44)
    apart = jnp.linalg.norm(poses[:, :3, 3] - goal[:3, 3], axis=-1)
    turn = heading(poses) - heading(goal)
    return apart + metres_per_radian * jnp.abs(jnp.arctan2(jnp.sin(turn), jnp.cos(turn)))


@dataclasses.dataclass(frozen=True, eq=False)
class Sum:
    """A weighted sum of costs, from ``(weight, cost)`` pairs."""

    parts: tuple[tuple[float, FrameCost], ...]

    def __call__(self, frames: Frames, goal: Frames) -> Any:
        """Return (K,) costs."""
        return sum(weight * cost(frames, goal) for weight, cost in self.parts)


def with_depth(cost: FrameCost, weight: float) -> Sum:
    """Return a cost that adds the weighted log-depth difference (``Depth``) to another cost."""
    weights = getattr(cost, "weights", None)
    return Sum(((1.0, cost), (weight, Depth(weights=weights))))
