"""Layers of Stable Video Diffusion, channels last: residual blocks and attention, space and time.

Each layer works on single frames first and then on each pixel's frames; a learned number mixes the
two results. The U-Net and the decoder of the autoencoder share the residual blocks. Norms and
softmax are computed in float32, the rest in the dtype of the activations. ``…_leaves`` lists a
layer's parameters: ``mix`` is one number, the logit of the spatial branch's weight. References:
``SpatioTemporalResBlock`` and ``TransformerSpatioTemporalModel`` of diffusers.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from pewm_jax.nn import layers
from pewm_jax.nn.attention import multi_head_attention
from pewm_jax.nn.layers import group_norm_affine, layer_norm, linear, mlp
from pewm_jax.nn.parameters import Leaf, convolution
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.parameters import mlp as mlp_leaves
from pewm_jax.nn.parameters import norm as norm_leaves
from pewm_jax.nn.video_convolution import SAME, convolve_frames, convolve_upsampled
from pewm_jax.types import Array, Params

GROUPS = 32
"""Groups of every group norm in the reference."""
EPS = 1e-6
"""Added to the variance in the group norms before attention."""


def norm(params: Params, x_BTHWC: Array, eps: float, *, over_time: bool = False) -> Array:
    """Group norm of each frame, or of all frames of a clip together, in float32."""
    batch, frames, *rest = x_BTHWC.shape
    x = x_BTHWC if over_time else x_BTHWC.reshape(batch * frames, 1, *rest)
    factor, offset = (v[:, None, None, None] for v in group_norm_affine(params, x, GROUPS, eps))
    return (x.astype(jnp.float32) * factor + offset).reshape(x_BTHWC.shape)


def active(params: Params, x_BTHWC: Array, eps: float, *, over_time: bool = False) -> Array:
    """Group norm and SiLU, in x's dtype."""
    return jax.nn.silu(norm(params, x_BTHWC, eps, over_time=over_time)).astype(x_BTHWC.dtype)


def convolve_time(params: Params, x_BTHWC: Array) -> Array:
    """Convolve each pixel over three frames, with zeros before the first and after the last.

    Every frame is multiplied with the three taps of ``kernel`` (3, C, D) at once; the products are
    then added to the frames they belong to. Few large matrix products are what a CPU is fastest at.
    """
    kernel = params["kernel"].astype(x_BTHWC.dtype)
    frames = x_BTHWC.shape[1]
    before, here, after = (x_BTHWC @ tap for tap in kernel)
    edge = ((0, 0), (1, 1), (0, 0), (0, 0), (0, 0))
    before, after = (jnp.pad(x, edge) for x in (before, after))
    bias = params["bias"].astype(x_BTHWC.dtype)
    return before[:, :frames] + here + after[:, 2:] + bias


def resnet_2d(params: Params, x_BTHWC: Array, time_BTE: Array | None, eps: float) -> Array:
    """Residual block of single frames: norm, SiLU, 3×3 convolution, twice.

    ``time_BTE`` is (B, T or 1, E), SiLU of the time embedding.
    """
    h = convolve_frames(params["conv1"], active(params["norm1"], x_BTHWC, eps), 1, SAME)
    if time_BTE is not None:
        h = h + linear(params["time"], time_BTE)[:, :, None, None]
    h = convolve_frames(params["conv2"], active(params["norm2"], h, eps), 1, SAME)
    if "shortcut" in params:
        x_BTHWC = linear(params["shortcut"], x_BTHWC)
    return x_BTHWC + h


