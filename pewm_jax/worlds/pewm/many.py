"""Many candidates from one state: what they share is made once, what nobody looks at is not made.

A candidate imagines what ``pewm.imagine`` imagines without remembering. But the present frame is
encoded once. What the memory shows may be given (``pewm_views``); if it is not, it is rendered, on
a processor, once for each camera that several candidates have in common (equal beginnings lead to
equal cameras), and not in both sides of a branch, as ``jax.vmap`` would. Where only the last frame
is asked for, only that is decoded, if the codec works frame by frame.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.config import ModelConfig
from pewm_jax.memory import interface as memories
from pewm_jax.types import Array, Camera, Control, Frames, MemoryReadout, Params, View, WorldState
from pewm_jax.worlds import sampling, world_model
from pewm_jax.worlds.control import control_of


def imagine_many(
    model: ModelConfig,
    params: Params,
    state: WorldState,
    controls: Any,
    keys: Array,
    *,
    memory: bool = True,
    last: bool = False,
    views: View | None = None,
) -> tuple[WorldState, Frames]:
    """Imagine K candidates; see ``worlds.imagine_many``. ``views`` is of ``pewm_views.Views``."""
    asked = jax.vmap(lambda control: control_of(model, state.frame.camera, control))(controls)
    length = model.clip.frames - 1
    count = asked.camera.world_from_camera.shape[1]
    clips = -(-count // length)
    keys_KC = jax.vmap(lambda key: jax.random.split(key, clips))(keys)
    present, shared, made = state.frame, True, []
    for number in range(clips):
        here = slice(number * length, min((number + 1) * length, count))
        wanted = here.stop - here.start
        chunk = Control(jax.tree.map(lambda x, s=here: _filled(x[:, s], length), asked.camera))
        if asked.actions_TA is not None:
            rest = [(0, 0), (0, length - wanted), (0, 0)]
            told = asked.state_A
            if told is not None and number:
                told = asked.actions_TA[:, here.start - 1]
            chunk = Control(chunk.camera, jnp.pad(asked.actions_TA[:, here], rest), told)
        frames = _clip(
            model,
            params,
            (present, shared),
            state.map,
            chunk,
            keys_KC[:, number],
            shown=slice(wanted - 1, wanted) if last else slice(0, wanted),
            memory=memory,
            view=None if views is None else jax.tree.map(lambda x, n=number: x[:, n], views),
        )
        made.append(frames)
        present, shared = jax.tree.map(lambda x: x[:, -1:], frames), False
    made = made[-1:] if last else made
    frames = jax.tree.map(lambda *x: jnp.concatenate(x, 1), *made)
    return WorldState(present, state.map), frames


def to_compare(model: ModelConfig, state: WorldState) -> WorldState:
    """Return a state whose memory has no more room than it needs; see ``worlds.to_compare``."""
    return WorldState(state.frame, model.memory.trimmed(state.map))


def _filled(x_KT: Array, length: int) -> Array:
    """Repeat the last camera up to a clip's length: there the agent stands still."""
    missing = length - x_KT.shape[1]
    return jnp.concatenate([x_KT, jnp.repeat(x_KT[:, -1:], missing, 1)], 1) if missing else x_KT


