"""Image encoders, whose features the memory keeps: one interface, chosen by the settings' type.

An encoder is an ``EncoderSettings`` and a module (or object) with

    init(settings, key) -> params                       {} if it has none
    encode(settings, params, rgb_THWC) -> features_ThwF
    preprocessing(settings) -> {"network": …, "preprocessing": …}
                                                        plain values that identify a feature cache
    colours(features_VF) -> (V, 3)                      colours in which features are drawn
    SHARDING                                            rules over ``encoder/…`` paths
    costs(model, share, frames) -> Costs                for a clip with this many context frames
"""

from __future__ import annotations

import numpy as np

from pewm_jax.config import EncoderSettings, functions
from pewm_jax.types import Array, Params


def init(config: EncoderSettings, key: Array) -> Params:
    """Return random parameters."""
    return functions(config).init(config, key)


def encode(config: EncoderSettings, params: Params, rgb_THWC: Array) -> Array:
    """Return patch features (T, h, w, F); the map upsamples them itself.

    Args:
        config: the encoder.
        params: its parameters, empty where it has none.
        rgb_THWC: (T, H, W, 3) float in [−1, 1].
    """
    return functions(config).encode(config, params, rgb_THWC)


def colours(config: EncoderSettings, features_VF: Array) -> np.ndarray:
    """Return (V, 3) colours in [−1, 1] in which features are drawn."""
    return functions(config).colours(np.asarray(features_VF, np.float32))


def principal_colours(features_VF: np.ndarray) -> np.ndarray:
    """Return colours in [−1, 1] from the features' first three principal components."""
    centred = features_VF - features_VF.mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    shown = centred @ axes[:3].T
    return np.tanh(shown / np.maximum(shown.std(0), 1e-6))
