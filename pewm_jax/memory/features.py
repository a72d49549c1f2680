"""Image features that the map keeps, by one of two encoders.

``dinov2`` is the paper's: patch tokens of a frozen DINOv2. ``patch_colours`` is small and has no
weights: the mean colour c of each patch and its negative. The map keeps the maximum over all
views, so a cell holds the largest value of each channel and, through −c, the smallest one too;
their middle is the cell's colour.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import MemoryConfig
from pewm_jax.models import dinov2
from pewm_jax.types import Array, Params

COLOURS = 6
"""Channels of ``patch_colours``."""


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


def encode(config: MemoryConfig, params: Params, rgb_THWC: Array) -> Array:
    """Return the encoder's patch features (T, h, w, F); the map upsamples them itself.

    Args:
        config: names the encoder and its patch size.
        params: the encoder's parameters, empty for ``patch_colours``.
        rgb_THWC: (T, H, W, 3) float in [−1, 1].
    """
    if config.encoder == "dinov2":
        images = dinov2.preprocess(rgb_THWC, config.encoder_size, config.dinov2.patch)
        return dinov2.apply(config.dinov2, params, images)
    return patch_colours(rgb_THWC, config.encoder_patch)


def colours(features_VF: Array) -> np.ndarray:
    """Return (V, 3) colours in [−1, 1] to draw cells with.

    The six features of ``patch_colours`` give the middle of a cell's range; others keep no colour
    and are drawn by their three principal components.
    """
    values = np.asarray(features_VF, np.float32)
    if values.shape[-1] == COLOURS:
        return (values[..., :3] - values[..., 3:6]) / 2
    centred = values - values.mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    shown = centred @ axes[:3].T
    return np.tanh(shown / np.maximum(shown.std(0), 1e-6))
