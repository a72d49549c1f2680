"""User input that steers a world, in one form: cameras, and actions if known; cut into clips."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import UserError, World
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.types import Array, Camera, Control, Frames


def control_of(model: World, present: Camera, control: Any) -> Control:
    """Return (n,) cameras of the frames to imagine, and the (n, A) actions that lead to them.

    In contrast to the ``Control`` of training, the present frame, whose camera is (1,), is not a
    part.

    Raises:
        UserError: the control is empty or has no form of ``worlds.imagine``. Values are checked by
            ``worlds.checks``.
    """
    found = _in_one_form(model, present, control)
    require_actions(model, found.actions_TA, "imagine()")
    return found


def require_actions(model: World, actions_TA: Array | None, who: str) -> None:
    """Refuse missing actions that the model's control needs, and (…, A) actions of another A."""
    wanted, kind = model.batch_spec.actions, model.facts.control
    if not wanted:
        return
    steered = f"this model's control ({kind})" if kind else "this model"
    if actions_TA is None:
        raise UserError(
            f"{who} got cameras without actions, and {steered} is steered "
            f"by actions of {wanted} numbers: give actions, or a Control with both."
        )
    if actions_TA.shape[-1] != wanted:
        raise UserError(
            f"{who} got actions of {actions_TA.shape[-1]} numbers, and {steered} takes "
            f"{wanted}: give those it was trained with."
        )


def _in_one_form(model: World, present: Camera, control: Any) -> Control:
    """Return cameras, and actions where there are any; see ``control_of``."""
    if isinstance(control, Control):
        count = _require_cameras(control.camera)
        actions = None if control.actions_TA is None else jnp.asarray(control.actions_TA)
        if actions is not None and (actions.ndim != 2 or len(actions) != count):
            raise UserError(
                f"imagine() got {count} cameras and actions of shape {actions.shape}; give "
                f"({count}, A): action k leads to camera k."
            )
        state = None if control.state_A is None else jnp.asarray(control.state_A)
        if state is not None and actions is not None and state.shape != actions.shape[1:]:
            raise UserError(
                f"imagine() got a state of shape {state.shape} and actions of shape "
                f"{actions.shape}; give a state of as many numbers as an action has, "
                f"{actions.shape[1:]}: that of the present frame."
            )
        return Control(_as_arrays(control.camera), actions, state)
    if isinstance(control, Camera):
        _require_cameras(control)
        return Control(_as_arrays(control))
    actions = jnp.asarray(control)
    count = actions.shape[0] if actions.ndim else 0
    if count == 0:
        raise UserError("imagine() got no actions; give at least one.")
    moves = action_geometry.continuous(model.actions, actions)
    if moves.ndim != 2 or moves.shape[1] != 3:
        raise UserError(
            f"imagine() got actions of shape {actions.shape}; give ({count},) integers or "
            f"({count}, 3) floats (dx, dy, dyaw); actions of another kind come with their cameras, "
            "as a Control."
        )
    poses = action_geometry.integrate(present.world_from_camera[0], moves)[1:]
    intrinsics = jnp.broadcast_to(present.intrinsics_4, (count, 4))
    return Control(Camera(intrinsics, poses), moves)


def _as_arrays(camera: Camera) -> Camera:
    return Camera(jnp.asarray(camera.intrinsics_4), jnp.asarray(camera.world_from_camera))


def _require_cameras(camera: Camera) -> int:
    """Return the number of cameras, or refuse arrays that are not a sequence of cameras."""
    poses, intrinsics = camera.world_from_camera.shape, camera.intrinsics_4.shape
    count = poses[0] if len(poses) == 3 else 0
    if count < 1 or poses != (count, 4, 4) or intrinsics != (count, 4):
        raise UserError(
            f"imagine() got cameras with poses {poses} and intrinsics {intrinsics}; give (n, 4, 4) "
            "and (n, 4), a camera for each of n ≥ 1 frames to imagine."
        )
    return count


def cut_into_clips(
    asked: Control, length: int, still: Callable[[Array], Array]
) -> tuple[Control, Array | None]:
    """Cut the control of n frames into clips that imagine ``length`` frames each.

    ``still`` returns the action with which the agent stands still (``Conditioner.still``).

    Returns:
        ``(chunks, wanted)``: the control with leading axes (clips, length), and which of these
        frames were asked for, or None if all were. Where frames are missing the agent stands still.
        A given state is that before the first clip; before each other clip it is the preceding
        action.
    """
    count = asked.camera.world_from_camera.shape[0]
    clips = -(-count // length)
    missing = clips * length - count

    def whole(x: Array, last: Array) -> Array:
        filled = jnp.concatenate([x, jnp.repeat(last, missing, 0)]) if missing else x
        return filled.reshape(clips, length, *x.shape[1:])

    camera = jax.tree.map(lambda x: whole(x, x[-1:]), asked.camera)
    actions, state = asked.actions_TA, asked.state_A
    if actions is not None:
        if state is not None:
            later = actions[length - 1 : (clips - 1) * length : length]
            state = jnp.concatenate([state[None], later])
        actions = whole(actions, still(actions[-1:]))
    wanted = jnp.arange(clips * length).reshape(clips, length) < count if missing else None
    return Control(camera, actions, state), wanted


def join_clips(frames: Frames, count: int) -> Frames:
    """Join the frames of all clips, (clips, length, …), and drop those not asked for."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], frames)


def last_frames(frames: Frames, end: Any = None, count: int = 1) -> Frames:
    """Return the last ``count`` frames of those before ``end``, or of all."""
    end = frames.depth_THW.shape[0] if end is None else end
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, end - count, count), frames)
