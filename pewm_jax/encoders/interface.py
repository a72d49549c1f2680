"""Image encoders, whose features the memory keeps: one interface, chosen by the settings' type.

An encoder is an ``Encoder`` and a module (or object) with

    init(settings, key) -> params                       {} if it has none
    encode(settings, params, rgb_THWC) -> features_ThwF
    preprocessing(settings) -> {"network": …, "preprocessing": …}
                                                        plain values that identify a feature cache
    colours(features_VF) -> (V, 3)                      colours in which features are drawn
    SHARDING                                            rules over ``encoder/…`` paths
    costs(model, share, frames) -> Costs                for a clip with this many context frames

One that takes another part's parameters (``WEIGHTS``) has, in place of ``encode`` and
``preprocessing``,

    features(model, params, rgb_THWC) -> features_ThwF  with the world model's parameters
"""

from __future__ import annotations

import numpy as np

from pewm_jax.config import Encoder, ModelConfig, UserError, functions
from pewm_jax.types import Array, Params


def init(config: Encoder, key: Array) -> Params:
    """Return random parameters."""
    return functions(config).init(config, key)


def encode(config: Encoder, params: Params, rgb_THWC: Array) -> Array:
    """Return patch features (T, h, w, F); the map upsamples them itself.

    Args:
        config: the encoder.
        params: its parameters, empty where it has none.
        rgb_THWC: (T, H, W, 3) float in [−1, 1].

    Raises:
        UserError: the features are those of another part of the model; see ``features``.
    """
    require_own(config, "cannot be made without the model")
    return functions(config).encode(config, params, rgb_THWC)


def features(model: ModelConfig, params: Params, rgb_THWC: Array) -> Array:
    """Return the features (T, h, w, F) that a model's memory keeps of frames.

    Args:
        model: the model.
        params: the world model's parameters, of which those in ``weights`` are used.
        rgb_THWC: (T, H, W, 3) float in [−1, 1].
    """
    config = model.memory.encoder
    if config.WEIGHTS == "encoder":
        return encode(config, params.get("encoder", {}), rgb_THWC)
    return functions(config).features(model, params, rgb_THWC)


def weights(model: ModelConfig, params: Params) -> Params:
    """Return those of the world model's parameters that ``features`` uses; {} if it uses none."""
    name = model.memory.encoder.WEIGHTS
    return {name: params[name]} if name in params else {}


def require_own(config: Encoder, what: str) -> None:
    """Refuse an encoder that takes another part's parameters.

    Raises:
        UserError: it does; ``what`` completes the sentence "its features …".
    """
    if config.WEIGHTS != "encoder":
        raise UserError(
            f"memory.encoder takes the weights of the {config.WEIGHTS}: its features {what}; "
            "use encoders.features(model, params, colours)."
        )


def colours(config: Encoder, features_VF: Array) -> np.ndarray:
    """Return (V, 3) colours in [−1, 1] in which features are drawn."""
    return functions(config).colours(np.asarray(features_VF, np.float32))


def principal_colours(features_VF: np.ndarray) -> np.ndarray:
    """Return colours in [−1, 1] from the features' first three principal components."""
    centred = features_VF - features_VF.mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    shown = centred @ axes[:3].T
    return np.tanh(shown / np.maximum(shown.std(0), 1e-6))
