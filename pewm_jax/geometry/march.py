"""What rays meet on their way through a grid of class ids: all occupied cells, in order.

A ray goes from cell to cell (Amanatides and Woo 1987, "A fast voxel traversal algorithm"). The next
border is computed from the cell's number and not by adding up, so that rounding does not grow with
the way. PERSIST's renderer (arXiv 2603.03482) takes such layers of faces for each pixel.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.types import Array, Camera

SIDES, SHIFT, INSIDE = 4, 2, 3
"""Ways into a cell, and their bits: by one of three axes, or by beginning there."""
EMPTY = 0
"""The class id of a cell with nothing in it."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Layers:
    """What rays meet, any leading shape; slots behind the last occupied cell are empty.

    Attributes:
        ids_L: (..., L) int32 class ids, ``EMPTY`` where there is nothing more.
        distance_L: (..., L) where the ray enters the cell, in lengths of its direction; 0 there,
            and where the ray begins inside of the cell.
        side_L: (..., L) int32, by which axis (0, 1, 2) it enters; −1 there.
    """

    ids_L: Array
    distance_L: Array
    side_L: Array


def march(
    ids_XYZ: Array,
    low_3: Array,
    cell_m: float | Array,
    origins_R3: Array,
    directions_R3: Array,
    layers: int,
) -> Layers:
    """Return the occupied cells along rays, nearest first.

    Args:
        ids_XYZ: (X, Y, Z) integer class ids.
        low_3: the corner of the grid with the smallest coordinates, metres.
        cell_m: side of a cell, metres.
        origins_R3: (R, 3) where rays begin, inside of the grid or not, metres.
        directions_R3: (R, 3) where they go; not all zero, of any length.
        layers: L; cells beyond the first L are left out.

    Returns:
        (R, L).
    """
    shape, rays = ids_XYZ.shape, len(origins_R3)
    flat = ids_XYZ.astype(jnp.int32).reshape(-1)
    start, way = (origins_R3 - low_3).T / cell_m, directions_R3.T / cell_m  # (3, R) each
    forward, still = way > 0, way == 0
    inverse, ahead = 1 / jnp.where(still, 1, way), jnp.where(forward, 1, -1)
    cells_3R, side_R, first_R, met_R = _enter(start, way, jnp.array(shape)[:, None])

    def number(cells_3R: tuple[Array, ...]) -> tuple[Array, Array]:
        """Return the cells' places in ``flat``, and whether they are in the grid."""
        inside = met_R
        for cell, count in zip(cells_3R, shape, strict=True):
            inside = inside & (cell >= 0) & (cell < count)
        x, y, z = cells_3R
        return jnp.where(inside, (x * shape[1] + y) * shape[2] + z, 0), inside

    rows, slots = jnp.arange(rays) * layers, rays * layers

    def step(at: tuple[Any, ...]) -> tuple[Any, ...]:
        cells_3R, side_R, distance_R, count_R, ids, distances = at
        place, inside = number(cells_3R)
        found = flat[place]
        full = inside & (found != EMPTY)
        slot = jnp.where(full & (count_R < layers), rows + count_R, slots)
        ids = ids.at[slot].set(found << SHIFT | side_R, mode="drop")
        distances = distances.at[slot].set(distance_R, mode="drop")
        away = [
            jnp.where(still[axis], jnp.inf, (cell + forward[axis] - start[axis]) * inverse[axis])
            for axis, cell in enumerate(cells_3R)
        ]
        by_x, by_y = (away[0] <= away[1]) & (away[0] <= away[2]), away[1] <= away[2]
        side_R = jnp.where(by_x, 0, jnp.where(by_y, 1, 2))
        distance_R = jnp.minimum(away[0], jnp.minimum(away[1], away[2]))
        moved = (cell + jnp.where(side_R == a, ahead[a], 0) for a, cell in enumerate(cells_3R))
        return tuple(moved), side_R, distance_R, count_R + full, ids, distances

    def goes_on(at: tuple[Any, ...]) -> Array:
        return number(at[0])[1].any()

    begun = (tuple(cells_3R), side_R, first_R, jnp.zeros(rays, jnp.int32))
    nothing = jnp.full(slots, EMPTY << SHIFT | INSIDE), jnp.zeros(slots, start.dtype)
    *_, ids, distances = jax.lax.while_loop(goes_on, step, (*begun, *nothing))
    ids, distances = (x.reshape(rays, layers) for x in (ids, distances))
    side = ids & SIDES - 1
    return Layers(ids >> SHIFT, distances, jnp.where(side == INSIDE, -1, side))


def _enter(start: Array, way: Array, shape_31: Array) -> tuple[Array, Array, Array, Array]:
    """Return the first cells (3, R), the side and distance by which rays come in, and if they do.

    Args:
        start: (3, R) where rays begin, in cells.
        way: (3, R) where they go.
        shape_31: cells of the grid.
    """
    still, forward, size = way == 0, way > 0, shape_31.astype(start.dtype)
    inverse = 1 / jnp.where(still, 1, way)
    never = still & ~((start >= 0) & (start < size))
    enter = jnp.where(forward, 0, size) - start
    enter = jnp.where(still, jnp.where(never, jnp.inf, -jnp.inf), enter * inverse)
    leave = jnp.where(forward, size, 0) - start
    leave = jnp.where(still, jnp.where(never, -jnp.inf, jnp.inf), leave * inverse)
    first = jnp.maximum(enter.max(0), 0)
    side = jnp.where(enter.max(0) > 0, enter.argmax(0), INSIDE)
    cell = jnp.floor(start + jnp.where(jnp.isfinite(first), first, 0) * way).astype(jnp.int32)
    edge = jnp.where(forward, 0, shape_31 - 1)  # of the axis by which a ray comes in, exactly
    cell = jnp.where(jnp.arange(3)[:, None] == side, edge, jnp.clip(cell, 0, shape_31 - 1))
    return cell, side, first, first < leave.min(0)


def through_pixels(
    ids_XYZ: Array,
    low_3: Array,
    cell_m: float | Array,
    camera: Camera,
    height: int,
    width: int,
    layers: int,
) -> Layers:
    """Return what the rays through the pixels of cameras meet; distances are depths along z.

    Args:
        ids_XYZ: (X, Y, Z) integer class ids.
        low_3: as for ``march``.
        cell_m: as for ``march``.
        camera: (T,) cameras, whose intrinsics are for images of ``height`` × ``width``.
        height: of the images, pixels.
        width: of the images, pixels.
        layers: L.

    Returns:
        (T, H, W, L).
    """
    rows, columns = jnp.arange(height) + 0.5, jnp.arange(width) + 0.5
    fx, fy, cx, cy = jnp.moveaxis(camera.intrinsics_4, -1, 0)[..., None, None]
    down = jnp.broadcast_to((rows[:, None] - cy) / fy, (len(fx), height, width))
    right = jnp.broadcast_to((columns - cx) / fx, (len(fx), height, width))
    seen = jnp.stack([right, down, jnp.ones_like(right)], -1)
    pose = camera.world_from_camera
    directions = jnp.einsum("tij,thwj->thwi", pose[:, :3, :3], seen)
    origins = jnp.broadcast_to(pose[:, None, None, :3, 3], directions.shape)
    flat = march(ids_XYZ, low_3, cell_m, origins.reshape(-1, 3), directions.reshape(-1, 3), layers)
    return jax.tree.map(lambda x: x.reshape(*directions.shape[:-1], layers), flat)
