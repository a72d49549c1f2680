"""What steers a clip: every control behind one interface, chosen by the type of its settings.

A control is a ``ControlSettings`` and a module (or object) with

    init(model, key) -> params                       {} where there are none
    condition(model, params, observed, control) -> Conditioning
    SHARDING                                         rules over ``control/…`` paths
    costs(model, share, *, trained) -> Costs         see ``models.costs``

and ``settings.channels(model)`` says how many channels it joins to the denoiser's input.
``models.camera_control`` is an example.
"""

from __future__ import annotations

from pewm_jax.config import ModelConfig, functions
from pewm_jax.models.backbones import Conditioning
from pewm_jax.types import Array, Control, Frames, Params


def init(model: ModelConfig, key: Array) -> Params:
    """Return random parameters."""
    return functions(model.control).init(model, key)


def condition(
    model: ModelConfig, params: Params, observed: Frames, control: Control
) -> Conditioning:
    """Say what steers a batch of clips.

    Args:
        model: the model.
        params: the control's parameters, empty where it has none.
        observed: (B, 1) the observed first frames, colours in [−1, 1].
        control: (B, T) cameras, and (B, T − 1) actions where there are any.

    Returns:
        What is joined to the input, added to the modulation (per latent frame), given as tokens.
    """
    return functions(model.control).condition(model, params, observed, control)
