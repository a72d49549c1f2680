"""Errors planted into what the memory shows, in training (``train.memory_errors``).

A memory of true frames shows the truth. In a rollout it also holds imagined surfaces, and in real
recordings what a depth camera measured. A model that never saw errors copies them. So a share of
the clips gets a readout with errors. They are functions of a key alone; each clip draws which kinds
it gets (each with probability ``EACH``), and how strong they are, up to the constants below:

- wrong surfels: some cells of the world have other colours; others are shown at another place;
- shifted depth: too near or too far as a whole, and in broad waves;
- missing parts: some cells of the world are not shown;
- the errors of depth cameras: noise that grows with the square of depth, dropouts at depth edges,
  and per frame a small error of the pose and of the exposure (gain and bias).

Cells are cubes of the world, so that an error lies at the same place in all frames of a clip.
Tokens get wrong features, wrong positions and dropouts; latents of a rendering get latents of
another place, and holes.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import AssembledModel
from pewm_jax.geometry.cameras import unproject
from pewm_jax.nn import placement, target
from pewm_jax.types import Array, Camera, EncodedView, MapTokens, MemoryReadout, View

BROAD = 8
"""Pixels, along each axis, per cell of the broad noise on depth."""
FINE = 0.3
"""The noise on depth of each pixel, as a share of the broad noise."""

EACH = 0.5
"""Probability of each kind of error in a clip that gets errors."""
WRONG, MOVED, MISSING = 0.2, 0.1, 0.4
"""Largest shares of cells with wrong colours, at a wrong place, and missing."""
SMALL_M, LARGE_M = 0.06, 1.0
"""Sides of these cells, drawn log-uniformly for each clip and kind."""
COLOUR = 0.5
"""Largest change of a wrong cell's colours, which come from another place of the image."""
FAR = 0.15
"""Largest displacement of moved cells, as a share of the image's side; and of their depth."""
SHIFT, WAVES = 0.05, 0.05
"""Deviation of the shift of depth of a whole clip, and largest size of its waves; shares."""
QUADRATIC = 0.003
"""Largest deviation of depth at 1 m, metres; it grows with z² (structured light and time of flight
have 0.001 to 0.003)."""
EDGE = 0.1
"""Relative difference of depth between neighbours that is an edge; pixels there may drop out."""
TURN, MOVE_M = np.deg2rad(1.0), 0.02
"""Largest deviations of a frame's pose: angle, and metres parallel to the image."""
GAIN, BIAS = 0.1, 0.05
"""Deviations of the logarithm of a frame's exposure, and of its bias, for colours in [−1, 1]."""
TOKEN_M = 0.1
"""Deviation of the positions of tokens, metres."""


