"""Many candidates from one state: shared parts are computed once, and only requested frames.

Unless ``model.asked_alone`` is set, a candidate imagines the same as ``imagine`` without
remembering. The present frame is encoded once. The rendered memory may be given (``Views``);
otherwise it is rendered, on a CPU, once per distinct camera (equal beginnings lead to equal
cameras), and not in both sides of a branch as under ``jax.vmap``. If only the last frame is
requested, only that is decoded, where the codec works frame by frame.

``Views`` caches renderings. Discrete actions reach the same places by many ways, and the candidates
of a search become more alike the longer it lasts. Cameras count as equal up to a millionth of a
metre, because the same turns in another order differ in their last bits. Views are those of the
rounded cameras, independent of earlier requests.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import rgbd
from pewm_jax.config import AssembledModel
from pewm_jax.memory import interface as memories
from pewm_jax.types import Array, Camera, Control, Frames, MemoryReadout, Params, View, WorldState
from pewm_jax.worlds import draft as drafts
from pewm_jax.worlds import world_model
from pewm_jax.worlds.control import control_of


def clip_control(
    asked: Control, here: slice, length: int, still: Callable[[Array], Array]
) -> Control:
    """Return the control of one clip of every candidate, the frames ``here`` of (K, n).

    If it has less than ``length`` frames, the agent then stands still (``Conditioner.still``).
    """
    chunk = Control(jax.tree.map(lambda x: _filled(x[:, here], length), asked.camera))
    if asked.actions_TA is None:
        return chunk
    actions, agent = asked.actions_TA[:, here], asked.state_A
    if missing := length - (here.stop - here.start):
        rest = jnp.repeat(still(actions[:, -1:]), missing, 1)
        actions = jnp.concatenate([actions, rest], 1)
    if agent is not None and here.start:
        agent = asked.actions_TA[:, here.start - 1]
    return Control(chunk.camera, actions, agent)


def _filled(x_KT: Array, length: int) -> Array:
    """Repeat the last camera up to a clip's length: there the agent stands still."""
    missing = length - x_KT.shape[1]
    return jnp.concatenate([x_KT, jnp.repeat(x_KT[:, -1:], missing, 1)], 1) if missing else x_KT


def imagine_clip(
    model: AssembledModel,
    params: Params,
    present: tuple[Frames, bool],
    remembered: Any,
    control: Control,
    keys: Array,
    *,
    shown: slice,
    memory: bool,
    view: View | None = None,
    alone: bool = False,
) -> Frames:
    """Imagine one clip of every candidate: (K, n) frames, ``shown`` of its T − 1.

    ``present`` is the present frame and whether all share it; else it has a leading axis K. The
    control has (K, T − 1) cameras, and actions that lead to them; ``view`` is the (K, T) rendered
    memory, if it is known. With ``alone``, ``shown`` is one frame, which is imagined without those
    between it and the present one; a draft is still made of the whole clip.
    """
    frame, shared = present
    count = len(keys)
    first = frame.camera
    if shared:
        first = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), first)
    camera = jax.tree.map(lambda a, b: jnp.concatenate([a, b], 1), first, control.camera)

    whole, drafted = dataclasses.replace(control, camera=camera), None
    over = None if shared else 0, 0, 0
    rows = np.array([0, shown.stop]) if alone else np.arange(1 + shown.stop)
    if alone and not model.draft.PREDICTS:
        camera, view = _select((camera, view), rows)
    reads = memory and ("memory" in params or model.draft.PREDICTS)
    readout = read_memory(model, remembered, camera, params, view) if reads else None
    if readout is None and model.draft.PREDICTS:
        readout = _of_present(model, params, frame, camera, shared=shared)
    if readout is not None and model.draft.PREDICTS:
        drafted = jax.vmap(functools.partial(_draft, model, params), over)(frame, whole, readout)
    if alone:
        model = dataclasses.replace(model, clip=dataclasses.replace(model.clip, frames=2))
        if drafted is not None:
            assert readout is not None
            camera = _select(camera, rows)
            readout, drafted = _select_frames(readout, drafted, rows)
        whole, shown = Control(camera), slice(0, 1)
        control = Control(jax.tree.map(lambda x: x[:, 1:], camera))
    condition = functools.partial(_condition, model, params)
    conditioning = jax.vmap(condition, over)(frame, whole, drafted)
    batched = jax.tree.map(lambda x: x[:, None], readout)
    draw = functools.partial(world_model.draw, model, params)
    latents = jax.vmap(draw)(conditioning, batched, keys)[:, 0]
    seen = slice(shown.start + 1, shown.stop + 1)  # frame 0 of a clip is the present one
    rgb, depth = _decoded(model, params, latents, seen)
    if readout is not None and readout.view is not None and memories.gated(model):
        blended = readout.view
        if drafted is not None:
            blended = drafts.gate_input(model, params, drafted, blended)
        remembered_there = jax.tree.map(lambda x: x[:, seen], blended)
        rgb, depth = rgbd.mix(model, params, rgb, depth, remembered_there)
    depth = depth if model.clip.depth else jnp.zeros_like(depth)
    return Frames(rgb, depth, jax.tree.map(lambda x: x[:, shown], control.camera))


