"""One step of the world ``persist``: voxels, camera, features, picture (arXiv 2603.03482).

``Past`` is all that a step needs of what was. Frames come one by one, so arrays have no batch; the
networks are given one of 1.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import NoiseSettings, PersistConfig
from pewm_jax.diffusion import noise as noises
from pewm_jax.geometry import camera_steps
from pewm_jax.geometry.actions import step_pose
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.models import camera_model, codecs, voxel_dit, voxel_renderer, voxel_vae
from pewm_jax.models.frame_blocks import FrameCache
from pewm_jax.models.plain_layers import linear
from pewm_jax.types import Array, Camera, Frames, Params
from pewm_jax.worlds import persist_windows as windows
from pewm_jax.worlds.persist_windows import Shown


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class History:
    """What the networks keep of the frames so far.

    The present voxel frame is not in ``voxels`` yet: it is encoded anew when the next one is made,
    so that what was edited counts.

    Attributes:
        voxels: of the world frames' transformer, up to the frame before the present one.
        cameras: of the camera model, up to the present frame.
        pictures: of the renderer, up to the present frame.
        action_A: the action that led to the present frame.
        shown: the picture that the present voxel frame was shown.
        start_3: int32, first cell of the present window in the world's grid.
    """

    voxels: FrameCache
    cameras: FrameCache
    pictures: FrameCache
    action_A: Array
    shown: Shown
    start_3: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Past:
    """The world before a step.

    Attributes:
        grid: the world's voxels, with their ``History``.
        shown: the present picture as the next voxel frame is shown it.
    """

    grid: ClassGrid
    shown: Shown


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Given:
    """What is known of the frame that a step leads to; None is made by the networks.

    Attributes:
        camera: its camera.
        rgb_HWC: its colours in [−1, 1], with ``depth_HW``.
        depth_HW: its depth, metres.
        classes_XYZ: its voxels, a window at ``start_3``.
        start_3: int32, where that window begins in the world's grid.
    """

    camera: Camera | None = None
    rgb_HWC: Array | None = None
    depth_HW: Array | None = None
    classes_XYZ: Array | None = None
    start_3: Array | None = None


def encoded(model: PersistConfig, params: Params, rgb_HWC: Array, depth_HW: Array) -> Array:
    """Return the latents (h, w, C) of a picture: those of its depth with them, if it has any."""
    both = codecs.encode_rgbd(model, params, rgb_HWC[None, None], depth_HW[None, None])
    return both[0, 0, ..., : model.picture_channels]


def decoded(model: PersistConfig, params: Params, latents_hwC: Array) -> tuple[Array, Array]:
    """Return colours (H, W, 3) and depth (H, W) of a picture's latents; depth 0 without any."""
    missing = model.codec.channels - latents_hwC.shape[-1]
    latents = jnp.pad(latents_hwC, ((0, 0), (0, 0), (0, missing)))
    rgb, depth = codecs.decode_rgbd(model, params, latents[None, None])
    return rgb[0, 0], depth[0, 0] if model.clip.depth else jnp.zeros_like(depth[0, 0])


