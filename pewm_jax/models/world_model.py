"""The denoiser and all that conditions it: what was seen, what is done, what is remembered.

Input channels, in order: noisy colour and depth latents, clean latents of the observed first
frame (zero for later latent frames), what the control joins (Plücker rays). Where the backbone lets
it, a reader reads the memory.

Parameters: ``backbone``, ``memory`` (the reader), and where the settings ask for them ``control``,
the frozen ``codec`` (the VAE), ``encoder`` (DINOv2) and ``text`` (the prompt's embedding). Without
the ``memory`` entry, or without map tokens, it is the stage-1 model.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import ModelConfig
from pewm_jax.models import backbones, camera_control, codecs, controls, encoders, readers
from pewm_jax.models.backbones import NOBODY, Conditioning
from pewm_jax.types import Array, Camera, Control, Frames, MapTokens, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClipConditioning:
    """All that conditions a batch of clips besides the memory.

    Attributes:
        given: what the backbone is told.
        camera: (B, T) cameras of the clips' frames.
        rays_BthwC: their Plücker rays at the latent rate, for readers.
    """

    given: Conditioning
    camera: Camera
    rays_BthwC: Array


def condition(
    model: ModelConfig, params: Params, observed: Frames, control: Control
) -> ClipConditioning:
    """Build the conditioning of a batch of clips.

    Args:
        model: the model.
        params: the world model's parameters; codec, control and text are used.
        observed: (B, 1) the first frames, colours float in [−1, 1], depth in metres.
        control: (B, T) cameras of all frames, and (B, T − 1) actions where there are any.
    """
    batch, (frames, h, w) = len(observed.depth_THW), model.latent_shape
    first = codecs.encode_rgbd(model, params, observed.rgb_THWC, observed.depth_THW, condition=True)
    padding = jnp.zeros((batch, frames - 1, h, w, first.shape[-1]), first.dtype)
    first = _seen(model, jnp.concatenate([first, padding], 1))
    steering = controls.condition(model, params.get("control", {}), observed, control)
    joined = [x for x in (first, steering.joined_BthwC) if x is not None]
    given = Conditioning(
        joined_BthwC=jnp.concatenate(joined, -1),
        modulation_BtE=steering.modulation_BtE,
        tokens_BLC=_text(model, params, batch, steering.tokens_BLC),
    )
    return ClipConditioning(given, control.camera, camera_control.rays(model, control.camera))


def _text(model: ModelConfig, params: Params, batch: int, more: Array | None) -> Array | None:
    """Return the prompt's tokens, zeros where there is no prompt, and those of the control."""
    shape = model.backbone.text_shape
    if shape is None:
        return more
    prompt = jnp.zeros(shape)
    prompt = jnp.asarray(params.get("text", {}).get("prompt_LC", prompt), jnp.float32)
    text = jnp.broadcast_to(prompt, (batch, *prompt.shape))
    return text if more is None else jnp.concatenate([text, more], 1)


def init(model: ModelConfig, key: Array, *, memory: bool = True) -> Params:
    """Initialise the backbone and, with ``memory``, the reader (which changes nothing at first)."""
    backbone_key, memory_key = jax.random.split(key)
    frozen_key = jax.random.fold_in(key, 2)
    channels = model.in_channels, model.codec.channels
    params: Params = {"backbone": backbones.init(model.backbone, backbone_key, *channels)}
    if memory:
        params["memory"] = readers.init(model, memory_key)
    parts = {
        "codec": codecs.init(model.codec, frozen_key),
        "encoder": encoders.init(model.memory.encoder, jax.random.fold_in(frozen_key, 1)),
        "control": controls.init(model, jax.random.fold_in(key, 3)),
    }
    params |= {name: part for name, part in parts.items() if part}
    if model.backbone.stores_prompt:
        params["text"] = {"prompt_LC": jnp.zeros(model.backbone.text_shape)}
    return params


def apply(
    model: ModelConfig,
    params: Params,
    noisy_BthwC: Array,
    conditioning: ClipConditioning,
    time_B: Array,
    tokens: MapTokens | None = None,
) -> Array:
    """Predict what the noise asks for (x0, v, ε, velocity …) from noisy latents.

    Args:
        model: the model.
        params: ``{"backbone": …, "memory": …}``.
        noisy_BthwC: (B, t, h, w, C) noisy colour and depth latents.
        conditioning: the observed frame, control and text.
        time_B: (B,) what the noise tells the network, or (B, t), for each latent frame.
        tokens: map tokens with leading axis B; None is the stage-1 model.

    Returns:
        (B, t, h, w, C) float32 prediction.
    """
    dtype, who = jnp.dtype(model.dtype), NOBODY
    if tokens is not None and "memory" in params:
        who = readers.prepare(
            model, params["memory"], tokens, conditioning.camera, conditioning.rays_BthwC
        )
    noisy = _seen(model, noisy_BthwC).astype(dtype)
    out = backbones.apply(
        model.backbone, params["backbone"], noisy, time_B, conditioning.given, who
    )
    return _seen(model, out.astype(jnp.float32))


def _seen(model: ModelConfig, latents_C: Array) -> Array:
    """Blank the depth channels of latents where the denoiser works without depth.

    They stay, so that both variants have the same parameters.
    """
    if model.clip.depth:
        return latents_C
    colour = np.arange(latents_C.shape[-1]) < model.codec.rgb_channels
    return jnp.where(colour, latents_C, 0)
