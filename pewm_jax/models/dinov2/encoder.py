"""The paper's image encoder: patch tokens of a frozen DINOv2."""

from __future__ import annotations

from typing import Any

from jax.sharding import PartitionSpec as P

from pewm_jax import config as configuration
from pewm_jax.config import DINOv2EncoderConfig, ModelConfig
from pewm_jax.encoders.interface import principal_colours
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.nn.costs import FLOAT, Costs, Product, Share
from pewm_jax.types import Array, Params

SHARDING = (
    (r"encoder/.*/kernel", P(None, "fsdp")),
    (r"encoder/position_embed", P(None, "fsdp")),
    (r"encoder/register_tokens", P(None, "fsdp")),
    (r"encoder/blocks/scale[12]", P()),
    (r"encoder/cls_token", P()),
    (r"encoder/.*/(scale|bias)", P()),
)
"""Weights are stored sharded and gathered for use; each device encodes its own frames."""

colours = principal_colours


def init(config: DINOv2EncoderConfig, key: Array) -> Params:
    """Return random parameters."""
    return dinov2.init(config.network, key)


def encode(config: DINOv2EncoderConfig, params: Params, rgb_THWC: Array) -> Array:
    """Return (T, size/p, size/p, D) patch tokens; see ``encoders.encode``."""
    images = dinov2.preprocess(rgb_THWC, config.size, config.network.patch)
    return dinov2.apply(config.network, params, images)


def preprocessing(config: DINOv2EncoderConfig) -> dict[str, Any]:
    """Return what the features depend on besides the weights."""
    return {
        "network": configuration.to_dict(config.network),
        "preprocessing": {
            "size": config.size,
            "resize": "bicubic, antialiased",
            "mean": list(dinov2.MEAN_3),
            "std": list(dinov2.STD_3),
        },
    }


def costs(model: ModelConfig, share: Share, frames: int) -> Costs:
    """Return the costs of encoding all context frames, including their resizing."""
    del share
    config, clip = model.memory.encoder, model.clip
    assert isinstance(config, DINOv2EncoderConfig)
    network, side = config.network, config.size
    tokens, width = 1 + network.registers + (side // network.patch) ** 2, network.width
    count = frames * tokens
    forward = (3 if network.swiglu else 2) * network.hidden * width
    patches = frames * (side // network.patch) ** 2 * 3 * network.patch**2 * width
    resized = frames * 3 * side * clip.width * (clip.height + side)
    linear = network.layers * count * (4 * width * width + forward)
    logits = frames * network.heads * tokens**2
    return Costs(
        products=(
            Product("encoder", "linear", linear),
            Product("encoder", "attention", network.layers * count * 2 * tokens * width),
            Product("encoder", "linear", patches + resized),
        ),
        held=FLOAT * (2 * logits + 12 * count * width),
    )