def depth_noise(key: Array, shape: tuple[int, ...], most: float) -> Array:
    """Draw multiplicative errors of depth (B, T, H, W): smooth over the image, and small per pixel.

    Each clip draws its size from 0 to ``most``, a share of the depth.
    """
    size_key, broad_key, fine_key = jax.random.split(key, 3)
    batch, frames, height, width = shape
    size = most * jax.random.uniform(size_key, (batch, 1, 1, 1))
    cells = (batch, frames, -(-height // BROAD), -(-width // BROAD))
    broad = jax.image.resize(jax.random.normal(broad_key, cells), shape, "bilinear")
    fine = jax.random.normal(fine_key, shape)
    return jnp.exp(size * (broad + FINE * fine))


def plant_errors(
    model: AssembledModel, share: float, readout: MemoryReadout, camera: Camera, key: Array
) -> MemoryReadout:
    """Return a batch's readout with errors in a share of the clips.

    Args:
        model: the model.
        share: probability that a clip gets errors.
        readout: the readouts, leading axis B.
        camera: (B, T) the clips' cameras.
        key: all that the errors depend on.
    """
    batch = len(jax.tree.leaves(readout)[0])
    chosen_key, key = jax.random.split(key)
    chosen = jax.random.bernoulli(chosen_key, share, (batch,))
    limit = None if model.memory.KEEPS_FEATURES else 1.0

    def changed(readout: MemoryReadout, camera: Camera, key: Array) -> MemoryReadout:
        keys = jax.random.split(key, 3)
        tokens, view, encoded = readout.tokens, readout.view, readout.encoded
        return MemoryReadout(
            None if tokens is None else perturb_tokens(tokens, keys[0]),
            None if view is None else perturb_view(view, camera, keys[1], limit),
            None if encoded is None else perturb_latents(encoded, keys[2]),
        )

    def of_clip(clip: tuple[Array, MemoryReadout, Camera, Array]) -> MemoryReadout:
        chosen, *inputs = clip
        return jax.lax.cond(chosen, changed, lambda readout, *_: readout, *inputs)

    def of_batch(_: None, *clips: Any) -> MemoryReadout:
        return jax.lax.map(of_clip, clips)

    clips = chosen, readout, jax.tree.map(jnp.asarray, camera), jax.random.split(key, batch)
    if target.current().platform == "cpu":  # one by one, errors are computed only where chosen
        return placement.by_batch(of_batch, None, *clips)
    return jax.vmap(lambda *clip: of_clip(clip))(*clips)


def perturb_view(view: View, camera: Camera, key: Array, limit: float | None = None) -> View:
    """Return one clip's (T,) views with errors; features stay within ± ``limit``, if given."""
    names = ("which", "wrong", "moved", "missing", "depth", "sensor")
    keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
    kinds = (_wrong_cells, _moved_cells, _missing_cells, _shifted_depth, _sensor)
    which = jax.random.bernoulli(keys.pop("which"), EACH, (len(kinds),))
    points = unproject(jnp.asarray(view.depth_THW), camera)
    found = view
    for drawn, kind, own in zip(which, kinds, keys.values(), strict=True):
        found = jax.lax.cond(drawn, kind, lambda view, *_: view, found, points, camera, own)
    seen = found.seen_THW
    features = jnp.where(seen[..., None], found.features_THWF, 0)
    if limit is not None:
        features = jnp.clip(features, -limit, limit)
    return View(features, found.depth_THW, seen)


def _side(key: Array) -> Array:
    """Draw the side of a clip's cells, metres."""
    return SMALL_M * (LARGE_M / SMALL_M) ** jax.random.uniform(key)


def _per_cell(key: Array, points_THW3: Array, count: int) -> Array:
    """Draw ``count`` uniform numbers for each cell of the world, (T, H, W, count), by hashing."""
    side_key, offset_key, salt_key = jax.random.split(key, 3)
    side = _side(side_key)
    offset = jax.random.uniform(offset_key, (3,)) * side
    cell = jnp.floor((points_THW3 + offset) / side).astype(jnp.int32).astype(jnp.uint32)
    primes = jnp.asarray([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], jnp.uint32)
    salts = jax.random.bits(salt_key, (count,), jnp.uint32)
    mixed = jnp.bitwise_xor(_mix((cell * primes).sum(-1, dtype=jnp.uint32))[..., None], salts)
    return _mix(mixed).astype(jnp.float32) / np.float32(2**32)


def _mix(x: Array) -> Array:
    """Return the finalizer of MurmurHash3, a bijection of 32 bits."""
    for shift, prime in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = (x ^ (x >> shift)) * jnp.uint32(prime)
    return x ^ (x >> 16)


def _offset(key: Array, height: int, width: int) -> Array:
    """Draw a displacement in the image: rows and columns, int32."""
    most = jnp.asarray([height, width]) * FAR
    return jnp.round(jax.random.uniform(key, (2,), minval=-1, maxval=1) * most).astype(jnp.int32)


def _shifted(x: Any, offset: Array) -> Any:
    return jax.tree.map(lambda leaf: jnp.roll(leaf, offset, (1, 2)), x)


def _wrong_cells(view: View, points: Array, camera: Camera, key: Array) -> View:
    """Give some cells the features of another place, changed at random."""
    del camera
    cell_key, share_key, place_key, size_key = jax.random.split(key, 4)
    channels = view.features_THWF.shape[-1]
    drawn = _per_cell(cell_key, points, 1 + channels)
    wrong = drawn[..., :1] < WRONG * jax.random.uniform(share_key)
    other = _shifted(view.features_THWF, _offset(place_key, *view.seen_THW.shape[1:]))
    other = other + COLOUR * jax.random.uniform(size_key) * (2 * drawn[..., 1:] - 1)
    features = jnp.where(wrong & view.seen_THW[..., None], other, view.features_THWF)
    return dataclasses.replace(view, features_THWF=features)


def _moved_cells(view: View, points: Array, camera: Camera, key: Array) -> View:
    """Show some cells at another place of the image, nearer or farther, instead of their own."""
    del camera
    cell_key, share_key, place_key, depth_key = jax.random.split(key, 4)
    moved = _per_cell(cell_key, points, 1)[..., 0] < MOVED * jax.random.uniform(share_key)
    moved = moved & view.seen_THW
    scale = jnp.exp(jax.random.uniform(depth_key, minval=-FAR, maxval=FAR))
    offset = _offset(place_key, *moved.shape[1:])
    features, depth, there = _shifted((view.features_THWF, view.depth_THW * scale, moved), offset)
    there = there & ((depth < view.depth_THW) | ~view.seen_THW | moved)
    return View(
        jnp.where(there[..., None], features, view.features_THWF),
        jnp.where(there, depth, jnp.where(moved, 0, view.depth_THW)),
        there | (view.seen_THW & ~moved),
    )


def _missing_cells(view: View, points: Array, camera: Camera, key: Array) -> View:
    """Drop some cells."""
    del camera
    cell_key, share_key = jax.random.split(key)
    missing = _per_cell(cell_key, points, 1)[..., 0] < MISSING * jax.random.uniform(share_key)
    return _without(view, missing)


def _without(view: View, missing: Array) -> View:
    depth = jnp.where(missing, 0, view.depth_THW)
    return dataclasses.replace(view, depth_THW=depth, seen_THW=view.seen_THW & ~missing)


def _shifted_depth(view: View, points: Array, camera: Camera, key: Array) -> View:
    """Scale depth as a whole and in waves."""
    del points, camera
    shift_key, waves_key = jax.random.split(key)
    scale = jnp.exp(SHIFT * jax.random.normal(shift_key))
    waves = depth_noise(waves_key, (1, *view.depth_THW.shape), WAVES)[0]
    return dataclasses.replace(view, depth_THW=view.depth_THW * scale * waves)


def _sensor(view: View, points: Array, camera: Camera, key: Array) -> View:
    """Add the errors of depth cameras."""
    del points
    edge_key, drop_key, noise_key, size_key, pose_key, light_key = jax.random.split(key, 6)
    depth = view.depth_THW
    dropped = jax.random.uniform(edge_key, depth.shape) < jax.random.uniform(drop_key)
    view = _without(view, _edges(depth) & dropped)
    size = QUADRATIC * jax.random.uniform(size_key)
    noisy = view.depth_THW + size * view.depth_THW**2 * jax.random.normal(noise_key, depth.shape)
    noisy = jnp.maximum(noisy, view.depth_THW / 2)  # never 0, which means not measured
    view = _moved_camera(dataclasses.replace(view, depth_THW=noisy), camera, pose_key)
    frames = (len(depth), 1, 1, 1)
    gain, bias = jax.random.normal(light_key, (2, *frames))
    features = view.features_THWF * jnp.exp(GAIN * gain) + BIAS * bias
    return dataclasses.replace(view, features_THWF=features)


def _edges(depth_THW: Array) -> Array:
    """Return where depth differs much from that of a neighbour."""
    found = jnp.zeros(depth_THW.shape, bool)
    for axis in (1, 2):
        ahead, behind = (jax.lax.slice_in_dim(depth_THW, a, b, axis=axis) for a, b in _ENDS)
        apart = jnp.abs(ahead - behind) > EDGE * jnp.minimum(ahead, behind)
        sides = [(0, 0)] * 3
        for side in ((1, 0), (0, 1)):
            sides[axis] = side
            found = found | jnp.pad(apart, sides)
    return found


_ENDS = ((1, None), (0, -1))


def _moved_camera(view: View, camera: Camera, key: Array) -> View:
    """Show each frame as from a camera turned and moved a little; pixels are not interpolated."""
    size_key, turn_key, move_key = jax.random.split(key, 3)
    frames, height, width = view.depth_THW.shape
    size = jax.random.uniform(size_key)
    turn = size * TURN * jax.random.normal(turn_key, (2, frames, 1, 1))
    move = size * MOVE_M * jax.random.normal(move_key, (2, frames, 1, 1))
    near = 1 / jnp.where(view.depth_THW > 0, view.depth_THW, jnp.inf)
    focal = jnp.moveaxis(camera.intrinsics_4[:, :2], -1, 0)[..., None, None]
    across, down = jnp.round(focal * (turn + move * near)).astype(jnp.int32)
    row = jnp.clip(np.arange(height)[:, None] + down, 0, height - 1)
    column = jnp.clip(np.arange(width) + across, 0, width - 1)
    frame = np.arange(frames)[:, None, None]
    return jax.tree.map(lambda leaf: leaf[frame, row, column], view)


def perturb_tokens(tokens: MapTokens, key: Array) -> MapTokens:
    """Return one clip's tokens with other features, at other places, and fewer of them."""
    keys = jax.random.split(key, 5)
    count = tokens.valid_M.shape[0]
    shares = jnp.asarray([WRONG, MOVED, MISSING]) * jax.random.uniform(keys[0], (3,))
    shares = shares * jax.random.bernoulli(keys[1], EACH, (3,))
    wrong, moved, missing = jax.random.uniform(keys[2], (3, count)) < shares[:, None]
    other = jnp.roll(tokens.features_MF, jax.random.randint(keys[3], (), 1, max(count, 2)), 0)
    places = TOKEN_M * jax.random.normal(keys[4], tokens.points_world_M3.shape)
    valid = tokens.valid_M & ~missing
    return MapTokens(
        jnp.where((wrong & tokens.valid_M)[:, None], other, tokens.features_MF),
        jnp.where(moved[:, None], tokens.points_world_M3 + places, tokens.points_world_M3),
        valid,
    )


def perturb_latents(encoded: EncodedView, key: Array) -> EncodedView:
    """Return one clip's encoded rendering with latents of other places, and holes."""
    keys = jax.random.split(key, 4)
    (_, height, width, _), seen = encoded.latents_thwC.shape, encoded.seen_THW
    shares = jnp.asarray([WRONG, MISSING]) * jax.random.uniform(keys[0], (2,))
    shares = shares * jax.random.bernoulli(keys[1], EACH, (2,))
    wrong, missing = jax.random.uniform(keys[2], (2, height, width)) < shares[:, None, None]
    other = _shifted(encoded.latents_thwC, _offset(keys[3], height, width))
    pixels = seen.shape[1] // height, seen.shape[2] // width
    holes = jnp.repeat(jnp.repeat(missing, pixels[0], 0), pixels[1], 1)
    latents = jnp.where(wrong[..., None], other, encoded.latents_thwC)
    return EncodedView(latents, seen & ~holes)
