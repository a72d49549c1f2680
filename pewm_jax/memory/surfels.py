"""Surfels: one small coloured surface per small cell, at the resolution of the sensor.

The voxel map keeps features of cells of a quarter of a metre; this memory keeps colours of cells of
a few centimetres, so that observed surfaces can be rendered. Each surfel lies at the mean position
of the points in its cell. It is as wide as the cell, or as a pixel of the camera that saw it, if
that is wider. Observed points take precedence over imagined ones: the first observation of an
imagined cell replaces it and, with ``memory.protect``, imagined frames change no observed cell.
Without it, a cell counts as observed as long as it holds observed points: until imagined ones
replace them (``keep`` newest); a mean of both counts as observed.

Cells are sorted, as in the voxel map. Sums are accumulated in the order of the pixels, so on a CPU
equal frames give bit-identical memories. A moved surfel keeps its sums and its observed flag,
replaces the surfels at its target, and surfels that arrive in one cell are merged.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import AssembledModel, Memory
from pewm_jax.errors import require, require_positive
from pewm_jax.geometry.cameras import matmul, transform_points, unproject
from pewm_jax.geometry.depth_images import normals
from pewm_jax.memory import cells, rendering
from pewm_jax.types import Array, Camera, Frames, MapTokens, Params

COLUMNS = 10
"""The columns of ``sums_VC`` before features: how many points, their offsets, colours, normals."""
TURNED = 0.5
"""Least length of the mean of a cell's normals; below it the surfel faces both sides."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Surfels:
    """Surfels with static capacity V.

    Attributes:
        cell_V: (V,) int32 cells in increasing order; free slots, last, hold the number of cells.
        sums_VC: (V, 10 + F) count of points, and sums of their offsets from the cell's lower corner
            (metres), of their colours, of their normals, and of their features where these are kept
            (else F = 0).
        size_V: (V,) width of the finest pixel that saw it, metres at its place; 0 in free slots.
        observed_V: (V,) bool, False where a surfel is imagined or the slot is free.
        origin_3: (3,) lower corner of the grid, metres.
        occupied: () int32, surfels in use.
        dropped: () int32, cells seen but not kept because the capacity was full (per insertion).
        outside: () int32, points that fell outside the grid.
    """

    cell_V: Array
    sums_VC: Array
    size_V: Array
    observed_V: Array
    origin_3: Array
    occupied: Array
    dropped: Array
    outside: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Points:
    """P points to insert.

    Attributes:
        points_P3: (P, 3) in the world, metres.
        values_PC: (P, 6 + F) colours in [−1, 1], normals (0 where unknown), then features.
        size_P: (P,) width of the pixel that saw it, metres at its place.
        time_P: (P,) int32 ≥ 0, larger is newer.
        valid_P: (P,) bool; others are ignored.
    """

    points_P3: Array
    values_PC: Array
    size_P: Array
    time_P: Array
    valid_P: Array


def insert(config: SurfelConfig, surfels: Surfels, new: Points, observed: bool = True) -> Surfels:
    """Insert points, observed or imagined; cells beyond the capacity are counted and dropped."""
    none, capacity = cells.nowhere(config), surfels.cell_V.shape[0]
    cell_P = cells.keys(config, surfels.origin_3, new.points_P3)
    outside = (new.valid_P & (cell_P == none)).sum(dtype=jnp.int32)
    cell_P = jnp.where(new.valid_P, cell_P, none)
    cell_V, dropped = cells.admit(surfels.cell_V, cell_P, none)

    before, known = cells.find(surfels.cell_V, cell_V)
    known = known & (cell_V < none)
    was_observed = known & surfels.observed_V[before]
    slot, found = cells.find(cell_V, cell_P)
    taken = found & (cell_P < none)
    if not observed and config.protect:
        taken = taken & ~was_observed[slot]
    if config.keep == "newest":
        newest = jnp.full((capacity,), -1, jnp.int32)
        newest = newest.at[jnp.where(taken, slot, capacity)].max(new.time_P, mode="drop")
        taken = taken & (new.time_P == newest[slot])
    target = jnp.where(taken, slot, capacity)
    touched = jnp.zeros((capacity,), bool).at[target].set(True, mode="drop")
    stays = known & ~touched
    if config.keep == "mean":
        stays = stays | (known & was_observed if observed else known)

    corner = cells.corners(config, surfels.origin_3, jnp.where(taken, cell_P, 0))
    one = jnp.ones((len(cell_P), 1))  # rows of points that are not taken are dropped
    rows = jnp.concatenate([one, new.points_P3 - corner, new.values_PC], -1)
    sums = jnp.where(stays[:, None], surfels.sums_VC[before], 0)
    size = jnp.where(stays, surfels.size_V[before], jnp.inf)
    size = size.at[target].min(new.size_P, mode="drop")
    return Surfels(
        cell_V,
        sums.at[target].add(rows, mode="drop"),
        jnp.where(cell_V < none, size, 0),
        was_observed | touched if observed else was_observed & stays,
        surfels.origin_3,
        occupied=(cell_V < none).sum(dtype=jnp.int32),
        dropped=surfels.dropped + dropped,
        outside=surfels.outside + outside,
    )


