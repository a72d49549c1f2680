"""One step of the world ``persist``: voxels, camera, features, picture (arXiv 2603.03482).

Frames come one by one, so arrays have no batch; the networks are given one of 1.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.config import PersistConfig
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer
from pewm_jax.types import Array, Camera, Frames, Params
from pewm_jax.worlds.persist import pictures as persist_pictures
from pewm_jax.worlds.persist import sight as persist_sight
from pewm_jax.worlds.persist import voxels as persist_voxels
from pewm_jax.worlds.persist import windows
from pewm_jax.worlds.persist.past import Given, History, Past, decoded, encoded
from pewm_jax.worlds.persist.sight import ObservedCells


def begin(
    model: PersistConfig,
    params: Params,
    grid: ClassGrid,
    frame: Frames,
    key: Array,
    *,
    real: bool = True,
) -> Past:
    """Return the world at its first frame; where nothing is known of its window, w₀ is generated.

    Args:
        model: the model.
        params: all parameters.
        grid: what is known of the world.
        frame: (1,) the first frame, colours in [−1, 1].
        key: randomness of w₀.
        real: whether the frame is real, and shows what is there (``model.sight``).
    """
    camera = jax.tree.map(lambda x: x[0], frame.camera)
    latents = encoded(model, params, frame.rgb_THWC[0], frame.depth_THW[0])
    shown = windows.shown_of(latents, frame.depth_THW[0], camera)
    nets = model.backbone
    dtype = jnp.dtype(model.dtype)
    start = windows.first_cell(model, grid.low_3, camera.world_from_camera[:3, 3])
    history = History(
        voxel_dit.empty_cache(nets.world_frames, 1, dtype),  # type: ignore[attr-defined]
        camera_model.empty_cache(nets.camera_model, 1, dtype),  # type: ignore[attr-defined]
        voxel_renderer.empty_cache(nets.renderer, 1, dtype),  # type: ignore[attr-defined]
        jnp.zeros((model.control.actions,)),
        shown,
        start,
    )
    voxel_key, picture_key = jax.random.split(key)
    before = windows.window(model, grid.classes_XYZ, start)
    middle = windows.middle(model, grid.low_3, start)
    sight = None
    if real:
        sight = _sight(model, grid, start, frame.rgb_THWC[0], frame.depth_THW[0], camera)
    made = persist_voxels.sample(
        model, params, history, history.voxels, middle, before, voxel_key, sight
    )
    classes = jnp.where(before >= 0, before, made)  # a known grid is not changed by its picture
    everything = windows.written(grid.classes_XYZ, classes, start)
    seen = persist_pictures.features(model, params, classes, grid.low_3, start, camera)
    pictures = persist_pictures.remembered(
        model, params, latents, seen, history.action_A, history.pictures, picture_key
    )
    history = dataclasses.replace(history, pictures=pictures)
    return Past(ClassGrid(everything, grid.low_3, history), shown)


def step(
    model: PersistConfig,
    params: Params,
    past: Past,
    action_A: Array,
    key: Array,
    given: Given | None = None,
) -> tuple[Past, Frames]:
    """Carry the world on by one frame.

    Args:
        model: the model.
        params: all parameters.
        past: the world so far.
        action_A: the action that leads to the frame.
        key: randomness.
        given: what is known of the frame.

    Returns:
        The world after it, and the frame, (1,).
    """
    given = Given() if given is None else given
    grid, history, here = past.grid, past.grid.history, past.shown.camera
    keys = jax.random.split(key, 4)
    camera = given.camera
    if camera is None:
        camera = persist_pictures.reckoned(model, here, action_A)
    start = given.start_3
    if start is None:
        start = windows.first_cell(model, grid.low_3, camera.world_from_camera[:3, 3])
    middle = windows.middle(model, grid.low_3, start)
    before = windows.window(model, grid.classes_XYZ, start)
    cache = windows.moved(model, history.voxels, history.start_3, start)
    cache = persist_voxels.taken_in(model, params, history, cache, middle, before, keys[0])
    now = dataclasses.replace(history, action_A=action_A, shown=past.shown)
    classes = given.classes_XYZ
    if classes is None:
        sight = None
        if given.rgb_HWC is not None and given.depth_HW is not None:
            sight = _sight(model, grid, start, given.rgb_HWC, given.depth_HW, camera)
        classes = persist_voxels.sample(model, params, now, cache, middle, before, keys[1], sight)
    everything = windows.written(grid.classes_XYZ, classes, start)
    made, cameras = persist_pictures.next_camera(
        model, params, everything, grid.low_3, here, action_A, history.cameras
    )
    camera = made if given.camera is None else camera
    seen = persist_pictures.features(model, params, classes, grid.low_3, start, camera)
    if given.rgb_HWC is None:
        latents = persist_pictures.sample(model, params, seen, action_A, history.pictures, keys[2])
        rgb, depth = decoded(model, params, latents)
    else:
        rgb, depth = given.rgb_HWC, given.depth_HW
        latents = encoded(model, params, rgb, depth)
    pictures = persist_pictures.remembered(
        model, params, latents, seen, action_A, history.pictures, keys[3]
    )
    history = dataclasses.replace(
        now, voxels=cache, cameras=cameras, pictures=pictures, start_3=start
    )
    after = Past(
        ClassGrid(everything, grid.low_3, history),
        windows.shown_of(latents, depth, camera),
    )
    one = jax.tree.map(lambda x: x[None], (rgb, depth, camera))
    return after, Frames(*one)


def _sight(
    model: PersistConfig,
    grid: ClassGrid,
    start_3: Array,
    rgb_HWC: Array,
    depth_HW: Array,
    camera: Camera,
) -> ObservedCells | None:
    """Return what a real picture shows of the window's cells, where the model looks."""
    if not model.sight:
        return None
    corner = grid.low_3 + start_3 * windows.cell_m(model)
    return persist_sight.seen(model, corner, rgb_HWC, depth_HW, camera)
