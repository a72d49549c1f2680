"""The parts of the codec's losses: noisy latents, errors of pixels, LPIPS, and the gate's score.

They are functions of arrays; ``worlds.codec`` and the gate's stage of PEWM make losses of them.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import gates
from pewm_jax.codecs.signals import depth_from_signal, rgbd_signal
from pewm_jax.config import ClipConfig
from pewm_jax.models.lpips import convert as lpips_convert
from pewm_jax.models.lpips import model as lpips
from pewm_jax.types import Array, Frames, Params
from pewm_jax.worlds import sharpen

SMALL = 1e-4
"""Added to variances."""
ABSOLUTE = 0.1
"""Weight of the absolute error beside the squared one."""
LPIPS: lpips.Net = "alex"
"""The network of LPIPS in the loss of a world model's gate."""
EASY = 1e-3
"""Errors of a frame below this no longer matter."""


def noisy_latents(
    model: Any, size: float, codec: Params, truth: Array, key: Array
) -> tuple[Array, Array, Array]:
    """Encode pictures and add noise, ``size`` times each channel's deviation in the batch.

    Returns:
        The latents, which are not normalised, and the mean and the variance of each channel.
    """
    latents = model.codec.encode_raw(codec, truth.astype(model.dtype))
    latents = latents.astype(jnp.float32)
    mean, variance = moments(latents)
    noise = jax.random.normal(key, latents.shape) * jnp.sqrt(variance)
    return (latents + size * noise).astype(model.dtype), mean, variance


def pixel_errors(train: Any, made: Array, truth: Array, counts: Array) -> tuple[Array, Array]:
    """Return the weighted error of the pixels of colour and of depth, and the squared error.

    ``truth`` and ``counts`` are those of ``CodecTask.pictures``, and ``train`` has the weights.
    Both results are (2,).
    """
    error = (made - truth) * counts
    pixels = jnp.maximum(counts.sum((1, 2, 3, 4)), 1) * error.shape[-1]
    absolute = jnp.abs(error).sum((1, 2, 3, 4)) / pixels
    squared = jnp.square(error).sum((1, 2, 3, 4)) / pixels
    gradients = _of_neighbours(made - truth, counts, 2) + _of_neighbours(made - truth, counts, 3)
    each = absolute + train.gradient_weight * gradients + train.squared_weight * squared
    return each, squared


def qualities(
    model: Any, made: Array, truth: Array, counts: Array, squared: Array
) -> dict[str, Array]:
    """Return ``psnr_rgb`` in decibels and ``depth_m``, the mean absolute error in metres."""
    off = depth_from_signal(model.clip, made[1].mean(-1))
    off = jnp.abs(off - depth_from_signal(model.clip, truth[1, ..., 0])) * counts[1, ..., 0]
    return {
        "psnr_rgb": -10 * jnp.log10(jnp.maximum(squared[0] / 4, 1e-10)),
        "depth_m": off.sum() / jnp.maximum(counts[1].sum(), 1),
    }


def lpips_weights(net: lpips.Net, clip: ClipConfig, file: str = "") -> Params:
    """Return the weights of LPIPS from a file, or of the installed package, under ``lpips``.

    Raises:
        UserError: they are absent, damaged, or of another network, or the frames are too small.
    """
    found = {"lpips": lpips_convert.read(lpips_convert.find(net, file), net)[1]}
    lpips.require_size(net, clip.height, clip.width)
    return found


def moments(latents: Array) -> tuple[Array, Array]:
    """Return the mean and the variance of each channel."""
    places = tuple(range(latents.ndim - 1))
    return latents.mean(places), latents.var(places) + SMALL


def _of_neighbours(error: Array, counts: Array, axis: int) -> Array:
    """Return the mean absolute difference between neighbours along an axis, (2,)."""

    def cut(x: Array, first: int, last: int) -> Array:
        return jax.lax.slice_in_dim(x, first, last, axis=axis)

    size = error.shape[axis]
    both = cut(counts, 1, size) * cut(counts, 0, size - 1)
    apart = jnp.abs(cut(error, 1, size) - cut(error, 0, size - 1)) * both
    return apart.sum((1, 2, 3, 4)) / (jnp.maximum(both.sum((1, 2, 3, 4)), 1) * error.shape[-1])