def resnet(
    params: Params,
    x_BTHWC: Array,
    time_BTE: Array | None,
    eps: float,
    temporal_eps: float | None = None,
    *,
    switched: bool = False,
) -> Array:
    """Residual block over space, then one over time, mixed.

    ``time_BTE`` is (B, T or 1, E), SiLU of the time embedding. ``temporal_eps`` is ``eps`` over
    time, if it differs. ``switched`` tells that ``mix`` weighs the temporal branch, as in the
    autoencoder.
    """
    x = resnet_2d(params["spatial"], x_BTHWC, time_BTE, eps)
    inside = params["temporal"]
    eps = temporal_eps or eps
    h = convolve_time(inside["conv1"], active(inside["norm1"], x, eps, over_time=True))
    if time_BTE is not None:
        h = h + linear(inside["time"], time_BTE)[:, :, None, None]
    h = convolve_time(inside["conv2"], active(inside["norm2"], h, eps, over_time=True))
    # Mixing x and x + h is x plus a weighted h.
    return x + _temporal_weight(params, x.dtype, of_time=switched) * h


def _temporal_weight(params: Params, dtype: jnp.dtype, *, of_time: bool) -> Array:
    """Return the weight of the temporal branch."""
    logit = params["mix"].astype(jnp.float32)
    return jax.nn.sigmoid(logit if of_time else -logit).astype(dtype)


def upsample(params: Params, x_BTHWC: Array, height: int, width: int) -> Array:
    """Repeat rows and columns up to a size, twice its own or one less, and convolve."""
    if (height, width) == tuple(2 * side for side in x_BTHWC.shape[2:4]):
        return convolve_upsampled(params, x_BTHWC)
    x = jnp.repeat(jnp.repeat(x_BTHWC, 2, 2), 2, 3)[:, :, :height, :width]
    return convolve_frames(params, x, 1, SAME)


def attend(params: Params, x_BTHWC: Array, image_BMD: Array, heads: int, layers_: int) -> Array:
    """Attention over the pixels of a frame, then over the frames of a pixel, mixed; residual.

    Both attend to the embedding of the image as well. There are ``layers_`` pairs of a spatial and
    a temporal layer.
    """
    batch, frames, height, width, channels = x_BTHWC.shape
    pixels, dtype = height * width, x_BTHWC.dtype
    x = norm(params["norm"], x_BTHWC, EPS).astype(dtype)
    x = linear(params["proj_in"], x.reshape(batch, frames, pixels, channels))
    number = layers.sinusoid(jnp.arange(frames), channels).astype(dtype)
    number = mlp(params["frame_embed"], number)[None, :, None]
    for k in range(layers_):
        flat = x.reshape(batch * frames, pixels, channels)
        context = jnp.repeat(image_BMD, frames, 0) if image_BMD.shape[1] > 1 else image_BMD
        x = _spatial(params[f"spatial_{k}"], flat, context, heads, frames)
        x = x.reshape(batch, frames, pixels, channels)
        moved = _temporal(params[f"temporal_{k}"], x + number, image_BMD, heads)
        x = x + _temporal_weight(params, dtype, of_time=False) * (moved - x)
    x = linear(params["proj_out"], x).reshape(x_BTHWC.shape)
    return x + x_BTHWC


def _spatial(params: Params, x_NPC: Array, context: Array, heads: int, frames: int) -> Array:
    """Run a layer on the pixels of every frame: self-attention, the image, feed-forward."""
    normed = layer_norm(params["norm1"], x_NPC)
    x = x_NPC + multi_head_attention(params["attn1"], normed, normed, heads)
    x = x + _attend_image(params, x, context, heads, frames)
    return x + _feed_forward(params["ff"], layer_norm(params["norm3"], x))


def _temporal(params: Params, x_BTPC: Array, image_BMD: Array, heads: int) -> Array:
    """Run a layer on the frames of every pixel; also a feed-forward layer at its start."""
    batch, frames, pixels, channels = x_BTPC.shape
    x = x_BTPC + _feed_forward(params["ff_in"], layer_norm(params["norm_in"], x_BTPC))
    normed = layer_norm(params["norm1"], x)
    x = x + _over_frames(params["attn1"], normed, heads)
    flat = x.reshape(batch, frames * pixels, channels)
    x = (flat + _attend_image(params, flat, image_BMD, heads, 1)).reshape(x.shape)
    return x + _feed_forward(params["ff"], layer_norm(params["norm3"], x))