def begin(model: PersistConfig, params: Params, grid: ClassGrid, frame: Frames, key: Array) -> Past:
    """Return the world at its first frame; where nothing is known of its window, w₀ is generated.

    Args:
        model: the model.
        params: all parameters.
        grid: what is known of the world.
        frame: (1,) the first frame, colours in [−1, 1].
        key: randomness of w₀.
    """
    camera = jax.tree.map(lambda x: x[0], frame.camera)
    latents = encoded(model, params, frame.rgb_THWC[0], frame.depth_THW[0])
    shown = windows.shown_of(latents, frame.depth_THW[0], camera)
    nets = model.backbone
    dtype = jnp.dtype(model.dtype)
    start = windows.first_cell(model, grid.low_3, camera.world_from_camera[:3, 3])
    history = History(
        voxel_dit.no_frames(nets.world_frames, 1, dtype),  # type: ignore[attr-defined]
        camera_model.no_frames(nets.camera_model, 1, dtype),  # type: ignore[attr-defined]
        voxel_renderer.no_frames(nets.renderer, 1, dtype),  # type: ignore[attr-defined]
        jnp.zeros((model.control.actions,)),
        shown,
        start,
    )
    voxel_key, picture_key = jax.random.split(key)
    before = windows.window(model, grid.classes_XYZ, start)
    middle = windows.middle(model, grid.low_3, start)
    made = voxels(model, params, history, history.voxels, middle, before, voxel_key)
    classes = jnp.where(before >= 0, before, made)  # a known grid is not changed by its picture
    everything = windows.written(grid.classes_XYZ, classes, start)
    seen = _features(model, params, classes, grid.low_3, start, camera)
    pictures = _remembered(
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
        camera = _reckoned(model, here, action_A)
    start = given.start_3
    if start is None:
        start = windows.first_cell(model, grid.low_3, camera.world_from_camera[:3, 3])
    middle = windows.middle(model, grid.low_3, start)
    before = windows.window(model, grid.classes_XYZ, start)
    cache = windows.moved(model, history.voxels, history.start_3, start)
    cache = _taken_in(model, params, history, cache, middle, before, keys[0])
    now = dataclasses.replace(history, action_A=action_A, shown=past.shown)
    classes = given.classes_XYZ
    if classes is None:
        classes = voxels(model, params, now, cache, middle, before, keys[1])
    everything = windows.written(grid.classes_XYZ, classes, start)
    cameras = history.cameras
    if given.camera is None:
        camera, cameras = _camera(model, params, everything, grid.low_3, here, action_A, cameras)
    seen = _features(model, params, classes, grid.low_3, start, camera)
    if given.rgb_HWC is None:
        latents = _picture(model, params, seen, action_A, history.pictures, keys[2])
        rgb, depth = decoded(model, params, latents)
    else:
        rgb, depth = given.rgb_HWC, given.depth_HW
        latents = encoded(model, params, rgb, depth)
    pictures = _remembered(model, params, latents, seen, action_A, history.pictures, keys[3])
    history = dataclasses.replace(
        now, voxels=cache, cameras=cameras, pictures=pictures, start_3=start
    )
    after = Past(
        ClassGrid(everything, grid.low_3, history),
        windows.shown_of(latents, depth, camera),
    )
    one = jax.tree.map(lambda x: x[None], (rgb, depth, camera))
    return after, Frames(*one)


def voxels(
    model: PersistConfig,
    params: Params,
    history: History,
    cache: FrameCache,
    middle_3: Array,
    before_XYZ: Array,
    key: Array,
) -> Array:
    """Sample a voxel frame: (X, Y, Z) class ids.

    Args:
        model: the model.
        params: all parameters.
        history: gives the action that leads to the frame, and the picture that it is shown.
        cache: of the frames before it.
        middle_3: the middle of its window, metres.
        before_XYZ: the window's cells before; where they are known, ``model.hold`` counts.
        key: randomness.
    """
    config, noise = model.backbone.world_frames, model.voxel_noise  # type: ignore[attr-defined]
    asked = _asked(model, history, middle_3)
    shape = (1, 1, *(config.latent_side,) * 3, config.latent_channels)

    def denoise(x: Array, time_B: Array, weight: Array) -> Array:
        del weight
        times = time_B[:, None]
        inputs, network_times = noises.shown(noise, x, times)
        inputs = inputs.astype(jnp.dtype(model.dtype))
        made, _ = voxel_dit.apply(
            config, params["voxel_dit"], inputs, network_times, **asked, cache=cache
        )
        return noises.to_x0(noise, made.astype(jnp.float32), x, times)

    latents = noises.sample(noise, denoise, jax.random.normal(key, shape))[:, 0]
    return held(model, params, latents, before_XYZ)


def held(model: PersistConfig, params: Params, latents_BxyzC: Array, before_XYZ: Array) -> Array:
    """Return the class ids (X, Y, Z) that latents (1, …) decode to.

    A cell whose class was known has another one only if that is likelier by ``model.hold``.
    """
    config = model.backbone.voxel_vae  # type: ignore[attr-defined]
    weights, dtype = params["voxel_vae"], jnp.dtype(model.dtype)
    if not model.hold:
        return voxel_vae.decode(config, weights, latents_BxyzC, dtype)[0]
    seen = voxel_vae.features(config, weights, latents_BxyzC, dtype)[0]

    def likeliest(slab: tuple[Array, Array]) -> Array:
        features, before = slab
        scores = linear(weights["decoder"]["scores"], features).astype(jnp.float32)
        same = jnp.arange(config.classes) == before[..., None]
        return (scores + model.hold * same).argmax(-1).astype(jnp.int32)

    slab = config.slab or config.side
    cut = (x.reshape(-1, slab, *x.shape[1:]) for x in (seen, before_XYZ.astype(jnp.int32)))
    return jax.lax.map(likeliest, tuple(cut)).reshape(before_XYZ.shape)


def _asked(model: PersistConfig, history: History, middle_3: Array) -> dict[str, Any]:
    """Return the transformer's condition of one voxel frame."""
    config, shown = model.backbone.world_frames, history.shown  # type: ignore[attr-defined]
    told = windows.told(model, shown, middle_3)
    camera = camera_steps.numbers(shown.camera, model.clip.width, middle_3)
    return {
        "actions_BTA": history.action_A[None, None],
        "pixels_BThwC": told[None, None],
        "camera_BTN": camera[None, None] if config.camera_numbers else None,
    }


def _taken_in(
    model: PersistConfig,
    params: Params,
    history: History,
    cache: FrameCache,
    middle_3: Array,
    classes_XYZ: Array,
    key: Array,
) -> FrameCache:
    """Encode the present voxels and add them to the cache; what is not known of them is noise."""
    config, noise = model.backbone.world_frames, model.voxel_noise  # type: ignore[attr-defined]
    vae, dtype = model.backbone.voxel_vae, jnp.dtype(model.dtype)  # type: ignore[attr-defined]
    known = windows.known_latents(model, classes_XYZ)
    ids = jnp.maximum(classes_XYZ, 0).astype(jnp.int32)
    latents = voxel_vae.encode(vae, params["voxel_vae"], ids[None], dtype)[:, None]
    noise_key, unknown_key = jax.random.split(key)
    x, times = _context(noise, latents, noise_key)
    x = jnp.where(known[..., None], x, jax.random.normal(unknown_key, x.shape))
    inputs, network_times = noises.shown(noise, x, times)
    _, cache = voxel_dit.apply(
        config,
        params["voxel_dit"],
        inputs.astype(dtype),
        network_times,
        **_asked(model, history, middle_3),
        cache=cache,
    )  # type: ignore[assignment]
    return cache


def _context(noise: NoiseSettings, x0: Array, key: Array) -> tuple[Array, Array]:
    """Return frames (1, 1, …) with the noise that given ones have, and their times."""
    times = jnp.full(x0.shape[:2], getattr(noise, "context_noise", 0.0))
    drawn = jax.random.normal(key, x0.shape, x0.dtype)
    return noises.corrupt(noise, x0, drawn, times), times


def _reckoned(model: PersistConfig, here: Camera, action_A: Array) -> Camera:
    """Return about where an action leads, to lay the window there: planar ones alone say."""
    if model.control.actions != 3:
        return here
    return Camera(here.intrinsics_4, step_pose(here.world_from_camera, action_A))


def _camera(
    model: PersistConfig,
    params: Params,
    classes_XYZ: Array,
    low_3: Array,
    here: Camera,
    action_A: Array,
    cache: FrameCache,
) -> tuple[Camera, FrameCache]:
    """Return where the camera goes, given the voxels around where it is."""
    config = model.backbone.camera_model  # type: ignore[attr-defined]
    place, size = here.world_from_camera[:3, 3], windows.cell_m(model)
    cell = jnp.floor((place - low_3) / size).astype(jnp.int32)
    inner = windows.cut(classes_XYZ, cell - config.inner // 2, config.inner)
    seen = camera_steps.numbers(here, model.clip.width, low_3 + cell * size)
    made, cache = camera_model.apply(
        config,
        params["camera_model"],
        jnp.maximum(inner, 0).astype(jnp.int32)[None, None],
        seen[None, None],
        action_A[None, None],
        dtype=jnp.dtype(model.dtype),
        cache=cache,
    )  # type: ignore[assignment]
    change = made[0, 0] + reckoning(model, action_A)
    return camera_steps.follow(here, change, model.clip.width), cache


def reckoning(model: PersistConfig, actions_A: Array) -> Array:
    """Return the steps (..., 6) to which the camera model adds what it says."""
    if not model.dead_reckoning:
        return jnp.zeros((*actions_A.shape[:-1], camera_steps.STEPS))
    dx, dy, turn = jnp.moveaxis(actions_A, -1, 0)
    still = jnp.zeros_like(dx)
    return jnp.stack([dx, dy, still, still, turn, still], -1)


def _features(
    model: PersistConfig,
    params: Params,
    classes_XYZ: Array,
    low_3: Array,
    start_3: Array,
    camera: Camera,
) -> Array:
    """Return what the camera sees of a window, (1, 1, h, w, F); no gradient goes through rays."""
    config = model.backbone.renderer  # type: ignore[attr-defined]
    camera = jax.lax.stop_gradient(camera)
    corner = low_3 + start_3 * windows.cell_m(model)
    layers = voxel_renderer.look(
        config,
        jnp.maximum(classes_XYZ, 0)[None],
        corner[None],
        windows.cell_m(model),
        jax.tree.map(lambda x: x[None], camera),
        (model.clip.height, model.clip.width),
    )
    return voxel_renderer.features(config, params["renderer"], layers, jnp.dtype(model.dtype))[None]


def _render(
    model: PersistConfig,
    params: Params,
    x: Array,
    times_BT: Array,
    features: Array,
    action_A: Array,
    cache: FrameCache,
) -> tuple[Array, FrameCache]:
    config, noise = model.backbone.renderer, model.noise  # type: ignore[attr-defined]
    inputs, network_times = noises.shown(noise, x, times_BT)
    return voxel_renderer.apply(
        config,
        params["renderer"],
        inputs.astype(jnp.dtype(model.dtype)),
        network_times,
        features,
        actions_BTA=action_A[None, None] if config.actions else None,
        cache=cache,
    )  # type: ignore[return-value]


def _picture(
    model: PersistConfig,
    params: Params,
    features: Array,
    action_A: Array,
    cache: FrameCache,
    key: Array,
) -> Array:
    """Sample the latents (h, w, C) of a picture of the voxels."""
    config, noise = model.backbone.renderer, model.noise  # type: ignore[attr-defined]
    shape = (1, 1, config.height, config.width, config.latent_channels)

    def denoise(x: Array, time_B: Array, weight: Array) -> Array:
        del weight
        times = time_B[:, None]
        made, _ = _render(model, params, x, times, features, action_A, cache)
        return noises.to_x0(noise, made.astype(jnp.float32), x, times)

    return noises.sample(noise, denoise, jax.random.normal(key, shape))[0, 0]


def _remembered(
    model: PersistConfig,
    params: Params,
    latents_hwC: Array,
    features: Array,
    action_A: Array,
    cache: FrameCache,
    key: Array,
) -> FrameCache:
    """Add a picture to the renderer's cache."""
    x, times = _context(model.noise, latents_hwC[None, None], key)
    return _render(model, params, x, times, features, action_A, cache)[1]
