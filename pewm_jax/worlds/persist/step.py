"""One step of the world ``persist``: voxels, camera, features, image (arXiv 2603.03482).

Frames are processed one by one, so arrays have no batch axis; the networks get one of 1.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from pewm_jax.geometry.actions import (
    CAMERA_STEP_NUMBERS,
    camera_numbers,
    follow_camera_steps,
    step_pose,
)
from pewm_jax.memory.class_grid import EMPTY, OBSERVED, SHOWN, UNKNOWN, ClassGrid
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.types import Array, Camera, Frames, Params, View
from pewm_jax.worlds.persist import state as grid_state
from pewm_jax.worlds.persist import voxel_frames
from pewm_jax.worlds.persist.config import PersistModel
from pewm_jax.worlds.persist.state import (
    History,
    KnownFrame,
    Past,
    ShownPicture,
    decode_picture,
    encode_picture,
    noisy_context,
)
from pewm_jax.worlds.persist.voxel_frames import ObservedCells


def reckoned_camera(model: PersistModel, here: Camera, action_A: Array) -> Camera:
    """Return the camera that a planar action leads to; the present camera for other actions."""
    if model.control.actions != 3:
        return here
    return Camera(here.intrinsics_4, step_pose(here.world_from_camera, action_A))


def reckoned_steps(model: PersistModel, actions_A: Array) -> Array:
    """Return the steps (..., 6) to which the camera model's output is added."""
    if not model.dead_reckoning:
        return jnp.zeros((*actions_A.shape[:-1], CAMERA_STEP_NUMBERS))
    dx, dy, turn = jnp.moveaxis(actions_A, -1, 0)
    still = jnp.zeros_like(dx)
    return jnp.stack([dx, dy, still, still, turn, still], -1)


