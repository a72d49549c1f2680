"""The share of pixels seen before that reaches the denoiser: remembered, chosen, attended to.

A pixel that was seen before can be known only if the memory holds its place, if that place is among
the tokens that condition the clip, and if the frame's own camera attends to it; or, where the
memory is rendered, if the rendering shows that place.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import AssembledModel, Memory
from pewm_jax.geometry.cameras import fold_frames, unproject
from pewm_jax.memory import cells, rendering
from pewm_jax.memory import interface as memories
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.geometry import group_latents, sightings
from pewm_jax.types import Array, Camera, Frames, MapTokens


def coverage(
    model: AssembledModel,
    memory: memories.Memory,
    tokens: MapTokens,
    frames: Frames,
    seen_THW: Array,
    reader: AttentionConfig | None = None,
) -> dict[str, Array]:
    """Count the pixels seen before that are remembered, chosen, attended to and rendered.

    A place is a cell of the memory's grid; for surfels, whose cells are about as small as pixels,
    that cell or one beside it. ``frames`` are T true frames of the clip, ``tokens`` the clip's
    (``Memory.read``). The reader is by default the memory's.

    Returns:
        () int32 numbers of pixels by name; divide by ``seen`` after adding up clips. ``seen``:
        pixels seen before, with a depth; of these, ``held``: pixels whose place the memory holds;
        ``chosen``: whose place is among the clip's tokens; ``attended``: among the tokens that the
        frame's camera attends to, equal to ``chosen`` with positions that depend on no camera;
        ``rendered``: where the rendered memory's depth agrees with the true one; ``looked_at``:
        what the memory's reader reads, ``attended``, ``rendered`` or either.
    """
    depth = jnp.asarray(frames.depth_THW)
    _, height, width = depth.shape
    seen = jnp.asarray(seen_THW) & (depth > 0) & jnp.isfinite(depth)
    camera = jax.tree.map(jnp.asarray, frames.camera)
    points, _, valid = model.memory.to_points(model, memory)
    grid = model.memory.grid
    # Memories without a grid of their own get one around their first camera.
    origin = getattr(memory, "origin_3", None)
    if origin is None:
        origin = cells.origin(grid, camera.world_from_camera[0, :3, 3])
    pixel_THW = cells.keys(grid, origin, unproject(depth, camera))
    reach = model.memory.GRID_TOLERANCE

    def among(cell: Array, points_V3: Array, valid_V: Array) -> Array:
        return _among(grid, cell, cells.keys(grid, origin, points_V3), valid_V, reach)

    chosen = among(pixel_THW, tokens.points_world_M3, tokens.valid_M)
    looked_TM = _looked(model, reader or model.memory.reader, camera, tokens)
    attended = jax.lax.map(
        lambda x: among(x[0], tokens.points_world_M3, x[1]), (pixel_THW, looked_TM)
    )
    view = memories.render(model, memory, camera, height, width)
    slack = jnp.maximum(rendering.tolerance(depth), max(grid.cell_m[:2]))
    agrees = view.seen_THW & (jnp.abs(view.depth_THW - depth) <= slack)

    def count(mask: Array) -> Array:
        return (seen & mask).sum(dtype=jnp.int32)

    held = among(pixel_THW, points, valid)
    kind = model.memory.reader
    read = (attended & kind.READS_TOKENS) | (agrees & kind.READS_VIEW)
    masks = {
        "seen": jnp.ones_like(seen),
        "held": held,
        "chosen": chosen,
        "attended": attended,
        "rendered": agrees,
        "looked_at": read,
    }
    return {name: count(mask) for name, mask in masks.items()}


def _among(config: Memory, cell: Array, cell_V: Array, valid_V: Array, reach: int) -> Array:
    """Return (...,) bool: whether cells, or those at most ``reach`` beside them, are in a list."""
    nowhere = math.prod(config.cells)
    listed = jnp.sort(jnp.where(valid_V, cell_V, nowhere))
    _, ny, nz = config.cells
    place = (cell // (ny * nz), cell // nz % ny, cell % nz)
    found = jnp.zeros(cell.shape, bool)
    for step in np.ndindex(*(2 * reach + 1,) * 3):
        moved = [x + i - reach for x, i in zip(place, step, strict=True)]
        inside = cell < nowhere
        for x, size in zip(moved, config.cells, strict=True):
            inside = inside & (x >= 0) & (x < size)
        beside = jnp.where(inside, (moved[0] * ny + moved[1]) * nz + moved[2], nowhere)
        slot = jnp.minimum(jnp.searchsorted(listed, beside), len(listed) - 1)
        found = found | (inside & (listed[slot] == beside))
    return found


def _looked(model: AssembledModel, reader: object, camera: Camera, tokens: MapTokens) -> Array:
    """Return (T, M) bool: the tokens that each frame's camera attends to."""
    frames, count = len(camera.world_from_camera), len(tokens.valid_M)
    if not isinstance(reader, AttentionConfig) or reader.positions != "projective":
        return jnp.broadcast_to(tokens.valid_M, (frames, count))
    batch = jax.tree.map(lambda x: x[None], (camera, tokens.points_world_M3, tokens.valid_M))
    seen = sightings(model, reader, *batch)
    fold = fold_frames(jnp.arange(frames), model.codec.temporal)
    frame_tq = group_latents(fold, model.backbone.places.patch_t)
    looked = jnp.zeros((frames, count), bool)
    place = jnp.broadcast_to(frame_tq[..., None], seen.index_tqJ.shape[1:])
    return looked.at[place, seen.index_tqJ[0]].max(seen.visible_tqJ[0])
