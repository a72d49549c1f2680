"""The loss of the gate: noisy true latents, decoded, beside the memory of what was seen before."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import gates, rgbd
from pewm_jax.codecs.signals import as_signal, depth_from_signal, signal_from_depth
from pewm_jax.config import CodecTrainConfig, CodecWorldConfig, TrainSettings
from pewm_jax.memory import interface as memories
from pewm_jax.models.lpips import model as lpips
from pewm_jax.types import Array, Camera, Clip, Frames, Params

ABSOLUTE = 0.1
"""Weight of the absolute error beside the squared one."""
LPIPS: lpips.Net = "alex"
"""The network of LPIPS in the loss."""
EASY = 1e-3
"""Errors of a frame below this no longer matter."""


def rendered(model: CodecWorldConfig, clip: Clip) -> tuple[Array, Array]:
    """Render each clip's memory of its context for the clip's frames.

    Returns:
        ``(rendered_BTHWC, seen_BTHW)``: colour and depth signal (4 channels), and where there is
        anything.
    """
    height, width = model.clip.height, model.clip.width

    def one(inputs: tuple[Frames, Array, Camera]) -> tuple[Array, Array]:
        context, valid, camera = inputs
        memory = memories.from_context(model, {}, context, valid)  # type: ignore[arg-type]
        view = memories.render(model, memory, camera, height, width)  # type: ignore[arg-type]
        depth = signal_from_depth(model.clip, view.depth_THW)[..., None]
        return jnp.concatenate([view.features_THWF[..., :3], depth], -1), view.seen_THW

    inputs = (as_signal(clip.context), clip.context_valid_S, clip.frames.camera)
    return jax.lax.map(one, jax.tree.map(jnp.asarray, inputs))


def mix(
    model: CodecWorldConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of stage ``gate``.

    The frames after each clip's first, which is part of its context, are encoded; noise of a random
    size is added to the latents, and the gate mixes what is decoded with what is rendered.

    Returns:
        ``(loss, measured)``: the logarithm of each frame's squared error and a little absolute
        error, of colour and of depth where it was measured, so that frames of which little was seen
        before do not outweigh those of which much was; PSNR of colour in decibels, of what is
        decoded and of what the gate makes of it, and where anything was rendered also of that
        alone; ``depth_m``, the mean absolute error of the gate's depth.
    """
    assert isinstance(train, CodecTrainConfig)
    frames = as_signal(clip.frames)
    later = Frames(
        frames.rgb_THWC[:, 1:],
        frames.depth_THW[:, 1:],
        jax.tree.map(lambda x: x[:, 1:], frames.camera),
    )
    asked = Clip(later, clip.context, clip.context_valid_S)
    shown_BTHWC, seen_BTHW = jax.lax.stop_gradient(rendered(model, asked))
    latents = rgbd.encode_rgbd(model, params, later.rgb_THWC, later.depth_THW)  # type: ignore[arg-type]
    level_key, noise_key = jax.random.split(key)
    level = jax.random.uniform(level_key, (len(latents), 1, 1, 1, 1), maxval=train.gate_noise)
    noisy = latents + level * jax.random.normal(noise_key, latents.shape)
    rgb, depth = rgbd.decode_rgbd(model, params, noisy)  # type: ignore[arg-type]
    return score(model, params["codec"]["gate"], rgb, depth, shown_BTHWC, seen_BTHW, later)


def score(
    model: Any,
    gate: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    shown_BTHWC: Array,
    seen_BTHW: Array,
    truth: Frames,
    perceptual: tuple[float, Params] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of what a gate makes of decoded frames and of the rendered memory; see above.

    Args:
        model: the model; its clip says what depth is as a signal.
        gate: the gate's parameters.
        rgb_BTHWC: decoded colours.
        depth_BTHW: decoded depth, metres.
        shown_BTHWC: colour and depth signal of the memory, 4 channels.
        seen_BTHW: where it shows anything.
        truth: the recorded frames, colours in [−1, 1].
        perceptual: a weight and the weights of LPIPS, which then counts too, and is measured.
    """
    decoded = _four(model, rgb_BTHWC, depth_BTHW)
    wanted = _four(model, truth.rgb_THWC, truth.depth_THW)
    shape = (-1, *wanted.shape[-3:])
    decoded, shown, wanted = (x.reshape(shape) for x in (decoded, shown_BTHWC, wanted))
    decoded = jax.lax.stop_gradient(decoded)
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
        apart = lpips.apply(LPIPS, network, made[..., :3], wanted[..., :3]).mean()
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


def _four(model: Any, rgb: Array, depth: Array) -> Array:
    """Return colour and depth signal in 4 channels."""
    return jnp.concatenate([rgb, signal_from_depth(model.clip, depth)[..., None]], -1)


def _psnr(made: Array, truth: Array, where: Array) -> Array:
    """Return the PSNR of colour in decibels, of the pixels where ``where`` is 1."""
    squared = (jnp.square(made - truth)[..., :3] * where).sum() / jnp.maximum(3 * where.sum(), 1)
    return -10 * jnp.log10(jnp.maximum(squared / 4, 1e-10))
