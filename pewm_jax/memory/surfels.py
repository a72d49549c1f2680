"""Surfels: what was seen, at the sensor's resolution, one small coloured surface per small cell.

The voxel map keeps features of cells of a quarter of a metre; this keeps colours of cells of a few
centimetres, so that what was seen can be shown again (``render``). Each surfel stands at the mean
position of what fell into its cell and is as wide as the cell, or as a pixel of the camera that saw
it was there if that is wider. What was observed beats what was imagined: the first observation of
an imagined cell replaces it and, with ``memory.protect``, imagined frames change no observed cell.
Without it, a cell counts as observed as long as it holds observed points: until imagined ones
replace them (``keep`` newest); a mean of both counts as observed.

Cells are kept sorted, as the voxel map's are. Sums are added up in the order of the pixels, so that
on a CPU equal frames make equal memories bit for bit.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import ModelConfig, SurfelConfig
from pewm_jax.geometry.cameras import unproject
from pewm_jax.geometry.depth_images import normals
from pewm_jax.memory import boxes, cells, rendering, surfel_edit, views, voxel_cells
from pewm_jax.types import Array, Camera, Frames, MapTokens

COLUMNS = 10
"""The columns of ``sums_VC`` before features: how many points, their offsets, colours, normals."""
TURNED = 0.5
"""The mean of a cell's normals is at least so long, or it is seen from both sides."""


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
    """What is inserted: P points.

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


def empty(model: ModelConfig, centre_3: Array) -> Surfels:
    """Return a memory of no surfels, its grid centred on a world position."""
    config = settings_of(model)
    count, zero = config.capacity, jnp.zeros((), jnp.int32)
    columns = COLUMNS + (config.encoder.channels if config.features else 0)
    return Surfels(
        jnp.full((count,), voxel_cells.nowhere(config), jnp.int32),
        jnp.zeros((count, columns)),
        jnp.zeros((count,)),
        jnp.zeros((count,), bool),
        cells.origin(config, centre_3),
        occupied=zero,
        dropped=zero,
        outside=zero,
    )


def insert(config: SurfelConfig, surfels: Surfels, new: Points, observed: bool = True) -> Surfels:
    """Insert points; new cells beyond the capacity are counted, and what is there stays.

    Args:
        config: cell size, extent, capacity, what is kept of a cell.
        surfels: those so far.
        new: the points.
        observed: False where they were imagined.
    """
    none, capacity = voxel_cells.nowhere(config), surfels.cell_V.shape[0]
    cell_P = cells.keys(config, surfels.origin_3, new.points_P3)
    outside = (new.valid_P & (cell_P == none)).sum(dtype=jnp.int32)
    cell_P = jnp.where(new.valid_P, cell_P, none)
    cell_V, dropped = voxel_cells.admit(surfels.cell_V, cell_P, none)

    before, known = voxel_cells.find(surfels.cell_V, cell_V)
    known = known & (cell_V < none)
    was_observed = known & surfels.observed_V[before]
    slot, found = voxel_cells.find(cell_V, cell_P)
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
    offset = jnp.where(taken[:, None], new.points_P3 - corner, 0)
    values = jnp.where(taken[:, None], new.values_PC, 0)
    rows = jnp.concatenate([taken[:, None].astype(jnp.float32), offset, values], -1)
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


def remember(
    model: ModelConfig,
    surfels: Surfels,
    frames: Frames,
    features_ThwF: Array | None = None,
    valid_T: Array | None = None,
    observed: bool = True,
) -> Surfels:
    """Insert every pixel of posed RGB-D frames, colours in [−1, 1].

    Args:
        model: the model.
        surfels: those so far.
        frames: T frames, the newest last.
        features_ThwF: (T, h, w, F) the encoder's; a pixel gets those of the patch it lies in. Not
            used where features are not kept.
        valid_T: (T,) bool, False frames are ignored.
        observed: False where the frames were imagined.
    """
    config = settings_of(model)
    depth_THW = jnp.asarray(frames.depth_THW)
    count, height, width = depth_THW.shape
    valid = (depth_THW > 0) & jnp.isfinite(depth_THW)
    if valid_T is not None:
        valid = valid & jnp.asarray(valid_T)[:, None, None]
    camera = jax.tree.map(jnp.asarray, frames.camera)
    values = jnp.concatenate([jnp.asarray(frames.rgb_THWC), normals(depth_THW, camera)], -1)
    if config.features:
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
    return insert(config, surfels, new, observed)


def means(config: SurfelConfig, surfels: Surfels) -> tuple[Array, Array, Array, Array, Array]:
    """Return ``(points_world_V3, colours_V3, normals_V3, features_VF, valid_V)``; free slots are 0.

    F is 0 where features are not kept.
    """
    valid = surfels.cell_V < voxel_cells.nowhere(config)
    mean = surfels.sums_VC[:, 1:] / jnp.where(valid, surfels.sums_VC[:, 0], 1)[:, None]
    corner = cells.corners(config, surfels.origin_3, jnp.where(valid, surfels.cell_V, 0))
    points = jnp.where(valid[:, None], corner + mean[:, :3], 0)
    return points, mean[:, 3:6], mean[:, 6:9], mean[:, 9:], valid


def to_points(model: ModelConfig, surfels: Surfels) -> tuple[Array, Array, Array]:
    """Return all slots as ``(points_world_V3, features_VF, valid_V)``; free slots are 0.

    Without ``memory.features`` these are the colour, a 1 for being there, and zeros up to the
    encoder's channels.
    """
    config = settings_of(model)
    points, colours, _, features, valid = means(config, surfels)
    if config.features:
        return points, features, valid
    there = valid[:, None].astype(jnp.float32)
    padding = jnp.zeros((valid.shape[0], config.encoder.channels - 4))
    return points, jnp.concatenate([colours, there, padding], -1), valid


def trimmed(surfels: Surfels) -> Surfels:
    """Return surfels without most of the free slots: they look the same, and are drawn faster.

    The capacity is cut to the next eighth of what it was, so that few shapes are ever compiled for.
    It is read on the host; what is inserted afterwards has that much less room.
    """
    capacity = len(surfels.cell_V)
    part = -(-capacity // 8)
    left = min(capacity, max(1, -(-int(surfels.occupied) // part)) * part)
    names = ("cell_V", "sums_VC", "size_V", "observed_V")
    return dataclasses.replace(surfels, **{name: getattr(surfels, name)[:left] for name in names})


def tokens(model: ModelConfig, surfels: Surfels, camera: Camera) -> MapTokens:
    """Choose the surfels that condition one clip; see ``cells.choose``."""
    points, features, valid = to_points(model, surfels)
    size = (model.clip.height, model.clip.width)
    wide = widths(settings_of(model), surfels)
    order = cells.choose(model.memory, points, valid, camera, size, wide)
    return MapTokens(features[order], points[order], valid[order])


def render(
    model: ModelConfig, surfels: Surfels, camera: Camera, height: int, width: int
) -> rendering.View:
    """Return what cameras see: the features if they are kept, else the 3 colours.

    See ``memories.render``.
    """
    config = settings_of(model)
    which = means(config, surfels)[3 if config.features else 1]
    return _shown(config, surfels, which, camera, height, width)


def render_colours(
    model: ModelConfig, surfels: Surfels, camera: Camera, height: int, width: int
) -> rendering.View:
    """Return what cameras see, with the 3 colours alone, in [−1, 1]."""
    config = settings_of(model)
    return _shown(config, surfels, means(config, surfels)[1], camera, height, width)


def _shown(
    config: SurfelConfig,
    surfels: Surfels,
    features_VF: Array,
    camera: Camera,
    height: int,
    width: int,
) -> rendering.View:
    """Draw surfels as wide as they are, those that were observed before those imagined."""
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
        return views.over(observed, draw(imagined))

    return jax.lax.cond(imagined.any(), with_imagined, lambda: observed)


def widths(config: SurfelConfig, surfels: Surfels) -> Array:
    """Return (V,) how wide surfels are, metres: as their cell, or as the pixel that saw them."""
    return jnp.maximum(surfels.size_V, max(config.cell_m))


def erase(model: ModelConfig, surfels: Surfels, box_23: Array) -> Surfels:
    """Forget a box; see ``memories.erase``."""
    config = settings_of(model)
    points, *_, valid = means(config, surfels)
    return surfel_edit.erase(config, surfels, boxes.within(points, valid, box_23))


def move(
    model: ModelConfig, surfels: Surfels, box_23: Array, transform: Array, *, leave: bool = False
) -> Surfels:
    """Move or copy what is in a box; see ``memories.move``."""
    config, transform = settings_of(model), boxes.rigid(transform, "move")
    points, *_, valid = means(config, surfels)
    taken = boxes.within(points, valid, box_23)
    return surfel_edit.move(config, surfels, points, taken, transform, leave=leave)


def settings_of(model: ModelConfig) -> SurfelConfig:
    """Return the settings of the memory, which must be surfels."""
    config = model.memory
    if not isinstance(config, SurfelConfig):
        raise TypeError(f"surfels need a SurfelConfig, got {type(config).__name__}.")
    return config
