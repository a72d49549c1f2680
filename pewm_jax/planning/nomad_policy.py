"""Proposals of NoMaD: trajectories from observed images and, optionally, a goal image.

    waypoints = nomad_policy.propose(policy, params, seen, goal, key, 16)   # (16, 8, 2) metres
    actions = nomad_policy.continuous(waypoints)                            # (16, 8, 3)
    steps = nomad_policy.discrete(model.actions, waypoints)                 # (16, 8)

``worlds.imagine_many`` and ``candidates.rank`` accept either kind of actions. ``Policy`` acts
without a planner.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs.signals import signal_from_rgb
from pewm_jax.config import ActionConfig, UserError
from pewm_jax.diffusion import squared_cosine
from pewm_jax.geometry.actions import discrete_table
from pewm_jax.models.nomad import model as nomad
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.types import Array, Params

STILL_M = 0.02
"""A step shorter than this has no direction, metres."""
SEQUENCES_AT_ONCE = 6561
"""Number of sequences of discrete actions compared at once: all sequences of 8 actions."""


def history(config: NomadConfig, rgb_SHWC: np.ndarray) -> np.ndarray:
    """Return the last context + 1 of S ≥ 1 images; if there are fewer, repeat the first."""
    count = config.context + 1
    seen = np.asarray(rgb_SHWC)[-count:]
    return np.concatenate([np.repeat(seen[:1], count - len(seen), 0), seen])


@functools.partial(jax.jit, static_argnames=("config", "count"), inline=True)
def propose(
    config: NomadConfig,
    params: Params,
    rgb_THWC: Array,
    goal_HWC: Array | None,
    key: Array,
    count: int,
) -> Array:
    """Sample trajectories: (K, N, 2) waypoints, metres forward and left of the present position.

    Pure, and compiled once per configuration, count and set of shapes; inside the caller's jit,
    config and count are static.

    Args:
        config: the policy.
        params: its parameters.
        rgb_THWC: (context + 1, H, W, 3) observed images, uint8 or floats in [−1, 1], the present
            last (``history``).
        goal_HWC: (H, W, 3) image at the goal; None to explore.
        key: randomness.
        count: K proposals.

    Raises:
        UserError: the number of images is wrong.
    """
    seen = nomad.preprocess(config, signal_from_rgb(rgb_THWC))[None]
    shown = (
        seen[:, -1]
        if goal_HWC is None
        else nomad.preprocess(config, signal_from_rgb(goal_HWC)[None])
    )
    condition = nomad.encode(config, params, seen, shown, jnp.array([goal_HWC is None]))
    conditions = jnp.repeat(condition, count, 0)

    def predict(noisy: Array, time: Array) -> Array:
        return nomad.denoise(config, params, noisy, jnp.full(count, time), conditions)

    steps = squared_cosine.sample(config.noise_steps, predict, (count, config.waypoints, 2), key)
    return nomad.waypoints(config, steps)


@functools.partial(jax.jit, static_argnums=0, inline=True)
def distance(config: NomadConfig, params: Params, rgb_THWC: Array, goal_HWC: Array) -> Array:
    """Return the policy's estimate of the number of steps to the goal, (); see ``propose``."""
    seen = nomad.preprocess(config, signal_from_rgb(rgb_THWC))[None]
    shown = nomad.preprocess(config, signal_from_rgb(goal_HWC)[None])
    return nomad.distance(config, params, nomad.encode(config, params, seen, shown, [False]))[0]


def continuous(waypoints_KN2: np.ndarray) -> np.ndarray:
    """Return the (..., N, 3) float32 actions dx, dy, dyaw that pass through (..., N, 2) waypoints.

    The agent moves straight to a waypoint and then turns towards the next one; after the last one,
    or between equal waypoints, it keeps its heading. So the first move may be sideways, and each is
    as long as the distance to its waypoint.
    """
    points = np.asarray(waypoints_KN2, np.float64)
    moves = np.diff(points, axis=-2, prepend=np.zeros_like(points[..., :1, :]))
    towards = np.arctan2(moves[..., 1], moves[..., 0])
    still = np.hypot(moves[..., 0], moves[..., 1]) < STILL_M
    yaw = np.zeros((*points.shape[:-2], points.shape[-2] + 1))  # before each move, and at the end
    for number in range(1, points.shape[-2]):
        same = still[..., number]
        yaw[..., number] = np.where(same, yaw[..., number - 1], towards[..., number])
    yaw[..., -1] = yaw[..., -2]
    cos, sin = np.cos(yaw[..., :-1]), np.sin(yaw[..., :-1])
    forward = cos * moves[..., 0] + sin * moves[..., 1]
    left = -sin * moves[..., 0] + cos * moves[..., 1]
    turn = (np.diff(yaw, axis=-1) + np.pi) % (2 * np.pi) - np.pi
    return np.stack([forward, left, turn], -1).astype(np.float32)


