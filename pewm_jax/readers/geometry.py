"""Positions of remembered cells for memory attention.

* ``sinusoid`` (the paper): a 3D sinusoid of the cell's position, concatenated to its features. The
  position is relative to the clip's first camera or, with ``frame`` world, absolute.
* ``projective``: every cell is projected into the camera of every frame. Keys get a rotary
  embedding of their image coordinates, queries one of their patch's centre. A query's logit is
  therefore largest for cells that project into its patch. Cells behind the camera or far outside
  the image are masked. A latent frame covers q frames, each with its own camera, and head k uses
  camera k mod q. Moving cameras and map together by a rigid motion changes nothing.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import AssembledModel
from pewm_jax.geometry import zbuffer
from pewm_jax.geometry.cameras import fold_frames, invert_rigid, project, transform_points
from pewm_jax.nn import placement
from pewm_jax.types import Array, Camera, Params

MARGIN = 0.25
"""Cells may project outside the image by up to this share of its size."""
BEHIND = 1.4
"""A cell counts as hidden if it is this many times farther than the nearest one in its patch."""
NEAREST_M = 0.05
"""Cells nearer to the camera plane than this are masked, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sightings:
    """Map tokens in view of the cameras of a clip.

    t counts tokens in time, and q the cameras of one token: those of its ``patch_t`` latent frames.

    Attributes:
        index_tqJ: (B, t, q, J) int32, which of the M map tokens each camera attends to.
        angles_tqJR: (B, t, q, J, d/2) rotary angles of the keys.
        place_tqJ3: (B, t, q, J, 3) image coordinates in [−1, 1] and log depth.
        visible_tqJ: (B, t, q, J) bool.
        query_angles_nR: (n, d/2) rotary angles of the n patches of one latent frame.
    """

    index_tqJ: Array
    angles_tqJR: Array
    place_tqJ3: Array
    visible_tqJ: Array
    query_angles_nR: Array


def pad_time(x_BthwC: Array, patch_t: int) -> Array:
    """Repeat the first latent frame in front, up to a multiple of ``patch_t``, as the denoiser."""
    missing = -x_BthwC.shape[1] % patch_t
    return jnp.concatenate([x_BthwC[:, :1]] * missing + [x_BthwC], 1)


def init_stacked(block: Any, key: Array, count: int, example: tuple[Any, ...]) -> Params:
    """Return random parameters of ``count`` blocks, stacked, for example inputs."""
    return jax.vmap(lambda k: block.init(k, *example)["params"])(jax.random.split(key, count))


def group_latents(cameras_tqX: Array, patch_t: int) -> Array:
    """Join the cameras of ``patch_t`` latent frames: (t, q, …) → (⌈t/p⌉, p·q, …).

    If t is not a multiple of p, the first latent frame is repeated in front, as in the denoiser.
    """
    missing = -cameras_tqX.shape[0] % patch_t
    padded = jnp.concatenate([cameras_tqX[:1]] * missing + [cameras_tqX])
    return padded.reshape(-1, patch_t * padded.shape[1], *padded.shape[2:])


def frequencies(head_dim: int, grid: int) -> np.ndarray:
    """Return (head_dim/4,) radians per patch: wavelengths of 1 patch up to 2 × the grid."""
    count = head_dim // 4
    share = np.arange(count) / max(count - 1, 1)
    return (2 * math.pi / (2.0 * grid) ** share).astype(np.float32)


def _angles(uv_2: Array, head_dim: int, grid: int) -> Array:
    """Return (..., d/2) angles of positions (..., 2) in patches: half for u, half for v."""
    angle = uv_2[..., :, None] * jnp.asarray(frequencies(head_dim, grid))
    return angle.reshape(*uv_2.shape[:-1], -1)


