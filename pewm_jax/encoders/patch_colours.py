"""The small image encoder, without weights: the mean colour c of each patch, and −c.

The map keeps the maximum over all views. A cell therefore holds the largest value of each colour
channel and, through −c, the smallest one. The middle of the two is the cell's colour.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import ModelConfig, PatchColoursConfig
from pewm_jax.nn.costs import Costs, Share
from pewm_jax.types import Array, Params

SHARDING = ()
"""It has no parameters."""


def init(config: PatchColoursConfig, key: Array) -> Params:
    """Return the parameters: none."""
    del config, key
    return {}


def patch_colours(rgb_THWC: Array, patch: int) -> Array:
    """Return (T, H/p, W/p, 6): mean colour of each patch and its negative.

    Args:
        rgb_THWC: (T, H, W, 3) float in [−1, 1].
        patch: p, pixels.
    """
    frames, height, width, _ = rgb_THWC.shape
    grid = rgb_THWC.reshape(frames, height // patch, patch, width // patch, patch, 3)
    mean = grid.mean((2, 4))
    return jnp.concatenate([mean, -mean], -1)


def encode(config: PatchColoursConfig, params: Params, rgb_THWC: Array) -> Array:
    """Return (T, H/p, W/p, 6) features; see ``encoders.encode``."""
    del params
    return patch_colours(rgb_THWC, config.patch)


def preprocessing(config: PatchColoursConfig) -> dict[str, Any]:
    """Return what the features depend on."""
    return {"network": {}, "preprocessing": {"patch": config.patch}}


def colours(features_VF: np.ndarray) -> np.ndarray:
    """Return the middle of each cell's range of colours."""
    return (features_VF[..., :3] - features_VF[..., 3:6]) / 2


def costs(model: ModelConfig, share: Share, frames: int) -> Costs:
    """Return the costs, which are negligible."""
    del model, share, frames
    return Costs()
