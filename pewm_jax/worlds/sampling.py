"""Sampling the latents of clips: the noise, the sampler's steps, guidance by the memory."""

from __future__ import annotations

import jax

from pewm_jax.config import ModelConfig
from pewm_jax.models import interface as backbones
from pewm_jax.types import Array, MemoryReadout, Params
from pewm_jax.worlds import world_model


def draw(
    model: ModelConfig,
    params: Params,
    conditioning: world_model.ClipConditioning,
    sight: MemoryReadout | None,
    key: Array,
    *,
    blind: world_model.ClipConditioning | None = None,
) -> Array:
    """Sample the latents of one clip, (1, t, h, w, C), from noise of its own; see ``sample``."""
    noise = jax.random.normal(key, (1, *model.latent_shape, model.codec.channels))
    again = jax.random.fold_in(key, 1)
    return sample(model, params, conditioning, sight, noise, again, blind=blind)


def sample(
    model: ModelConfig,
    params: Params,
    conditioning: world_model.ClipConditioning,
    sight: MemoryReadout | None,
    noise_BthwC: Array,
    key: Array | None = None,
    *,
    blind: world_model.ClipConditioning | None = None,
) -> Array:
    """Sample one batch of clips' latents with the configured noise and sampler.

    With ``noise.guidance`` g ≠ 1 the prediction is x0(no map) + g·(x0(map) − x0(no map)); DDPM
    lets g vary with the step (``noise.dynamic_guidance``). Where ``blind`` is given, it is what the
    prediction is compared with, in the place of the same without the map. Latents that the
    conditioning knows are held: whatever is predicted there, x0 is what is known.

    Args:
        model: the model.
        params: the world model's parameters.
        conditioning: observed frame, control, text.
        sight: what the memory shows the clips, or None for no memory.
        noise_BthwC: standard normal start.
        key: randomness of the steps, if the sampler draws noise.
        blind: the conditioning without what guidance is to strengthen.

    Returns:
        (B, t, h, w, C) latents.

    Raises:
        ValueError: the sampler draws noise at every step and there is no key.
    """
    noise = model.noise

    def x0(
        x: Array, times: Array, given: world_model.ClipConditioning, sight: MemoryReadout | None
    ) -> Array:
        inputs, network_time = noise.precondition(x, times)
        out = world_model.apply(model, params, inputs, given, network_time, sight)
        return noise.to_x0(out, x, times)

    def denoise(x: Array, times: Array, weight: Array) -> Array:
        clean = x0(x, times, conditioning, sight)
        if noise.guidance != 1 and (sight is not None or blind is not None):
            without = x0(x, times, blind or conditioning, None)
            clean = without + weight * (clean - without)
        return backbones.held(conditioning.given, clean)

    return noise.sample(denoise, noise_BthwC, key)
