"""Any world as a pure functional environment.

Its two functions work eagerly, and under jit, vmap and scan with a static model::

    state = reset(model, params, frames, key)               # posed RGB-D frames
    state, seen = step(model, params, state, action, key)   # one action
    state, seen = step(model, params, state, actions, key)  # a block of n actions

A world imagines clips of ``clip.frames − 1`` frames. A single action is imagined as its own clip,
in which the agent stands still after the action; the first frame is returned and inserted into the
memory, the others are discarded. So a single step costs as much as a block that fills a clip. A
block of any length is imagined clip by clip, as in ``worlds.imagine``; the frames of one clip are
sampled jointly, those of separate single steps are not. Prefer blocks if a policy can commit to
them.

There is no collision detection: a move is always executed, and the frame at its end is imagined.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax import worlds
from pewm_jax.codecs.signals import rgb_from_signal
from pewm_jax.config import Config, World
from pewm_jax.geometry.actions import heading
from pewm_jax.types import Array, Camera, Control, Frames, Params, WorldState
from pewm_jax.worlds.checks import as_array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ImaginedState:
    """The state of the environment, a pytree.

    Attributes:
        world: the world's state: its present frame and its memory.
        steps: () int32, actions since ``reset``.
    """

    world: WorldState
    steps: Array

    @property
    def pose(self) -> Array:
        """Return the present (4, 4) ``world_from_camera``."""
        return self.world.frame.camera.world_from_camera[0]


def reset(
    model: Config | World,
    params: Params,
    frames: Frames,
    key: Array,
    *,
    depth_scale: float | None = None,
) -> ImaginedState:
    """Start from S ≥ 1 posed RGB-D frames; the last one is the present.

    ``model`` is static under jit. ``key`` is for worlds with a random start; the library has none.
    ``depth_scale``: as for ``worlds.start``.

    Raises:
        UserError: the frames do not fit the model, or are invalid; see ``worlds.start``.
    """
    del key
    world = worlds.start(model, params, frames, depth_scale=depth_scale)
    return ImaginedState(world, jnp.zeros((), jnp.int32))


def step(
    model: Config | World,
    params: Params,
    state: ImaginedState,
    action: Any,
    key: Array,
) -> tuple[ImaginedState, dict[str, Array]]:
    """Imagine the frame after one action, or after each action of a block; see the module.

    Args:
        model: as for ``reset``.
        params: the world model's parameters.
        state: from ``reset`` or an earlier step.
        action: one action: () integer (0 forward, 1 turn left, 2 turn right) or (3,) floats (dx,
            dy, dyaw); or a block: (n,) integers, (n, 3) floats, or n cameras (``Camera``).
        key: randomness of the sampling noise.

    Returns:
        ``(state, observation)``; the observation has ``rgb`` (H, W, 3) uint8, ``depth`` (H, W)
        metres and ``pose`` (4, 4), with a leading axis n for a block. Under jit, vmap and grad an
        unknown or non-finite action gives NaN depth and pose and an arbitrary ``rgb``, whose bytes
        have no NaN; the state's frame is NaN and its memory is the one before the step.

    Raises:
        UserError: the action has none of these forms; or, outside of jit, vmap and grad, it is
            unknown or not finite.
    """
    control, single = action, False
    if not isinstance(action, (Camera, Control)):
        control = as_array(action, "step", "actions")
        single = _is_single(control)
        control = control[None] if single else control
    world, frames = worlds.imagine(model, params, state.world, control, key)
    steps, seen = _after(state.steps, frames, single=single)
    return ImaginedState(world, steps), seen


def observation(state: ImaginedState) -> dict[str, Array]:
    """Return the present observation: after ``reset`` the last frame passed to it."""
    return _to_observations(state.world.frame, single=True)


def distance(pose: Array, goal: Array) -> Array:
    """Return the distance of cameras (…, 4, 4) to a goal (4, 4) on the ground, metres."""
    away = pose[..., :2, 3] - goal[:2, 3]
    return jnp.sqrt(jnp.sum(away**2, -1))


def turned(pose: Array, goal: Array) -> Array:
    """Return the angle between the headings of cameras (…, 4, 4) and of a goal, from 0 to π."""
    return jnp.abs((heading(pose) - heading(goal) + jnp.pi) % (2 * jnp.pi) - jnp.pi)


def reached(pose: Array, goal: Array, within_m: float = 0.5, within_deg: float = 180.0) -> Array:
    """Return (…) bool: whether cameras (…, 4, 4) are at a goal (4, 4), bounds included."""
    near = distance(pose, goal) <= within_m
    return near & (jnp.degrees(turned(pose, goal)) <= within_deg)


def satisfied(seen: dict[str, Array], cost: Callable[[Array], Array], at_most: float) -> Array:
    """Return whether a cost of the observed image is at most a bound: a goal without a pose.

    ``seen`` is the observation of a single step; ``cost`` maps an image (H, W, 3) uint8 to a
    number, such as the distance to a goal image.
    """
    return jnp.asarray(cost(seen["rgb"]) <= at_most)


def _is_single(action: Array) -> bool:
    """Return whether this is a single action instead of a block."""
    whole = jnp.issubdtype(action.dtype, jnp.integer)
    return action.ndim == 0 or (action.ndim == 1 and not whole)


@functools.partial(jax.jit, static_argnames="single", inline=True)
def _after(steps: Array, frames: Frames, *, single: bool) -> tuple[Array, dict[str, Array]]:
    """Return the updated number of steps, and the frames as observations."""
    return steps + frames.depth_THW.shape[0], _to_observations(frames, single=single)


@functools.partial(jax.jit, static_argnames="single", inline=True)
def _to_observations(frames: Frames, *, single: bool) -> dict[str, Array]:
    """Return frames (T, …) as observations; without the axis T if ``single``."""
    seen = {
        "rgb": rgb_from_signal(frames.rgb_THWC),
        "depth": jnp.asarray(frames.depth_THW, jnp.float32),
        "pose": jnp.asarray(frames.camera.world_from_camera, jnp.float32),
    }
    return jax.tree.map(lambda x: x[0], seen) if single else seen