def score(
    model: Any,
    gate: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    shown_BTHWC: Array,
    seen_BTHW: Array,
    truth: Frames,
    perceptual: tuple[float, Params] | None = None,
    *,
    net: lpips.Net = LPIPS,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of a gate on decoded frames and the rendered memory.

    Decoded depth is in metres; ``shown_BTHWC`` has colour and depth signal of the memory, 4
    channels, and ``seen_BTHW`` is True where it shows anything. ``perceptual`` is a weight and the
    weights of LPIPS with the network ``net``, which is then added and measured.

    Returns:
        ``(loss, measured)``: the logarithm of each frame's squared error plus a little absolute
        error, of colour and of measured depth, so that frames with few pixels seen before do not
        outweigh the others; PSNR of colour in decibels, of the gate's result and of the decoded
        frames, and where anything was rendered also of the rendering; ``depth_m``, the mean
        absolute error of the gate's depth.
    """
    decoded, shown, wanted = _signals(model, rgb_BTHWC, depth_BTHW, shown_BTHWC, truth)
    seen = seen_BTHW.reshape(-1, *wanted.shape[1:3])
    made = gates.apply(gate, decoded, shown, seen)
    depth = truth.depth_THW.reshape(seen.shape)
    measured = (depth > 0).astype(made.dtype)
    counts = jnp.stack([jnp.ones_like(measured)] * 3 + [measured], -1)
    error = (made - wanted) * counts
    each = jnp.square(error) + ABSOLUTE * jnp.abs(error)
    each = each.sum((1, 2, 3)) / jnp.maximum(counts.sum((1, 2, 3)), 1)
    loss = jnp.log(each + EASY).mean()
    perceived = {}
    if perceptual is not None:
        weight, network = perceptual
        apart = lpips.apply(net, network, made[..., :3], wanted[..., :3]).mean()
        loss, perceived = loss + weight * apart, {"lpips": apart}
    off = jnp.abs(depth_from_signal(model.clip, made[..., 3]) - depth)
    hit = seen[..., None].astype(made.dtype)
    return loss, perceived | {
        "psnr_rgb": _psnr(made, wanted, jnp.ones_like(hit)),
        "psnr_decoded": _psnr(decoded, wanted, jnp.ones_like(hit)),
        "psnr_seen": _psnr(made, wanted, hit),
        "psnr_rendered": _psnr(shown, wanted, hit),
        "depth_m": (off * measured).sum() / jnp.maximum(measured.sum(), 1),
    }


def _signals(
    model: Any, rgb_BTHWC: Array, depth_BTHW: Array, shown_BTHWC: Array, truth: Frames
) -> tuple[Array, Array, Array]:
    """Return decoded, rendered and true frames (N, H, W, 4): colour and depth signal."""
    decoded = rgbd_signal(model.clip, rgb_BTHWC, depth_BTHW)
    wanted = rgbd_signal(model.clip, truth.rgb_THWC, truth.depth_THW)
    shape = (-1, *wanted.shape[-3:])
    decoded, shown, wanted = (x.reshape(shape) for x in (decoded, shown_BTHWC, wanted))
    return jax.lax.stop_gradient(decoded), shown, wanted


def sharpen_gate(
    model: Any,
    train: Any,
    params: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    shown_BTHWC: Array,
    seen_BTHW: Array,
    truth: Frames,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss that sharpens a gate: ``sharpen.loss`` of colour, absolute error of depth.

    Arguments are those of ``score``; ``train`` has the weights, and ``params`` the gate, the
    discriminator and, if it counts, LPIPS.

    Returns:
        ``(loss, measured)``: those of ``sharpen.loss``; ``loss_depth``, and ``psnr_rgb`` of the
        gate's result.
    """
    gate = params["codec"]["gate"]
    decoded, shown, wanted = _signals(model, rgb_BTHWC, depth_BTHW, shown_BTHWC, truth)
    seen = seen_BTHW.reshape(-1, *wanted.shape[1:3])

    def mix(gate: Params) -> Array:
        return gates.apply(gate, decoded, shown, seen)

    def perceived(made_NHWC: Array) -> Array:
        return lpips.apply(LPIPS, params["lpips"], made_NHWC, wanted[..., :3]).mean()

    made = mix(gate)
    measured = (truth.depth_THW.reshape(seen.shape) > 0).astype(made.dtype)
    off = jnp.abs(made[..., 3] - wanted[..., 3]) * measured
    off = off.sum() / jnp.maximum(measured.sum(), 1)
    loss, found = sharpen.loss(
        made[..., :3],
        wanted[..., :3],
        params[sharpen.NAME],
        pull=sharpen.pull_of_last(lambda gate: mix(gate)[..., :3], gate),
        lpips=perceived if train.sharpen_lpips else None,
        lpips_weight=train.sharpen_lpips,
        gan_weight=train.gan_weight,
    )
    everywhere = jnp.ones_like(measured)[..., None]
    quality = {"loss_depth": off, "psnr_rgb": _psnr(made, wanted, everywhere)}
    return loss + off, found | quality


def _psnr(made: Array, truth: Array, where: Array) -> Array:
    """Return the PSNR of colour in decibels, of the pixels where ``where`` is 1."""
    squared = (jnp.square(made - truth)[..., :3] * where).sum() / jnp.maximum(3 * where.sum(), 1)
    return -10 * jnp.log10(jnp.maximum(squared / 4, 1e-10))
