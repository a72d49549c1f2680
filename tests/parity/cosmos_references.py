"""Small networks of Cosmos-Predict2 with random weights, made by the references."""

from types import SimpleNamespace

import numpy as np
import torch
from diffusers import CosmosTransformer3DModel
from diffusers.models.transformers import transformer_cosmos

from tests.parity.svd_references import randomise

SHRUNKEN = {
    "in_channels": 5,
    "out_channels": 4,
    "num_attention_heads": 2,
    "attention_head_dim": 16,
    "num_layers": 2,
    "mlp_ratio": 2.0,
    "text_embed_dim": 24,
    "adaln_lora_dim": 8,
    "max_size": (8, 12, 12),
    "rope_scale": (1.0, 3.0, 3.0),
    "extra_pos_embed_type": None,
}
"""Settings of a small transformer, otherwise those of Predict2."""


def resize(mask, size, interpolation):
    """Stand in for torchvision's resizing, which is this call for tensors and NEAREST."""
    assert interpolation == "nearest"
    return torch.nn.functional.interpolate(mask, size=size, mode=interpolation)


TRANSFORMS = SimpleNamespace(
    functional=SimpleNamespace(resize=resize),
    InterpolationMode=SimpleNamespace(NEAREST="nearest"),
)


def transformer(**settings):
    """Make the reference; without torchvision it lacks one function, which is put there."""
    if not hasattr(transformer_cosmos, "transforms"):
        transformer_cosmos.transforms = TRANSFORMS
    network = CosmosTransformer3DModel(**{**SHRUNKEN, **settings})
    return randomise(network)


def channels_first(x):
    return torch.tensor(np.moveaxis(np.asarray(x), -1, 1))


def channels_last(x):
    return np.moveaxis(x.numpy(), 1, -1)
