"""How the world ``persist`` makes its next voxel frame (arXiv 2603.03482).

The present voxels, as they are now, are encoded anew and go into the transformer's cache; the next
ones are sampled from noise, and what was known has the advantage of ``model.hold``.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import PersistConfig
from pewm_jax.geometry.actions import camera_numbers
from pewm_jax.memory.class_grid import EMPTY, UNKNOWN
from pewm_jax.models.persist import voxel_dit, voxel_vae
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.nn.layers import linear
from pewm_jax.types import Array, Params
from pewm_jax.worlds.persist import sight as persist_sight
from pewm_jax.worlds.persist import windows
from pewm_jax.worlds.persist.past import History, context
from pewm_jax.worlds.persist.sight import ObservedCells


def sample(
    model: PersistConfig,
    params: Params,
    history: History,
    cache: FrameCache,
    middle_3: Array,
    before_XYZ: Array,
    key: Array,
    sight: ObservedCells | None = None,
) -> Array:
    """Sample a voxel frame: (X, Y, Z) class ids.

    Args:
        model: the model.
        params: all parameters.
        history: gives the action that leads to the frame, and the picture that it is shown.
        cache: of the frames before it.
        middle_3: the middle of its window, metres.
        before_XYZ: the window's cells before; where they are known, ``model.hold`` counts.
        key: randomness.
        sight: what a real picture of this frame shows of the window's cells.
    """
    config, noise = model.backbone.world_frames, model.voxel_noise  # type: ignore[attr-defined]
    asked = _asked(model, history, middle_3)
    shape = (1, 1, *(config.latent_side,) * 3, config.latent_channels)

    def denoise(x: Array, time_B: Array, weight: Array) -> Array:
        del weight
        times = time_B[:, None]
        inputs, network_times = noise.precondition(x, times)
        inputs = inputs.astype(jnp.dtype(model.dtype))
        made, _ = voxel_dit.apply(
            config, params["voxel_dit"], inputs, network_times, **asked, cache=cache
        )
        return noise.to_x0(made.astype(jnp.float32), x, times)

    latents = noise.sample(denoise, jax.random.normal(key, shape))[:, 0]
    return held(model, params, latents, before_XYZ, sight)


def held(
    model: PersistConfig,
    params: Params,
    latents_BxyzC: Array,
    before_XYZ: Array,
    sight: ObservedCells | None = None,
) -> Array:
    """Return the class ids (X, Y, Z) that latents (1, …) decode to.

    A cell whose class was known has another one only if that is likelier by ``model.hold``; one of
    which nothing was known has air, unless a class is likelier by ``model.doubt``. What a real
    picture shows of it is likelier by ``model.sight``.
    """
    config = model.backbone.voxel_vae  # type: ignore[attr-defined]
    weights, dtype = params["voxel_vae"], jnp.dtype(model.dtype)
    looked = sight is not None and model.sight > 0
    if not model.hold and not model.doubt and not looked:
        return voxel_vae.decode(config, weights, latents_BxyzC, dtype)[0]
    features = voxel_vae.features(config, weights, latents_BxyzC, dtype)[0]

    def likeliest(slab: tuple[Array, Array, ObservedCells | None]) -> Array:
        features, before, sight = slab
        scores = linear(weights["decoder"]["scores"], features).astype(jnp.float32)
        number, before = jnp.arange(config.classes), before[..., None]
        scores = scores + model.hold * (number == before)
        scores = scores + model.doubt * ((before == UNKNOWN) & (number == EMPTY))
        if sight is not None:
            scores = scores + persist_sight.advantage(model, sight, config.classes)
        return scores.argmax(-1).astype(jnp.int32)

    slab = config.slab or config.side
    whole = features, before_XYZ.astype(jnp.int32), sight if looked else None
    cut = jax.tree.map(lambda x: x.reshape(-1, slab, *x.shape[1:]), whole)
    return jax.lax.map(likeliest, cut).reshape(before_XYZ.shape)


def taken_in(
    model: PersistConfig,
    params: Params,
    history: History,
    cache: FrameCache,
    middle_3: Array,
    classes_XYZ: Array,
    key: Array,
) -> FrameCache:
    """Encode the present voxels and add them to the cache; what is not known of them is noise."""
    config, noise = model.backbone.world_frames, model.voxel_noise  # type: ignore[attr-defined]
    vae, dtype = model.backbone.voxel_vae, jnp.dtype(model.dtype)  # type: ignore[attr-defined]
    known = windows.known_latents(model, classes_XYZ)
    ids = jnp.maximum(classes_XYZ, 0).astype(jnp.int32)
    latents = voxel_vae.encode(vae, params["voxel_vae"], ids[None], dtype)[:, None]
    noise_key, unknown_key = jax.random.split(key)
    x, times = context(noise, latents, noise_key)
    x = jnp.where(known[..., None], x, jax.random.normal(unknown_key, x.shape))
    inputs, network_times = noise.precondition(x, times)
    _, cache = voxel_dit.apply(
        config,
        params["voxel_dit"],
        inputs.astype(dtype),
        network_times,
        **_asked(model, history, middle_3),
        known_BTxyz=known[None, None],
        cache=cache,
    )  # type: ignore[assignment]
    return cache


def _asked(model: PersistConfig, history: History, middle_3: Array) -> dict[str, Any]:
    """Return the transformer's condition of one voxel frame."""
    config, shown = model.backbone.world_frames, history.shown  # type: ignore[attr-defined]
    told = windows.told(model, shown, middle_3)
    camera = camera_numbers(shown.camera, model.clip.width, middle_3)
    return {
        "actions_BTA": history.action_A[None, None],
        "pixels_BThwC": told[None, None],
        "camera_BTN": camera[None, None] if config.camera_numbers else None,
    }
