"""The training loss of PEWM's stages (paper, Eqs. 3 and 4; see ``config.parts.Noise`` for targets).

Chained clips (``train.chained``): in a rollout every clip but the first starts from an imagined
frame, which a model that learned on observed frames alone trusts too much. Imagining whole clips
would cost a sampling per training step. Instead, a share of the clips is run backwards once, from
the last frame to the first: the true latents get noise of a level drawn as in training, and the
model, with its present weights, denoises them in one step, given the last frame and the same
memory. The clip then starts from the first frame of the result, decoded and, where the codec has a
gate and the reader reads pictures, mixed with the rendered memory. No gradient flows through it.
This is weaker than a rollout: one step instead of a sampling, no guidance, and a memory of observed
frames only.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal, signal_from_rgb
from pewm_jax.config import AssembledModel, TrainSettings, UserError
from pewm_jax.config.parts import Noise
from pewm_jax.errors import require
from pewm_jax.memory import interface as memories
from pewm_jax.models.lpips import model as lpips
from pewm_jax.nn import placement
from pewm_jax.types import Array, Camera, Clip, Control, Frames, MemoryReadout, Params, View
from pewm_jax.worlds import codec_losses, perturbation, world_model
from pewm_jax.worlds import draft as drafts
from pewm_jax.worlds.control import require_actions


def clip_readout(
    model: AssembledModel, params: Params, clip: Clip, *, pictures: bool = False
) -> MemoryReadout:
    """Build every clip's memory from its context and return its readout, leading axis B.

    Pictures are rendered clip by clip, because one clip fits a processor's cache. With ``pictures``
    they are rendered even if the reader needs none.
    """

    def of_batch(weights: Params, clip: Clip) -> MemoryReadout:
        def of_clip(
            context: Frames, valid_S: Array, features: Array, camera: Camera
        ) -> MemoryReadout:
            memory = memories.from_context(model, weights, context, valid_S, features)
            return memories.readout(model, memory, camera, params=weights, pictures=pictures)

        features = clip.extras.get("context_features_ShwF")
        if features is None:
            features = _features(model, weights, clip.context.rgb_THWC)
        context = as_signal(clip.context)
        parts = context, clip.context_valid_S, features, clip.frames.camera
        if pictures or model.memory.reader.READS_VIEW:
            return jax.lax.map(lambda one: of_clip(*one), parts)
        return jax.vmap(of_clip)(*parts)

    weights = model.memory.encoder.weights(params)
    if model.memory.reader.READS_LATENTS and "codec" in params:
        weights["codec"] = params["codec"]
    return placement.by_batch(of_batch, weights, clip)


def _features(model: AssembledModel, weights: Params, rgb_BSHWC: Array) -> Array:
    """Return the features of every clip's context; encoders with weights run clip by clip."""

    def of_clip(rgb_SHWC: Array) -> Array:
        return model.memory.encoder.features(model, weights, signal_from_rgb(rgb_SHWC))

    large = model.memory.encoder.weights(weights)
    return jax.lax.map(of_clip, rgb_BSHWC) if large else jax.vmap(of_clip)(rgb_BSHWC)


def prepare(
    model: AssembledModel, params: Params, clip: Clip, *, memory: bool, history: int = 1
) -> Clip:
    """Encode a batch's frames and, with ``memory``, read out its memories; the context is dropped.

    Returns:
        The batch with the extras ``latents_thwC``, with a memory ``readout``, and with
        ``model.observed`` `warped` or `drafted` ``everywhere_thwC``, made from the first
        ``history`` frames.
    """
    frames = as_signal(clip.frames)
    everywhere, readout = None, None
    observed = jax.tree.map(lambda x: x[:, :history], frames)
    if model.observed == "warped":
        everywhere = world_model.everywhere(model, params, observed, frames.camera)
    if model.draft.PREDICTS:
        clip = drafts.drop_context(model, clip)
    if memory:
        readout = clip_readout(model, params, clip)
    if model.draft.PREDICTS:
        assert readout is not None, "a draft needs the memory"
        control = Control(frames.camera, clip.actions_TA)
        everywhere = drafts.predict(model, params, observed, control, readout)
    return clip.without_context().with_extras(
        context_features_ShwF=None,
        latents_thwC=rgbd.encode_rgbd(model, params, frames.rgb_THWC, frames.depth_THW),
        readout=readout,
        everywhere_thwC=everywhere,
    )


