"""A feature map seen from above: the voxel map with a single layer of cells.

The baseline "2D map" of the paper's Table 1. Everything above one square of the floor falls into
one cell, which keeps the maximum of the features. Tokens are at the height of the grid's centre.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from pewm_jax.config import AssembledModel, Memory
from pewm_jax.memory import voxel_map
from pewm_jax.types import Array, Camera, Frames, MapTokens, Params, VoxelMap


@dataclasses.dataclass(frozen=True)
class Map2DConfig(Memory):
    """The feature map seen from above: a cell reaches from the floor to the ceiling."""

    @property
    def grid(self) -> Map2DConfig:
        """The settings of the voxel map with one layer that implements the 2D map."""
        (x, y, z), (nx, ny, nz) = self.cell_m, self.cells
        return dataclasses.replace(self, cell_m=(x, y, z * nz), cells=(nx, ny, 1))

    def empty(self, model: AssembledModel, centre_3: Array) -> VoxelMap:
        """Return an empty 2D map.

        The single layer is centred exactly on the given height. If it were snapped to multiples of
        the cell's height, like the horizontal position, it could miss the room.
        """
        del model
        voxels = voxel_map.empty(self.grid, centre_3, self.encoder.channels)
        bottom = jnp.asarray(centre_3, jnp.float32)[2] - self.grid.cell_m[2] / 2
        return dataclasses.replace(voxels, origin_3=voxels.origin_3.at[2].set(bottom))

    def insert(
        self,
        model: AssembledModel,
        params: Params,
        memory: VoxelMap,
        frames: Frames,
        features_ThwF: Array,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> VoxelMap:
        """Insert the pixels of frames; see ``voxel_map.insert_frames``."""
        del model, params, observed
        return voxel_map.insert_frames(self.grid, memory, frames, features_ThwF, valid_T)

    def read(self, model: AssembledModel, memory: VoxelMap, camera: Camera) -> MapTokens:
        """Choose the cells that condition one clip; see ``voxel_map.tokens``."""
        size = (model.clip.height, model.clip.width)
        return voxel_map.tokens(self.grid, memory, camera, size)

    def to_points(self, model: AssembledModel, memory: VoxelMap) -> tuple[Array, Array, Array]:
        """Return centre, features and validity of all slots."""
        del model
        return voxel_map.to_points(self.grid, memory)
