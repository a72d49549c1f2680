"""Cast rays through a grid of class ids: the occupied cells in order, and their light.

A ray steps from cell to cell (Amanatides and Woo 1987, "A fast voxel traversal algorithm"). The
next border is computed from the cell's index instead of by accumulation, so rounding errors do not
grow along the ray. PERSIST's renderer (arXiv 2603.03482) uses such layers of faces for each pixel.

The light of block worlds depends on the side of a block, on distance, and on nearby corners. Images
of cells are rendered with it; PERSIST's world inverts it to read the colours of blocks.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.geometry.cameras import einsum
from pewm_jax.types import Array, Camera

SIDES, SHIFT, INSIDE = 4, 2, 3
"""Number of sides of a cell (one per axis, or the ray starts inside), their bits, and INSIDE."""
EMPTY = 0
"""The class id of an empty cell."""
CHUNK = 4096
"""Rays processed at a time, so that their state fits in a CPU cache."""
ROUND = 32
"""Cells of a ray looked up at a time: the bits of a word."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RayHits:
    """The occupied cells along rays, any leading shape; slots after the last one are empty.

    Attributes:
        ids_L: (..., L) int32 class ids, ``EMPTY`` in empty slots.
        distance_L: (..., L) distance at which the ray enters the cell, in lengths of its direction;
            0 in empty slots and where the ray starts inside the cell.
        side_L: (..., L) int32 axis (0, 1, 2) across which the ray enters; −1 where the distance is
            0 for these reasons.
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
) -> RayHits:
    """Return the occupied cells along R rays, nearest first, as (R, L) hits.

    Args:
        ids_XYZ: integer class ids.
        low_3: the corner of the grid with the smallest coordinates, metres.
        cell_m: side of a cell, metres.
        origins_R3: origins of the rays, inside or outside the grid, metres.
        directions_R3: directions of the rays, of any length above 0.
        layers: L; cells after the first L are dropped.

    Raises:
        UserError: the grid is too large for packing a cell into 32 bits.
    """
    shape, rays = ids_XYZ.shape, len(origins_R3)
    if SHIFT + sum((count + 1).bit_length() for count in shape) > 32:
        raise UserError(f"the grid has {shape} cells; rays can cross at most 1022 along each axis.")
    start, way = (origins_R3 - low_3).T / cell_m, directions_R3.T / cell_m  # (3, R) each
    flat = jnp.asarray(ids_XYZ).reshape(-1)
    if rays <= CHUNK:
        return _chunk(flat, shape, start, way, layers)
    parts = [
        jnp.pad(x, ((0, 0), (0, -rays % CHUNK)), "edge").reshape(3, -1, CHUNK).swapaxes(0, 1)
        for x in (start, way)
    ]
    made = jax.lax.map(lambda part: _chunk(flat, shape, part[0], part[1], layers), tuple(parts))
    return jax.tree.map(lambda x: x.reshape(-1, layers)[:rays], made)


def _chunk(
    flat: Array, shape: tuple[int, int, int], start: Array, way: Array, layers: int
) -> RayHits:
    """Return ``march`` of a chunk of rays, whose origins and directions (3, R) are in cells.

    The inner loop only steps to the next cell and stores its index. The class ids of ``ROUND``
    cells are then looked up at once, which gives a word per ray with one bit per occupied cell.
    Finally each layer takes the lowest set bit of every ray. There are no scattered writes.
    """
    rays, words = start.shape[1], -(-(sum(shape) + 1) // ROUND)
    code = _PackedCells(shape)
    forward, still = way > 0, way == 0
    inverse = 1 / jnp.where(still, 1, way)
    turns = code.turns(jnp.where(forward, 1, -1))
    cells_3R, side_R, met_R = _enter(start, way, jnp.array(shape)[:, None])

    def step(at_R: Array) -> Array:
        """Return the next cells; rays that have left the grid stay where they are."""
        away = [
            jnp.where(still[axis], jnp.inf, (cell + forward[axis] - start[axis]) * inverse[axis])
            for axis, cell in enumerate(code.cells(at_R))
        ]
        by_x, by_y = (away[0] <= away[1]) & (away[0] <= away[2]), away[1] <= away[2]
        turn = jnp.where(by_x, turns[0], jnp.where(by_y, turns[1], turns[2]))
        return jnp.where(code.inside(at_R), code.without_side(at_R) + turn, at_R)

    def walk(held: tuple[Array, ...]) -> tuple[Array, ...]:
        """Step through a round of cells and look up which are occupied."""
        number, at_R, way_WNR, full_WR = held

        def one(k: Array, held: tuple[Array, Array]) -> tuple[Array, Array]:
            at_R, way_NR = held
            return step(at_R), jax.lax.dynamic_update_index_in_dim(way_NR, at_R, k, 0)

        way_NR = jnp.zeros((ROUND, rays), jnp.uint32)
        at_R, way_NR = jax.lax.fori_loop(0, ROUND, one, (at_R, way_NR))
        inside = code.inside(way_NR)
        full = inside & (flat[jnp.where(inside, code.place(way_NR), 0)] != EMPTY)
        bits = jnp.left_shift(full.astype(jnp.uint32), jnp.arange(ROUND, dtype=jnp.uint32)[:, None])
        return (
            number + 1,
            at_R,
            jax.lax.dynamic_update_index_in_dim(way_WNR, way_NR, number, 0),
            jax.lax.dynamic_update_index_in_dim(full_WR, bits.sum(0, dtype=jnp.uint32), number, 0),
        )

    def take(held: tuple[Any, ...]) -> tuple[Any, ...]:
        """Take the nearest remaining occupied cell of every ray as one layer."""
        layer, full_WR, made = held
        word_R, number_R = full_WR[0], jnp.zeros(rays, jnp.int32)
        for number in range(1, words):
            number_R = jnp.where(word_R == 0, number, number_R)
            word_R = jnp.where(word_R == 0, full_WR[number], word_R)
        lowest_R, found = word_R & -word_R, word_R != 0
        rest_R, numbers = word_R ^ lowest_R, jnp.arange(words)[:, None]
        full_WR = jnp.where(numbers == number_R, rest_R, full_WR)
        place_R = number_R * ROUND + jax.lax.population_count(lowest_R - 1).astype(jnp.int32)
        at_R = ways[jnp.where(found, place_R * rays + jnp.arange(rays), 0)]
        side_R, cells = code.side(at_R), code.cells(at_R)
        border = [
            (cell + ~forward[axis] - start[axis]) * inverse[axis] for axis, cell in enumerate(cells)
        ]
        distance_R = jnp.where(side_R == 0, border[0], jnp.where(side_R == 1, border[1], border[2]))
        outside = found & (side_R != INSIDE)
        id_R = flat[jnp.where(found, code.place(at_R), 0)].astype(jnp.int32)
        layer_R = (
            jnp.where(found, id_R, EMPTY),
            jnp.where(outside, distance_R, 0),
            jnp.where(outside, side_R, -1),
        )
        put, pairs = jax.lax.dynamic_update_index_in_dim, zip(made, layer_R, strict=True)
        return layer + 1, full_WR, [put(x, x_R, layer, 1) for x, x_R in pairs]

    begun = jnp.where(met_R, code.pack(cells_3R, side_R), jnp.uint32(0))
    nothing = jnp.zeros((words, ROUND, rays), jnp.uint32), jnp.zeros((words, rays), jnp.uint32)
    *_, way_WNR, full_WR = jax.lax.while_loop(
        lambda held: code.inside(held[1]).any(), walk, (0, begun, *nothing)
    )
    ways = way_WNR.reshape(-1)
    empty = [
        jnp.full((rays, layers), EMPTY, jnp.int32),
        jnp.zeros((rays, layers), start.dtype),
        jnp.full((rays, layers), -1, jnp.int32),
    ]
    *_, made = jax.lax.while_loop(
        lambda held: (held[0] < layers) & (held[1] != 0).any(), take, (0, full_WR, empty)
    )
    return RayHits(*made)


class _PackedCells:
    """Packs a cell and the side by which it is entered into one number: x, y, z from 1, then side.

    A cell just outside the grid has 0, or the count of cells plus 1, along an axis.
    """

    def __init__(self, shape: tuple[int, int, int]):
        self.shape = shape
        self.bits = [(count + 1).bit_length() for count in shape]
        self.shifts = [SHIFT + sum(self.bits[:axis]) for axis in range(3)]

    def fields(self, at: Array) -> list[Array]:
        """Return x, y and z, each from 1, as unsigned numbers."""
        pairs = zip(self.shifts, self.bits, strict=True)
        return [at >> shift & (1 << bits) - 1 for shift, bits in pairs]

    def cells(self, at: Array) -> list[Array]:
        """Return x, y and z, int32."""
        return [field.astype(jnp.int32) - 1 for field in self.fields(at)]

    def inside(self, at: Array) -> Array:
        """Return whether cells lie in the grid."""
        x, y, z = (f - 1 < count for f, count in zip(self.fields(at), self.shape, strict=True))
        return x & y & z

    def place(self, at: Array) -> Array:
        """Return the indices of cells in the grid's flat array, int32."""
        x, y, z = self.cells(at)
        return (x * self.shape[1] + y) * self.shape[2] + z

    def side(self, at: Array) -> Array:
        """Return the sides by which cells are entered, int32."""
        return (at & SIDES - 1).astype(jnp.int32)

    def without_side(self, at: Array) -> Array:
        """Return the packed cells without their sides."""
        return at & ~jnp.uint32(SIDES - 1)

    def pack(self, cells: Array, side: Array) -> Array:
        """Return packed cells from indices (3, ...) and sides."""
        pairs = zip(cells, self.shifts, strict=True)
        x, y, z = (cell.astype(jnp.uint32) + 1 << shift for cell, shift in pairs)
        return x | y | z | side.astype(jnp.uint32)

    def turns(self, ahead: Array) -> list[Array]:
        """Return the increment of a packed cell for a step of −1 or 1 along each axis."""
        return [
            (step << shift).astype(jnp.uint32) + jnp.uint32(axis)
            for axis, (step, shift) in enumerate(zip(ahead, self.shifts, strict=True))
        ]


