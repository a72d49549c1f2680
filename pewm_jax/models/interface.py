"""Backbones: every denoiser behind one interface, chosen by the type of its settings.

A backbone is a ``Backbone`` and a module (or object) with

    init(settings, key, in_channels, out_channels) -> params
    apply(settings, params, x_BthwC, time_B, conditioning, readers) -> prediction_BthwC
    SHARDING                                    rules over ``backbone/…`` paths, see ``tree``
    costs(model, share, *, trained) -> Costs    see ``models.costs``

and ``settings.places`` says where a memory reader may run. ``models.dit_backbone`` is an example.
One that is shown the observed frames in another way than joined to its input has also

    observed(model, params, seen) -> Conditioning
    init_image(settings, key) -> params         frozen, under ``image/``; {} if it needs none

and ``models.svd_backbone`` is an example of that. ``models.cosmos_backbone`` holds observed frames
in the place of noisy ones.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import Backbone, ModelConfig, functions
from pewm_jax.types import Array, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Conditioning:
    """The inputs of a denoiser besides the noisy latents; a field that is None is unused.

    Attributes:
        joined_BthwC: concatenated to the channels of the noisy latents.
        modulation_BtE: added to the time embedding, per latent frame.
        tokens_BLC: text tokens, or other tokens of the same width.
        image_BMD: tokens of the observed image, of a width of their own.
        scalars_BK: numbers that are embedded as the time is, such as frames per second.
        known_BthwC: latents that are known, at frames that are given; zeros at the others.
        known_Bt: (B, t) bool, the latent frames that are given; sampling holds them.
        fps: frames per second, one number, where positions in time depend on it.
    """

    joined_BthwC: Array | None = None
    modulation_BtE: Array | None = None
    tokens_BLC: Array | None = None
    image_BMD: Array | None = None
    scalars_BK: Array | None = None
    known_BthwC: Array | None = None
    known_Bt: Array | None = None
    fps: Array | None = None


@dataclasses.dataclass(frozen=True)
class Observed:
    """The observed frames of a batch of clips, with which every clip begins.

    Attributes:
        latents_BthwC: their latents, encoded as a condition.
        rgb_BTHWC: their colours in [−1, 1], before any noise was added.
        noise_B: deviation of the noise that was added to the colours that are encoded.
    """

    latents_BthwC: Array
    rgb_BTHWC: Array
    noise_B: Array


@dataclasses.dataclass(frozen=True)
class Readers:
    """The functions with which a backbone reads the memory, for one batch of clips.

    A reader's ``prepare`` makes it.

    Attributes:
        block: ``(params of one place, video_BND, time_BE) -> video_BND``, run at each of the
            backbone's places on the video tokens, in the order of ``nn.tokens``; or None.
            ``time_BE`` may be (B, t, E), one embedding for each token in time.
        params: the parameters of ``block``, stacked over places.
        added_BND: added to the embedded video tokens before the first block.
    """

    block: Callable[[Any, Array, Array], Array] | None = None
    params: Any = None
    added_BND: Array | None = None


NO_READERS = Readers()
"""No memory is read."""


def init(config: Backbone, key: Array, in_channels: int, out_channels: int) -> Params:
    """Return random parameters of a backbone with these input and output channels."""
    return functions(config).init(config, key, in_channels, out_channels)


def apply(
    config: Backbone,
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


def init_image(config: Backbone, key: Array) -> Params:
    """Return random parameters of what a backbone sees images with; {} if it has nothing."""
    own = getattr(functions(config), "init_image", None)
    return {} if own is None else own(config, key)


def observed(model: ModelConfig, params: Params, seen: Observed) -> Conditioning:
    """Turn the observed frames into inputs of the backbone, by its own ways if it has any.

    By default the latents are joined to the input, zero for the frames to be imagined.

    Args:
        model: the model.
        params: the world model's parameters; those under ``image`` are the backbone's to use.
        seen: the observed frames.

    Returns:
        Conditioning with ``settings.shown_channels(model)`` joined channels: by default as many as
        the latents have.
    """
    own = getattr(functions(model.backbone), "observed", None)
    if own is not None:
        return own(model, params, seen)
    first = seen.latents_BthwC
    missing = model.latent_shape[0] - first.shape[1]
    padding = jnp.zeros((len(first), missing, *first.shape[2:]), first.dtype)
    return Conditioning(joined_BthwC=jnp.concatenate([first, padding], 1))


def joined(x_BthwC: Array, conditioning: Conditioning) -> Array:
    """Return the noisy latents with the conditioning concatenated to their channels."""
    if conditioning.joined_BthwC is None:
        return x_BthwC
    return jnp.concatenate([x_BthwC, conditioning.joined_BthwC], -1)


def held(conditioning: Conditioning, latents_BthwC: Array) -> Array:
    """Return latents with the known ones in their places, where a backbone says which are known."""
    if conditioning.known_Bt is None or conditioning.known_BthwC is None:
        return latents_BthwC
    there = conditioning.known_Bt[:, :, None, None, None]
    return jnp.where(there, conditioning.known_BthwC, latents_BthwC)
