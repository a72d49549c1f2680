"""The task that trains the learned codec, frame by frame.

Stage ``codec`` has it give frames back through noise on its latents. Stage ``statistics`` then fits
mean and scale of the averaged codec's latents, by which it normalises them. Where ``codec.gate``
asks for a gate, stage ``gate`` trains that (``mix``). So a finished run holds a codec that
another model can start from.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import gates, rgbd
from pewm_jax.codecs.signals import as_signal, depth_from_signal, signal_from_depth
from pewm_jax.config import CodecTrainConfig, CodecWorldConfig, TrainSettings
from pewm_jax.geometry import depth_images
from pewm_jax.memory import interface as memories
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.types import Array, Camera, Clip, Frames, Params
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

SMALL = 1e-4
"""Added to variances."""
PULL = 1e-2
"""Weight of what keeps each channel of the latents near mean 0 and variance 1."""


def init(model: CodecWorldConfig, key: Array) -> Params:
    """Return random parameters, under ``codec`` as in every model."""
    return {"codec": model.codec.init(key)}  # type: ignore[arg-type]


def _without_gate(model: CodecWorldConfig, key: Array) -> Params:
    """Return random parameters of all but the gate."""
    plain = dataclasses.replace(model.codec, gate=0)  # type: ignore[call-arg]
    return init(dataclasses.replace(model, codec=plain), key)


def pictures(model: CodecWorldConfig, clip: Clip) -> tuple[Array, Array]:
    """Return a batch's frames as the codec sees them, and which pixels count.

    Returns:
        (2, N, H, W, 3) colour and depth as a grey picture, in [−1, 1], and (2, N, H, W, 1): 0 where
        depth was not measured, else 1.
    """
    frames = as_signal(clip.frames)
    rgb = frames.rgb_THWC.reshape(-1, *frames.rgb_THWC.shape[-3:])
    depth = frames.depth_THW.reshape(-1, *frames.depth_THW.shape[-2:], 1)
    whole = depth_images.fill_depth(depth[..., 0], model.clip.far_m)[..., None]
    grey = jnp.broadcast_to(signal_from_depth(model.clip, whole), rgb.shape)
    measured = (depth > 0).astype(rgb.dtype)
    return jnp.stack([rgb, grey]), jnp.stack([jnp.ones_like(measured), measured])


def reconstruct(
    model: CodecWorldConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of stage ``codec``: frames given back through noise on their latents.

    Absolute and squared error of the pixels, and absolute error of the differences between
    neighbours, with the weights in ``train``; depth counts where it was measured. Where
    ``train.lpips_weight`` asks for it, LPIPS of colour too. The noise of a channel is relative to
    its deviation in the batch, so that larger latents gain nothing.

    Returns:
        ``(loss, measured)``: of colour ``psnr_rgb`` in decibels and ``lpips``, if it counts; of
        depth ``depth_m``, the mean absolute error in metres; all through the noise.
    """
    assert isinstance(train, CodecTrainConfig)
    truth, counts = pictures(model, clip)
    weights, codec = params["codec"], model.codec
    latents = codec.encode_raw(weights, truth.astype(model.dtype))  # type: ignore[arg-type]
    latents = latents.astype(jnp.float32)
    mean, variance = _moments(latents)
    noise = jax.random.normal(key, latents.shape) * jnp.sqrt(variance)
    noisy = (latents + train.latent_noise * noise).astype(model.dtype)
    made = codec.decode_raw(weights, noisy).astype(jnp.float32)  # type: ignore[arg-type]

    error = (made - truth) * counts
    pixels = jnp.maximum(counts.sum((1, 2, 3, 4)), 1) * error.shape[-1]
    absolute = jnp.abs(error).sum((1, 2, 3, 4)) / pixels
    squared = jnp.square(error).sum((1, 2, 3, 4)) / pixels
    gradients = _of_neighbours(made - truth, counts, 2) + _of_neighbours(made - truth, counts, 3)
    each = absolute + train.gradient_weight * gradients + train.squared_weight * squared
    pull = jnp.square(mean).mean() + jnp.square(jnp.log(variance)).mean()
    off = depth_from_signal(model.clip, made[1].mean(-1))
    off = jnp.abs(off - depth_from_signal(model.clip, truth[1, ..., 0])) * counts[1, ..., 0]
    loss, perceived = each.mean() + PULL * pull, {}
    if train.lpips_weight:
        apart = lpips.apply(train.lpips_net, params["lpips"], made[0], truth[0]).mean()
        loss, perceived = loss + train.lpips_weight * apart, {"lpips": apart}
    return loss, perceived | {
        "loss_rgb": each[0],
        "loss_depth": each[1],
        "psnr_rgb": -10 * jnp.log10(jnp.maximum(squared[0] / 4, 1e-10)),
        "depth_m": off.sum() / jnp.maximum(counts[1].sum(), 1),
    }


def perceptual(model: CodecWorldConfig, train: TrainSettings) -> Params | None:
    """Return the weights of LPIPS that ``reconstruct`` needs, under ``lpips``, or None.

    Raises:
        UserError: they are asked for and absent, damaged, or of another network, or the frames are
            too small for it.
    """
    assert isinstance(train, CodecTrainConfig)
    if not train.lpips_weight:
        return None
    file = lpips_weights.find(train.lpips_net, train.lpips_file)
    found = {"lpips": lpips_weights.read(file, train.lpips_net)[1]}
    lpips.require_size(train.lpips_net, model.clip.height, model.clip.width)
    return found


def distribute(
    model: CodecWorldConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of stage ``statistics``: how unlikely latents are under its normal law.

    It is least where ``latent_mean_C`` and ``latent_scale_C`` are mean and standard deviation.
    """
    del train, key
    truth, _ = pictures(model, clip)
    latents = model.codec.encode(params["codec"], truth.astype(model.dtype))  # type: ignore[arg-type]
    latents = latents.astype(jnp.float32)
    scale = jnp.abs(params["codec"]["latent_scale_C"])
    mean, variance = _moments(latents)
    loss = (jnp.square(latents) / 2).mean() + jnp.log(scale).mean()
    return loss, {
        "latent_mean": jnp.abs(mean).max(),
        "latent_variance": variance.mean(),
    }


def _moments(latents: Array) -> tuple[Array, Array]:
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


STATISTICS = r"codec/latent_(mean|scale)_C"
NETWORKS = r"codec/(encoder|decoder)/.*"
GATE = r"codec/gate/.*"
STAGES = (
    Stage(
        "codec",
        1,
        ((STATISTICS, FREEZE), (NETWORKS, TRAIN)),
        _without_gate,
        reconstruct,
        extra_weights=perceptual,
    ),
    Stage("statistics", 2, ((STATISTICS, TRAIN), (NETWORKS, FREEZE)), _without_gate, distribute),
    Stage("gate", 3, ((GATE, TRAIN), (STATISTICS, FREEZE), (NETWORKS, FREEZE)), init, mix),
)


def stages(model: CodecWorldConfig) -> tuple[Stage, ...]:
    """Return the stages: two, and one for the gate if there is one."""
    return STAGES if model.codec.gate else STAGES[:2]  # type: ignore[attr-defined]


def sharding(model: CodecWorldConfig) -> tuple[tuple[str, Any], ...]:
    """Return the codec's rules."""
    return model.codec.SHARDING