def _enter(start: Array, way: Array, shape_31: Array) -> tuple[Array, Array, Array]:
    """Return the first cells (3, R) of rays, the sides by which they enter, and whether they do."""
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
    edge = jnp.where(forward, 0, shape_31 - 1)  # exact index along the axis of entry
    cell = jnp.where(jnp.arange(3)[:, None] == side, edge, jnp.clip(cell, 0, shape_31 - 1))
    return cell, side, first < leave.min(0)


def through_pixels(
    ids_XYZ: Array,
    low_3: Array,
    cell_m: float | Array,
    camera: Camera,
    height: int,
    width: int,
    layers: int,
) -> RayHits:
    """Return the cells that the rays through the pixels of cameras hit, (T, H, W, L).

    Distances are z-depths. Arguments as for ``march``; the intrinsics of the (T,) cameras belong to
    images of ``height`` × ``width`` pixels.
    """
    rows, columns = jnp.arange(height) + 0.5, jnp.arange(width) + 0.5
    fx, fy, cx, cy = jnp.moveaxis(camera.intrinsics_4, -1, 0)[..., None, None]
    down = jnp.broadcast_to((rows[:, None] - cy) / fy, (len(fx), height, width))
    right = jnp.broadcast_to((columns - cx) / fx, (len(fx), height, width))
    seen = jnp.stack([right, down, jnp.ones_like(right)], -1)
    pose = camera.world_from_camera
    directions = einsum("tij,thwj->thwi", pose[:, :3, :3], seen)
    origins = jnp.broadcast_to(pose[:, None, None, :3, 3], directions.shape)
    flat = march(ids_XYZ, low_3, cell_m, origins.reshape(-1, 3), directions.reshape(-1, 3), layers)
    return jax.tree.map(lambda x: x.reshape(*directions.shape[:-1], layers), flat)


