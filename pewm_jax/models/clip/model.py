"""CLIP's image encoder, equal to ``CLIPVisionModelWithProjection`` of transformers.

``preprocess`` turns frames into its input as Stable Video Diffusion's pipeline does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.models.dinov2.model import resize_matrix
from pewm_jax.nn.attention import multi_head_attention
from pewm_jax.nn.layers import layer_norm, linear
from pewm_jax.nn.parameters import Leaf, draw, norm
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.tokens import patchify_images
from pewm_jax.types import Array, Params

MEAN_3 = (0.48145466, 0.4578275, 0.40821073)
"""Mean colour in [0, 1] of CLIP's training images, which it subtracts."""
STD_3 = (0.26862954, 0.26130258, 0.27577711)
"""Standard deviation of colours, by which CLIP divides."""


@dataclasses.dataclass(frozen=True)
class CLIPVisionConfig:
    """A vision transformer in CLIP's form with its projection (arXiv 2103.00020): ViT-H/14."""

    layers: int = 32
    """Transformer blocks."""
    heads: int = 16
    """Attention heads."""
    width: int = 1280
    """Model width."""
    hidden: int = 5120
    """Width of the feed-forward's hidden layer."""
    projection: int = 1024
    """Channels of the embedding of an image."""
    image_size: int = 224
    """Side of an image in pixels; no other size is accepted."""
    patch: int = 14
    """Pixels per patch, along height and along width."""
    activation: Literal["gelu", "quick_gelu"] = "gelu"
    """`quick_gelu` is x·sigmoid(1.702 x), as in OpenAI's models."""
    epsilon: float = 1e-5
    """Added to the variance in layer norms."""

    @property
    def tokens(self) -> int:
        """Tokens of an image: its patches and one for the whole."""
        return 1 + (self.image_size // self.patch) ** 2

    def __post_init__(self):
        """Validate."""
        sizes = ("layers", "heads", "width", "hidden", "projection", "image_size", "patch")
        require_positive(self, "clip_vision", *sizes)
        require(
            self.width % self.heads == 0,
            f"clip_vision.width {self.width} is not a multiple of clip_vision.heads {self.heads}.",
        )
        require(
            self.image_size % self.patch == 0,
            f"clip_vision.image_size {self.image_size} is not a multiple of clip_vision.patch "
            f"{self.patch}.",
        )
        require(self.epsilon > 0, f"clip_vision.epsilon is {self.epsilon}: it must be positive.")


def init(config: CLIPVisionConfig, key: Array) -> Params:
    """Initialise: float32, blocks stacked over layers.

    The tree: ``patch_embed/kernel`` (a linear layer on p·p·3 pixels), ``cls_token`` (D,),
    ``position_embed`` (1 + g², D) with the class token's first, ``norm_in``, ``blocks``,
    ``norm_out``, ``project/kernel``.
    """
    ends_key, blocks_key, *keys = jax.random.split(key, 4)
    shapes = {"cls_token": (config.width,), "position_embed": (config.tokens, config.width)}
    blocks = jax.vmap(lambda k: draw(dict(_block(config)), k, key_per_leaf=True))(
        jax.random.split(blocks_key, config.layers)
    )
    tokens = {
        name: 0.02 * jax.random.normal(k, shape)
        for k, (name, shape) in zip(keys, shapes.items(), strict=True)
    }
    return {**draw(dict(_ends(config)), ends_key, key_per_leaf=True), **tokens, "blocks": blocks}


def apply(config: CLIPVisionConfig, params: Params, images_BHWC: Array) -> Array:
    """Return the projected embedding of every image, (B, projection), not of unit length.

    The images are floats from ``preprocess``. Their dtype is the dtype of the computation; norms
    and softmax are in float32.

    Raises:
        UserError: images of another shape or dtype.
    """
    images = jnp.asarray(images_BHWC)
    side, dtype = config.image_size, images.dtype
    if images.shape[1:] != (side, side, 3) or not jnp.issubdtype(dtype, jnp.floating):
        raise UserError(
            f"CLIP got images of shape {images.shape} and dtype {dtype}: give it floats of shape "
            f"(batch, {side}, {side}, 3), from clip_vision.preprocess."
        )
    patches = linear(params["patch_embed"], patchify_images(images, config.patch))
    first = jnp.broadcast_to(params["cls_token"].astype(dtype), (len(images), 1, config.width))
    x = jnp.concatenate([first, patches], 1) + params["position_embed"].astype(dtype)
    x = layer_norm(params["norm_in"], x, config.epsilon)

    def body(x_BND: Array, layer: Params) -> tuple[Any, None]:
        return _run(config, layer, x_BND), None

    x, _ = jax.lax.scan(body, x, params["blocks"])
    return linear(params["project"], layer_norm(params["norm_out"], x[:, 0], config.epsilon))


def preprocess(rgb_BHWC: Array, size: int = 224) -> Array:
    """Turn colours in [−1, 1] into the encoder's input: resized to a square, then normalised.

    Resizing is that of the pipeline of Stable Video Diffusion in diffusers: a Gaussian blur whose
    width follows from the factor, then bicubic interpolation with aligned corners. Along each axis
    both are one matrix. The dtype is that of the colours.

    Raises:
        UserError: no RGB images, or too small ones.
    """
    rgb = jnp.asarray(rgb_BHWC)
    fits = rgb.ndim == 4 and rgb.shape[-1] == 3 and min(rgb.shape[1:3]) >= 2
    if not fits or not jnp.issubdtype(rgb.dtype, jnp.floating):
        raise UserError(
            f"clip_vision.preprocess got an array of shape {rgb.shape} and dtype {rgb.dtype}: give "
            "it floats in [-1, 1] of shape (batch, height, width, 3), at least 2×2 pixels."
        )
    rows, columns = (_smooth_resize(side, size) for side in rgb.shape[1:3])
    resized = jnp.einsum(
        "hr,wc,brcd->bhwd",
        rows,
        columns,
        rgb.astype(jnp.float32),
        precision=jax.lax.Precision.HIGHEST,
    )
    mean, std = (np.asarray(x, np.float32) for x in (MEAN_3, STD_3))
    return (((resized + 1) / 2 - mean) / std).astype(rgb.dtype)


def _smooth_resize(old: int, new: int) -> np.ndarray:
    """Return the (new, old) float32 matrix of a blur followed by bicubic interpolation."""
    sigma = max((old / new - 1) / 2, 0.001)
    taps = int(max(4 * sigma, 3)) // 2
    offsets = np.arange(-taps, taps + 1)
    kernel = np.exp(-(offsets**2) / (2 * sigma**2))
    blur = np.zeros((old, old))
    for row in range(old):
        columns = np.abs(row + offsets)  # reflected at the edges, which are not repeated
        columns = np.where(columns >= old, 2 * (old - 1) - columns, columns)
        np.add.at(blur[row], columns, kernel / kernel.sum())
    return (resize_matrix(old, new, antialias=False, corners=True) @ blur).astype(np.float32)


def _run(config: CLIPVisionConfig, params: Params, x_BND: Array) -> Array:
    """Pre-norm attention and feed-forward."""
    normed = layer_norm(params["norm1"], x_BND, config.epsilon)
    x = x_BND + multi_head_attention(params["attn"], normed, normed, config.heads)
    hidden = linear(params["up"], layer_norm(params["norm2"], x, config.epsilon))
    if config.activation == "gelu":
        hidden = jax.nn.gelu(hidden, approximate=False)
    else:
        hidden = hidden * jax.nn.sigmoid(1.702 * hidden)
    return x + linear(params["down"], hidden)


def _ends(config: CLIPVisionConfig) -> Iterator[Leaf]:
    yield "patch_embed/kernel", (config.patch**2 * 3, config.width)
    yield from norm("norm_in", config.width)
    yield from norm("norm_out", config.width)
    yield "project/kernel", (config.width, config.projection)


def _block(config: CLIPVisionConfig) -> Iterator[Leaf]:
    for name in ("to_q", "to_k", "to_v", "to_out"):
        yield from linear_leaves(f"attn/{name}", config.width, config.width)
    yield from norm("norm1", config.width)
    yield from norm("norm2", config.width)
    yield from linear_leaves("up", config.width, config.hidden)
    yield from linear_leaves("down", config.hidden, config.width)