def _clip(
    model: ModelConfig,
    params: Params,
    present: tuple[Frames, bool],
    remembered: Any,
    control: Control,
    keys: Array,
    *,
    shown: slice,
    memory: bool,
    view: View | None = None,
) -> Frames:
    """Imagine one clip of every candidate.

    Args:
        model: the model.
        params: the world model's parameters.
        present: the present frame, and whether all share it; else it has a leading axis K.
        remembered: the memory.
        control: (K, T − 1) cameras of the frames to imagine, and actions that lead to them.
        keys: (K,) sampling noise.
        shown: which of the T − 1 frames are returned.
        memory: False ignores the memory.
        view: (K, T) what the memory looks like, if it is known.

    Returns:
        (K, n) frames.
    """
    frame, shared = present
    count = len(keys)
    first = frame.camera
    if shared:
        first = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), first)
    camera = jax.tree.map(lambda a, b: jnp.concatenate([a, b], 1), first, control.camera)

    def condition(frame: Frames, control: Control) -> world_model.ClipConditioning:
        one = jax.tree.map(lambda x: x[None], (frame, control))
        return world_model.condition(model, params, *one)

    whole = dataclasses.replace(control, camera=camera)
    conditioning = jax.vmap(condition, (None if shared else 0, 0))(frame, whole)
    sight = None
    if memory and "memory" in params:
        sight = look(model, remembered, camera, params, view)
        batched = jax.tree.map(lambda x: x[:, None], sight)
        latents = jax.vmap(functools.partial(sampling.draw, model, params))(
            conditioning, batched, keys
        )
    else:
        latents = jax.vmap(lambda given, key: sampling.draw(model, params, given, None, key))(
            conditioning, keys
        )
    latents = latents[:, 0]
    seen = slice(shown.start + 1, shown.stop + 1)  # frame 0 of a clip is the present one
    early = model.codec.framewise
    if early:
        latents, seen_there = latents[:, seen], slice(None)
    else:
        seen_there = seen
    rgb, depth = rgbd.decode_rgbd(model, params, latents)
    rgb, depth = rgb[:, seen_there], depth[:, seen_there]
    if sight is not None and sight.view is not None and memories.gated(model):
        remembered_there = jax.tree.map(lambda x: x[:, seen], sight.view)
        rgb, depth = rgbd.mix(model, params, rgb, depth, remembered_there)
    depth = depth if model.clip.depth else jnp.zeros_like(depth)
    return Frames(rgb, depth, jax.tree.map(lambda x: x[:, shown], control.camera))


def look(
    model: ModelConfig, remembered: Any, camera: Camera, params: Params, view: View | None = None
) -> MemoryReadout:
    """Return what a memory shows K clips, leading axis K; see ``memory.interface.readout``.

    Args:
        model: the model.
        remembered: the memory.
        camera: (K, T) cameras.
        params: the world model's parameters.
        view: (K, T) what it looks like, if that is known.
    """
    pictures = memories.gated(model)
    reader = model.memory.reader
    each = functools.partial(memories.readout, model, remembered, params=params, pictures=pictures)
    if not (pictures or reader.READS_VIEW):
        return jax.vmap(each)(camera)

    def rendered(camera: Camera) -> View:
        height, width = model.clip.height, model.clip.width
        return memories.render(model, remembered, camera, height, width)

    def once(camera: Camera) -> View:
        return each_camera_once(rendered, camera)

    if view is None:
        view = jax.lax.platform_dependent(camera, cpu=once, default=jax.vmap(rendered))
    return jax.vmap(lambda camera, view: each(camera, view=view))(camera, view)


def each_camera_once(render: Any, camera: Camera) -> View:
    """Render (K, T) cameras one after the other, and those that are equal only once.

    Args:
        render: (T,) cameras → (T,) pictures.
        camera: (K, T) cameras; equal means the same numbers.

    Returns:
        (K, T) pictures.
    """
    leading = camera.world_from_camera.shape[:2]
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), camera)
    count = leading[0] * leading[1]
    numbers = jnp.concatenate([x.reshape(count, -1) for x in jax.tree.leaves(flat)], 1)
    same = (numbers[:, None] == numbers[None]).all(-1)
    first = jnp.argmax(same, 1)  # of a camera, the first that equals it
    new = first == jnp.arange(count)
    slot = (jnp.cumsum(new) - 1)[first]
    (order,) = jnp.nonzero(new, size=count, fill_value=0)
    like = jax.eval_shape(render, jax.tree.map(lambda x: x[:1], flat))
    blank = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), like)

    def draw(number: Array, pictures: View) -> View:
        one = render(jax.tree.map(lambda x: x[order[number]][None], flat))
        return jax.tree.map(lambda all_, x: all_.at[number].set(x[0]), pictures, one)

    pictures = jax.lax.fori_loop(0, new.sum(), draw, blank)
    return jax.tree.map(lambda x: x[slot].reshape(*leading, *x.shape[1:]), pictures)