BRIGHTNESS = (0.88, 0.74, 1.0, 0.5)
"""Light on sides perpendicular to x, y and z, and on the cell in which a ray starts."""
BELOW = 0.62
"""Light on a side seen from below, such as a ceiling."""
HALF_M = 7.0
"""Distance at which light falls to one half, metres."""
CORNER, CORNER_M = 0.35, 0.2
"""Darkening in a corner, and the distance from the corner at which it ends, metres."""


def light(
    occupied_XYZ: Array,
    low_3: Array,
    cell_m: float | Array,
    eye_3: Array,
    way_HW3: Array,
    far_HW: Array,
    side_HW: Array,
) -> Array:
    """Return the (H, W) factors that multiply the colours of the cells that rays hit.

    Args:
        occupied_XYZ: bool, which cells are occupied.
        low_3: lowest corner of the grid, metres.
        cell_m: side of a cell, metres.
        eye_3: origin of the rays, metres.
        way_HW3: (H, W, 3) directions of the rays.
        far_HW: distance from the origin to the hit cell, in lengths of the direction.
        side_HW: axis (0, 1, 2) across which the ray enters the cell; −1 if it starts inside.
    """
    facing = jnp.asarray(BRIGHTNESS, jnp.float32)[side_HW]
    facing = jnp.where((side_HW == 2) & (way_HW3[..., 2] > 0), BELOW, facing)
    metres = far_HW * jnp.linalg.norm(way_HW3, axis=-1)
    at = (eye_3 - low_3 + far_HW[..., None] * way_HW3) / cell_m
    dark = _corner_darkness(occupied_XYZ, cell_m, at, way_HW3, side_HW)
    return facing / (1 + jnp.square(metres / HALF_M)) * (1 - CORNER * dark)