def _decoded(
    model: AssembledModel, params: Params, latents_KthwC: Array, seen: slice
) -> tuple[Array, Array]:
    """Return colours and depth of the frames ``seen`` of K clips."""
    if model.codec.framewise:  # only the frames that are returned are decoded
        return rgbd.decode_rgbd(model, params, latents_KthwC[:, seen])

    # One candidate at a time: a video codec's activations need more memory than the rest.
    def decode(latents_thwC: Array) -> tuple[Array, Array]:
        rgb, depth = rgbd.decode_rgbd(model, params, latents_thwC[None])
        return rgb[0, seen], depth[0, seen]

    return jax.lax.map(decode, latents_KthwC)


def _select(parts: Any, rows: np.ndarray) -> Any:
    """Return some of the (K, T) frames of arrays."""
    return jax.tree.map(lambda x: x[:, rows], parts)


def _select_frames(readout: MemoryReadout, drafted: Array, rows: np.ndarray) -> tuple[Any, Array]:
    """Return the readout and the drafts of some of the (K, T) frames; tokens have no frames."""
    view, encoded, drafted = _select((readout.view, readout.encoded, drafted), rows)
    return dataclasses.replace(readout, view=view, encoded=encoded), drafted


def _draft(
    model: AssembledModel, params: Params, frame: Frames, control: Control, readout: MemoryReadout
) -> Array:
    """Return the draft of one candidate, (t, h, w, C + 1)."""
    one = jax.tree.map(lambda x: x[None], (frame, control, readout))
    return drafts.predict(model, params, *one)[0]


def _condition(
    model: AssembledModel, params: Params, frame: Frames, control: Control, drafted: Array | None
) -> world_model.ClipConditioning:
    """Return the conditioning of one candidate."""
    frame, control, drafted = jax.tree.map(lambda x: x[None], (frame, control, drafted))
    return world_model.condition(model, params, frame, control, everywhere_BthwC=drafted)


def _of_present(
    model: AssembledModel, params: Params, frame: Frames, camera: Camera, *, shared: bool
) -> MemoryReadout:
    """Return the readout of K clips whose memory holds their present frame alone."""

    def one(frame: Frames, camera: Camera) -> MemoryReadout:
        held = drafts.present_alone(model, params, frame)
        return memories.readout(model, held, camera, params=params, pictures=True)

    if shared:
        return jax.lax.map(lambda camera: one(frame, camera), camera)
    return jax.lax.map(lambda both: one(*both), (frame, camera))


