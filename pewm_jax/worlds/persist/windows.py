"""Which cells are a voxel frame of the world ``persist``, and what its networks are told of them.

A frame is a window of the world's grid around the agent. It moves by whole tokens of the
transformer, so that most steps leave it where it is, and so that what is remembered moves with it
exactly. Cells that come into it and were never near the agent are unknown.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import POINT_WAVES, PersistConfig
from pewm_jax.geometry.cameras import resize_intrinsics, unproject
from pewm_jax.memory.class_grid import UNKNOWN
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.types import Array, Camera

LONGEST_M, SHORTEST_M = 24.0, 1.5
"""Wavelengths of the sinusoids of a place, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Shown:
    """A picture as voxel frames are shown it.

    Attributes:
        latents_hwC: (..., h, w, C) its latents.
        depth_hw: (..., h, w) mean depth of what was measured there, metres; 0 where nothing was.
        camera: (...) its camera.
    """

    latents_hwC: Array
    depth_hw: Array
    camera: Camera


def cell_m(model: PersistConfig) -> float:
    """Return the side of a cell, metres."""
    return model.memory.cell_m[0]


def side(model: PersistConfig) -> int:
    """Return the cells along an axis of a window."""
    return model.backbone.voxel_vae.side  # type: ignore[attr-defined]


def first_cell(model: PersistConfig, low_3: Array, position_3: Array) -> Array:
    """Return the first cell (3,) of the window around a position, in a world's grid.

    Args:
        model: the model.
        low_3: lowest corner of the world's grid, metres.
        position_3: the agent's camera, metres.
    """
    token, wide = model.backbone.token_cells, side(model)  # type: ignore[attr-defined]
    cell = jnp.floor((position_3 - low_3) / cell_m(model)).astype(jnp.int32)
    start = snapped(cell - wide // 2, token)
    most = np.asarray(model.memory.cells) - wide
    return jnp.clip(start, 0, most).at[2].set(0)


def snapped(cell: Array, token: int) -> Array:
    """Return the nearest whole multiples of a token's cells."""
    return (cell + token // 2) // token * token


def window(model: PersistConfig, classes_XYZ: Array, start_3: Array) -> Array:
    """Return the cells of a window."""
    return jax.lax.dynamic_slice(classes_XYZ, tuple(start_3), (side(model),) * 3)


def written(classes_XYZ: Array, window_XYZ: Array, start_3: Array) -> Array:
    """Return the world's grid with a window put into it."""
    made = window_XYZ.astype(classes_XYZ.dtype)
    return jax.lax.dynamic_update_slice(classes_XYZ, made, tuple(start_3))


def cut(classes_XYZ: Array, start_3: Array, count: int) -> Array:
    """Return a cube of ``count`` cells that may reach out of a grid, unknown there."""
    for axis, start in enumerate(start_3):
        index = start + jnp.arange(count)
        size = classes_XYZ.shape[axis]
        found = jnp.take(classes_XYZ, jnp.clip(index, 0, size - 1), axis=axis)
        inside = (index >= 0) & (index < size)
        inside = inside.reshape([-1 if a == axis else 1 for a in range(3)])
        classes_XYZ = jnp.where(inside, found, UNKNOWN)
    return classes_XYZ


def known_latents(model: PersistConfig, classes_XYZ: Array) -> Array:
    """Return (x, y, z) bool: the latents of whose token all cells are known."""
    token, wide = model.backbone.token_cells, side(model)  # type: ignore[attr-defined]
    patch, count = model.backbone.world_frames.patch, wide // token  # type: ignore[attr-defined]
    known = (classes_XYZ != UNKNOWN).reshape(count, token, count, token, count, token)
    return spread(known.all((1, 3, 5)), patch)


def spread(known_xyz: Array, patch: int) -> Array:
    """Repeat what is said of tokens for all their latents."""
    for axis in (-3, -2, -1):
        known_xyz = jnp.repeat(known_xyz, patch, axis)
    return known_xyz


def moved(model: PersistConfig, cache: FrameCache, before_3: Array, after_3: Array) -> FrameCache:
    """Return what is kept of voxel frames for a window that has moved; nothing of new cells."""
    token = model.backbone.token_cells  # type: ignore[attr-defined]
    count = side(model) // token
    tokens = (after_3 - before_3) // token
    places = np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)
    source = places + tokens
    inside = ((source >= 0) & (source < count)).all(-1)
    at = jnp.clip(source, 0, count - 1)
    row = (at[:, 0] * count + at[:, 1]) * count + at[:, 2]

    return FrameCache(
        jnp.take(cache.keys_LBSNKd, row, 3),
        jnp.take(cache.values_LBSNKd, row, 3),
        jnp.take(cache.known_BSN, row, 2) & inside,
        cache.count,
    )


def shown_of(latents_hwC: Array, depth_HW: Array, camera: Camera) -> Shown:
    """Return what is shown of pictures, any leading shape.

    Args:
        latents_hwC: (..., h, w, C) the pictures' latents.
        depth_HW: (..., H, W) their depth, metres, 0 where it is not known.
        camera: (...) their cameras.
    """
    rows, columns = latents_hwC.shape[-3:-1]
    height, width = depth_HW.shape[-2:]
    cells = depth_HW.reshape(*depth_HW.shape[:-2], rows, height // rows, columns, width // columns)
    measured = (cells > 0).sum((-3, -1))
    mean = cells.sum((-3, -1)) / jnp.maximum(measured, 1)
    return Shown(latents_hwC, mean, camera)


def told(model: PersistConfig, shown: Shown, middle_3: Array) -> Array:
    """Return the channels of pictures as voxel frames are shown them, (..., h, w, C).

    Args:
        model: the model.
        shown: the pictures.
        middle_3: (..., 3) the middle of the window, metres, from which places are counted.
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


def middle(model: PersistConfig, low_3: Array, start_3: Array) -> Array:
    """Return the middle (3,) of the window that begins at a cell, metres."""
    return low_3 + (start_3 + side(model) / 2) * cell_m(model)
