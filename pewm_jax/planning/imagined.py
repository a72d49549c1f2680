"""Any world as a pure functional environment.

Its two functions work eagerly, and under jit, vmap and scan with the model static::

    state = reset(model, params, frames, key)               # posed RGB-D frames
    state, seen = step(model, params, state, action, key)   # one action
    state, seen = step(model, params, state, actions, key)  # a block of n actions

What a step is: a world imagines clips of ``clip.frames − 1`` frames. One action is imagined as a
clip of its own, in which the agent stands still after the action; its first frame is what is seen
and remembered, the others are dropped. So a single step costs as much as a block that fills a clip.
A block of any length is imagined clip by clip, as ``worlds.imagine`` does; the frames of a clip are
drawn together, and so are not those of single steps. Prefer blocks where a policy can commit to
them.

Walls are not known here: a move goes where it leads, and what is seen there is imagined.
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
        world: the world: its present frame and its memory.
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
    """Begin with what has been seen.

    Args:
        model: the model's settings, or an experiment's; static under jit.
        params: the world model's parameters.
        frames: S ≥ 1 posed RGB-D frames; the last one is the present.
        key: for worlds that begin at random; none of the library's does.
        depth_scale: as for ``worlds.start``.

    Raises:
        UserError: the frames do not fit the model, or cannot be used; see ``worlds.start``.
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
    """Imagine what is seen after one action, or after each of a block; see the module.

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
    """Return what is seen at present: after ``reset`` the last frame that was given."""
    return _shown(state.world.frame, single=True)


def distance(pose: Array, goal: Array) -> Array:
    """Return the distance of cameras (…, 4, 4) to a goal (4, 4) on the ground, metres."""
    away = pose[..., :2, 3] - goal[:2, 3]
    return jnp.sqrt(jnp.sum(away**2, -1))


def turned(pose: Array, goal: Array) -> Array:
    """Return the angle between the headings of cameras (…, 4, 4) and of a goal, from 0 to π."""
    return jnp.abs((heading(pose) - heading(goal) + jnp.pi) % (2 * jnp.pi) - jnp.pi)


def reached(pose: Array, goal: Array, within_m: float = 0.5, within_deg: float = 180.0) -> Array:
    """Return (…) bool: whether cameras (…, 4, 4) are at a goal (4, 4), inclusive of the bounds."""
    near = distance(pose, goal) <= within_m
    return near & (jnp.degrees(turned(pose, goal)) <= within_deg)


def satisfied(seen: dict[str, Array], cost: Callable[[Array], Array], at_most: float) -> Array:
    """Return whether a cost of the image seen is at most a bound: a goal without a pose.

    Args:
        seen: the observation of a single step.
        cost: an image (H, W, 3) uint8 → a number, such as the distance to a goal image.
        at_most: the bound, inclusive.
    """
    return jnp.asarray(cost(seen["rgb"]) <= at_most)


def _is_single(action: Array) -> bool:
    """Tell one action from a block of them."""
    whole = jnp.issubdtype(action.dtype, jnp.integer)
    return action.ndim == 0 or (action.ndim == 1 and not whole)


@functools.partial(jax.jit, static_argnames="single", inline=True)
def _after(steps: Array, frames: Frames, *, single: bool) -> tuple[Array, dict[str, Array]]:
    """Return the number of steps after more frames, and the frames as observations."""
    return steps + frames.depth_THW.shape[0], _shown(frames, single=single)


@functools.partial(jax.jit, static_argnames="single", inline=True)
def _shown(frames: Frames, *, single: bool) -> dict[str, Array]:
    """Return frames (T, …) as observations; of a ``single`` one without the axis T."""
    seen = {
        "rgb": rgb_from_signal(frames.rgb_THWC),
        "depth": jnp.asarray(frames.depth_THW, jnp.float32),
        "pose": jnp.asarray(frames.camera.world_from_camera, jnp.float32),
    }
    return jax.tree.map(lambda x: x[0], seen) if single else seen
