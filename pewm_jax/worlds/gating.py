"""Stages that fine-tune a codec's gate, which blends imagined frames with rendered ones.

The codec trains its gate on true latents with noise, but the errors of imagined frames differ: they
are sharp, plausible and displaced. So the model imagines each clip once, and only the gate is
trained to choose at each pixel between what was imagined and what is rendered: the memory of the
clip's context or, in a world without a memory, the observed frame (``model.observed warped``).
Stage ``sharpen`` trains the gate further on such clips, with LPIPS and a discriminator
(``worlds.sharpen``).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal, rgbd_signal
from pewm_jax.config import AssembledModel, TrainSettings
from pewm_jax.types import Array, Clip, Control, Frames, MemoryReadout, Params
from pewm_jax.worlds import codec_losses, objective, perturbation, world_model
from pewm_jax.worlds import draft as drafts

LPIPS_WEIGHT = "gate_lpips"
"""Name of the setting with the weight of LPIPS in ``loss``."""


def prepare(
    model: AssembledModel, params: Params, clip: Clip, *, memory: bool = True, history: int = 1
) -> Clip:
    """Imagine a batch of clips; ``latents_thwC`` are those imagined, ``readout`` what is rendered.

    The first ``history`` frames are observed. The noise depends on the clips alone. Without a
    memory there are guidance and noise on the observed frames as in rollouts
    (``model.image_noise``).
    """
    frames = as_signal(clip.frames)
    observed = jax.tree.map(lambda x: x[:, :history], frames)
    if model.draft.PREDICTS:
        clip = drafts.drop_context(model, clip)
    if memory:
        readout = objective.clip_readout(model, params, clip, pictures=True)
    else:
        readout = MemoryReadout(view=world_model.splatted(model, observed, frames.camera))
    state = objective.state_at_start(clip, history)
    control = Control(frames.camera, clip.actions_TA, state)
    key = jax.random.fold_in(jax.random.key(0), clip.frames.rgb_THWC.astype(jnp.uint32).sum())
    more: dict[str, Any] = {}
    if not memory and (level := getattr(model, "image_noise", 0.0)):
        more = {"noise_B": jnp.full(len(clean := observed.rgb_THWC), level), "clean_BTHWC": clean}
        noisy = clean + level * jax.random.normal(jax.random.fold_in(key, 2), clean.shape)
        observed = dataclasses.replace(observed, rgb_THWC=noisy)
    if model.draft.PREDICTS:
        drafted = drafts.predict(model, params, observed, control, readout)
        more["everywhere_BthwC"] = drafted
    conditioning = world_model.condition(model, params, observed, control, **more)
    shape = (len(frames.depth_THW), *model.latent_shape, model.codec.channels)
    noise = jax.random.normal(key, shape)
    shown, blind = readout if memory else None, None
    if not memory and model.noise.guidance != 1:
        blind = world_model.blind(model, params, conditioning, jnp.ones(shape[0], bool))
    again = jax.random.fold_in(key, 1)
    latents = world_model.sample(model, params, conditioning, shown, noise, again, blind=blind)
    if model.draft.PREDICTS:
        blended = drafts.gate_input(model, params, drafted, readout.view)
        readout = dataclasses.replace(readout, view=blended)
    return clip.without_context().with_extras(
        context_features_ShwF=None, latents_thwC=latents, readout=readout
    )


def loss(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    clip: Clip,
    key: Array,
    *,
    memory: bool = True,
    history: int = 1,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of the gate on imagined frames; see ``codec_losses.score``."""
    weight = getattr(train, LPIPS_WEIGHT)
    perceptual = (weight, params["lpips"]) if weight else None
    given = _inputs(model, train, params, clip, key, memory=memory, history=history)
    return codec_losses.score(model, params["codec"]["gate"], *given, perceptual)


def sharpen_loss(
    model: AssembledModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the loss that sharpens the gate; see ``codec_losses.sharpen_gate``."""
    given = _inputs(model, train, params, clip, key, memory=True, history=1)
    return codec_losses.sharpen_gate(model, train, params, *given)


def _inputs(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    clip: Clip,
    key: Array,
    *,
    memory: bool,
    history: int,
) -> tuple[Array, Array, Array, Array, Frames]:
    """Return imagined colours and depth, what is rendered, its mask, and the true frames.

    With ``train.memory_errors`` the rendering has errors. The frames were imagined without these,
    so the gate can learn to prefer them there.
    """
    if "latents_thwC" not in clip.extras:
        made = prepare(model, params, clip, memory=memory, history=history)
        clip = jax.lax.stop_gradient(made)
    readout = clip.extras["readout"]
    if train.memory_errors:
        camera = clip.frames.camera
        readout = perturbation.plant_errors(model, train.memory_errors, readout, camera, key)
    view = readout.view
    assert view is not None
    rgb, depth = rgbd.decode_rgbd(model, params, clip.extras["latents_thwC"])
    shown = rgbd_signal(model.clip, view.features_THWF[..., :3], view.depth_THW)
    everything = rgb, depth, shown, view.seen_THW, as_signal(clip.frames)
    return jax.tree.map(lambda x: x[:, history:], everything)


def perceptual_weights(
    model: AssembledModel, train: TrainSettings, weight: str = LPIPS_WEIGHT
) -> Params | None:
    """Return the weights that a loss with this weight of LPIPS needs, or None.

    See ``codec_losses.lpips_weights``.
    """
    if not getattr(train, weight):
        return None
    return codec_losses.lpips_weights(codec_losses.LPIPS, model.clip)