def next_camera(
    model: PersistModel,
    params: Params,
    classes_XYZ: Array,
    low_3: Array,
    here: Camera,
    action_A: Array,
    cache: FrameCache,
) -> tuple[Camera, FrameCache]:
    """Return the next camera, predicted from the voxels around the present one."""
    config = model.backbone.camera_model
    place, size = here.world_from_camera[:3, 3], model.cell
    cell = jnp.floor((place - low_3) / size).astype(jnp.int32)
    inner = grid_state.cut_box(classes_XYZ, cell - config.inner // 2, config.inner)
    seen = camera_numbers(here, model.clip.width, low_3 + cell * size)
    made, cache = camera_model.apply(
        config,
        params["camera_model"],
        jnp.maximum(inner, 0).astype(jnp.int32)[None, None],
        seen[None, None],
        action_A[None, None],
        dtype=jnp.dtype(model.dtype),
        cache=cache,
    )  # type: ignore[assignment]
    change = made[0, 0] + reckoned_steps(model, action_A)
    return follow_camera_steps(here, change, model.clip.width), cache


def features(
    model: PersistModel,
    params: Params,
    classes_XYZ: Array,
    low_3: Array,
    start_3: Array,
    camera: Camera,
) -> Array:
    """Return the features (1, 1, h, w, F) of a window seen by a camera; rays have no gradient."""
    config = model.backbone.renderer
    camera = jax.lax.stop_gradient(camera)
    corner = low_3 + start_3 * model.cell
    layers = voxel_renderer.cast_rays(
        config,
        jnp.maximum(classes_XYZ, 0)[None],
        corner[None],
        model.cell,
        jax.tree.map(lambda x: x[None], camera),
        (model.clip.height, model.clip.width),
    )
    colours = None
    if config.drawn:
        colours = draw_latents(model, params, classes_XYZ, corner, camera)[None]
    dtype = jnp.dtype(model.dtype)
    return voxel_renderer.features(config, params["renderer"], layers, dtype, drawn_hwC=colours)[
        None
    ]


def draw_latents(
    model: PersistModel, params: Params, classes_XYZ: Array, corner_3: Array, camera: Camera
) -> Array:
    """Return latents (h, w, C) of a window drawn in the colours of its classes, without light.

    ``corner_3`` is the window's lowest corner, metres.
    """
    view = _draw(model, classes_XYZ, corner_3, camera)
    return encode_picture(model, params, view.features_THWF[0], view.depth_THW[0])


def _draw(model: PersistModel, classes_XYZ: Array, corner_3: Array, camera: Camera) -> View:
    """Return the view (1, H, W) of a window's cells in the colours of their classes."""
    one = jax.tree.map(lambda x: x[None], camera)
    cells = ClassGrid(classes_XYZ, corner_3)
    view = model.memory.render(model, cells, one, model.clip.height, model.clip.width)
    assert view is not None
    return view


def shown_cells(model: PersistModel, classes_XYZ: Array, corner_3: Array, camera: Camera) -> Array:
    """Return (X, Y, Z) bool: the cells of a window that its own view shows, empty or filled."""
    depth = _draw(model, classes_XYZ, corner_3, camera).depth_THW[0]
    air, surface = voxel_frames.visible_cells(model, corner_3, depth, camera)
    return air | surface


def marked(
    model: PersistModel,
    grid: ClassGrid,
    start_3: Array,
    classes_XYZ: Array,
    evidence: ObservedCells | None,
    camera: Camera | None = None,
    stood_XYZ: Array | None = None,
) -> Array | None:
    """Return a world's mask after a frame: what was observed stays observed.

    ``stood_XYZ`` are the cells of the window that the agent stands in. ``evidence`` is that of a
    real frame. An imagined frame, of ``camera``, marks the cells of the window that it shows, if
    guesses that were shown count otherwise than those that were not.
    """
    if grid.mask_XYZ is None:
        return None
    mask = grid_state.window(model, grid.mask_XYZ, start_3)
    if evidence is not None:  # cells whose class contradicts it were not understood
        filled = classes_XYZ > EMPTY
        seen = jnp.where(filled, evidence.colour_XYZ >= 0, evidence.air_XYZ)
        mask = jnp.where(seen, jnp.uint8(OBSERVED), mask)
    guess, shown, _ = model.kept_logits
    if camera is not None and guess != shown:
        corner = grid.low_3 + start_3 * model.cell
        seen = shown_cells(model, classes_XYZ, corner, jax.lax.stop_gradient(camera))
        mask = jnp.where(seen, jnp.maximum(mask, jnp.uint8(SHOWN)), mask)
    if stood_XYZ is not None:
        mask = jnp.where(stood_XYZ, jnp.uint8(OBSERVED), mask)
    return grid_state.write_window(grid.mask_XYZ, mask, start_3)


def stood_in(
    model: PersistModel,
    grid: ClassGrid,
    start_3: Array,
    classes_XYZ: Array,
    camera: Camera,
    evidence: ObservedCells | None,
) -> Array | None:
    """Return (X, Y, Z) bool: the cells that the agent's body shows to be empty; None without one.

    ``classes_XYZ`` are the cells of the window at ``start_3``. Surfaces that an image has shown,
    now or before, stay.
    """
    if not model.body_m:
        return None
    eye = jax.lax.stop_gradient(camera).world_from_camera[:3, 3]
    surface = jnp.zeros(classes_XYZ.shape, bool)
    mask = _mask_window(model, grid, start_3)
    if mask is not None:
        surface = (mask == OBSERVED) & (classes_XYZ > EMPTY)
    if evidence is not None:
        surface = surface | (evidence.colour_XYZ >= 0)
    return voxel_frames.body_cells(model, grid.low_3 + start_3 * model.cell, eye) & ~surface


Render = Callable[[Array, Array], tuple[Array, FrameCache]]
"""``(x, times_BT) -> (prediction, cache)``: the renderer of one frame."""


def renderer(
    model: PersistModel, params: Params, features: Array, action_A: Array, cache: FrameCache
) -> Render:
    """Return the renderer of a frame with these features, after the frames in the cache."""
    config, noise = model.backbone.renderer, model.noise

    def render(x: Array, times_BT: Array) -> tuple[Array, FrameCache]:
        inputs, network_times = noise.precondition(x, times_BT)
        return voxel_renderer.apply(
            config,
            params["renderer"],
            inputs.astype(jnp.dtype(model.dtype)),
            network_times,
            features,
            actions_BTA=action_A[None, None] if config.actions else None,
            cache=cache,
        )  # type: ignore[return-value]

    return render


def sample(model: PersistModel, render: Render, key: Array) -> Array:
    """Sample the latents (h, w, C) of an image of the voxels."""
    config, noise = model.backbone.renderer, model.noise
    shape = (1, 1, config.height, config.width, config.latent_channels)

    def denoise(x: Array, time_B: Array, weight: Array) -> Array:
        del weight
        times = time_B[:, None]
        return noise.to_x0(render(x, times)[0].astype(jnp.float32), x, times)

    return noise.sample(denoise, jax.random.normal(key, shape))[0, 0]


def add_picture(model: PersistModel, render: Render, latents_hwC: Array, key: Array) -> FrameCache:
    """Add an image to the renderer's cache."""
    return render(*noisy_context(model.noise, latents_hwC[None, None], key))[1]


def begin(
    model: PersistModel,
    params: Params,
    grid: ClassGrid,
    frame: Frames,
    key: Array,
    *,
    real: bool = True,
) -> Past:
    """Return the world at its first frame (1,); unknown cells of its window are generated.

    A ``real`` frame is evidence of its voxels.
    """
    camera = jax.tree.map(lambda x: x[0], frame.camera)
    latents = encode_picture(model, params, frame.rgb_THWC[0], frame.depth_THW[0])
    shown = grid_state.shown_picture(latents, frame.depth_THW[0], camera)
    start = grid_state.first_cell(model, grid.low_3, camera.world_from_camera[:3, 3])
    history = _no_history(model, shown, start)
    voxel_key, picture_key = jax.random.split(key)
    before = grid_state.window(model, grid.classes_XYZ, start)
    middle = grid_state.middle(model, grid.low_3, start)
    evidence = None
    if real:
        evidence = _evidence(model, grid, start, frame.rgb_THWC[0], frame.depth_THW[0], camera)
    mask = _mask_window(model, grid, start)
    made = voxel_frames.sample(
        model, params, history, history.voxels, middle, before, voxel_key, evidence, mask
    )
    classes = jnp.where(before >= 0, before, made)  # a known grid is not changed by its picture
    stood = stood_in(model, grid, start, classes, camera, evidence)
    classes = classes if stood is None else jnp.where(stood, EMPTY, classes)
    everything = grid_state.write_window(grid.classes_XYZ, classes, start)
    everywhere = marked(model, grid, start, classes, evidence, stood_XYZ=stood)
    seen = features(model, params, classes, grid.low_3, start, camera)
    render = renderer(model, params, seen, history.action_A, history.pictures)
    pictures = add_picture(model, render, latents, picture_key)
    history = dataclasses.replace(history, pictures=pictures)
    return Past(ClassGrid(everything, grid.low_3, history, everywhere), shown)


def _no_history(model: PersistModel, shown: ShownPicture, start_3: Array) -> History:
    """Return the networks' empty caches before the first frame."""
    nets, dtype = model.backbone, jnp.dtype(model.dtype)
    return History(
        voxel_dit.empty_cache(nets.world_frames, 1, dtype),
        camera_model.empty_cache(nets.camera_model, 1, dtype),
        voxel_renderer.empty_cache(nets.renderer, 1, dtype),
        jnp.zeros((model.control.actions,)),
        shown,
        start_3,
    )


def imagine_window(
    model: PersistModel, params: Params, grid: ClassGrid, frame: Frames, key: Array
) -> Array:
    """Return the cells of a grid as large as a window, generated from one real image (H, W)."""
    start, camera = jnp.zeros(3, jnp.int32), frame.camera
    latents = encode_picture(model, params, frame.rgb_THWC, frame.depth_THW)
    shown = grid_state.shown_picture(latents, frame.depth_THW, camera)
    history = _no_history(model, shown, start)
    evidence = _evidence(model, grid, start, frame.rgb_THWC, frame.depth_THW, camera)
    middle = grid_state.middle(model, grid.low_3, start)
    cells, mask = grid.classes_XYZ, grid.mask_XYZ
    return voxel_frames.sample(
        model, params, history, history.voxels, middle, cells, key, evidence, mask
    )


def step(
    model: PersistModel,
    params: Params,
    past: Past,
    action_A: Array,
    key: Array,
    known: KnownFrame | None = None,
) -> tuple[Past, Frames]:
    """Advance the world by one frame, and return it with the frame, (1,).

    ``action_A`` leads to the frame, and ``known`` holds the known parts of it.
    """
    known = KnownFrame() if known is None else known
    grid, history, here = past.grid, past.grid.history, past.shown.camera
    keys = jax.random.split(key, 4)
    camera = known.camera
    if camera is None:
        camera = reckoned_camera(model, here, action_A)
    start = known.start_3
    if start is None:
        start = grid_state.first_cell(model, grid.low_3, camera.world_from_camera[:3, 3])
    classes, real = known.classes_XYZ, known.rgb_HWC is not None
    evidence, grid = _known_evidence(model, grid, start, known, camera)
    middle = grid_state.middle(model, grid.low_3, start)
    before = grid_state.window(model, grid.classes_XYZ, start)
    cache = grid_state.move_cache(model, history.voxels, history.start_3, start)
    mask = _mask_window(model, grid, start)
    cache = voxel_frames.add_present(model, params, history, cache, middle, before, keys[0], mask)
    now = dataclasses.replace(history, action_A=action_A, shown=past.shown)
    if classes is None:

        def sampled() -> Array:
            key = keys[1]
            return voxel_frames.sample(
                model, params, now, cache, middle, before, key, evidence, mask
            )

        if model.sampled == "always" or real:
            classes = sampled()
        else:
            kept = before.astype(jnp.int32)
            classes = jax.lax.cond((before == UNKNOWN).any(), sampled, lambda: kept)
    everything = grid_state.write_window(grid.classes_XYZ, classes, start)
    made, cameras = next_camera(
        model, params, everything, grid.low_3, here, action_A, history.cameras
    )
    camera = made if known.camera is None else camera
    stood = None  # given cells stay
    if known.classes_XYZ is None:
        stood = stood_in(model, grid, start, classes, camera, evidence)
    if stood is not None:
        classes = jnp.where(stood, EMPTY, classes)
        everything = grid_state.write_window(grid.classes_XYZ, classes, start)
    everywhere = marked(model, grid, start, classes, evidence, None if real else camera, stood)
    seen = features(model, params, classes, grid.low_3, start, camera)
    render = renderer(model, params, seen, action_A, history.pictures)
    if known.rgb_HWC is None:
        latents = sample(model, render, keys[2])
        rgb, depth = decode_picture(model, params, latents)
    else:
        rgb, depth = known.rgb_HWC, known.depth_HW
        latents = encode_picture(model, params, rgb, depth)
    pictures = add_picture(model, render, latents, keys[3])
    history = dataclasses.replace(
        now, voxels=cache, cameras=cameras, pictures=pictures, start_3=start
    )
    after = Past(
        ClassGrid(everything, grid.low_3, history, everywhere),
        grid_state.shown_picture(latents, depth, camera),
    )
    one = jax.tree.map(lambda x: x[None], (rgb, depth, camera))
    return after, Frames(*one)


def _mask_window(model: PersistModel, grid: ClassGrid, start_3: Array) -> Array | None:
    """Return the mask of a window's cells, if the world keeps one."""
    return None if grid.mask_XYZ is None else grid_state.window(model, grid.mask_XYZ, start_3)


def _known_evidence(
    model: PersistModel, grid: ClassGrid, start_3: Array, known: KnownFrame, camera: Camera
) -> tuple[ObservedCells | None, ClassGrid]:
    """Return the evidence of a known frame, and a grid without what it shows to have moved."""
    if known.classes_XYZ is not None or known.rgb_HWC is None or known.depth_HW is None:
        return None, grid
    found = _evidence(model, grid, start_3, known.rgb_HWC, known.depth_HW, camera)
    return found, grid if found is None else voxel_frames.forget_moved(model, grid, start_3, found)


def _evidence(
    model: PersistModel,
    grid: ClassGrid,
    start_3: Array,
    rgb_HWC: Array,
    depth_HW: Array,
    camera: Camera,
) -> ObservedCells | None:
    """Return the evidence of a real image, if the model uses it and has depth."""
    guess, shown, observed = model.kept_logits
    used = model.observation_logit or model.backbone.world_frames.map_embed or model.moving
    if not model.clip.depth or not (used or guess != observed or shown != observed):
        return None
    corner = grid.low_3 + start_3 * model.cell
    return voxel_frames.observe_cells(model, corner, rgb_HWC, depth_HW, camera)
