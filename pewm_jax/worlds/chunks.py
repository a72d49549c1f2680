"""A control of any length, cut into clips that are imagined one after the other."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.types import Array, Control, Frames


def cut(asked: Control, length: int) -> tuple[Control, Array | None]:
    """Cut the control of n frames into clips.

    Args:
        asked: (n) cameras of the frames to imagine, and (n, A) actions, if there are any.
        length: frames that a clip imagines.

    Returns:
        ``(chunks, wanted)``: the control with leading axes (clips, length), and which of these
        frames were asked for, or None if all were. Where frames are missing the agent stands still.
        A state that is given is that before the first clip; before the others it is what the
        action before says.
    """
    count = asked.camera.world_from_camera.shape[0]
    clips = -(-count // length)
    missing = clips * length - count

    def whole(x: Array, still: Array) -> Array:
        filled = jnp.concatenate([x, jnp.repeat(still, missing, 0)]) if missing else x
        return filled.reshape(clips, length, *x.shape[1:])

    camera = jax.tree.map(lambda x: whole(x, x[-1:]), asked.camera)
    actions, state = asked.actions_TA, asked.state_A
    if actions is not None:
        if state is not None:
            later = actions[length - 1 : (clips - 1) * length : length]
            state = jnp.concatenate([state[None], later])
        actions = whole(actions, jnp.zeros_like(actions[:1]))
    wanted = jnp.arange(clips * length).reshape(clips, length) < count if missing else None
    return Control(camera, actions, state), wanted


def joined(frames: Frames, count: int) -> Frames:
    """Join the frames of all clips, (clips, length, …), and drop those not asked for."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], frames)


def last(frames: Frames, end: Any = None, count: int = 1) -> Frames:
    """Return the last ``count`` frames of those before ``end``, or of all."""
    end = frames.depth_THW.shape[0] if end is None else end
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, end - count, count), frames)