def side_of(at_HW3: Array) -> Array:
    """Return the (H, W) axis of the cell border nearest to points on the sides of cells.

    Args:
        at_HW3: points, in cells from the grid's lowest corner.
    """
    return jnp.abs(at_HW3 - jnp.round(at_HW3)).argmin(-1)


def _corner_darkness(
    occupied_XYZ: Array, cell_m: float | Array, at_HW3: Array, way_HW3: Array, side_HW: Array
) -> Array:
    """Return (H, W) how close points are to a corner: 1 in it, 0 from ``CORNER_M`` on."""
    met = side_HW >= 0
    across = np.arange(3) == jnp.where(met, side_HW, 0)[..., None]
    # The open cell in front of the side, from which the ray comes.
    before = jnp.where(across, jnp.round(at_HW3) - (way_HW3 > 0), jnp.floor(at_HW3))
    before, inside = before.astype(jnp.int32), at_HW3 - jnp.floor(at_HW3)
    shape, dark = np.array(occupied_XYZ.shape), jnp.zeros(side_HW.shape)
    for axis in range(3):
        for sign in (-1, 1):
            beside = before + sign * (np.arange(3) == axis)
            within = ((beside >= 0) & (beside < shape)).all(-1)
            x, y, z = jnp.moveaxis(jnp.clip(beside, 0, shape - 1), -1, 0)
            wall = met & within & occupied_XYZ[x, y, z] & ~across[..., axis]
            gap = inside[..., axis] if sign < 0 else 1 - inside[..., axis]
            dark = jnp.maximum(dark, jnp.where(wall, 1 - gap * cell_m / CORNER_M, 0))
    return dark
