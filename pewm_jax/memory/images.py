"""A compact set of snapshots that covers the observed cells (after 3D-Mem, arXiv 2411.17735).

3D-Mem clusters detected objects. Here, without a detector, a frame covers the set of map cells that
its pixels fall into. Snapshots are chosen by greedy maximum coverage of all cells seen so far,
which reaches at least 1 − 1/e of the best possible coverage by K frames. Tokens are the patches of
the snapshots; a patch's position is the world point of its middle pixel.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from pewm_jax.config import AssembledModel, Memory
from pewm_jax.errors import require, require_positive
from pewm_jax.memory import cells
from pewm_jax.types import Array, Camera, Frames, MapTokens, Params

MOST = 24 * 24
"""The most pixels of a frame, in an even grid, that determine the cells it covers."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Snapshots:
    """K snapshots of P patches that cover up to C cells each.

    Attributes:
        features_KPF: (K, P, F) patch features.
        points_KP3: (K, P, 3) positions of the patches in the world, metres.
        valid_KP: (K, P) bool, False without depth, and for unused snapshots.
        cell_KC: (K, C) int32 cells covered, in any order, with repetitions; entries equal to the
            number of cells are no cell.
        origin_3: (3,) lower corner of the grid, metres.
        dropped: () int32, cells seen that no snapshot covers, summed over insertions.
    """

    features_KPF: Array
    points_KP3: Array
    valid_KP: Array
    cell_KC: Array
    origin_3: Array
    dropped: Array


def greedy_cover(cell_XC: Array, count: int, nowhere: int) -> tuple[Array, Array, Array]:
    """Choose ``count`` of X sets of cells greedily: each time the one with most uncovered cells.

    ``cell_XC`` has the cells of each set in any order, with repetitions and ``nowhere``.

    Returns:
        ``(chosen, gain, missed)``: (count,) indices of the sets in the order of choice (ties go to
        the lower index); (count,) cells that each set added, 0 if none were left, in which case
        its index is meaningless; () cells that remain uncovered.
    """
    sets = cell_XC.shape[0]
    flat = cell_XC.reshape(-1)
    order = jnp.argsort(flat)
    in_order = flat[order]
    first = jnp.concatenate([jnp.ones((1,), bool), in_order[1:] != in_order[:-1]])
    number = jnp.zeros_like(flat).at[order].set(jnp.cumsum(first, dtype=jnp.int32) - 1)
    column = jnp.where(cell_XC < nowhere, number.reshape(cell_XC.shape), flat.shape[0])
    covers_XU = jnp.zeros((sets, flat.shape[0]), bool)
    covers_XU = covers_XU.at[jnp.arange(sets)[:, None], column].set(True, mode="drop")

    def choose(left_U: Array, _) -> tuple[Array, tuple[Array, Array]]:
        gain_X = (covers_XU & left_U).sum(-1, dtype=jnp.int32)
        best = jnp.argmax(gain_X)
        return left_U & ~covers_XU[best], (best, gain_X[best])

    left_U, (chosen, gain) = jax.lax.scan(choose, covers_XU.any(0), length=count)
    return chosen, gain, left_U.sum(dtype=jnp.int32)


@dataclasses.dataclass(frozen=True)
class ImagesConfig(Memory):
    """A few snapshots that together cover the observed cells."""

    snapshots: int = 8
    """Frames that are kept; together they have at most `tokens` patches."""

    def patch_grid(self, model: AssembledModel) -> tuple[int, int]:
        """Return a snapshot's rows and columns of patches; all snapshots fit into ``tokens``."""
        return cells.grid_of(model.clip.height, model.clip.width, self.tokens // self.snapshots)

    def empty(self, model: AssembledModel, centre_3: Array) -> Snapshots:
        """Return an empty set of snapshots, with a grid centred on a world position."""
        count, patches = self.snapshots, math.prod(self.patch_grid(model))
        covers = math.prod(cells.grid_of(model.clip.height, model.clip.width, MOST))
        return Snapshots(
            jnp.zeros((count, patches, self.encoder.channels)),
            jnp.zeros((count, patches, 3)),
            jnp.zeros((count, patches), bool),
            jnp.full((count, covers), math.prod(self.cells), jnp.int32),
            cells.origin(self, centre_3),
            dropped=jnp.zeros((), jnp.int32),
        )

    def insert(
        self,
        model: AssembledModel,
        params: Params,
        memory: Snapshots,
        frames: Frames,
        features_ThwF: Array,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> Snapshots:
        """Choose the best snapshots among the present ones, which win ties, and T new frames."""
        del params, observed
        shape = features_ThwF.shape
        rows, columns = self.patch_grid(model)
        points, _, valid = cells.sample(frames, rows, columns, valid_T)
        pooled = jax.image.resize(features_ThwF, (shape[0], rows, columns, shape[-1]), "linear")
        pooled = pooled.reshape(shape[0], rows * columns, shape[-1])
        covered, _, measured = cells.sample(
            frames, *cells.grid_of(frames.depth_THW.shape[1], frames.depth_THW.shape[2], MOST)
        )
        if valid_T is not None:
            measured = measured & valid_T[:, None]
        nowhere = math.prod(self.cells)
        cell = jnp.where(measured, cells.keys(self, memory.origin_3, covered), nowhere)

        everything = Snapshots(
            jnp.concatenate([memory.features_KPF, jnp.where(valid[..., None], pooled, 0)]),
            jnp.concatenate([memory.points_KP3, jnp.where(valid[..., None], points, 0)]),
            jnp.concatenate([memory.valid_KP, valid]),
            jnp.concatenate([memory.cell_KC, cell]),
            memory.origin_3,
            memory.dropped,
        )
        chosen_K, gain_K, missed = greedy_cover(everything.cell_KC, self.snapshots, nowhere)
        useful = gain_K > 0
        return Snapshots(
            jnp.where(useful[:, None, None], everything.features_KPF[chosen_K], 0),
            jnp.where(useful[:, None, None], everything.points_KP3[chosen_K], 0),
            useful[:, None] & everything.valid_KP[chosen_K],
            jnp.where(useful[:, None], everything.cell_KC[chosen_K], nowhere),
            memory.origin_3,
            dropped=memory.dropped + missed,
        )

    def to_points(self, model: AssembledModel, memory: Snapshots) -> tuple[Array, Array, Array]:
        """Return all patches of all snapshots."""
        del model
        channels = memory.features_KPF.shape[-1]
        return (
            memory.points_KP3.reshape(-1, 3),
            memory.features_KPF.reshape(-1, channels),
            memory.valid_KP.reshape(-1),
        )

    def read(self, model: AssembledModel, memory: Snapshots, camera: Camera) -> MapTokens:
        """Return all patches of all snapshots, padded with masked tokens to ``tokens``."""
        del camera
        parts = self.to_points(model, memory)
        missing = self.tokens - parts[2].shape[0]
        points, features, valid = (
            jnp.pad(part, [(0, missing)] + [(0, 0)] * (part.ndim - 1)) for part in parts
        )
        return MapTokens(features, points, valid)

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require_positive(self, "memory", "snapshots")
        require(
            self.snapshots <= self.tokens,
            f"memory.snapshots {self.snapshots} exceeds memory.tokens {self.tokens}: every "
            "snapshot needs at least one token; raise tokens or lower snapshots.",
        )
