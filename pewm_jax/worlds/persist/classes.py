"""The error of a voxel frame in classes: what its latents say of the cells, by the frozen decoder.

Latents that are the mean of several possibilities decode to none of them. Compared as classes, the
network is asked for what is likeliest in every cell. Some latents of a frame are drawn, and each is
decoded alone, so the decoder must not look at its neighbours.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.models.persist import voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.nn.tokens import patchify
from pewm_jax.types import Array, Params


def compared(
    config: VoxelVAEConfig,
    params: Params,
    latents_BTxyzC: Array,
    classes_BTXYZ: Array,
    weight_BTxyz: Array,
    count: int,
    key: Array,
) -> tuple[Array, Array]:
    """Return the cross-entropy of the cells of latents that are drawn by their weight.

    Args:
        config: the autoencoder, such as ``PersistTrainConfig.classes`` needs.
        params: its parameters.
        latents_BTxyzC: normalised latents.
        classes_BTXYZ: int class ids of the cells, below 0 where they are not known.
        weight_BTxyz: what each latent counts; 0 for those that are never drawn.
        count: latents drawn of each frame.
        key: draws them.

    Returns:
        ``(error, right)``: () nats of a cell, () the share of cells whose class is the likeliest.
    """
    frames, side = latents_BTxyzC.shape[0] * latents_BTxyzC.shape[1], config.latent_side
    flat = latents_BTxyzC.reshape(frames, side**3, -1)
    weight = weight_BTxyz.reshape(frames, -1).astype(jnp.float32)
    cells = cells_of_latents(config, classes_BTXYZ.reshape(frames, *classes_BTXYZ.shape[2:]))
    drawn = voxel_vae.sample_cells(weight, count, key)[..., None]
    error, right = error_of(
        config,
        params,
        jnp.take_along_axis(flat, drawn, 1).reshape(frames * count, -1),
        jnp.take_along_axis(cells, drawn, 1).reshape(frames * count, -1),
    )
    # A frame of which nothing is known draws latents that do not count.
    counts = jnp.repeat((weight.sum(1) > 0).astype(jnp.float32), count)
    share = counts / jnp.maximum(counts.sum(), 1)
    return (error * share).sum(), (right * share).sum()


def cells_of_latents(config: VoxelVAEConfig, classes_BXYZ: Array) -> Array:
    """Return (B, latents, cells of one), a latent's cells in the order X, Y, Z."""
    return patchify(classes_BXYZ[..., None], config.factor, config.factor)


def error_of(
    config: VoxelVAEConfig, params: Params, latents_NC: Array, classes_NK: Array
) -> tuple[Array, Array]:
    """Return the cross-entropy of the cells of latents, each decoded alone.

    Args:
        config: the autoencoder.
        params: its parameters.
        latents_NC: normalised latents.
        classes_NK: class ids of the cells of each; those below 0 do not count.

    Returns:
        ``(error_N, right_N)``: its mean over the known cells of a latent, in nats, and the share of
        those whose class is the likeliest.
    """
    alone = dataclasses.replace(config, side=config.factor, cube=0, slab=0)
    scores = voxel_vae.logits(alone, params, latents_NC[:, None, None, None])
    scores = scores.reshape(*classes_NK.shape, -1).astype(jnp.float32)
    ids = jnp.maximum(classes_NK, 0).astype(jnp.int32)
    chosen = jnp.take_along_axis(scores, ids[..., None], -1)[..., 0]
    known = (classes_NK >= 0).astype(jnp.float32)
    share = known / jnp.maximum(known.sum(1, keepdims=True), 1)
    missed, right = jax.nn.logsumexp(scores, -1) - chosen, chosen >= scores.max(-1)
    return (missed * share).sum(1), (right * share).sum(1)
