"""CogVideoX's video autoencoder: frames ↔ latents, causal, in chunks of time.

Four frames of 8 × 8 pixels become one latent; the first frame has a latent of its own. A clip is
encoded in chunks of 8 frames (the first chunk also takes the remainder) and decoded in chunks of 2
latents (3 in the first chunk if their number is odd). Every convolution passes its last two frames
on to the next chunk, but the group norms see one chunk at a time. The chunks therefore affect the
result, and they bound the memory. Outside of ``jit``, a compiled function is called per chunk, so
two compilations serve videos of any length.

8N + 1 frames become 2N + 1 latents and 8N + 1 frames again. An *even* number of latents has no
first-frame rule: 2 latents decode to 8 frames, not 5. Large frames may be processed in overlapping
spatial tiles, which are blended (``in_tiles``), with less memory and a slightly different result.

Neither ``encode`` nor ``decode`` applies ``config.scaling_factor``; ``VAECodec`` does, a codec of
the mean of the latents. Reference: ``AutoencoderKLCogVideoX`` of diffusers.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError, require
from pewm_jax.models.cogvideox import vae_layers as layers
from pewm_jax.models.cogvideox.config import VAEConfig
from pewm_jax.models.cogvideox.vae_layers import layout
from pewm_jax.models.interface import PublishedVAE
from pewm_jax.nn.parameters import draw
from pewm_jax.nn.video_convolution import in_chunks, require_video
from pewm_jax.types import Array, Params

ENCODE_FRAMES = 8
"""Frames per chunk in the encoder."""
DECODE_LATENTS = 2
"""Latents per chunk in the decoder."""
LOGVAR_RANGE = (-30.0, 20.0)
"""The logarithm of a latent's variance is clipped to this range."""

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class VAECodec(VAEConfig, PublishedVAE):
    """The video autoencoder of CogVideoX; its weights come from a converted checkpoint."""

    depth: bool = True
    """Whether depth is encoded too, as grey pictures by the same weights, in as many channels more;
    CogVideoX itself knows colour alone."""

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be encoded, or decode to another number of frames."""
        super().check(model)
        require(
            self.frames(model.clip.frames) % 2 == 1,
            f"clip.frames {model.clip.frames}: the VAE decodes an even number of latent frames "
            "without its first-frame rule (2 latent frames become 8 frames, not 5); use 8k + 1 "
            "frames (9, 17, 25, …).",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return init(self, key)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video to the scaled mean of its latents; see ``Codec.encode``."""
        inverse = condition and self.invert_scale_latents
        mean, _ = encode(self, params, video_BTHWC)
        return mean * (1 / self.scaling_factor if inverse else self.scaling_factor)

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode scaled latents to q·(t − 1) + 1 frames.

        Raises:
            UserError: the VAE decodes this many latents to another number of frames.
        """
        frames = self.temporal * (latents_BthwC.shape[1] - 1) + 1
        return decode(self, params, latents_BthwC / self.scaling_factor, frames=frames)


def init(config: VAEConfig, key: Array) -> Params:
    """Return random parameters, float32: ``{"encoder": …, "decoder": …}``."""
    return draw(layout(config), key, key_per_leaf=True)


def frames_of(config: VAEConfig, latents: int) -> int:
    """Return the number of frames that latents decode to; an even number has no first frame."""
    return config.temporal * (latents - 1) + 1 if latents % 2 else config.temporal * latents


def latents_of(config: VAEConfig, frames: int) -> int:
    """Return the number of latents that some frames are encoded to.

    Raises:
        UserError: the number is neither temporal·k + 1 nor a multiple of 8; the reference would
            fold such a video irregularly.
    """
    step = config.temporal
    if frames >= 1 and ((frames - 1) % step == 0 or frames % ENCODE_FRAMES == 0):
        return -(-frames // step)
    raise UserError(
        f"a video of {frames} frames cannot be encoded: use 8N + 1 frames (1, 9, 17, …, 49), "
        f"another {step}k + 1, or a multiple of {ENCODE_FRAMES}."
    )


def encode(config: VAEConfig, params: Params, video_BTHWC: Array) -> tuple[Array, Array]:
    """Encode a video to mean and logarithm of the variance of its latents, (B, t, H/8, W/8, z).

    They are not scaled. To sample, compute mean + exp(logvar / 2)·noise. The video is of floats in
    [−1, 1], whose dtype is that of the computation; T is 8N + 1, or another number that
    ``latents_of`` accepts. Rows and columns beyond a multiple of ``config.spatial`` are lost, as in
    the reference.

    Raises:
        UserError: frames that cannot be encoded.
    """
    require_video(video_BTHWC, config.in_channels, "video_BTHWC")
    frames, height, width = video_BTHWC.shape[1:4]
    latents = latents_of(config, frames)
    side = config.spatial
    if min(height, width) < side:
        raise UserError(
            f"a video of {height}×{width} pixels is smaller than one latent, {side}×{side}: "
            "enlarge it."
        )
    if height % side or width % side:
        _log.warning(
            "a video of %d×%d pixels is no multiple of %d: it will decode to %d×%d.",
            *(height, width, side, height // side * side, width // side * side),
        )
    if frames_of(config, latents) != frames:
        _log.warning(
            "%d frames become %d latents, an even number, which decode to %d frames: "
            "use 8N + 1 frames (1, 9, 17, …, 49).",
            *(frames, latents, frames_of(config, latents)),
        )

    def whole(video: Array) -> Array:
        step = partial(_encode_chunk, config, params["encoder"])
        return _in_chunks(step, video, ENCODE_FRAMES)

    moments = in_tiles(whole, video_BTHWC, config, shrink=True)
    mean, logvar = jnp.split(moments, 2, -1)
    return mean, jnp.clip(logvar, *LOGVAR_RANGE)


def decode(
    config: VAEConfig, params: Params, latents_BthwC: Array, *, frames: int | None = None
) -> Array:
    """Decode latents (B, t, h, w, z) to (B, ``frames_of(config, t)``, 8h, 8w, C), in about [−1, 1].

    The latents are divided by ``config.scaling_factor`` again; their dtype is that of the
    computation. If the number of expected ``frames`` is not given, an even number of latents warns.

    Memory does not grow with the length of the clip, since two latents are decoded at a time. With
    the published widths, 49 frames of 480 × 720 in float32 need 20.8 GiB besides parameters and
    video, by XLA's memory analysis on a CPU (``python benchmarks/cogvideox_vae.py --memory``). It
    is proportional to the pixels of a frame: with ``config.tiling``, tiles of 240 × 360 need about
    a quarter.

    Raises:
        UserError: the latents decode to another number of frames than expected.
    """
    require_video(latents_BthwC, config.latent_channels, "latents_BthwC")
    count = latents_BthwC.shape[1]
    out = frames_of(config, count)
    advice = (
        f"{count} latents decode to {out} frames: an odd number of latents, 2N + 1, decodes to "
        f"{2 * config.temporal}N + 1 frames"
    )
    if frames is None and count % 2 == 0:
        _log.warning("%s, an even number has no first frame of its own.", advice)
    elif frames not in {None, out}:
        raise UserError(f"{advice}, {frames} frames were expected.")

    def whole(latents: Array) -> Array:
        step = partial(_decode_chunk, config, params["decoder"])
        return _in_chunks(step, latents, DECODE_LATENTS)

    return in_tiles(whole, latents_BthwC, config, shrink=False)


def _in_chunks(step: Any, x_BTHWC: Array, size: int) -> Array:
    """Run chunks of ``size``, of which the first also takes the remainder."""
    frames = x_BTHWC.shape[1]
    return in_chunks(step, x_BTHWC, frames - (max(frames // size, 1) - 1) * size, size)


@partial(jax.jit, static_argnums=0)
def _encode_chunk(
    config: VAEConfig, params: Params, x_BTHWC: Array, past: Params
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    x, new["conv_in"] = layers.causal_conv(config, params["conv_in"], x_BTHWC, past.get("conv_in"))
    halvings = config.temporal.bit_length() - 1
    for level in range(len(config.widths)):
        name = f"down_{level}"
        x, new[name] = _resnets(config, params[name], x, None, past.get(name, {}))
        if "resample" in params[name]:
            x = layers.downsample(params[name]["resample"], x, in_time=level < halvings)
    x, new["mid"] = _resnets(config, params["mid"], x, None, past.get("mid", {}))
    x, new["conv_out"] = layers.norm_conv(config, params, "_out", x, None, past.get("conv_out"))
    return x, new


@partial(jax.jit, static_argnums=0)
def _decode_chunk(
    config: VAEConfig, params: Params, latents_BthwC: Array, past: Params
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    x, new["conv_in"] = layers.causal_conv(
        config, params["conv_in"], latents_BthwC, past.get("conv_in")
    )
    x, new["mid"] = _resnets(config, params["mid"], x, latents_BthwC, past.get("mid", {}))
    halvings = config.temporal.bit_length() - 1
    for level in range(len(config.widths)):
        name = f"up_{level}"
        x, new[name] = _resnets(config, params[name], x, latents_BthwC, past.get(name, {}))
        if "resample" in params[name]:
            x = layers.upsample(config, params[name]["resample"], x, in_time=level < halvings)
    x, new["conv_out"] = layers.norm_conv(
        config, params, "_out", x, latents_BthwC, past.get("conv_out")
    )
    return x, new


def _resnets(
    config: VAEConfig, params: Params, x_BTHWC: Array, latents_BthwC: Array | None, past: Params
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    for k in range(sum(name.startswith("resnet") for name in params)):
        name = f"resnet_{k}"
        x_BTHWC, new[name] = layers.resnet(
            config, params[name], x_BTHWC, latents_BthwC, past.get(name, {})
        )
    return x_BTHWC, new


def in_tiles(
    whole: Callable[[Array], Array], x_BTHWC: Array, config: VAEConfig, *, shrink: bool
) -> Array:
    """Apply ``whole`` to the tiles of a video and blend, or to a video no larger than a tile.

    ``whole`` encodes (``shrink``: pixels in, latents out) or decodes. The result is that of the
    whole video up to effects at tile borders. If tiles do not overlap by a whole number of latents,
    its size differs, as in the reference, and a warning is logged.
    """
    pixels = config.tile_pixels
    latents = tuple(size // config.spatial for size in pixels)
    tile, out = (pixels, latents) if shrink else (latents, pixels)
    size = x_BTHWC.shape[2:4]
    if not config.tiling or (size[0] <= tile[0] and size[1] <= tile[1]):
        return whole(x_BTHWC)
    overlap = (config.tile_overlap_height, config.tile_overlap_width)
    steps = [int(n * (1 - share)) for n, share in zip(tile, overlap, strict=True)]
    blend = [int(n * share) for n, share in zip(out, overlap, strict=True)]
    keep = [n - extent for n, extent in zip(out, blend, strict=True)]
    starts = [list(range(0, n, step)) for n, step in zip(size, steps, strict=True)]

    tiles = _run_tiles(whole, x_BTHWC, starts, tile)
    rows = []
    for i in range(len(starts[0])):
        row = []
        for j in range(len(starts[1])):
            if i > 0:
                tiles[i, j] = _fade(tiles[i - 1, j], tiles[i, j], blend[0], axis=2)
            if j > 0:
                tiles[i, j] = _fade(tiles[i, j - 1], tiles[i, j], blend[1], axis=3)
            row.append(tiles[i, j][:, :, : keep[0], : keep[1]])
        rows.append(jnp.concatenate(row, 3))
    joined = jnp.concatenate(rows, 2)
    side = config.spatial
    wanted = tuple(n // side if shrink else n * side for n in size)
    if joined.shape[2:4] != wanted:
        _log.warning(
            "tiles of %d×%d pixels that overlap by shares of %.3g and %.3g do not join on whole "
            "latents: the result is %d×%d, not %d×%d; choose tiles whose overlap is a whole number "
            "of %d pixels, as 240×360 with 1/6 and 1/5.",
            *(*pixels, *overlap, *joined.shape[2:4], *wanted, side),
        )
    return joined


def _run_tiles(
    whole: Callable[[Array], Array],
    x_BTHWC: Array,
    starts: list[list[int]],
    tile: tuple[int, ...],
) -> dict[tuple[int, int], Array]:
    """Apply ``whole`` to every tile, with one ``lax.map`` per shape of tile."""
    height, width = x_BTHWC.shape[2:4]
    shapes: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, top in enumerate(starts[0]):
        for j, left in enumerate(starts[1]):
            shape = (min(tile[0], height - top), min(tile[1], width - left))
            shapes.setdefault(shape, []).append((i, j))
    tiles = {}
    for shape, places in shapes.items():
        corners = np.array([(starts[0][i], starts[1][j]) for i, j in places])

        def process(corner: Array, shape: tuple[int, int] = shape) -> Array:
            cut = jax.lax.dynamic_slice_in_dim(x_BTHWC, corner[0], shape[0], 2)
            return whole(jax.lax.dynamic_slice_in_dim(cut, corner[1], shape[1], 3))

        tiles.update(zip(places, jax.lax.map(process, jnp.asarray(corners)), strict=True))
    return tiles


def _fade(before: Array, after: Array, extent: int, axis: int) -> Array:
    """Blend the end of one tile linearly into the start of the next."""
    extent = min(before.shape[axis], after.shape[axis], extent)
    if extent == 0:
        return after
    shape = [1] * after.ndim
    shape[axis] = extent
    share = jnp.asarray(np.arange(extent).reshape(shape) / extent, after.dtype)
    end = jax.lax.slice_in_dim(before, before.shape[axis] - extent, None, axis=axis)
    start = jax.lax.slice_in_dim(after, 0, extent, axis=axis)
    rest = jax.lax.slice_in_dim(after, extent, None, axis=axis)
    return jnp.concatenate([end * (1 - share) + start * share, rest], axis)