def read_memory(
    model: AssembledModel, remembered: Any, camera: Camera, params: Params, view: View | None = None
) -> MemoryReadout:
    """Return the readout of K clips, leading axis K; ``view`` (K, T) is the rendering, if known."""
    pictures = memories.gated(model) or model.draft.PREDICTS
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
    """Render (K, T) cameras one after the other, equal ones only once.

    ``render`` maps (T,) cameras to (T,) views; cameras are equal if all their numbers are.
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
    pictures = _one_by_one(render, flat, lambda number: order[number])(new.sum())
    return jax.tree.map(lambda x: x[slot].reshape(*leading, *x.shape[1:]), pictures)


def _one_by_one(
    render: Any, camera: Camera, pick: Callable[[Array], Any]
) -> Callable[[Array], View]:
    """Return a function that renders so many of (n,) picked cameras; other views are 0."""
    like = jax.eval_shape(render, jax.tree.map(lambda x: x[:1], camera))
    room = len(camera.intrinsics_4)
    blank = jax.tree.map(lambda x: jnp.zeros((room, *x.shape[1:]), x.dtype), like)

    def draw(number: Array, pictures: View) -> View:
        one = render(jax.tree.map(lambda x: x[pick(number)][None], camera))
        return jax.tree.map(lambda all_, x: all_.at[number].set(x[0]), pictures, one)

    return lambda count: jax.lax.fori_loop(0, count, draw, blank)


FINE = 2.0**-20
"""Numbers of cameras are rounded to multiples of this, about a millionth of a metre."""
AT_ONCE = 8
"""Cameras that one call renders at most. The program has this size, however many are missing."""
MOST = 512 * 2**20
"""Bytes of views that are kept; when there would be more, all are forgotten."""


class Views:
    """The views of one state's memory; a callable with a cache. On the host, not under jit."""

    def __init__(self, model: AssembledModel, state: WorldState):
        self.model, self.state = model, state
        self.rendered = 0
        self._known: dict[bytes, list[np.ndarray]] = {}
        self._form: Any = None
        self._bytes = 0

    def __call__(self, controls: Any) -> View:
        """Return (K, clips, T) views of K controls, as ``imagine_many`` takes them."""
        asked = jax.device_get(_cameras(self.model, self.state.frame.camera, controls))
        rounded = [_rounded(x) for x in _flat(asked)]
        names = [b"".join(x[n].tobytes() for x in rounded) for n in range(len(rounded[0]))]
        wanted = dict.fromkeys(names)
        if len(wanted.keys() | self._known.keys()) * self._bytes > MOST:
            self._known = {}
        first = {name: number for number, name in reversed(list(enumerate(names)))}
        missing = [first[name] for name in wanted if name not in self._known]
        while missing:
            now, missing = missing[:AT_ONCE], missing[AT_ONCE:]
            self._render([names[n] for n in now], Camera(*(x[now] for x in rounded)))
        leading = asked.world_from_camera.shape[:-2]
        stacked = [np.stack(one) for one in zip(*(self._known[n] for n in names), strict=True)]
        shaped = [x.reshape(*leading, *x.shape[1:]) for x in stacked]
        return jax.tree.unflatten(self._form, shaped)

    def _render(self, names: list[bytes], camera: Camera) -> None:
        filled = jax.tree.map(lambda x: np.resize(x, (AT_ONCE, *x.shape[1:])), camera)
        shown = jax.device_get(_rendered(self.model, self.state.map, filled, len(names)))
        leaves, self._form = jax.tree.flatten(shown)
        self._bytes = sum(leaf[0].nbytes for leaf in leaves)
        for number, name in enumerate(names):
            self._known[name] = [leaf[number] for leaf in leaves]
        self.rendered += len(names)


def _flat(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the intrinsics and the poses of all cameras."""
    return camera.intrinsics_4.reshape(-1, 4), camera.world_from_camera.reshape(-1, 4, 4)


def _rounded(x: np.ndarray) -> np.ndarray:
    return (np.round(x / FINE) * FINE + 0.0).astype(np.float32)  # + 0: no zero has a sign


@functools.partial(jax.jit, static_argnums=0)
def _rendered(model: AssembledModel, memory: Any, camera: Camera, count: Array) -> View:
    """Render the first ``count`` of (n,) cameras; the other views are 0."""
    height, width = model.clip.height, model.clip.width
    render = functools.partial(memories.render, model, memory, height=height, width=width)
    return _one_by_one(render, camera, lambda number: number)(count)


@functools.partial(jax.jit, static_argnums=0)
def _cameras(model: AssembledModel, present: Camera, controls: Any) -> Camera:
    """Return (K, clips, T) cameras: of each clip the present one, and those that follow."""
    asked = jax.vmap(lambda control: control_of(model, present, control).camera)(controls)
    length = model.clip.frames - 1
    count, steps = asked.world_from_camera.shape[:2]
    missing = -steps % length

    def cut(now: jax.Array, x_KN: jax.Array) -> jax.Array:
        still = jnp.repeat(x_KN[:, -1:], missing, 1)
        after = jnp.concatenate([x_KN, still], 1).reshape(count, -1, length, *x_KN.shape[2:])
        before = jnp.broadcast_to(now[None], (count, 1, *now.shape[1:]))
        firsts = jnp.concatenate([before, after[:, :-1, -1]], 1)
        return jnp.concatenate([firsts[:, :, None], after], 2)

    return jax.tree.map(cut, present, asked)
