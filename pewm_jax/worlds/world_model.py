"""The world model's network: the denoiser, conditioned on frame, control, text and memory.

Input channels, in order: noisy colour and depth latents; the observed frames in the backbone's form
(by default their latents, zero for later frames); with ``model.observed`` `every` or `warped` the
observed frame at every latent frame (``everywhere``), with `drafted` the draft of each frame; the
channels of the control (Plücker rays). At the injection points of the backbone, a reader reads the
memory.

Parameters: ``backbone``, ``memory`` (the reader) and, if the settings need them, ``control``, the
frozen ``codec`` (the VAE), ``encoder`` (DINOv2), ``image`` (the backbone's image encoder),
``draft`` (the network of ``worlds.draft``) and ``text`` (the prompt's embedding, and a negative
one's where guidance is on text). Without the ``memory`` entry, or without a readout, it is the
stage-1 model.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.pixel import fold
from pewm_jax.config import AssembledModel
from pewm_jax.controls import camera as camera_control
from pewm_jax.memory import interface as memories
from pewm_jax.memory import rendering
from pewm_jax.models import interface as backbones
from pewm_jax.models.interface import NO_READERS, Conditioning, Observed
from pewm_jax.nn import placement
from pewm_jax.types import Array, Camera, Control, EncodedView, Frames, MemoryReadout, Params, View

COVERED = 0.75
"""Share of a latent cell's pixels that the memory shows where sampling takes it as rendered
(``noise.rendered_until``)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClipConditioning:
    """Conditioning of a batch of clips, except the memory.

    Attributes:
        backbone: the backbone's conditioning.
        camera: (B, T) cameras of the clips' frames.
        rays_BthwC: their Plücker rays at the latent rate, for readers.
        draft_BthwC: latents of the clips' drafts, from which sampling starts; None without a draft.
    """

    backbone: Conditioning
    camera: Camera
    rays_BthwC: Array
    draft_BthwC: Array | None = None


def condition(
    model: AssembledModel,
    params: Params,
    observed: Frames,
    control: Control,
    *,
    noise_B: Array | None = None,
    clean_BTHWC: Array | None = None,
    everywhere_BthwC: Array | None = None,
) -> ClipConditioning:
    """Build the conditioning of a batch of clips.

    Observed are the (B, 1) first frames, colours in [−1, 1], depth in metres, or as many as fill
    latent frames; the control has (B, T) cameras, and (B, T − 1) actions if there are any.
    ``noise_B`` is the deviation of noise that was added to the observed colours, and
    ``clean_BTHWC`` are the colours before. ``everywhere_BthwC`` is the result of ``everywhere``, if
    it is known.
    """
    batch, rgb = len(observed.depth_THW), observed.rgb_THWC
    first = rgbd.encode_rgbd(model, params, rgb, observed.depth_THW, condition=True)
    seen = Observed(
        _seen(model, first),
        rgb if clean_BTHWC is None else clean_BTHWC,
        jnp.zeros((batch,)) if noise_B is None else noise_B,
    )
    shown = backbones.observed(model, params, seen)
    steering = model.control.condition(model, params.get("control", {}), observed, control)
    if everywhere_BthwC is None:
        assert model.observed != "drafted", "drafts are made by worlds.draft"
        everywhere_BthwC = everywhere(model, params, observed, control.camera, first)
    parts = (shown.joined_BthwC, everywhere_BthwC, steering.joined_BthwC)
    joined = [x for x in parts if x is not None]
    given = dataclasses.replace(
        shown,
        joined_BthwC=jnp.concatenate(joined, -1),
        modulation_BtE=steering.modulation_BtE,
        tokens_BLC=_text(model, params, batch, steering.tokens_BLC),
    )
    rays = camera_control.rays(model, control.camera)
    draft = None
    if everywhere_BthwC is not None and model.draft.PREDICTS:
        draft = everywhere_BthwC[..., :-1]
    return ClipConditioning(given, control.camera, rays, draft)


