"""Colour and depth of frames to latents and back with a model's codec, and its gate."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.core import Tracer

from pewm_jax.codecs.pixel import fold
from pewm_jax.codecs.signals import depth_from_signal, rgbd_signal, signal_from_depth
from pewm_jax.config import AssembledModel
from pewm_jax.geometry import depth_images
from pewm_jax.nn import placement
from pewm_jax.types import Array, Params, View


def encode_rgbd(
    model: AssembledModel,
    params: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    *,
    condition: bool = False,
) -> Array:
    """Encode colour (B, T, H, W, 3) in [−1, 1] and depth, metres, and concatenate the channels.

    Pixels without depth get that of the nearest measured pixel, and an image without any
    ``clip.far_m``; ``measured`` returns the weights. ``params`` are the world model's;
    ``condition`` is that of ``Codec.encode``.
    """
    weights = params.get("codec", {})
    if not model.codec.depth_channels:
        return _clip_by_clip(
            lambda weights, rgb: model.codec.encode(
                weights, rgb.astype(jnp.dtype(model.dtype)), condition=condition
            ).astype(jnp.float32),
            weights,
            rgb_BTHWC,
        )
    depth = jnp.asarray(depth_BTHW)
    whole = depth_images.fill_depth(depth.reshape(-1, *depth.shape[-2:]), model.clip.far_m)
    signal = signal_from_depth(model.clip, whole.reshape(depth.shape))[..., None]
    if not model.codec.DEPTH_AS_GREY:
        parts = [model.codec.encode(weights, x, condition=condition) for x in (rgb_BTHWC, signal)]
        return jnp.concatenate(parts, -1)

    def together(weights: Params, rgb: Array, signal: Array) -> Array:
        grey = jnp.broadcast_to(signal, rgb.shape)
        both = jnp.concatenate([rgb, grey]).astype(jnp.dtype(model.dtype))
        latents = model.codec.encode(weights, both, condition=condition)
        return jnp.concatenate(jnp.split(latents.astype(jnp.float32), 2), -1)

    return _clip_by_clip(together, weights, rgb_BTHWC, signal)


def _clip_by_clip(encoded: Callable[..., Array], weights: Params, *videos: Array) -> Array:
    """Encode clip by clip if traced, so that memory use does not grow with the batch."""

    def one_by_one(weights: Params, *videos: Array) -> Array:
        if len(videos[0]) == 1:
            return encoded(weights, *videos)
        latents = jax.lax.map(lambda clip: encoded(weights, *(x[None] for x in clip)), videos)
        return latents[:, 0]

    traced = isinstance(videos[0], Tracer)
    return placement.by_batch(one_by_one if traced else encoded, weights, *videos)


def decode_rgbd(model: AssembledModel, params: Params, latents_BthwC: Array) -> tuple[Array, Array]:
    """Invert ``encode_rgbd``: colour in [−1, 1] (B, T, H, W, 3) and metric depth (B, T, H, W).

    Depth is 0, unknown, if the codec does not encode it.
    """
    if not model.codec.depth_channels:
        latents = latents_BthwC.astype(jnp.dtype(model.dtype))
        rgb = model.codec.decode(params.get("codec", {}), latents).astype(jnp.float32)
        return jnp.clip(rgb, -1, 1), jnp.zeros(rgb.shape[:-1])
    parts = jnp.split(latents_BthwC, [model.codec.rgb_channels], -1)
    weights = params.get("codec", {})
    if not model.codec.DEPTH_AS_GREY:
        rgb, signal = (model.codec.decode(weights, part) for part in parts)
    else:
        both = jnp.stack(parts).astype(jnp.dtype(model.dtype))
        rgb, signal = _decode_both(model, weights, both)
    return jnp.clip(rgb, -1, 1), depth_from_signal(model.clip, signal.mean(-1))


def _decode_both(model: AssembledModel, weights: Params, both_2BthwC: Array) -> Array:
    """Decode colour and depth; one after the other if traced and clips are decoded as a whole.

    The memory is then that of one of them.
    """

    def decoded(latents_BthwC: Array) -> Array:
        return model.codec.decode(weights, latents_BthwC).astype(jnp.float32)

    if isinstance(both_2BthwC, Tracer) and not model.codec.framewise:
        return jax.lax.map(decoded, both_2BthwC)
    video = decoded(both_2BthwC.reshape(-1, *both_2BthwC.shape[2:]))
    return video.reshape(2, -1, *video.shape[1:])


def mix(
    model: AssembledModel, params: Params, rgb_BTHWC: Array, depth_BTHW: Array, view: View
) -> tuple[Array, Array]:
    """Blend decoded frames with the rendered memory by the codec's gate.

    Colours are in [−1, 1], depth in metres; the first 3 features of the (B, T) view are colours.
    Pixels are unchanged where nothing is rendered.
    """

    def pictures(rgb: Array, depth: Array) -> Array:
        four = rgbd_signal(model.clip, rgb, depth)
        return four.reshape(-1, *four.shape[-3:])

    made = model.codec.mix(  # type: ignore[attr-defined]
        params["codec"],
        pictures(rgb_BTHWC, depth_BTHW),
        pictures(view.features_THWF[..., :3], view.depth_THW),
        view.seen_THW.reshape(-1, *view.seen_THW.shape[-2:]),
    ).reshape(*rgb_BTHWC.shape[:-1], 4)
    depth = jnp.where(view.seen_THW, depth_from_signal(model.clip, made[..., 3]), depth_BTHW)
    return jnp.clip(made[..., :3], -1, 1), depth


def measured(model: AssembledModel, depth_BTHW: Array) -> Array:
    """Return the share of measured pixels in each depth latent, the weight of its error.

    The shape (B, t, h, w, C) broadcasts with the depth channels of ``encode_rgbd``. If a channel is
    one pixel, as in the pixel codec, the share is 0 or 1, else the mean over the latent's pixels.
    """
    own = model.codec.measured(depth_BTHW)
    if own is not None:
        return own
    valid = (depth_BTHW > 0).astype(jnp.float32)[..., None]
    share = fold(valid, model.codec.spatial, model.codec.temporal)
    return share if model.codec.PIXELWISE else share.mean(-1, keepdims=True)
