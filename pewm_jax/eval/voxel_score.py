"""What the 3D VAE of a ``persist`` world gives back of recorded voxels, class and all."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import numpy as np

from pewm_jax.config import PersistConfig
from pewm_jax.models.persist import voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.types import Array, Params

EVERY = 40
"""Of a walk, frames from one grid that is looked at to the next."""


def given_back(
    model: PersistConfig, params: Params, grids: Sequence[np.ndarray]
) -> dict[str, float]:
    """Return shares of the cells whose class the autoencoder gives back.

    Args:
        model: the world.
        params: its parameters.
        grids: (T, X, Y, Z) class ids of each walk's frames, 0 where there is nothing; of larger
            grids than the autoencoder's the middle is taken.

    Returns:
        ``grids``: how many were looked at; ``occupied``: the share of occupied cells that come back
        with their class; ``filled``: of these, those that come back as occupied at all; ``empty``:
        the share of empty cells that come back empty.
    """
    config = model.backbone.voxel_vae  # type: ignore[attr-defined]
    again = jax.jit(functools.partial(_again, config))
    right = filled = occupied = clear = empty = count = 0
    for walk in grids:
        low = [(size - config.side) // 2 for size in walk.shape[1:]]
        x, y, z = (slice(at, at + config.side) for at in low)
        for grid in walk[::EVERY, x, y, z].astype(np.int32):
            back, there = np.asarray(again(params["voxel_vae"], grid[None])[0]), grid > 0
            right += int((back == grid)[there].sum())
            filled += int((back > 0)[there].sum())
            clear += int((back == 0)[~there].sum())
            occupied, empty = occupied + int(there.sum()), empty + int((~there).sum())
            count += 1
    return {
        "grids": count,
        "occupied": right / max(occupied, 1),
        "filled": filled / max(occupied, 1),
        "empty": clear / max(empty, 1),
    }


def _again(config: VoxelVAEConfig, params: Params, grid_BXYZ: Array) -> Array:
    return voxel_vae.decode(config, params, voxel_vae.encode(config, params, grid_BXYZ))