def everywhere(
    model: AssembledModel,
    params: Params,
    observed: Frames,
    camera: Camera,
    latents_BthwC: Array | None = None,
) -> Array | None:
    """Return the observed frame at every latent frame: its latents, and a mask as last channel.

    With ``model.observed`` `every` these are the last observed frame's latents, and the mask is 1.
    With `warped` the observed frames are rendered from the clip's cameras by their depth
    (``rendering.splat_frames``) and encoded, holes filled from the nearest pixel. The mask is the
    share of a cell's pixels that were rendered; latents are 0 where it is 0.

    Args:
        model: the model.
        params: the world model's parameters; the codec's are used.
        observed: (B, S) the observed frames, colours in [−1, 1], depth in metres.
        camera: (B, T) the clip's cameras.
        latents_BthwC: the observed frames' latents, encoded as a condition, if they are known.

    Returns:
        (B, t, h, w, C + 1); None with `first`.
    """
    if model.observed == "first":
        return None
    if model.observed == "warped":
        latents, mask = _warped(model, params, observed, camera)
    else:
        if latents_BthwC is None:
            latents_BthwC = rgbd.encode_rgbd(
                model, params, observed.rgb_THWC, observed.depth_THW, condition=True
            )
        assert latents_BthwC is not None
        last = latents_BthwC[:, -1:]
        latents = jnp.broadcast_to(last, (len(last), *model.latent_shape, last.shape[-1]))
        mask = jnp.ones((*latents.shape[:-1], 1))
    return jnp.concatenate([_seen(model, latents), mask], -1)


def splatted(model: AssembledModel, observed: Frames, camera: Camera) -> View:
    """Render the pixels of (B, S) observed frames, colours in [−1, 1], from (B, T) cameras."""

    def of_batch(_: Params, observed: Frames, camera: Camera) -> View:
        return jax.lax.map(lambda clip: _splatted(model, *clip), (observed, camera))

    return placement.by_batch(of_batch, {}, *jax.tree.map(jnp.asarray, (observed, camera)))


def _splatted(model: AssembledModel, observed: Frames, camera: Camera) -> View:
    """Render the pixels of one clip's observed frames, without the agent's own body."""
    if model.own_m:
        depth = jnp.where(observed.depth_THW < model.own_m, 0, observed.depth_THW)
        observed = dataclasses.replace(observed, depth_THW=depth)
    return rendering.splat_frames(observed, camera, model.clip.height, model.clip.width)


def _warped(
    model: AssembledModel, params: Params, observed: Frames, camera: Camera
) -> tuple[Array, Array]:
    """Return the latents of observed frames seen from other cameras, and the share of each cell."""

    def of_batch(weights: Params, observed: Frames, camera: Camera) -> EncodedView:
        def of_clip(clip: tuple[Frames, Camera]) -> EncodedView:
            return memories.encode(model, weights, _splatted(model, *clip))

        return jax.lax.map(of_clip, (observed, camera))

    inputs = jax.tree.map(jnp.asarray, (observed, camera))
    encoded = placement.by_batch(of_batch, _codec(params), *inputs)
    shown = share(model, encoded.seen_THW)
    return jnp.where(shown > 0, encoded.latents_thwC, 0), shown


def _codec(params: Params) -> Params:
    """Return the codec's parameters among the world model's."""
    return {name: params[name] for name in ("codec",) if name in params}


def share(model: AssembledModel, seen_BTHW: Array) -> Array:
    """Return (B, t, h, w, 1) the share of each latent cell's pixels that views show."""
    seen = seen_BTHW[..., None].astype(jnp.float32)
    return fold(seen, model.codec.spatial, model.codec.temporal).mean(-1, keepdims=True)