def discrete(actions: ActionConfig, waypoints_KN2: np.ndarray) -> np.ndarray:
    """Return the discrete actions (..., N) that best approximate (..., N, 2) waypoints, in metres.

    They minimize the sum of squared distances between the position after action k and waypoint k:
    over all sequences for up to 8 waypoints, otherwise by a beam search with ``SEQUENCES_AT_ONCE``
    prefixes. Ties prefer forward first, then left.
    """
    points = np.asarray(waypoints_KN2, np.float64)
    flat = points.reshape(-1, *points.shape[-2:])
    table = discrete_table(actions).astype(np.float64)
    found = np.stack([_nearest(table, each) for each in flat])
    return found.reshape(points.shape[:-1])


def _nearest(table: np.ndarray, points_N2: np.ndarray) -> np.ndarray:
    """Beam search over waypoints, keeping the best prefixes."""
    places, yaws, costs = np.zeros((1, 2)), np.zeros(1), np.zeros(1)
    taken = np.zeros((1, 0), int)
    for point in points_N2:
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        moved = np.stack(
            [cos * table[:, 0] - sin * table[:, 1], sin * table[:, 0] + cos * table[:, 1]], -1
        )
        places = (places[:, None] + moved).reshape(-1, 2)
        yaws = (yaws[:, None] + table[:, 2]).reshape(-1)
        costs = np.repeat(costs, len(table)) + np.square(places - point).sum(-1)
        last = np.tile(np.arange(len(table)), len(taken))[:, None]
        taken = np.concatenate([np.repeat(taken, len(table), 0), last], -1)
        if len(costs) > SEQUENCES_AT_ONCE:
            best = np.sort(np.argsort(costs, kind="stable")[:SEQUENCES_AT_ONCE])
            places, yaws, costs, taken = (x[best] for x in (places, yaws, costs, taken))
    return taken[np.argmin(np.round(costs, 9))]


compiled = propose
"""The deprecated name of the compiled ``propose``."""


class Policy:
    """A policy for environments: it maps an observation to an action, from one proposal at a time.

    It stores the images of an episode: call ``reset`` at the start of another. ``actions`` is the
    motion of a discrete action, None for continuous actions; ``steps`` the number of actions taken
    from a proposal before the next one.
    """

    def __init__(
        self,
        config: NomadConfig,
        params: Params,
        actions: ActionConfig | None = None,
        *,
        steps: int = 1,
        seed: int = 0,
    ):
        if not 1 <= steps <= config.waypoints:
            raise UserError(
                f"Policy got steps {steps}: take 1 to {config.waypoints} actions of a proposal."
            )
        self.config, self.params, self.actions, self.steps = config, params, actions, steps
        self.key = jax.random.key(seed)
        self.seen: deque[np.ndarray] = deque(maxlen=config.context + 1)
        self.waiting: list[Any] = []
        self.made = 0

    def reset(self) -> None:
        """Discard the stored images."""
        self.seen.clear()
        self.waiting = []

    def __call__(self, observation: Mapping[str, Any]) -> Any:
        """Return an action, an integer or (dx, dy, dyaw), for an observation with ``rgb``.

        The goal is ``goal`` if that is an image; otherwise the policy explores.
        """
        self.seen.append(np.asarray(observation["rgb"]))
        if not self.waiting:
            goal = observation.get("goal")
            goal = goal if goal is not None and np.ndim(goal) == 3 else None
            key, self.made = jax.random.fold_in(self.key, self.made), self.made + 1
            seen = history(self.config, np.stack(list(self.seen)))
            way = np.asarray(propose(self.config, self.params, seen, goal, key, 1))[0]
            found = continuous(way) if self.actions is None else discrete(self.actions, way)
            self.waiting = list(found[: self.steps])
        action = self.waiting.pop(0)
        return action if self.actions is None else int(action)