def means(config: SurfelConfig, surfels: Surfels) -> tuple[Array, Array, Array, Array, Array]:
    """Return (points_V3, colours_V3, normals_V3, features_VF, valid_V); free slots are 0."""
    valid = surfels.cell_V < cells.nowhere(config)
    mean = surfels.sums_VC[:, 1:] / jnp.where(valid, surfels.sums_VC[:, 0], 1)[:, None]
    corner = cells.corners(config, surfels.origin_3, jnp.where(valid, surfels.cell_V, 0))
    points = jnp.where(valid[:, None], corner + mean[:, :3], 0)
    return points, mean[:, 3:6], mean[:, 6:9], mean[:, 9:], valid


def _render(
    config: SurfelConfig,
    surfels: Surfels,
    features_VF: Array,
    camera: Camera,
    height: int,
    width: int,
) -> rendering.View:
    """Draw surfels at their width; observed ones cover imagined ones."""
    points, _, normals_V3, _, valid = means(config, surfels)
    turned = jnp.linalg.norm(normals_V3, axis=-1, keepdims=True) >= TURNED
    sides = jnp.where(turned, normals_V3, 0) if config.sides else None

    def draw(valid_V: Array) -> rendering.View:
        return rendering.splat_surfels(
            points,
            features_VF,
            widths(config, surfels),
            valid_V,
            camera,
            height,
            width,
            most=config.footprint,
            normals_V3=sides,
        )

    if not config.observed_first:
        return draw(valid)
    observed = draw(valid & surfels.observed_V)
    imagined = valid & ~surfels.observed_V

    def with_imagined() -> rendering.View:
        return rendering.over(observed, draw(imagined))

    return jax.lax.cond(imagined.any(), with_imagined, lambda: observed)


def widths(config: SurfelConfig, surfels: Surfels) -> Array:
    """Return (V,) widths of surfels, metres: that of their cell, or of the pixel that saw them."""
    return jnp.maximum(surfels.size_V, max(config.cell_m))


COUNT, PLACE, COLOUR, NORMAL = slice(0, 1), slice(1, 4), slice(4, 7), slice(7, 10)
"""Columns of ``sums_VC``; features come after them."""


def _erase(config: SurfelConfig, surfels: Surfels, taken_V: Array) -> Surfels:
    """Return the surfels without those in ``taken_V``."""
    no_cell = cells.nowhere(config)
    cell_V = jnp.sort(jnp.where(taken_V, no_cell, surfels.cell_V))
    return _rearranged(config, surfels, cell_V)