def blind(
    model: AssembledModel, params: Params, conditioning: ClipConditioning, hidden_B: Array
) -> ClipConditioning:
    """Hide the input of guidance from the clips in ``hidden_B``, in a world without a memory.

    That is the observed image or, for a backbone that is guided by text, the prompt, which the
    negative prompt replaces.
    """
    tokens = conditioning.backbone.tokens_BLC
    if not model.backbone.GUIDED_BY_TEXT:
        return without_image(model, conditioning, hidden_B)
    stored = params.get("text", {})
    if tokens is None or "negative_LC" not in stored:
        return conditioning
    negative = jnp.asarray(stored["negative_LC"], tokens.dtype)
    other = tokens.at[:, : len(negative)].set(negative)
    chosen = jnp.where(hidden_B[:, None, None], other, tokens)
    given = dataclasses.replace(conditioning.backbone, tokens_BLC=chosen)
    return dataclasses.replace(conditioning, backbone=given)


def without_image(
    model: AssembledModel, conditioning: ClipConditioning, hidden_B: Array
) -> ClipConditioning:
    """Hide the observed image from the clips in ``hidden_B``; control, text and scalars stay."""
    given = conditioning.backbone

    def hide(x: Array, channels: int) -> Array:
        there = hidden_B.reshape(-1, *(1,) * (x.ndim - 1))
        return jnp.where(there & (np.arange(x.shape[-1]) < channels), 0, x)

    joined, image, known = given.joined_BthwC, given.image_BMD, given.known_Bt
    shown = model.backbone.shown_channels(model) + model.everywhere_channels
    hidden = dataclasses.replace(
        given,
        joined_BthwC=None if joined is None else hide(joined, shown),
        image_BMD=None if image is None else hide(image, image.shape[-1]),
        known_Bt=None if known is None else known & ~jnp.asarray(hidden_B)[:, None],
    )
    return dataclasses.replace(conditioning, backbone=hidden)


def _text(model: AssembledModel, params: Params, batch: int, more: Array | None) -> Array | None:
    """Return the prompt's tokens (zeros without a prompt), followed by the control's."""
    shape = model.backbone.text_shape
    if shape is None:
        return more
    prompt = jnp.zeros(shape)
    prompt = jnp.asarray(params.get("text", {}).get("prompt_LC", prompt), jnp.float32)
    text = jnp.broadcast_to(prompt, (batch, *prompt.shape))
    return text if more is None else jnp.concatenate([text, more], 1)


def init(model: AssembledModel, key: Array, *, memory: bool = True) -> Params:
    """Return random parameters; with ``memory`` and injection points, also those of the reader."""
    backbone_key, memory_key = jax.random.split(key)
    frozen_key = jax.random.fold_in(key, 2)
    channels = model.in_channels, model.codec.channels
    params: Params = {"backbone": model.backbone.init(backbone_key, *channels)}
    if memory and model.backbone.places is not None:
        params["memory"] = model.memory.reader.init(model, memory_key)
    parts = {
        "codec": model.codec.init(frozen_key),
        "encoder": model.memory.encoder.init(jax.random.fold_in(frozen_key, 1)),
        "control": model.control.init(model, jax.random.fold_in(key, 3)),
        "image": model.backbone.init_image(jax.random.fold_in(key, 4)),
        "draft": model.draft.init(model, jax.random.fold_in(key, 5)),
    }
    params |= {name: part for name, part in parts.items() if part}
    if model.backbone.stores_prompt:
        names = ("prompt_LC", "negative_LC")[: 1 + model.backbone.GUIDED_BY_TEXT]
        params["text"] = {name: jnp.zeros(model.backbone.text_shape) for name in names}
    return params


def apply(
    model: AssembledModel,
    params: Params,
    noisy_BthwC: Array,
    conditioning: ClipConditioning,
    time_B: Array,
    readout: MemoryReadout | None = None,
) -> Array:
    """Predict the noise's target (x0, v, ε, velocity …) from noisy latents, in float32.

    ``time_B`` is (B,) in the network's units, or (B, t), one for each latent frame. The readout has
    a leading axis B; None is the stage-1 model.
    """
    dtype, memory_readers = jnp.dtype(model.dtype), NO_READERS
    if readout is not None and "memory" in params:
        memory_readers = model.memory.reader.prepare(
            model, params["memory"], readout, conditioning.camera, conditioning.rays_BthwC
        )
    noisy = _seen(model, noisy_BthwC).astype(dtype)
    out = model.backbone.apply(
        params["backbone"], noisy, time_B, conditioning.backbone, memory_readers
    )
    return _seen(model, out.astype(jnp.float32))


