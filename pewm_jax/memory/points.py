"""A point cloud: positions and colours, without features.

The baseline "point cloud" of the paper's ablation. It is thinned by voxel downsampling: each
grid cell keeps one point, with the mean position and mean colour of all points that fell into it.
Points are sorted by cell, so an insertion is one sort and one segmented sum.
"""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp

from pewm_jax.config import AssembledModel, Memory
from pewm_jax.memory import cells
from pewm_jax.types import Array, Camera, Frames, MapTokens, Params

MOST = 64 * 64
"""The most pixels of a frame that are inserted, in an even grid."""
CHANNELS = 4
"""Channels of a point: its colour in [−1, 1], and a 1 that marks it as occupied."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointCloud:
    """A thinned point cloud with static capacity V.

    Attributes:
        cell_V: (V,) int32 cells in increasing order; free slots, last, hold the number of cells.
        sums_V7: (V, 7) number of points, sum of their offsets from ``origin_3``, sum of colours.
        origin_3: (3,) lower corner of the grid, metres.
        occupied: () int32, slots in use.
        dropped: () int32, cells that did not fit into the capacity, summed over insertions.
        outside: () int32, points that fell outside the grid.
    """

    cell_V: Array
    sums_V7: Array
    origin_3: Array
    occupied: Array
    dropped: Array
    outside: Array


def insert(
    config: Memory, cloud: PointCloud, points_P3: Array, rgb_PC: Array, valid_P: Array
) -> PointCloud:
    """Insert (P, 3) world points with colours in [−1, 1]; points with False are ignored.

    New cells that do not fit are dropped, highest numbers first.
    """
    nowhere, capacity = math.prod(config.cells), cloud.cell_V.shape[0]
    cell_P = cells.keys(config, cloud.origin_3, points_P3)
    outside = (valid_P & (cell_P == nowhere)).sum(dtype=jnp.int32)
    counted = valid_P & (cell_P < nowhere)
    offset = jnp.where(counted[:, None], points_P3 - cloud.origin_3, 0)
    colour = jnp.where(counted[:, None], rgb_PC, 0)
    rows = jnp.concatenate([counted[:, None].astype(jnp.float32), offset, colour], -1)

    cell = jnp.concatenate([cloud.cell_V, jnp.where(counted, cell_P, nowhere)])
    order = jnp.argsort(cell, stable=True)
    cell, old = cell[order], order < capacity
    first = jnp.concatenate([jnp.ones((1,), bool), cell[1:] != cell[:-1]]) & (cell < nowhere)
    # The sort is stable: of equal cells, the one already in the cloud comes first.
    known, new = first & old, first & ~old
    room = capacity - cloud.occupied
    admitted = known | (new & (jnp.cumsum(new) <= room))
    slot = jnp.where(admitted, jnp.cumsum(admitted) - 1, capacity)
    # Every row goes to the slot of the first row of its cell.
    leader = jax.lax.cummax(jnp.where(first, jnp.arange(cell.shape[0]), 0))
    target = jnp.where(cell < nowhere, slot[leader], capacity)
    sums = jnp.concatenate([cloud.sums_V7, rows])[order]
    return PointCloud(
        jnp.full((capacity,), nowhere, jnp.int32).at[slot].set(cell, mode="drop"),
        jnp.zeros((capacity, 7)).at[target].add(sums, mode="drop", indices_are_sorted=False),
        cloud.origin_3,
        occupied=admitted.sum(dtype=jnp.int32),
        dropped=cloud.dropped + (new & ~admitted).sum(dtype=jnp.int32),
        outside=cloud.outside + outside,
    )


@dataclasses.dataclass(frozen=True)
class PointsConfig(Memory):
    """Coloured points, one per cell, without features."""

    KEEPS_FEATURES: ClassVar[bool] = False

    def empty(self, model: AssembledModel, centre_3: Array) -> PointCloud:
        """Return a cloud without points, its grid centred on a world position."""
        del model
        zero = jnp.zeros((), jnp.int32)
        return PointCloud(
            jnp.full((self.capacity,), math.prod(self.cells), jnp.int32),
            jnp.zeros((self.capacity, 7)),
            cells.origin(self, centre_3),
            occupied=zero,
            dropped=zero,
            outside=zero,
        )

    def insert(
        self,
        model: AssembledModel,
        params: Params,
        memory: PointCloud,
        frames: Frames,
        features_ThwF: Array | None = None,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> PointCloud:
        """Insert the pixels of posed RGB-D frames, colours in [−1, 1]; features are not used."""
        del model, params, features_ThwF, observed
        rows, columns = cells.grid_of(frames.depth_THW.shape[1], frames.depth_THW.shape[2], MOST)
        points, rgb, valid = cells.sample(frames, rows, columns, valid_T)
        return insert(self, memory, points.reshape(-1, 3), rgb.reshape(-1, 3), valid.reshape(-1))

    def to_points(self, model: AssembledModel, memory: PointCloud) -> tuple[Array, Array, Array]:
        """Return all slots; features are the colour, a 1, and zeros up to the encoder's channels.

        Raises:
            ValueError: the encoder has fewer than four channels.
        """
        del model
        channels = self.encoder.channels
        if channels < CHANNELS:
            raise ValueError(f"a coloured point needs {CHANNELS} channels, got {channels}.")
        valid = memory.sums_V7[:, 0] > 0
        mean = memory.sums_V7[:, 1:] / jnp.where(valid, memory.sums_V7[:, 0], 1)[:, None]
        points = jnp.where(valid[:, None], memory.origin_3 + mean[:, :3], 0)
        mark = valid[:, None].astype(jnp.float32)
        padding = jnp.zeros((valid.shape[0], channels - CHANNELS))
        return points, jnp.concatenate([mean[:, 3:], mark, padding], -1), valid

    def read(self, model: AssembledModel, memory: PointCloud, camera: Camera) -> MapTokens:
        """Choose the points that condition one clip; see ``cells.choose``."""
        points, features, valid = self.to_points(model, memory)
        size = (model.clip.height, model.clip.width)
        order = cells.choose(self, points, valid, camera, size)
        return MapTokens(features[order], points[order], valid[order])
