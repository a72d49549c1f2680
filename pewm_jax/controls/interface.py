"""Controls, which steer a clip: one interface, chosen by the type of the settings.

A control is a ``Conditioner`` and a module (or object) with

    init(model, key) -> params                       {} if it has none
    condition(model, params, observed, control) -> Conditioning
    SHARDING                                         rules over ``control/…`` paths
    costs(model, share, *, trained) -> Costs         see ``models.costs``

and ``settings.channels(model)``, the number of channels it adds to the denoiser's input.
``models.camera_control`` is an example, ``models.action_control`` one that modulates.
"""

from __future__ import annotations

from pewm_jax.config import ModelConfig, functions
from pewm_jax.models.interface import Conditioning
from pewm_jax.types import Array, Control, Frames, Params


def init(model: ModelConfig, key: Array) -> Params:
    """Return random parameters."""
    return functions(model.control).init(model, key)


def condition(
    model: ModelConfig, params: Params, observed: Frames, control: Control
) -> Conditioning:
    """Turn what steers a batch of clips into inputs of the denoiser.

    Args:
        model: the model.
        params: the control's parameters, empty where it has none.
        observed: (B, 1) the observed first frames, colours in [−1, 1]; or more of them.
        control: (B, T) cameras, (B, T − 1) actions and (B, A) states if there are any.

    Returns:
        Input channels, modulation (per latent frame) and tokens.
    """
    return functions(model.control).condition(model, params, observed, control)