def _seen(model: AssembledModel, latents_C: Array) -> Array:
    """Set the depth channels to zero, but keep them, if the denoiser works without depth."""
    if model.clip.depth:
        return latents_C
    colour = np.arange(latents_C.shape[-1]) < model.codec.rgb_channels
    return jnp.where(colour, latents_C, 0)


def draw(
    model: AssembledModel,
    params: Params,
    conditioning: ClipConditioning,
    readout: MemoryReadout | None,
    key: Array,
    *,
    blind: ClipConditioning | None = None,
) -> Array:
    """Sample the latents of one clip, (1, t, h, w, C), from noise of its own; see ``sample``."""
    noise = jax.random.normal(key, (1, *model.latent_shape, model.codec.channels))
    again = jax.random.fold_in(key, 1)
    return sample(model, params, conditioning, readout, noise, again, blind=blind)


def sample(
    model: AssembledModel,
    params: Params,
    conditioning: ClipConditioning,
    readout: MemoryReadout | None,
    noise_BthwC: Array,
    key: Array | None = None,
    *,
    blind: ClipConditioning | None = None,
) -> Array:
    """Sample one batch of clips' latents with the configured noise and sampler.

    With ``noise.guidance`` g ≠ 1 the prediction is x0(no map) + g·(x0(map) − x0(no map)); DDPM lets
    g vary with the step (``noise.dynamic_guidance``). ``blind`` is the conditioning without the
    input that guidance strengthens, and replaces "no map". Where the conditioning knows latents, x0
    is the known value. Sampling starts from standard normal noise; ``key`` is for samplers that
    draw more. With ``noise.rendered_until``, the latents that the rendered memory covers are those
    of the rendering with noise, down to that level.

    Raises:
        ValueError: the sampler draws noise at every step and there is no key.
    """
    noise = model.noise

    def x0(x: Array, times: Array, given: ClipConditioning, readout: MemoryReadout | None) -> Array:
        inputs, network_time = noise.precondition(x, times)
        out = apply(model, params, inputs, given, network_time, readout)
        return noise.to_x0(out, x, times)

    def denoise(x: Array, times: Array, weight: Array) -> Array:
        clean = x0(x, times, conditioning, readout)
        if noise.guidance != 1 and (readout is not None or blind is not None):
            without = x0(x, times, blind or conditioning, None)
            clean = without + weight * (clean - without)
        return backbones.held(conditioning.backbone, clean)

    more: dict[str, Any] = {}
    if noise.rendered_until and readout is not None:
        more = {"held": rendered_latents(model, params, readout)}
    if conditioning.draft_BthwC is not None:
        more["start"] = conditioning.draft_BthwC
    return noise.sample(denoise, noise_BthwC, key, **more)


def rendered_latents(
    model: AssembledModel, params: Params, readout: MemoryReadout
) -> tuple[Array, Array]:
    """Return the latents of a batch's rendered memory, and the cells that it covers.

    Returns:
        ``(latents_BthwC, covered_Bthw1)``; a cell is covered if the memory shows at least the share
        ``COVERED`` of its pixels; holes have the colour and depth of the nearest pixel.
    """
    encoded = readout.encoded
    if encoded is None:

        def of_batch(weights: Params, view: View) -> EncodedView:
            return jax.lax.map(lambda one: memories.encode(model, weights, one), view)

        encoded = placement.by_batch(of_batch, _codec(params), readout.view)
    covered = share(model, encoded.seen_THW) >= COVERED
    return _seen(model, encoded.latents_thwC), covered
