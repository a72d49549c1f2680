"""DreamSim (Fu et al. 2023, arXiv 2306.09344): a distance that follows human similarity judgements.

Three vision transformers (DINO, CLIP and OpenCLIP, ViT-B/16 each), adapted to human judgements,
embed both pictures; the distance is one minus the cosine between their joined, centred features.
The reference is ``dreamsim`` 0.2, kind ``ensemble``: of DINO the class token of the last block,
before the last norm; of both CLIPs the embedding. No package contains its weights: see
``models.dreamsim.convert``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import jax
import jax.numpy as jnp

from pewm_jax.models.clip.model import MEAN_3 as CLIP_MEAN_3
from pewm_jax.models.clip.model import STD_3 as CLIP_STD_3
from pewm_jax.models.dinov2.model import MEAN_3, STD_3
from pewm_jax.nn.layers import layer_norm, linear
from pewm_jax.nn.tokens import patchify_images
from pewm_jax.types import Array, Params

Encoder = Literal["dino_vitb16", "clip_vitb16", "open_clip_vitb16"]
ENCODERS: tuple[Encoder, ...] = ("dino_vitb16", "clip_vitb16", "open_clip_vitb16")
"""The encoders in the order in which their features are concatenated."""
HEAD = 64
"""Channels of an attention head."""
QUICK = 1.702


@dataclasses.dataclass(frozen=True)
class Kind:
    """How an encoder differs from the others.

    Attributes:
        mean_3: colour that is subtracted.
        std_3: by which colours are divided.
        epsilon: of layer norms.
        quick: whether GELU is x · sigmoid(1.702 x).
        embeds: whether tokens are normed before the first block, and the class token is normed and
            projected after the last one.
    """

    mean_3: tuple[float, float, float]
    std_3: tuple[float, float, float]
    epsilon: float
    quick: bool
    embeds: bool


KINDS: Mapping[Encoder, Kind] = {
    "dino_vitb16": Kind(MEAN_3, STD_3, 1e-6, quick=False, embeds=False),
    "clip_vitb16": Kind(CLIP_MEAN_3, CLIP_STD_3, 1e-5, quick=True, embeds=True),
    "open_clip_vitb16": Kind(CLIP_MEAN_3, CLIP_STD_3, 1e-5, quick=False, embeds=True),
}


def distance(params: Params, a_BHWC: Array, b_BHWC: Array) -> Array:
    """Return DreamSim's distances of colours in [0, 1], (B,) float32; 0 for equal pictures.

    ``params`` are from ``models.dreamsim.convert.read``: a vision transformer for each encoder.
    """
    a, b = embed(params, a_BHWC), embed(params, b_BHWC)
    return 1 - (a * b).sum(-1)


def embed(params: Params, rgb_BHWC: Array) -> Array:
    """Return the joined features of pictures in [0, 1], (B, F) float32, centred and of length 1."""
    parts = []
    for name in ENCODERS:
        images = resized(rgb_BHWC, side(params[name]))
        parts.append(encode(name, params[name], images))
    joined = jnp.concatenate(parts, -1)
    centred = joined - joined.mean(-1, keepdims=True)
    return centred / jnp.linalg.norm(centred, axis=-1, keepdims=True)


def resized(rgb_BHWC: Array, pixels: int) -> Array:
    """Return square pictures, bicubic with antialiasing, as the reference resizes; in [0, 1]."""
    rgb = jnp.asarray(rgb_BHWC, jnp.float32)
    shape = (len(rgb), pixels, pixels, 3)
    return jnp.clip(jax.image.resize(rgb, shape, "cubic", antialias=True), 0, 1)


def side(params: Params) -> int:
    """Return the pixels, height and width, of the pictures that an encoder takes."""
    places = params["position_embed"].shape[0] - 1
    patch = round((params["patch_embed"]["kernel"].shape[0] / 3) ** 0.5)
    return round(places**0.5) * patch


def encode(name: Encoder, params: Params, images_BHWC: Array) -> Array:
    """Return one encoder's features (B, F), float32, of colours in [0, 1] of its ``side``.

    Its parameters are ``patch_embed``, ``cls_token`` (D,), ``position_embed`` (1 + N, D),
    ``blocks`` (stacked over layers), and of the CLIPs ``norm_before``, ``norm`` and ``projection``
    (D, F).
    """
    kind = KINDS[name]
    images = (images_BHWC - jnp.array(kind.mean_3)) / jnp.array(kind.std_3)
    width = params["cls_token"].shape[0]
    patch = round((params["patch_embed"]["kernel"].shape[0] / 3) ** 0.5)
    tokens = linear(params["patch_embed"], patchify_images(images, patch))
    first = jnp.broadcast_to(params["cls_token"], (len(tokens), 1, width))
    tokens = jnp.concatenate([first, tokens], 1) + params["position_embed"]
    if kind.embeds:
        tokens = layer_norm(params["norm_before"], tokens, kind.epsilon)

    def block(x_BND: Array, layer: Params) -> tuple[Array, None]:
        x_BND = x_BND + _attend(layer, layer_norm(layer["norm1"], x_BND, kind.epsilon))
        hidden = linear(layer["up"], layer_norm(layer["norm2"], x_BND, kind.epsilon))
        hidden = hidden * jax.nn.sigmoid(QUICK * hidden) if kind.quick else _gelu(hidden)
        return x_BND + linear(layer["down"], hidden), None

    token = jax.lax.scan(block, tokens, params["blocks"])[0][:, 0]
    if not kind.embeds:
        return token
    return layer_norm(params["norm"], token, kind.epsilon) @ params["projection"]


def _attend(layer: Params, x_BND: Array) -> Array:
    width = x_BND.shape[-1]
    qkv = linear(layer["qkv"], x_BND)
    q, k, v = qkv.reshape(*x_BND.shape[:2], 3, width // HEAD, HEAD).transpose(2, 0, 3, 1, 4)
    weights = jax.nn.softmax(q @ k.swapaxes(-1, -2) * HEAD**-0.5, -1)
    mixed = (weights @ v).swapaxes(1, 2).reshape(x_BND.shape)
    return linear(layer["to_out"], mixed)


def _gelu(x: Array) -> Array:
    return jax.nn.gelu(x, approximate=False)
