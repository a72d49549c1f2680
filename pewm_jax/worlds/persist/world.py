"""The world of PERSIST: a grid of class ids that evolves, and images rendered from it.

The memory is the state of the world itself. A diffusion transformer samples the next voxels, a
camera model predicts the camera, rays through the voxels determine what it faces, and a second
diffusion transformer renders the image (arXiv 2603.03482). Voxels are encoded at each step, so
edits of the grid (``edit``, ``PERSIST.erase``, ``PERSIST.move``) change the frames that follow.

Where actions steer, the camera model predicts the cameras; given cameras are kept.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import UserError, register
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.memory import interface as memories
from pewm_jax.memory.class_grid import GUESSED, OBSERVED, ClassGrid
from pewm_jax.types import Array, Camera, Control, Frames, Params, WorldState
from pewm_jax.worlds import checks
from pewm_jax.worlds.control import control_of
from pewm_jax.worlds.persist import stages as persist_stages
from pewm_jax.worlds.persist import state as grid_state
from pewm_jax.worlds.persist.config import PersistModel
from pewm_jax.worlds.persist.state import KnownFrame, Past, encode_picture
from pewm_jax.worlds.persist.step import begin, step
from pewm_jax.worlds.stages import Stage

START = 0
"""Seed of the noise from which the voxels of real frames are made."""


@register("world", "persist")
@dataclasses.dataclass(frozen=True)
class PERSIST(memories.MemoryEdits, PersistModel):
    """A world that is three-dimensional itself (PERSIST, arXiv 2603.03482)."""

    def init(self, key: Array) -> Params:
        """Return random parameters of the codec and of the four networks."""
        return persist_stages.init(self, key)

    def stages(self) -> tuple[Stage, ...]:
        """Return the stages."""
        return persist_stages.STAGES

    def sharding(self) -> tuple[tuple[str, Any], ...]:
        """Return the rules of the four networks and of the codec."""
        return (*self.backbone.SHARDING, *self.codec.SHARDING)

    def split_heads(self, stage: Stage) -> dict[str, int]:
        """Return the head counts that ``train.mesh.tensor`` must divide."""
        nets = self.backbone
        heads = {
            "world_frames": {"backbone.world_frames.blocks.heads": nets.world_frames.blocks.heads},
            "camera": {"backbone.camera_model.blocks.heads": nets.camera_model.blocks.heads},
            "renderer": {"backbone.renderer.blocks.heads": nets.renderer.blocks.heads},
        }
        return heads.get(stage.name, {})

    def start(self, params: Params, frames: Frames) -> WorldState:
        """Begin a world; see ``worlds.start``.

        The voxels around the first frame are generated from its image. Each later frame advances
        them by one step with the real image.
        """
        checks.require_frames(self, frames, "start")
        return _begin_from_frames(self, params, frames)

    def observe(self, params: Params, state: WorldState, frames: Frames) -> WorldState:
        """Observe real frames; see ``worlds.observe``."""
        checks.require_frames(self, frames, "observe")
        params, frames = _as_arrays(params, as_signal(frames))
        return _observe(self, params, past_of(self, params, state), frames)

    def imagine(
        self,
        params: Params,
        state: WorldState,
        control: Any,
        key: Array,
        *,
        remember: bool = True,
        memory: bool = True,
    ) -> tuple[WorldState, Frames]:
        """Imagine frame after frame; see ``worlds.imagine``.

        Without ``memory`` the voxels are generated from the present image, and the state keeps its
        grid.
        """
        params = _as_arrays(params)[0]
        asked, steered = _steering(self, state.frame.camera, control)
        # If observed cells are an input, the present image is the only one of a world without 3D
        # state; its cells count as observed.
        real = self.backbone.world_frames.map_embed > 0
        begun = state if memory else _begin_from_frames(self, params, state.frame, real=real)
        past = past_of(self, params, begun)

        def one(past: Past, inputs: tuple[Array, Camera, Array]) -> tuple[Past, Frames]:
            action, camera, frame_key = inputs
            known = None if steered else KnownFrame(camera=camera)
            return step(self, params, past, action, frame_key, known)

        keys = jax.random.split(key, asked.camera.intrinsics_4.shape[0])
        after, frames = jax.lax.scan(one, past, (asked.actions_TA, asked.camera, keys))
        frames = jax.tree.map(lambda x: x[:, 0], frames)
        last = jax.tree.map(lambda x: x[-1:], frames)
        return WorldState(last, after.grid if remember and memory else state.map), frames


def start_in(
    model: PersistModel,
    params: Params,
    frames: Frames,
    classes_XYZ: Array,
    origin_3: Array,
    *,
    depth_scale: float | None = None,
) -> WorldState:
    """Begin a world from a known grid; unknown cells of the first window are generated.

    ``classes_XYZ`` are (n, n, n) class ids around the camera of the first of S ≥ 1 frames, −1 where
    unknown, and ``origin_3`` the world position of their lowest corner, metres.

    Raises:
        UserError: as for ``worlds.start``, or the shape of the grid is another.
    """
    frames = checks.check_frames(frames, "start_in", depth_scale)
    return _start_in(model, params, frames, classes_XYZ, origin_3, depth_scale)


@functools.partial(jax.jit, static_argnums=0, inline=True)
def _start_in(
    model: PersistModel,
    params: Params,
    frames: Frames,
    classes_XYZ: Array,
    origin_3: Array,
    depth_scale: Array | None,
) -> WorldState:
    frames = checks.in_metres(frames, depth_scale)
    checks.require_frames(model, frames, "start_in")
    if jnp.ndim(classes_XYZ) != 3 or jnp.shape(origin_3) != (3,):
        raise UserError(
            f"start_in() got cells of shape {jnp.shape(classes_XYZ)} from {jnp.shape(origin_3)}: "
            "give (n, n, n) class ids and the (3,) lowest corner in metres."
        )
    params, frames = _as_arrays(params, as_signal(frames))
    empty = model.memory.empty(model, frames.camera.world_from_camera[0, :3, 3])
    size, origin = model.cell, jnp.asarray(origin_3, jnp.float32)
    # The world's lattice of cells is that of the given ones.
    off = jnp.round((empty.low_3 - origin) / size)
    low = origin + off * size
    given = jnp.asarray(classes_XYZ).astype(jnp.int16)
    shape = empty.classes_XYZ.shape
    given = grid_state.cut_box(given, off.astype(jnp.int32), shape)
    cells = jnp.where(given >= 0, given, empty.classes_XYZ)
    mask = jnp.where(given >= 0, jnp.uint8(OBSERVED), jnp.uint8(GUESSED))
    return _begin(model, params, ClassGrid(cells, low, mask_XYZ=mask), frames)


def edit(state: WorldState, change: Callable[..., ClassGrid], *arguments: Any) -> WorldState:
    """Change the voxels of a world; the next frames show the change.

    ``change`` is a function of ``memory.class_grid``; its arguments are the grid's settings and
    those after the grid::

        state = edit(state, class_grid.place, model.memory, box_23, number)
        state = edit(state, class_grid.erase, model.memory, box_23)
        state = edit(state, class_grid.move, model.memory, box_23, transform)
        piece = class_grid.copy(model.memory, state.map, box_23)
        state = edit(state, class_grid.paste, model.memory, piece, transform)
    """
    config, *rest = arguments
    changed = change(config, state.map, *rest)
    return WorldState(state.frame, dataclasses.replace(changed, history=state.map.history))


@functools.partial(jax.jit, static_argnums=0, inline=True)
def render_true(
    model: PersistModel,
    params: Params,
    state: WorldState,
    control: Any,
    classes_TXYZ: Array,
    origin_T3: Array,
    key: Array,
) -> tuple[WorldState, Frames]:
    """Render given voxels: the upper bound of the renderer's quality.

    The state is from ``start_in``, with the same lattice of cells as the (n, R, R, R) recorded
    grids, whose lowest corners are ``origin_T3``, metres. The control has n cameras.
    """
    params = _as_arrays(params)[0]
    asked, _ = _steering(model, state.frame.camera, control)
    past = past_of(model, params, state)
    size, low = model.cell, state.map.low_3

    def one(past: Past, inputs: Any) -> tuple[Past, Frames]:
        action, camera, classes, origin, frame_key = inputs
        first = grid_state.first_cell(model, low, camera.world_from_camera[:3, 3])
        recorded = jnp.round((origin - low) / size).astype(jnp.int32)
        grid = grid_state.cut_box(classes.astype(jnp.int16), first - recorded, model.side)
        known = KnownFrame(camera=camera, classes_XYZ=grid, start_3=first)
        return step(model, params, past, action, frame_key, known)

    keys = jax.random.split(key, asked.camera.intrinsics_4.shape[0])
    inputs = (asked.actions_TA, asked.camera, jnp.asarray(classes_TXYZ), origin_T3, keys)
    after, frames = jax.lax.scan(one, past, inputs)
    frames = jax.tree.map(lambda x: x[:, 0], frames)
    return WorldState(jax.tree.map(lambda x: x[-1:], frames), after.grid), frames


def past_of(model: PersistModel, params: Params, state: WorldState) -> Past:
    """Return the input of a step from a state."""
    frame = state.frame
    latents = encode_picture(model, params, frame.rgb_THWC[0], frame.depth_THW[0])
    camera = jax.tree.map(lambda x: x[0], frame.camera)
    return Past(state.map, grid_state.shown_picture(latents, frame.depth_THW[0], camera))


def _as_arrays(*trees: Any) -> Any:
    """Return trees of JAX arrays: loaded weights are NumPy's, which traced indices cannot index."""
    return jax.tree.map(jnp.asarray, trees)


