"""The denoiser: every backbone behind one interface, chosen by the type of its settings.

A backbone is a ``BackboneSettings`` and a module (or object) with

    init(settings, key, in_channels, out_channels) -> params
    apply(settings, params, x_BthwC, time_B, conditioning, readers) -> prediction_BthwC
    SHARDING                                    rules over ``backbone/…`` paths, as ``tree`` reads
    costs(model, share, *, trained) -> Costs    see ``models.costs``

and ``settings.places`` says where it lets a reader of the memory run. ``models.dit_backbone`` is an
example.
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
    """What a denoiser is told besides the noisy latents; what is None is not there.

    Attributes:
        joined_BthwC: joined to the channels of the input.
        modulation_BtE: added to the time embedding, per latent frame.
        tokens_BLC: text tokens, or others of their width.
    """

    joined_BthwC: Array | None = None
    modulation_BtE: Array | None = None
    tokens_BLC: Array | None = None


@dataclasses.dataclass(frozen=True)
class Readers:
    """What reads the memory, made by a reader's ``prepare`` for one batch of clips.

    Attributes:
        block: ``(params of one place, video_BND, time_BE) -> video_BND``, run at each of the
            backbone's places on the video tokens, in the order of ``token_layout``; None for none.
            ``time_BE`` may be (B, t, E), one embedding for each token in time.
        params: the parameters of ``block``, stacked over places.
        added_BND: added to the embedded video tokens before the first block.
    """

    block: Callable[[Any, Array, Array], Array] | None = None
    params: Any = None
    added_BND: Array | None = None


NOBODY = Readers()
"""Nobody reads."""


def init(config: BackboneSettings, key: Array, in_channels: int, out_channels: int) -> Params:
    """Return random parameters for so many latent channels in and out."""
    return functions(config).init(config, key, in_channels, out_channels)


def apply(
    config: BackboneSettings,
    params: Params,
    x_BthwC: Array,
    time_B: Array,
    conditioning: Conditioning,
    readers: Readers = NOBODY,
) -> Array:
    """Denoise.

    Args:
        config: the backbone.
        params: its parameters.
        x_BthwC: (B, t, h, w, C) noisy latents; their dtype is the dtype of the computation.
        time_B: (B,) what the noise tells the network, or (B, t), one for each latent frame.
        conditioning: what is joined, added and given as tokens.
        readers: who reads the memory.

    Returns:
        (B, t, h, w, C_out) prediction.
    """
    return functions(config).apply(config, params, x_BthwC, time_B, conditioning, readers)


def joined(x_BthwC: Array, conditioning: Conditioning) -> Array:
    """Return the noisy latents with what is joined to their channels."""
    if conditioning.joined_BthwC is None:
        return x_BthwC
    return jnp.concatenate([x_BthwC, conditioning.joined_BthwC], -1)
