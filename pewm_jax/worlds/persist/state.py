"""The state of the world ``persist``: windows of its grid, and the caches of its networks.

A voxel frame is a window of the world's grid around the agent. It moves by whole tokens of the
transformer, so that most steps do not move it, and so that the networks' caches move with it
exactly. Cells that enter the window for the first time are unknown.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import rgbd
from pewm_jax.config import Noise
from pewm_jax.geometry.cameras import resize_intrinsics, unproject
from pewm_jax.memory.class_grid import UNKNOWN, ClassGrid
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.types import Array, Camera, Params
from pewm_jax.worlds.persist.config import POINT_WAVES, PersistModel

LONGEST_M, SHORTEST_M = 24.0, 1.5
"""Wavelengths of the sinusoids of a place, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ShownPicture:
    """An image as the conditioning of voxel frames.

    Attributes:
        latents_hwC: (..., h, w, C) its latents.
        depth_hw: (..., h, w) mean measured depth of each latent, metres; 0 without measurement.
        camera: (...) its camera.
    """

    latents_hwC: Array
    depth_hw: Array
    camera: Camera


def first_cell(model: PersistModel, low_3: Array, position_3: Array) -> Array:
    """Return the first cell (3,) of the window around a position, relative to the world's grid.

    ``low_3`` is the lowest corner of the grid and ``position_3`` the agent's camera, metres.
    """
    token, wide = model.backbone.token_cells, model.side
    cell = jnp.floor((position_3 - low_3) / model.cell).astype(jnp.int32)
    start = snap(cell - wide // 2, token)
    most = np.asarray(model.memory.cells) - wide
    return jnp.clip(start, 0, most).at[2].set(0)


def snap(cell: Array, token: int) -> Array:
    """Return the nearest whole multiples of a token's cells."""
    return (cell + token // 2) // token * token


def window(model: PersistModel, classes_XYZ: Array, start_3: Array) -> Array:
    """Return the cells of a window."""
    return jax.lax.dynamic_slice(classes_XYZ, tuple(start_3), (model.side,) * 3)


def write_window(classes_XYZ: Array, window_XYZ: Array, start_3: Array) -> Array:
    """Return the world's grid with a window written into it."""
    made = window_XYZ.astype(classes_XYZ.dtype)
    return jax.lax.dynamic_update_slice(classes_XYZ, made, tuple(start_3))


def cut_box(classes_XYZ: Array, start_3: Array, count: int | tuple[int, ...]) -> Array:
    """Return a box of ``count`` cells along each axis; cells outside the grid are unknown."""
    counts = (count,) * 3 if isinstance(count, int) else count
    for axis, (start, length) in enumerate(zip(start_3, counts, strict=True)):
        index = start + jnp.arange(length)
        size = classes_XYZ.shape[axis]
        found = jnp.take(classes_XYZ, jnp.clip(index, 0, size - 1), axis=axis)
        inside = (index >= 0) & (index < size)
        inside = inside.reshape([-1 if a == axis else 1 for a in range(3)])
        classes_XYZ = jnp.where(inside, found, UNKNOWN)
    return classes_XYZ


def known_latents(model: PersistModel, classes_XYZ: Array) -> Array:
    """Return (x, y, z) bool: the latents of predicted tokens whose cells are all known."""
    return ~any_in_token(model, classes_XYZ == UNKNOWN) & predicted_latents(model)


def any_in_token(model: PersistModel, cells_XYZ: Array) -> Array:
    """Return (..., x, y, z) bool: the latents of predicted tokens that have such a cell."""
    config, factor = model.backbone.world_frames, model.backbone.voxel_vae.factor
    low, high = config.levels
    cut = cells_XYZ[..., low * factor : high * factor]
    split = [
        n
        for count, p in zip(config.token_sides, config.patches, strict=True)
        for n in (count, p * factor)
    ]
    there = cut.reshape(*cells_XYZ.shape[:-3], *split).any((-5, -3, -1))
    for axis, patch in zip((-3, -2, -1), config.patches, strict=True):
        there = jnp.repeat(there, patch, axis)
    beside = [(0, 0)] * (there.ndim - 1) + [(low, config.latent_side - high)]
    return jnp.pad(there, beside)


def predicted_latents(model: PersistModel) -> np.ndarray:
    """Return (z,) bool: the levels of a window's latents that the world frames predict."""
    low, high = model.backbone.world_frames.levels
    level = np.arange(model.backbone.world_frames.latent_side)
    return (level >= low) & (level < high)


def predicted_levels(model: PersistModel) -> np.ndarray:
    """Return (Z,) bool: the levels of a window's cells that the world frames predict."""
    return np.repeat(predicted_latents(model), model.backbone.voxel_vae.factor)


def move_cache(
    model: PersistModel, cache: FrameCache, before_3: Array, after_3: Array
) -> FrameCache:
    """Return the cache of voxel frames for a window that has moved; new cells have no entries."""
    moved = (after_3 - before_3) // model.backbone.token_cells
    count_3 = np.array(model.backbone.world_frames.token_sides)
    places = np.stack(np.meshgrid(*map(np.arange, count_3), indexing="ij"), -1).reshape(-1, 3)
    source = places + moved.at[2].set(0)
    inside = ((source >= 0) & (source < count_3)).all(-1)
    at = jnp.clip(source, 0, count_3 - 1)
    row = (at[:, 0] * count_3[1] + at[:, 1]) * count_3[2] + at[:, 2]

    return FrameCache(
        jnp.take(cache.keys_LBSNKd, row, 3),
        jnp.take(cache.values_LBSNKd, row, 3),
        jnp.take(cache.known_BSN, row, 2) & inside,
        cache.count,
    )


def shown_picture(latents_hwC: Array, depth_HW: Array, camera: Camera) -> ShownPicture:
    """Return images, with latents and depth in metres (0 if unknown), as conditioning."""
    rows, columns = latents_hwC.shape[-3:-1]
    height, width = depth_HW.shape[-2:]
    cells = depth_HW.reshape(*depth_HW.shape[:-2], rows, height // rows, columns, width // columns)
    measured = (cells > 0).sum((-3, -1))
    mean = cells.sum((-3, -1)) / jnp.maximum(measured, 1)
    return ShownPicture(latents_hwC, mean, camera)


def picture_channels(model: PersistModel, shown: ShownPicture, middle_3: Array) -> Array:
    """Return the channels (..., h, w, C) by which images condition voxel frames.

    With ``model.points``, positions are relative to ``middle_3``, (..., 3) the middle of the
    window, metres.
    """
    if not model.points:
        return shown.latents_hwC
    rows, columns = shown.depth_hw.shape[-2:]
    shrink = columns / model.clip.width, rows / model.clip.height
    intrinsics = resize_intrinsics(shown.camera.intrinsics_4, *shrink)
    camera = Camera(intrinsics, shown.camera.world_from_camera)
    points = unproject(shown.depth_hw, camera) - jnp.asarray(middle_3)[..., None, None, :]
    share = np.linspace(0, 1, POINT_WAVES)
    lengths = SHORTEST_M * (LONGEST_M / SHORTEST_M) ** share
    angle = points[..., None] * np.asarray(2 * np.pi / lengths, np.float32)
    waves = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)
    waves = waves.reshape(*waves.shape[:-2], 6 * POINT_WAVES)
    waves = jnp.where((shown.depth_hw > 0)[..., None], waves, 0)
    return jnp.concatenate([shown.latents_hwC, waves], -1)


def middle(model: PersistModel, low_3: Array, start_3: Array) -> Array:
    """Return the middle (3,) of the window that begins at a cell, metres."""
    return low_3 + (start_3 + model.side / 2) * model.cell


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class History:
    """The networks' caches of the frames so far.

    The present voxel frame is not in ``voxels`` yet: it is encoded when the next one is sampled, so
    that edits have an effect.

    Attributes:
        voxels: of the world frames' transformer, up to the frame before the present one.
        cameras: of the camera model, up to the present frame.
        pictures: of the renderer, up to the present frame.
        action_A: the action that led to the present frame.
        shown: the image that conditioned the present voxel frame.
        start_3: int32, first cell of the present window in the world's grid.
    """

    voxels: FrameCache
    cameras: FrameCache
    pictures: FrameCache
    action_A: Array
    shown: ShownPicture
    start_3: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Past:
    """The world before a step.

    Attributes:
        grid: the world's voxels, with their ``History``.
        shown: the present image as conditioning of the next voxel frame.
    """

    grid: ClassGrid
    shown: ShownPicture


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class KnownFrame:
    """The known parts of the frame that a step leads to; the networks predict those that are None.

    Attributes:
        camera: its camera.
        rgb_HWC: its colours in [−1, 1], with ``depth_HW``.
        depth_HW: its depth, metres.
        classes_XYZ: its voxels, a window at ``start_3``.
        start_3: int32, first cell of that window in the world's grid.
    """

    camera: Camera | None = None
    rgb_HWC: Array | None = None
    depth_HW: Array | None = None
    classes_XYZ: Array | None = None
    start_3: Array | None = None


def encode_picture(model: PersistModel, params: Params, rgb_HWC: Array, depth_HW: Array) -> Array:
    """Return the latents (h, w, C) of an image, with those of its depth, if it has any."""
    both = rgbd.encode_rgbd(model, params, rgb_HWC[None, None], depth_HW[None, None])
    return both[0, 0, ..., : model.picture_channels]


def decode_picture(model: PersistModel, params: Params, latents_hwC: Array) -> tuple[Array, Array]:
    """Return colours (H, W, 3) and depth (H, W), 0 if unknown, of an image's latents."""
    missing = model.codec.channels - latents_hwC.shape[-1]
    latents = jnp.pad(latents_hwC, ((0, 0), (0, 0), (0, missing)))
    rgb, depth = rgbd.decode_rgbd(model, params, latents[None, None])
    return rgb[0, 0], depth[0, 0] if model.clip.depth else jnp.zeros_like(depth[0, 0])


def noisy_context(noise: Noise, x0: Array, key: Array) -> tuple[Array, Array]:
    """Return known frames (1, 1, …) with the noise of ``context_noise``, and their times."""
    times = jnp.full(x0.shape[:2], getattr(noise, "context_noise", 0.0))
    drawn = jax.random.normal(key, x0.shape, x0.dtype)
    return noise.corrupt(x0, drawn, times), times