def _begin_from_frames(
    model: PersistModel, params: Params, frames: Frames, *, real: bool = True
) -> WorldState:
    """Return a world of which only frames are known."""
    params, frames = _as_arrays(params, as_signal(frames))
    grid = model.memory.empty(model, frames.camera.world_from_camera[0, :3, 3])
    return _begin(model, params, grid, frames, real=real)


def _begin(
    model: PersistModel, params: Params, grid: ClassGrid, frames: Frames, *, real: bool = True
) -> WorldState:
    first, later = (jax.tree.map(lambda x, c=c: x[c], frames) for c in (slice(1), slice(1, None)))
    key = jax.random.key(START)
    past = begin(model, params, grid, first, key, real=real)
    if not later.depth_THW.shape[0]:
        return WorldState(first, past.grid)
    return _observe(model, params, past, later)


def _observe(model: PersistModel, params: Params, past: Past, frames: Frames) -> WorldState:
    """Advance the voxels along real frames."""
    count = frames.depth_THW.shape[0]
    here = past.shown.camera.world_from_camera[None]
    poses = jnp.concatenate([here, frames.camera.world_from_camera])
    actions = _actions_between(model, poses)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(START), 1), count)

    def one(past: Past, inputs: tuple[Frames, Array, Array]) -> tuple[Past, None]:
        frame, action, key = inputs
        known = KnownFrame(frame.camera, frame.rgb_THWC, frame.depth_THW)
        return step(model, params, past, action, key, known)[0], None

    past, _ = jax.lax.scan(one, past, (frames, actions, keys))
    return WorldState(jax.tree.map(lambda x: x[-1:], frames), past.grid)


def _actions_between(model: PersistModel, poses: Array) -> Array:
    """Return the actions between cameras; zeros where they are not planar and so unknown."""
    if model.control.actions == action_geometry.PLANAR:
        return action_geometry.actions_between(poses)
    return jnp.zeros((len(poses) - 1, model.control.actions))


def _steering(model: PersistModel, present: Camera, control: Any) -> tuple[Control, bool]:
    """Return cameras and actions of the frames to imagine, and whether only actions steer."""
    planar = model.control.actions == action_geometry.PLANAR
    if isinstance(control, Camera) and planar:
        control = Control(control)
    if isinstance(control, Control) and control.actions_TA is None and planar:
        poses = jnp.asarray(control.camera.world_from_camera)
        if poses.ndim == 3:
            whole = jnp.concatenate([present.world_from_camera, poses])
            actions = action_geometry.actions_between(whole)
            control = dataclasses.replace(control, actions_TA=actions)
    steered = not isinstance(control, (Camera, Control))
    asked = control_of(model, present, control)
    return asked, steered