def loss(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    clip: Clip,
    key: Array,
    *,
    memory: bool,
    history: int = 1,
    blind: float = 0.0,
    perceptual: bool = False,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of one batch and its parts.

    ``train`` has the settings of noise on the observed frame, chained clips, hidden memories and
    errors in them. Warped latents of the observed frame get noise of the same size as its colours.
    The first ``history`` frames of a clip are observed; a share ``blind`` of the clips lacks the
    input of guidance; ``memory`` is True in stage 2, and ``perceptual`` in stages whose loss has
    ``train.denoised_lpips``.

    Returns:
        ``(loss, {"loss_rgb", "loss_depth"})``, and ``lpips`` if it has a weight: the weighted
        squared error of the noise's target, averaged over colour and over depth where measured.
        If the denoiser works without depth (``clip.depth``), only colour counts. Known latent
        frames of the backbone (``Conditioning.known_Bt``) do not count.
    """
    share = {"memory": memory, "history": history, "blind": blind}
    found = denoise(model, train, params, clip, key, **share, perceptual=perceptual)
    return with_lpips(model, train, params, *found)


def state_at_start(clip: Clip, history: int) -> Array | None:
    """Return the (B, A) states of the agents at the last observed frame, if they are known."""
    state = clip.extras.get("state_A")
    if state is not None and clip.actions_TA is not None and history > 1:
        return clip.actions_TA[:, history - 2]
    return state


class Denoised(NamedTuple):
    """One denoised frame of each clip of a batch.

    Attributes:
        colours_B1hwC: the latents of its colours.
        truth_BHWC: its true colours in [−1, 1].
        share_B: the share of the signal in the variance of the clip's noisy latents.
    """

    colours_B1hwC: Array
    truth_BHWC: Array
    share_B: Array


def denoise(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    clip: Clip,
    key: Array,
    *,
    memory: bool,
    history: int = 1,
    blind: float = 0.0,
    perceptual: bool = False,
) -> tuple[Array, dict[str, Array], Denoised | None]:
    """Return ``loss`` without LPIPS, its parts, and what LPIPS needs if the loss has it."""
    frames = as_signal(clip.frames)
    x0 = clip.extras.get("latents_thwC")
    if x0 is None:
        x0 = rgbd.encode_rgbd(model, params, frames.rgb_THWC, frames.depth_THW)
    time_key, noise_key, level_key, image_key = jax.random.split(key, 4)
    times = model.noise.draw(time_key, x0.shape[0], x0.shape[1])
    noise = jax.random.normal(noise_key, x0.shape)
    x_t = model.noise.corrupt(x0, noise, times)
    readout = _readout(model, train, params, clip, key) if memory else None
    observed, more = _observed(
        model, train, params, clip, x0, readout, (key, level_key, image_key), history
    )
    require_actions(model, clip.actions_TA, "the loss")
    control = Control(frames.camera, clip.actions_TA, state_at_start(clip, history))
    conditioning = world_model.condition(model, params, observed, control, **more)
    if blind:
        hidden = jax.random.bernoulli(jax.random.fold_in(key, 6), blind, (len(x0),))
        conditioning = world_model.blind(model, params, conditioning, hidden)
    inputs, network_time = model.noise.precondition(x_t, times)
    prediction = world_model.apply(model, params, inputs, conditioning, network_time, readout)

    error = (prediction - model.noise.prediction_target(x0, noise, times)) ** 2
    error = error * Noise.expand(model.noise.weight(times), error.ndim)
    split = model.codec.rgb_channels
    measured = jnp.broadcast_to(rgbd.measured(model, frames.depth_THW), error[..., split:].shape)
    rgb = error[..., :split].mean()
    if conditioning.backbone.known_Bt is not None:
        counted = Noise.expand(1.0 - conditioning.backbone.known_Bt, error.ndim)
        rgb = (error[..., :split] * counted).mean() / jnp.maximum(counted.mean(), 1e-6)
        measured = measured * counted
    depth = (error[..., split:] * measured).sum() / jnp.maximum(measured.sum(), 1)
    measures = {"loss_rgb": rgb, "loss_depth": depth}
    channels = error.shape[-1]
    total = rgb
    if model.clip.depth:
        total = (rgb * split + depth * (channels - split)) / channels
    if not (perceptual and train.denoised_lpips):
        return total, measures, None
    made = model.noise.to_x0(prediction, x_t, times)
    return total, measures, one_frame(model, clip, made, times, jax.random.fold_in(key, 8))


def with_lpips(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    total: Array,
    measures: dict[str, Array],
    denoised: Denoised | None,
) -> tuple[Array, dict[str, Array]]:
    """Add ``train.denoised_lpips`` times the distance of denoised frames, if any, to a loss."""
    if denoised is None:
        return total, measures
    if train.denoised_lpips_weights == "equal":
        denoised = denoised._replace(share_B=jnp.ones_like(denoised.share_B))
    distance = denoised_distance(model, train.denoised_lpips_net, params, denoised)
    return total + train.denoised_lpips * distance, measures | {"lpips": distance}


def _readout(
    model: AssembledModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> MemoryReadout:
    """Return what the memories of a batch show in training: some hidden, some with errors."""
    readout = clip.extras.get("readout")
    if readout is None:
        readout = clip_readout(model, params, clip)
    if train.hidden:
        batch = len(clip.frames.depth_THW)
        kept = jax.random.bernoulli(jax.random.fold_in(key, 4), 1 - train.hidden, (batch,))
        readout = hide_readout(readout, kept)
    if train.memory_errors:
        own = jax.random.fold_in(key, 7)
        readout = perturbation.plant_errors(
            model, train.memory_errors, readout, clip.frames.camera, own
        )
    return readout


def _observed(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    clip: Clip,
    latents_BthwC: Array,
    readout: MemoryReadout | None,
    keys: tuple[Array, Array, Array],
    history: int,
) -> tuple[Frames, dict[str, Any]]:
    """Return the observed frames of a batch with noise, some of them predicted by the model.

    Returns:
        The frames, and the further arguments of ``world_model.condition`` that describe them.
    """
    key, level_key, image_key = keys
    frames, batch = as_signal(clip.frames), len(latents_BthwC)
    level = jnp.exp(
        train.image_noise_mean
        + train.image_noise_std * jax.random.normal(level_key, (batch, 1, 1, 1, 1))
    )
    observed = jax.tree.map(lambda x: x[:, :history], frames)
    first, depth = observed.rgb_THWC, observed.depth_THW
    if train.chained:
        again = jax.random.fold_in(key, 5)
        first, depth = first_frames(
            model,
            train.chained,
            params,
            frames,
            latents_BthwC,
            readout,
            again,
            clip.extras.get("everywhere_thwC"),
        )
    more = {"noise_B": level.reshape(batch), "clean_BTHWC": first}
    if model.observed == "warped":
        rows = math.ceil(train.chained * batch)
        warped = _warped(model, params, clip, Frames(first, depth, observed.camera), rows)
        more["everywhere_BthwC"] = _noisy(warped, level, jax.random.fold_in(image_key, 2))
    elif model.draft.PREDICTS:
        more["everywhere_BthwC"] = clip.extras["everywhere_thwC"]
    first = first + level * jax.random.normal(image_key, first.shape)
    if train.depth_noise:
        errors_key = jax.random.fold_in(image_key, 1)
        depth = depth * perturbation.depth_noise(errors_key, depth.shape, train.depth_noise)
    return Frames(first, depth, observed.camera), more


def _warped(
    model: AssembledModel, params: Params, clip: Clip, observed: Frames, rows: int
) -> Array:
    """Return ``world_model.everywhere`` of a batch; if prepared, only its leading rows are made."""
    prepared, camera = clip.extras.get("everywhere_thwC"), clip.frames.camera
    if prepared is not None:
        if not rows:
            return prepared
        observed, camera = jax.tree.map(lambda x: x[:rows], (observed, camera))
    made = world_model.everywhere(model, params, observed, camera)
    assert made is not None
    return made if prepared is None else jnp.concatenate([made, prepared[rows:]])


def _noisy(warped_BthwC: Array, level: Array, key: Array) -> Array:
    """Add noise to warped latents as deep as that on the observed colours; not to holes or mask."""
    latents, mask = warped_BthwC[..., :-1], warped_BthwC[..., -1:]
    noise = level * jax.random.normal(key, latents.shape)
    return jnp.concatenate([jnp.where(mask > 0, latents + noise, latents), mask], -1)


def hide_readout(readout: MemoryReadout, kept_B: Array) -> MemoryReadout:
    """Mask the memory's readout for the clips of a batch that are not in ``kept_B``."""

    def masked(part: Any, name: str) -> Any:
        if part is None:
            return None
        mask = getattr(part, name)
        kept = kept_B[(slice(None), *[None] * (mask.ndim - 1))]
        return dataclasses.replace(part, **{name: mask & kept})

    names = {"tokens": "valid_M", "view": "seen_THW", "encoded": "seen_THW"}
    return MemoryReadout(**{part: masked(getattr(readout, part), m) for part, m in names.items()})


def of_stage(
    model: AssembledModel,
    train: TrainSettings,
    params: Params,
    clip: Clip,
    key: Array,
    *,
    stage: str,
    memory: bool,
    perceptual: bool = False,
) -> tuple[Array, dict[str, Array]]:
    """Return ``loss`` of the frames that a step of this stage imagines (``StageConfig.frames``).

    Clips of drawn frames are not chained. LPIPS is outside the choice between whole clips and drawn
    frames: inside, XLA's CPU backend is slow.
    """
    settings, length = getattr(train, stage), model.clip.frames - 1
    if model.draft.PREDICTS and "everywhere_thwC" not in clip.extras:
        clip = jax.lax.stop_gradient(prepare(model, params, clip, memory=memory))
    of_some = functools.partial(denoise, memory=memory, perceptual=perceptual)

    def of_clips() -> tuple[Array, dict[str, Array], Denoised | None]:
        return of_some(model, train, params, clip, key)

    def of_drawn() -> tuple[Array, dict[str, Array], Denoised | None]:
        shorter, drawn = draw_frames(model, clip, settings.frames, jax.random.fold_in(key, 9))
        return of_some(shorter, dataclasses.replace(train, chained=0.0), params, drawn, key)

    if not 0 < settings.frames < length:
        found = of_clips()
    elif not settings.whole:
        found = of_drawn()
    else:
        whole = jax.random.bernoulli(jax.random.fold_in(key, 10), settings.whole)
        found = jax.lax.cond(whole, of_clips, of_drawn)
    total, measures, denoised = cast("tuple[Array, dict[str, Array], Denoised | None]", found)
    return with_lpips(model, train, params, total, measures, denoised)


def draw_frames(
    model: AssembledModel, clip: Clip, count: int, key: Array
) -> tuple[AssembledModel, Clip]:
    """Return the model and a batch of clips of the observed frame and ``count`` others, in order.

    They are drawn at random, the same in all clips of the batch.
    """
    length = clip.frames.depth_THW.shape[1]
    drawn = jnp.sort(jax.random.choice(key, length - 1, (count,), replace=False)) + 1
    rows = jnp.concatenate([jnp.zeros((1,), drawn.dtype), drawn])

    def take(part: Any) -> Any:
        return jax.tree.map(lambda x: jnp.take(x, rows, 1), part)

    extras = dict(clip.extras)
    for name in ("latents_thwC", "everywhere_thwC"):
        if name in extras:
            extras[name] = take(extras[name])
    if "readout" in extras:
        shown: MemoryReadout = extras["readout"]
        extras["readout"] = dataclasses.replace(
            shown, view=take(shown.view), encoded=take(shown.encoded)
        )
    shorter = dataclasses.replace(model.clip, frames=count + 1)
    clip = dataclasses.replace(clip, frames=take(clip.frames), extras=extras)
    return dataclasses.replace(model, clip=shorter), clip


without_memory = functools.partial(of_stage, stage="stage1", memory=False)
"""The loss of stage 1."""
with_memory = functools.partial(of_stage, stage="stage2", memory=True)
"""The loss of stage 2."""
joint = functools.partial(of_stage, stage="joint", memory=True, perceptual=True)
"""The loss of stage ``joint``."""


def perceptual_weights(model: AssembledModel, train: TrainSettings) -> Params | None:
    """Return the weights of LPIPS that ``train.denoised_lpips`` needs, or None without it.

    Raises:
        UserError: a latent frame is not one frame of the video; see also
            ``codec_losses.lpips_weights``.
    """
    if not train.denoised_lpips:
        return None
    require(
        model.codec.temporal == 1,
        f"train.denoised_lpips is {train.denoised_lpips}, but the codec makes one latent frame of "
        f"{model.codec.temporal} frames: use a codec of single frames, or 0.",
    )
    return codec_losses.lpips_weights(train.denoised_lpips_net, model.clip)


def one_frame(
    model: AssembledModel, clip: Clip, x0_BthwC: Array, times: Array, key: Array
) -> Denoised:
    """Return one of all frames but the first, the same in all clips, of denoised latents."""
    at = jax.random.randint(key, (), 1, x0_BthwC.shape[1])

    def frame(x_BT: Array) -> Array:
        return jax.lax.dynamic_slice_in_dim(x_BT, at, 1, axis=1)

    ones, zeros = jnp.ones_like(x0_BthwC[..., :1]), jnp.zeros_like(x0_BthwC[..., :1])
    signal, noise = model.noise.corrupt(ones, zeros, times), model.noise.corrupt(zeros, ones, times)
    return Denoised(
        frame(x0_BthwC)[..., : model.codec.rgb_channels],
        signal_from_rgb(frame(clip.frames.rgb_THWC))[:, 0],
        (signal**2 / (signal**2 + noise**2)).mean((1, 2, 3, 4)),
    )


def denoised_distance(
    model: AssembledModel, net: lpips.Net, params: Params, denoised: Denoised
) -> Array:
    """Return LPIPS between denoised and true colours, the mean over clips.

    A clip's weight is its ``share_B``: in noise nothing can be recognised, and LPIPS would reward
    any sharp picture. ``params`` has the codec, and under ``lpips`` the network.
    """
    colours = denoised.colours_B1hwC.astype(model.dtype)
    made = model.codec.decode(params.get("codec", {}), colours)[:, 0].astype(jnp.float32)
    truth = jax.lax.stop_gradient(lpips.describe(net, params["lpips"], denoised.truth_BHWC))
    distance_B = lpips.distance(params["lpips"], lpips.describe(net, params["lpips"], made), truth)
    return (denoised.share_B * distance_B).mean()


def first_frames(
    model: AssembledModel,
    share: float,
    params: Params,
    frames: Frames,
    latents_BthwC: Array,
    readout: MemoryReadout | None,
    key: Array,
    everywhere_BthwC: Array | None = None,
) -> tuple[Array, Array]:
    """Return the first frames of a batch of clips, a share of them predicted by the model.

    Only the leading clips of a batch, as many as the share asks for, go through the model: over the
    batch the share is exact on average, and only these clips are ever chosen.

    Returns:
        Colours (B, 1, H, W, 3) in [−1, 1] and depth (B, 1, H, W) in metres; 0 if the denoiser works
        without depth.

    Raises:
        UserError: the control needs actions; only cameras can be run backwards.
    """
    if model.control.actions:
        raise UserError(
            "train.chained is above 0, which runs clips backwards, but this model's control needs "
            "actions, which are unknown for the way back: use a control by cameras "
            "(control.kind camera), or train.chained 0."
        )
    batch = len(frames.depth_THW)
    rows = math.ceil(share * batch)
    chosen_key, key = jax.random.split(key)
    chosen = jax.random.bernoulli(chosen_key, share * batch / rows, (rows,))

    def leading(whole: Any) -> Any:
        return jax.tree.map(lambda x: x[:rows], whole)

    made = jax.lax.stop_gradient(
        _predict_backwards(
            model,
            jax.lax.stop_gradient(params),
            leading(frames),
            leading(latents_BthwC),
            leading(readout),
            key,
            leading(everywhere_BthwC) if model.draft.PREDICTS else None,
        )
    )
    true = frames.rgb_THWC[:, :1], frames.depth_THW[:, :1]

    def replaced(new: Array, old: Array) -> Array:
        which = chosen.reshape(rows, *(1,) * (old.ndim - 1))
        return jnp.concatenate([jnp.where(which, new, old[:rows]), old[rows:]])

    return replaced(made[0], true[0]), replaced(made[1], true[1])


def backwards(model: AssembledModel, readout: MemoryReadout) -> MemoryReadout:
    """Return the readout of clips that are run backwards; leading axes B and T.

    Tokens have no order in time; all other parts are reversed along T.

    Raises:
        UserError: the codec folds several frames into a latent one, and the reader takes latents,
            which cannot be reversed then.
    """
    if readout.encoded is not None and not model.codec.framewise:
        raise UserError(
            "train.chained is above 0, which runs clips backwards, but memory.reader.picture is "
            "latents and the codec folds several frames into one latent: use a codec of single "
            "frames, memory.reader.picture pixels, or train.chained 0."
        )
    pictures = dataclasses.replace(readout, tokens=None)
    pictures = jax.tree.map(lambda x: x[:, ::-1], pictures)
    return dataclasses.replace(pictures, tokens=readout.tokens)


def _predict_backwards(
    model: AssembledModel,
    params: Params,
    frames: Frames,
    latents_BthwC: Array,
    readout: MemoryReadout | None,
    key: Array,
    drafted_BthwC: Array | None = None,
) -> tuple[Array, Array]:
    """Run clips backwards in one denoising step, and return the predicted frames at their start."""
    back = jax.tree.map(lambda x: x[:, ::-1], frames)
    if model.codec.framewise:  # latents of one frame each
        x0 = latents_BthwC[:, ::-1]
    else:
        x0 = rgbd.encode_rgbd(model, params, back.rgb_THWC, back.depth_THW)
    readout = None if readout is None else backwards(model, readout)
    view = None if readout is None else readout.view
    observed = jax.tree.map(lambda x: x[:, :1], back)
    if drafted_BthwC is not None:
        drafted_BthwC = drafted_BthwC[:, ::-1]
    conditioning = world_model.condition(
        model, params, observed, Control(back.camera), everywhere_BthwC=drafted_BthwC
    )
    time_key, noise_key = jax.random.split(key)
    times = model.noise.draw(time_key, *x0.shape[:2])
    x_t = model.noise.corrupt(x0, jax.random.normal(noise_key, x0.shape), times)
    inputs, network_time = model.noise.precondition(x_t, times)
    out = world_model.apply(model, params, inputs, conditioning, network_time, readout)
    latents = model.noise.to_x0(out, x_t, times)
    last = latents[:, -1:] if model.codec.framewise else latents
    rgb, depth = (x[:, -1:] for x in rgbd.decode_rgbd(model, params, last))
    if view is not None and memories.gated(model):
        arrived: View = jax.tree.map(lambda x: x[:, -1:], view)
        if drafted_BthwC is not None:
            arrived = drafts.gate_input(model, params, drafted_BthwC[:, -1:], arrived)
        rgb, depth = rgbd.mix(model, params, rgb, depth, arrived)
    return rgb, depth if model.clip.depth else jnp.zeros_like(depth)
