"""Clips that start from what the model itself makes of their first frame.

In a rollout every clip but the first starts from an imagined frame, and a model that learned on
observed ones alone believes it too much. Whole chained clips would cost a sampling for each step of
training. Here the clip before is the same clip run backwards, from its last frame to its first, for
which nothing more is to be read: its true latents get noise of a level drawn as in training; the
model, as it is then, denoises them once, with the last frame as the observed one and the same
memory; and the clip starts from the frame that this comes to last, decoded, and mixed with the
memory's picture by the codec's gate, where there is one and the reader reads pictures. So it lies
between what the codec makes of the true frame and what the model imagines there of its own. No
gradient goes through it.

This is less than a rollout: one step instead of a sampling, without guidance, and the memory holds
what was observed alone.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.config import ModelConfig, UserError
from pewm_jax.memory import interface as memories
from pewm_jax.types import Array, Control, Frames, MemoryReadout, Params, View
from pewm_jax.worlds import world_model


def first_frames(
    model: ModelConfig,
    share: float,
    params: Params,
    frames: Frames,
    latents_BthwC: Array,
    sight: MemoryReadout | None,
    key: Array,
) -> tuple[Array, Array]:
    """Return the first frames of a batch of clips, a share of them as the model makes them.

    Only the leading clips of a batch, as many as the share asks for, go through the model.

    Args:
        model: the model; its control must be by cameras, which can be run backwards.
        share: probability of each clip to be chained, above 0; over the batch it is exact on
            average, and only the leading clips are ever chosen.
        params: the world model's parameters.
        frames: (B, T) the clips' frames, colours in [−1, 1].
        latents_BthwC: their latents.
        sight: what the memory shows the clips, leading axis B, or None without memory.
        key: randomness of choice, level and noise.

    Returns:
        Colours (B, 1, H, W, 3) in [−1, 1] and depth (B, 1, H, W) in metres; 0 if the denoiser works
        without depth.

    Raises:
        UserError: the control needs actions.
    """
    if model.control.actions:
        raise UserError(
            "train.chained is above 0, which runs clips backwards, but this model's control needs "
            "actions, and nobody knows those of the way back: use a control by cameras "
            "(control.kind camera), or train.chained 0."
        )
    batch = len(frames.depth_THW)
    rows = math.ceil(share * batch)
    chosen_key, key = jax.random.split(key)
    chosen = jax.random.bernoulli(chosen_key, share * batch / rows, (rows,))

    def leading(whole: Any) -> Any:
        return jax.tree.map(lambda x: x[:rows], whole)

    made = jax.lax.stop_gradient(
        _looking_back(
            model,
            jax.lax.stop_gradient(params),
            leading(frames),
            leading(latents_BthwC),
            leading(sight),
            key,
        )
    )
    true = frames.rgb_THWC[:, :1], frames.depth_THW[:, :1]

    def replaced(new: Array, old: Array) -> Array:
        which = chosen.reshape(rows, *(1,) * (old.ndim - 1))
        return jnp.concatenate([jnp.where(which, new, old[:rows]), old[rows:]])

    return replaced(made[0], true[0]), replaced(made[1], true[1])


def backwards(model: ModelConfig, sight: MemoryReadout) -> MemoryReadout:
    """Return what the memory shows clips that are run backwards; leading axes B and T.

    Tokens have no order in time. All else is reversed along T; latents that stand for one frame
    each are reversed as frames are.

    Raises:
        UserError: the codec folds several frames into a latent one, and the reader takes latents,
            which cannot be reversed then.
    """
    if sight.encoded is not None and not model.codec.framewise:
        raise UserError(
            "train.chained is above 0, which runs clips backwards, but memory.reader.picture is "
            "latents and the codec folds several frames into one latent: use a codec of single "
            "frames, memory.reader.picture pixels, or train.chained 0."
        )
    parts = {field.name: getattr(sight, field.name) for field in dataclasses.fields(sight)}
    reversed_parts = {
        name: jax.tree.map(lambda x: x[:, ::-1], part)
        for name, part in parts.items()
        if name != "tokens"
    }
    return dataclasses.replace(sight, **reversed_parts)


def _looking_back(
    model: ModelConfig,
    params: Params,
    frames: Frames,
    latents_BthwC: Array,
    sight: MemoryReadout | None,
    key: Array,
) -> tuple[Array, Array]:
    """Run clips backwards, and return what the model makes of the frames where they arrive."""
    back = jax.tree.map(lambda x: x[:, ::-1], frames)
    if model.codec.framewise:  # latents of one frame each
        x0 = latents_BthwC[:, ::-1]
    else:
        x0 = rgbd.encode_rgbd(model, params, back.rgb_THWC, back.depth_THW)
    sight = None if sight is None else backwards(model, sight)
    view = None if sight is None else sight.view
    observed = jax.tree.map(lambda x: x[:, :1], back)
    conditioning = world_model.condition(model, params, observed, Control(back.camera))
    time_key, noise_key = jax.random.split(key)
    times = model.noise.draw(time_key, *x0.shape[:2])
    x_t = model.noise.corrupt(x0, jax.random.normal(noise_key, x0.shape), times)
    inputs, network_time = model.noise.precondition(x_t, times)
    out = world_model.apply(model, params, inputs, conditioning, network_time, sight)
    latents = model.noise.to_x0(out, x_t, times)
    last = latents[:, -1:] if model.codec.framewise else latents
    rgb, depth = (x[:, -1:] for x in rgbd.decode_rgbd(model, params, last))
    if view is not None and memories.gated(model):
        arrived: View = jax.tree.map(lambda x: x[:, -1:], view)
        rgb, depth = rgbd.mix(model, params, rgb, depth, arrived)
    return rgb, depth if model.clip.depth else jnp.zeros_like(depth)