def _attend_image(params: Params, x_NPC: Array, context: Array, heads: int, repeats: int) -> Array:
    """Attend to the image's embedding.

    A single token gets all weight for any query, so queries and keys are not computed.
    """
    inside = params["attn2"]
    context = context.astype(x_NPC.dtype)
    if context.shape[1] > 1:
        return multi_head_attention(inside, layer_norm(params["norm2"], x_NPC), context, heads)
    return jnp.repeat(linear(inside["to_out"], linear(inside["to_v"], context)), repeats, 0)


def _over_frames(params: Params, x_BTPC: Array, heads: int) -> Array:
    """Self-attention among the frames of every pixel."""
    batch, frames, pixels, channels = x_BTPC.shape
    x = x_BTPC.swapaxes(1, 2).reshape(batch * pixels, frames, channels)
    out = multi_head_attention(params, x, x, heads)
    return out.reshape(batch, pixels, frames, channels).swapaxes(1, 2)


def _feed_forward(params: Params, x: Array) -> Array:
    """Gated feed-forward: half of the hidden channels, times GELU of the other half."""
    value, gate = jnp.split(linear(params["up"], x), 2, -1)
    return linear(params["down"], value * jax.nn.gelu(gate, approximate=False))


def resnet_2d_leaves(where: str, inside: int, outside: int, time: int = 0) -> Iterator[Leaf]:
    """Yield a residual block of single frames; ``time`` channels of the time embedding."""
    yield from norm_leaves(f"{where}/norm1", inside)
    yield from convolution(f"{where}/conv1", (3, 3), inside, outside)
    if time:
        yield from linear_leaves(f"{where}/time", time, outside)
    yield from norm_leaves(f"{where}/norm2", outside)
    yield from convolution(f"{where}/conv2", (3, 3), outside, outside)
    if inside != outside:
        yield from linear_leaves(f"{where}/shortcut", inside, outside)


def resnet_leaves(where: str, inside: int, outside: int, time: int = 0) -> Iterator[Leaf]:
    """Yield a residual block over space, one over time, and how they are mixed."""
    yield from resnet_2d_leaves(f"{where}/spatial", inside, outside, time)
    there = f"{where}/temporal"
    for k in "12":
        yield from norm_leaves(f"{there}/norm{k}", outside)
        yield from convolution(f"{there}/conv{k}", (3,), outside, outside)
    if time:
        yield from linear_leaves(f"{there}/time", time, outside)
    yield f"{where}/mix", (1,)


def attend_leaves(where: str, width: int, image_dim: int, layers_: int) -> Iterator[Leaf]:
    """Yield the attention of one level of the U-Net."""
    yield from norm_leaves(f"{where}/norm", width)
    yield from linear_leaves(f"{where}/proj_in", width, width)
    yield from mlp_leaves(f"{where}/frame_embed", width, 4 * width, width)
    for k in range(layers_):
        for branch in ("spatial", "temporal"):
            there = f"{where}/{branch}_{k}"
            if branch == "temporal":
                yield from norm_leaves(f"{there}/norm_in", width)
                yield from _feed_forward_leaves(f"{there}/ff_in", width)
            for n, dim in ((1, width), (2, image_dim)):
                yield from norm_leaves(f"{there}/norm{n}", width)
                yield f"{there}/attn{n}/to_q/kernel", (width, width)
                yield f"{there}/attn{n}/to_k/kernel", (dim, width)
                yield f"{there}/attn{n}/to_v/kernel", (dim, width)
                yield from linear_leaves(f"{there}/attn{n}/to_out", width, width)
            yield from norm_leaves(f"{there}/norm3", width)
            yield from _feed_forward_leaves(f"{there}/ff", width)
    yield f"{where}/mix", (1,)
    yield from linear_leaves(f"{where}/proj_out", width, width)


def _feed_forward_leaves(where: str, width: int) -> Iterator[Leaf]:
    yield from linear_leaves(f"{where}/up", width, 8 * width)
    yield from linear_leaves(f"{where}/down", 4 * width, width)
