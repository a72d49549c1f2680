"""What a real picture says of the cells that it shows, with no network: air, surfaces, colours.

Of a world of blocks (``memory.pictures cells``). A real frame has depth: a cell in front of what
was measured is air; one that a measured surface lies in is occupied, in the colour that it has
without the light on it. ``model.sight`` is the advantage, in nats, that this gives a class over
others when voxels are made of a real frame (``persist_voxels.held``). Imagined frames are made of
the voxels, so nothing is concluded from them. Not as published.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import PersistConfig
from pewm_jax.data.voxels import PALETTE
from pewm_jax.geometry import block_light
from pewm_jax.geometry.cameras import invert_rigid, transform_points, unproject
from pewm_jax.types import Array, Camera
from pewm_jax.worlds.persist import windows

INTO_M = 0.005
"""A measured point belongs to the cell this far behind it, metres; depth is kept in millimetres."""
VOTES = 2
"""Pixels that must show a surface in a cell: a single one may be a ray that clips an edge."""
NEAREST_M = 0.05
"""Cells nearer to the camera than this are not judged, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ObservedCells:
    """What is seen of the cells of a window.

    Attributes:
        air_XYZ: bool, that nothing is there.
        colour_XYZ: int32 number of the palette's colour of the surface in it, −1 where none is.
    """

    air_XYZ: Array
    colour_XYZ: Array


def advantage(model: PersistConfig, sight: ObservedCells, classes: int) -> Array:
    """Return the nats (X, Y, Z, classes) that sight adds to the scores of classes."""
    number = jnp.arange(classes)
    colours = model.memory.colours  # type: ignore[attr-defined]
    air = sight.air_XYZ[..., None] & (number == 0)
    surface = (number > 0) & ((number - 1) % colours == sight.colour_XYZ[..., None])
    return model.sight * (air | surface)


def seen(
    model: PersistConfig, corner_3: Array, rgb_HWC: Array, depth_HW: Array, camera: Camera
) -> ObservedCells:
    """Return what a picture shows of a window's cells.

    Args:
        model: the model.
        corner_3: the window's lowest corner, metres.
        rgb_HWC: colours in [−1, 1].
        depth_HW: depth, metres; 0 where nothing was measured.
        camera: its camera.
    """
    size, side = windows.cell_m(model), windows.side(model)
    eye = camera.world_from_camera[:3, 3]
    way_HW3 = unproject(depth_HW, camera) - eye
    metres_HW1 = jnp.linalg.norm(way_HW3, axis=-1, keepdims=True)
    behind_HW3 = way_HW3 * (1 + INTO_M / jnp.maximum(metres_HW1, INTO_M)) + (eye - corner_3)
    at = jnp.floor(behind_HW3 / size).astype(jnp.int32)
    met = (depth_HW > 0) & ((at >= 0) & (at < side)).all(-1)
    cell = jnp.where(met, (at[..., 0] * side + at[..., 1]) * side + at[..., 2], side**3)
    cell = cell.reshape(-1)
    hits = jnp.zeros(side**3 + 1, jnp.int32).at[cell].add(1)[:-1]
    surface = (hits >= VOTES).reshape((side,) * 3)

    # What lights the cells that are seen is known, so their own colours are.
    borders = block_light.side_of((way_HW3 + (eye - corner_3)) / size)
    ones = jnp.ones(depth_HW.shape)
    lit = block_light.light(surface, corner_3, size, eye, way_HW3, ones, borders)
    colour_HW = _nearest(model, (rgb_HWC + 1) / 2 / lit[..., None])
    colours = model.memory.colours  # type: ignore[attr-defined]
    votes = jnp.zeros((side**3 + 1, colours), jnp.int32)
    votes = votes.at[cell, colour_HW.reshape(-1)].add(1)[:-1]
    colour = votes.argmax(-1).reshape((side,) * 3).astype(jnp.int32)
    air = _before(model, corner_3, depth_HW, camera) & ~surface
    return ObservedCells(air, jnp.where(surface, colour, -1))


def _before(model: PersistConfig, corner_3: Array, depth_HW: Array, camera: Camera) -> Array:
    """Return which cells (X, Y, Z) lie before what was measured in their direction."""
    size, side = windows.cell_m(model), windows.side(model)
    steps = (np.arange(side) + 0.5) * size
    middle = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).astype(np.float32)
    place = transform_points(invert_rigid(camera.world_from_camera), middle + corner_3)
    far = jnp.maximum(place[..., 2], NEAREST_M)
    fx, fy, cx, cy = camera.intrinsics_4
    column = jnp.floor(place[..., 0] / far * fx + cx).astype(jnp.int32)
    row = jnp.floor(place[..., 1] / far * fy + cy).astype(jnp.int32)
    height, width = depth_HW.shape
    within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    measured = depth_HW[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
    return within & (place[..., 2] > NEAREST_M) & (place[..., 2] + size / 2 < measured)


def _nearest(model: PersistConfig, rgb_HW3: Array) -> Array:
    """Return the number of the nearest colour of the palette, (H, W)."""
    count = model.memory.colours  # type: ignore[attr-defined]
    palette = np.array(list(PALETTE.values())[:count], np.float32) / 255
    return jnp.square(rgb_HW3[..., None, :] - palette).sum(-1).argmin(-1)
