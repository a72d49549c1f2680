"""Image features that the map keeps.

``patch_colours`` is small and has no weights: the mean colour c of each patch and its negative.
The map keeps the maximum over all views, so a cell holds the largest value of each channel and,
through −c, the smallest one too; their middle is the cell's colour.
"""

from __future__ import annotations

import jax.numpy as jnp

from pewm_jax.config import MemoryConfig
from pewm_jax.types import Array


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


def encode(config: MemoryConfig, rgb_THWC: Array) -> Array:
    """Return the encoder's patch features (T, h, w, F); the map upsamples them itself.

    Args:
        config: names the encoder and its patch size.
        rgb_THWC: (T, H, W, 3) float in [−1, 1].
    """
    return patch_colours(rgb_THWC, config.encoder_patch)


def colours(features_VF: Array) -> Array:
    """Return (V, 3) colours in [−1, 1] of cells: the middle of their range."""
    return (features_VF[..., :3] - features_VF[..., 3:6]) / 2
