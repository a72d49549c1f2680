"""Small networks of Cosmos-Predict2 with random weights, made by the references."""

from types import SimpleNamespace

import numpy as np
import torch
from diffusers import (
    AutoencoderKLWan,
    Cosmos2VideoToWorldPipeline,
    CosmosTransformer3DModel,
    FlowMatchEulerDiscreteScheduler,
)
from diffusers.models.transformers import transformer_cosmos

from tests.models.svd.references import randomise

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


class Harmless:
    """Stands where the pipeline wants its filter of contents."""

    def to(self, *_, **__):
        return self

    def check_video_safety(self, video):
        return video


def scheduler():
    return FlowMatchEulerDiscreteScheduler(use_karras_sigmas=True)


def small_pipeline():
    """Return the pipeline of the reference; making it completes its scheduler's settings."""
    vae = AutoencoderKLWan(
        base_dim=4,
        z_dim=4,
        dim_mult=[1, 2, 1],
        num_res_blocks=1,
        temperal_downsample=[True, True],
        latents_mean=[0.1, -0.2, 0.3, 0.0],
        latents_std=[0.5, 1.5, 1.0, 2.0],
    )
    made = Cosmos2VideoToWorldPipeline(
        text_encoder=None,
        tokenizer=None,
        transformer=transformer(),
        vae=randomise(vae),
        scheduler=scheduler(),
        safety_checker=Harmless(),
    )
    made.set_progress_bar_config(disable=True)
    return made


def channels_first(x):
    return torch.tensor(np.moveaxis(np.asarray(x), -1, 1))


def channels_last(x):
    return np.moveaxis(x.numpy(), 1, -1)
