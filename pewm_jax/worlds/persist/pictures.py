"""Where the camera of the world ``persist`` goes, and what it sees (arXiv 2603.03482)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.config import PersistConfig
from pewm_jax.geometry.actions import (
    CAMERA_STEP_NUMBERS,
    camera_numbers,
    follow_camera_steps,
    step_pose,
)
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.models.persist import camera_model, voxel_renderer
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.types import Array, Camera, Params
from pewm_jax.worlds.persist import windows
from pewm_jax.worlds.persist.past import context, encoded


def reckoned(model: PersistConfig, here: Camera, action_A: Array) -> Camera:
    """Return about where an action leads, to lay the window there: planar ones alone say."""
    if model.control.actions != 3:
        return here
    return Camera(here.intrinsics_4, step_pose(here.world_from_camera, action_A))


def reckoning(model: PersistConfig, actions_A: Array) -> Array:
    """Return the steps (..., 6) to which the camera model adds what it says."""
    if not model.dead_reckoning:
        return jnp.zeros((*actions_A.shape[:-1], CAMERA_STEP_NUMBERS))
    dx, dy, turn = jnp.moveaxis(actions_A, -1, 0)
    still = jnp.zeros_like(dx)
    return jnp.stack([dx, dy, still, still, turn, still], -1)


def next_camera(
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
    change = made[0, 0] + reckoning(model, action_A)
    return follow_camera_steps(here, change, model.clip.width), cache


def features(
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
    layers = voxel_renderer.cast_rays(
        config,
        jnp.maximum(classes_XYZ, 0)[None],
        corner[None],
        windows.cell_m(model),
        jax.tree.map(lambda x: x[None], camera),
        (model.clip.height, model.clip.width),
    )
    told = None
    if config.drawn:
        told = drawn(model, params, classes_XYZ, corner, camera)[None]
    dtype = jnp.dtype(model.dtype)
    return voxel_renderer.features(config, params["renderer"], layers, dtype, drawn_hwC=told)[None]


def drawn(
    model: PersistConfig, params: Params, classes_XYZ: Array, corner_3: Array, camera: Camera
) -> Array:
    """Return latents (h, w, C) of a window drawn in the colours of its classes, without light.

    Args:
        model: the model.
        params: gives the codec.
        classes_XYZ: the window's cells.
        corner_3: its lowest corner, metres.
        camera: one camera.
    """
    cells = ClassGrid(classes_XYZ, corner_3)
    one = jax.tree.map(lambda x: x[None], camera)
    view = model.memory.render(model, cells, one, model.clip.height, model.clip.width)
    return encoded(model, params, view.features_THWF[0], view.depth_THW[0])


def sample(
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
        return noise.to_x0(made.astype(jnp.float32), x, times)

    return noise.sample(denoise, jax.random.normal(key, shape))[0, 0]


def remembered(
    model: PersistConfig,
    params: Params,
    latents_hwC: Array,
    features: Array,
    action_A: Array,
    cache: FrameCache,
    key: Array,
) -> FrameCache:
    """Add a picture to the renderer's cache."""
    x, times = context(model.noise, latents_hwC[None, None], key)
    return _render(model, params, x, times, features, action_A, cache)[1]


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