def hidden(uv_TM2: Array, z_TM: Array, visible_TM: Array, size: np.ndarray, bin_px: int) -> Array:
    """Return (T, M) bool: cells that are behind a much nearer cell in the same image bin.

    A coarse depth buffer with bins of ``bin_px`` pixels. Cells are thick, so a cell counts as
    hidden only where it is ``BEHIND`` times farther than the nearest one.
    """
    columns = -(-int(size[0]) // bin_px)
    place = jnp.clip(jnp.floor(uv_TM2 / bin_px), 0, np.ceil(size / bin_px) - 1).astype(jnp.int32)
    index = place[..., 1] * columns + place[..., 0]
    bins = columns * (-(-int(size[1]) // bin_px))
    depth = jnp.where(visible_TM, z_TM, jnp.inf)
    nearest = jax.vmap(lambda i, d: jnp.full((bins,), jnp.inf).at[i].min(d)[i])(index, depth)
    return visible_TM & (z_TM > BEHIND * nearest)


def patch_pixels(model: AssembledModel) -> int:
    """Return the side of a video token in pixels."""
    return model.codec.spatial * model.backbone.places.patch


def sightings(
    model: AssembledModel, config: Any, camera: Camera, points_M3: Array, valid_M: Array
) -> Sightings:
    """Choose the map tokens that each camera attends to, and compute their positions.

    Each camera gets J = ``looks`` tokens in view: first visible ones, every part of its image in
    turn (``geometry.zbuffer``; not with ``memory.choose`` nearest), then the nearest. Tokens behind
    much nearer ones come last. ``points_M3`` are (B, M, 3) in the world, cameras (B, T).
    """
    clip, patch = model.clip, patch_pixels(model)
    rows, columns = clip.height // patch, clip.width // patch
    v, u = np.meshgrid(np.arange(rows) + 0.5, np.arange(columns) + 0.5, indexing="ij")
    centres = np.stack([u.ravel(), v.ravel()], -1).astype(np.float32)

    def look(_: None, camera: Camera, points: Array, valid: Array) -> tuple[Array, ...]:
        return _look(model, config, camera, points, valid)

    looked = placement.by_batch(look, None, camera, points_M3, valid_M)
    turns = _angles(jnp.asarray(centres), config.head_dim, max(rows, columns))
    return Sightings(*looked, query_angles_nR=turns)


def _look(
    model: AssembledModel, config: Any, camera: Camera, points_M3: Array, valid_M: Array
) -> tuple[Array, ...]:
    """Return the first four fields of ``Sightings``."""
    clip, patch, patch_t = model.clip, patch_pixels(model), model.backbone.places.patch_t
    head_dim, grid = config.head_dim, max(clip.height // patch, clip.width // patch)
    looks = min(config.looks, points_M3.shape[1])

    uv, z = project(points_M3[:, None], camera)
    size = np.array([clip.width, clip.height], np.float32)
    margin = MARGIN * size
    inside = jnp.all((uv > -margin) & (uv < size + margin), -1)
    visible = inside & (z > NEAREST_M) & valid_M[:, None]
    behind = jax.vmap(lambda uv, z, seen: hidden(uv, z, seen, size, patch))(uv, z, visible)
    rank = z + jnp.where(behind, 1e3, 0.0)
    if model.memory.choose == "visible":
        turn = jax.vmap(lambda *seen: _turns(model, *seen))(points_M3, valid_M, camera)
        rank = jnp.where(turn < zbuffer.CLASS, turn - zbuffer.CLASS, rank)
    rank = jnp.where(visible, rank, jnp.inf)
    _, index = jax.lax.top_k(-rank, looks)

    uv = jnp.take_along_axis(uv, index[..., None], 2)
    z, visible = (jnp.take_along_axis(x, index, 2) for x in (z, visible))
    uv = jnp.where(visible[..., None], uv, 0.0)
    log_z = jnp.log(jnp.where(visible, z, 1.0))
    place = jnp.concatenate([2 * uv / size - 1, log_z[..., None]], -1)

    fold = jax.vmap(lambda x: group_latents(fold_frames(x, model.codec.temporal), patch_t))
    return fold(index), _angles(fold(uv) / patch, head_dim, grid), fold(place), fold(visible)


def _turns(model: AssembledModel, points_M3: Array, valid_M: Array, camera: Camera) -> Array:
    """Return (T, M) the rank of each token for each camera; see ``zbuffer.visibility_rank``."""
    cell_m, size = model.memory.cell_m, (model.clip.height, model.clip.width)
    wide, tall = jnp.float32(max(cell_m[:2])), jnp.float32(cell_m[2])
    return zbuffer.visibility_rank(points_M3, wide, tall, valid_M, camera, size)


def sinusoid_3d(model: AssembledModel, config: Any, camera: Camera, points_M3: Array) -> Array:
    """Return (B, M, 6·10) sines and cosines of (B, M, 3) positions, metres.

    The 10 wavelengths grow geometrically from 4 × a cell's smallest side to 4 × the map's largest
    extent. With ``config.frame`` camera, positions are relative to the first of the (B, T) cameras.
    """
    local = points_M3
    if config.frame == "camera":
        first_from_world = invert_rigid(jnp.asarray(camera.world_from_camera)[:, 0])
        local = transform_points(first_from_world, points_M3)
    memory = model.memory
    wavelengths = np.geomspace(4 * min(memory.cell_m), 4 * memory.extent_m, 10)
    angle = local[..., None] * (2 * math.pi / wavelengths).astype(np.float32)
    angle = angle.reshape(*local.shape[:-1], -1)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)