def _move(
    config: SurfelConfig,
    surfels: Surfels,
    points_V3: Array,
    taken_V: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> Surfels:
    """Move or copy the surfels in ``taken_V``; those that do not fit or leave are counted."""
    no_cell, capacity = cells.nowhere(config), surfels.cell_V.shape[0]
    there = transform_points(transform, points_V3)
    target = cells.keys(config, surfels.origin_3, there)
    outside = (taken_V & (target == no_cell)).sum(dtype=jnp.int32)
    target = jnp.where(taken_V, target, no_cell)

    rest = surfels if leave else _erase(config, surfels, taken_V)
    cell_V, dropped = cells.admit(rest.cell_V, target, no_cell)
    after = _rearranged(config, rest, cell_V)
    slot, found = cells.find(cell_V, target)
    arrives = found & (target < no_cell)
    slot = jnp.where(arrives, slot, capacity)
    covered = jnp.zeros((capacity,), bool).at[slot].set(True, mode="drop")

    count, turn = surfels.sums_VC[:, COUNT], transform[:3, :3]
    corner = cells.corners(config, surfels.origin_3, jnp.where(arrives, target, 0))
    rows = surfels.sums_VC.at[:, PLACE].set((there - corner) * count)
    rows = rows.at[:, NORMAL].set(matmul(surfels.sums_VC[:, NORMAL], turn.T))
    rows = jnp.where(arrives[:, None], rows, 0)
    size = jnp.where(covered, jnp.inf, after.size_V).at[slot].min(surfels.size_V, mode="drop")
    observed = jnp.where(covered, False, after.observed_V)
    return dataclasses.replace(
        after,
        sums_VC=jnp.where(covered[:, None], 0, after.sums_VC).at[slot].add(rows, mode="drop"),
        size_V=size,
        observed_V=observed.at[slot].max(surfels.observed_V, mode="drop"),
        dropped=surfels.dropped + dropped,
        outside=surfels.outside + outside,
    )


def _rearranged(config: SurfelConfig, surfels: Surfels, cell_V: Array) -> Surfels:
    """Return the surfels in the slots of a new list of cells; those of new cells are empty."""
    no_cell = cells.nowhere(config)
    before, known = cells.find(surfels.cell_V, cell_V)
    known = known & (cell_V < no_cell)
    return dataclasses.replace(
        surfels,
        cell_V=cell_V,
        sums_VC=jnp.where(known[:, None], surfels.sums_VC[before], 0),
        size_V=jnp.where(known, surfels.size_V[before], 0),
        observed_V=known & surfels.observed_V[before],
        occupied=(cell_V < no_cell).sum(dtype=jnp.int32),
    )


@dataclasses.dataclass(frozen=True)
class SurfelConfig(Memory):
    """Small coloured surfaces at the sensor's resolution; cells, tokens and capacity as elsewhere.

    Only this memory distinguishes observed from imagined content: see ``protect``.
    """

    EDITABLE: ClassVar[bool] = True
    GRID_TOLERANCE: ClassVar[int] = 1

    cell_m: tuple[float, float, float] = (0.04, 0.04, 0.04)
    """Size of a cell along x, y, z, metres; each cell keeps one surfel."""
    cells: tuple[int, int, int] = (1024, 1024, 128)
    """Cells of the grid along x, y, z; the extent costs nothing."""
    capacity: int = 65536
    """Surfels that can be kept; others are counted and dropped."""
    keep: Literal["mean", "newest"] = "mean"
    """Content of a cell: the mean of all points, or those of the newest frame."""
    protect: bool = True
    """Whether imagined points never change observed cells."""
    features: bool = False
    """Keep the encoder's features beside the colour, and give them to the reader."""
    footprint: int = 3
    """Pixels that a surfel covers at most, across and down, when the memory is rendered."""
    sides: bool = True
    """Show a surfel only from the side it was observed from. From behind, such as a wall of the
    next room, it occludes but is not shown, because its colour there is unknown."""
    imagined_again: bool = False
    """Also insert imagined pixels where the memory was already rendered; else only new surfaces, so
    that surfaces do not grow with every clip. Needs a reader or a gate for which the memory is
    rendered."""
    observed_first: bool = True
    """Render imagined surfels only where no observed surfel is visible."""

    @property
    def KEEPS_FEATURES(self) -> bool:  # noqa: N802  # type: ignore[override]
        """Whether points carry the encoder's features; else the first three are their colour."""
        return self.features

    def check(self, model: Any) -> None:
        """Refuse an encoder without room for a colour."""
        super().check(model)
        require(
            self.features or self.encoder.channels >= 4,
            f"memory.encoder has {self.encoder.channels} channels: a coloured surfel needs 4; take "
            "an encoder with more, or set memory.features.",
        )

    def empty(self, model: AssembledModel, centre_3: Array) -> Surfels:
        """Return a memory of no surfels, its grid centred on a world position."""
        del model
        count, zero = self.capacity, jnp.zeros((), jnp.int32)
        columns = COLUMNS + (self.encoder.channels if self.features else 0)
        return Surfels(
            jnp.full((count,), cells.nowhere(self), jnp.int32),
            jnp.zeros((count, columns)),
            jnp.zeros((count,)),
            jnp.zeros((count,), bool),
            cells.origin(self, centre_3),
            occupied=zero,
            dropped=zero,
            outside=zero,
        )

    def insert(
        self,
        model: AssembledModel,
        params: Params,
        memory: Surfels,
        frames: Frames,
        features_ThwF: Array | None = None,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> Surfels:
        """Insert every pixel of T posed RGB-D frames, the newest last.

        A pixel gets the features of the patch it lies in, if features are kept.
        """
        del model, params
        depth_THW = jnp.asarray(frames.depth_THW)
        count, height, width = depth_THW.shape
        valid = (depth_THW > 0) & jnp.isfinite(depth_THW)
        if valid_T is not None:
            valid = valid & jnp.asarray(valid_T)[:, None, None]
        camera = jax.tree.map(jnp.asarray, frames.camera)
        values = jnp.concatenate([jnp.asarray(frames.rgb_THWC), normals(depth_THW, camera)], -1)
        if self.features:
            if features_ThwF is None:
                raise ValueError("memory.features is set, but no features were given.")
            down, across = features_ThwF.shape[1:3]
            row = ((np.arange(height) + 0.5) * down / height).astype(int)
            column = ((np.arange(width) + 0.5) * across / width).astype(int)
            patches = jnp.asarray(features_ThwF)[:, row][:, :, column]
            values = jnp.concatenate([values, patches.astype(values.dtype)], -1)
        focal = camera.intrinsics_4[:, 0, None, None]
        time = jnp.broadcast_to(jnp.arange(count, dtype=jnp.int32)[:, None, None], depth_THW.shape)
        new = Points(
            unproject(depth_THW, camera).reshape(-1, 3),
            values.reshape(-1, values.shape[-1]),
            (depth_THW / focal).reshape(-1),
            time.reshape(-1),
            valid.reshape(-1),
        )
        return insert(self, memory, new, observed)

    def to_points(self, model: AssembledModel, memory: Surfels) -> tuple[Array, Array, Array]:
        """Return all slots; without ``features``, a point's are its colour, a 1 and zeros."""
        del model
        points, colours, _, features, valid = means(self, memory)
        if self.features:
            return points, features, valid
        there = valid[:, None].astype(jnp.float32)
        padding = jnp.zeros((valid.shape[0], self.encoder.channels - 4))
        return points, jnp.concatenate([colours, there, padding], -1), valid

    def read(self, model: AssembledModel, memory: Surfels, camera: Camera) -> MapTokens:
        """Choose the surfels that condition one clip; see ``cells.choose``."""
        points, features, valid = self.to_points(model, memory)
        size = (model.clip.height, model.clip.width)
        order = cells.choose(self, points, valid, camera, size, widths(self, memory))
        return MapTokens(features[order], points[order], valid[order])

    def render(
        self, model: AssembledModel, memory: Surfels, camera: Camera, height: int, width: int
    ) -> rendering.View:
        """Render the features if they are kept, else the 3 colours; see ``Memory.render``."""
        del model
        which = means(self, memory)[3 if self.features else 1]
        return _render(self, memory, which, camera, height, width)

    def render_colours(
        self, memory: Surfels, camera: Camera, height: int, width: int
    ) -> rendering.View:
        """Render the 3 colours only, in [−1, 1]."""
        return _render(self, memory, means(self, memory)[1], camera, height, width)

    def trimmed(self, memory: Surfels) -> Surfels:
        """Return surfels without most of the free slots: they render equally and faster.

        The capacity is cut to a multiple of an eighth, so that few shapes are compiled.
        """
        capacity = len(memory.cell_V)
        part = -(-capacity // 8)
        left = min(capacity, max(1, -(-int(memory.occupied) // part)) * part)
        names = ("cell_V", "sums_VC", "size_V", "observed_V")
        return dataclasses.replace(memory, **{name: getattr(memory, name)[:left] for name in names})

    def erase(self, model: AssembledModel, memory: Surfels, box_23: Array) -> Surfels:
        """Erase a box; see ``Memory.erase``."""
        del model
        points, *_, valid = means(self, memory)
        return _erase(self, memory, cells.within(points, valid, box_23))

    def move(
        self,
        model: AssembledModel,
        memory: Surfels,
        box_23: Array,
        transform: Array,
        *,
        leave: bool = False,
    ) -> Surfels:
        """Move or copy the content of a box; see ``Memory.move``."""
        del model
        transform = cells.rigid(transform, "move")
        points, *_, valid = means(self, memory)
        taken = cells.within(points, valid, box_23)
        return _move(self, memory, points, taken, transform, leave=leave)

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require_positive(self, "memory", "footprint")
        require(
            self.keep in ("mean", "newest"),
            f"memory.keep is {self.keep!r}; choose mean or newest.",
        )
