"""Backbones: every denoiser behind one interface, chosen by the type of its settings.

A backbone is a ``BackboneSettings`` and a module (or object) with

    init(settings, key, in_channels, out_channels) -> params
    apply(settings, params, x_BthwC, time_B, conditioning, readers) -> prediction_BthwC
    SHARDING                                    rules over ``backbone/…`` paths, see ``tree``
    costs(model, share, *, trained) -> Costs    see ``models.costs``

and ``settings.places`` says where a memory reader may run. ``models.dit_backbone`` is an example.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import BackboneSettings, functions
from pewm_jax.types import Array, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Conditioning:
    """The inputs of a denoiser besides the noisy latents; a field that is None is unused.

    Attributes:
        joined_BthwC: concatenated to the channels of the noisy latents.
        modulation_BtE: added to the time embedding, per latent frame.
        tokens_BLC: text tokens, or other tokens of the same width.
    """

    joined_BthwC: Array | None = None
    modulation_BtE: Array | None = None
    tokens_BLC: Array | None = None


@dataclasses.dataclass(frozen=True)
class Readers:
    """The functions with which a backbone reads the memory, for one batch of clips.

    A reader's ``prepare`` makes it.

    Attributes:
        block: ``(params of one place, video_BND, time_BE) -> video_BND``, run at each of the
            backbone's places on the video tokens, in the order of ``token_layout``; or None.
            ``time_BE`` may be (B, t, E), one embedding for each token in time.
        params: the parameters of ``block``, stacked over places.
        added_BND: added to the embedded video tokens before the first block.
    """

    block: Callable[[Any, Array, Array], Array] | None = None
    params: Any = None
    added_BND: Array | None = None


NO_READERS = Readers()
"""No memory is read."""


def init(config: BackboneSettings, key: Array, in_channels: int, out_channels: int) -> Params:
    """Return random parameters of a backbone with these input and output channels."""
    return functions(config).init(config, key, in_channels, out_channels)


def apply(
    config: BackboneSettings,
    params: Params,
    x_BthwC: Array,
    time_B: Array,
    conditioning: Conditioning,
    readers: Readers = NO_READERS,
) -> Array:
    """Predict from noisy latents what the noise asks for.

    Args:
        config: the backbone.
        params: its parameters.
        x_BthwC: (B, t, h, w, C) noisy latents; their dtype is the dtype of the computation.
        time_B: (B,) noise level as the network sees it, or (B, t), one for each latent frame.
        conditioning: further inputs.
        readers: how the memory is read.

    Returns:
        (B, t, h, w, C_out) prediction.
    """
    return functions(config).apply(config, params, x_BthwC, time_B, conditioning, readers)


def joined(x_BthwC: Array, conditioning: Conditioning) -> Array:
    """Return the noisy latents with the conditioning concatenated to their channels."""
    if conditioning.joined_BthwC is None:
        return x_BthwC
    return jnp.concatenate([x_BthwC, conditioning.joined_BthwC], -1)
