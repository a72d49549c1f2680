"""Sampling that keeps what the memory shows at a level of noise, down to ``rendered_until``."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.config import ConfigError
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.memory import interface as memories
from pewm_jax.types import Control
from pewm_jax.worlds import world_model
from tests.helpers import random_world, tiny_model
from tests.worlds.test_observed import EACH, MEMORY, condition, observed_frame

NOISE = EDMConfig(sigma_max=20.0, sigma_min=0.1, sample_steps=5, ends="sigma_min")
SHAPE = (1, 3, 2, 2, 4)


def drawn(seed):
    return jax.random.normal(jax.random.key(seed), SHAPE)


COVERED = jnp.arange(SHAPE[1])[None, :, None, None, None] < 2
CLEAN = 0.3
"""What the denoiser of these tests takes every latent for."""


def denoise(x, time_B, weight):
    return jnp.full_like(x, CLEAN)


def sample(noise, held=None):
    return noise.sample(denoise, drawn(0), held=held)


@pytest.mark.parametrize("sampler", ["euler", "heun"])
@pytest.mark.parametrize("target", ["edm", "v"])
def test_covered_latents_are_the_rendering_with_the_noise_of_the_last_level(sampler, target):
    noise = dataclasses.replace(NOISE, sampler=sampler, target=target, rendered_until=0.1)
    found = sample(noise, (drawn(1), COVERED))
    expected = drawn(1) + noise.levels()[-1] * drawn(0)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-5)
    np.testing.assert_allclose(found[:, 2:], sample(noise)[:, 2:], atol=1e-6)


def test_below_the_level_they_are_free():
    levels = NOISE.levels()
    noise = dataclasses.replace(NOISE, rendered_until=float(levels[2]))
    found = sample(noise, (drawn(1), COVERED))
    # With a denoiser that always says the same, the ODE is a straight line to that.
    started = drawn(1) + levels[2] * drawn(0)
    expected = CLEAN + (started - CLEAN) * levels[-1] / levels[2]
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-4)
    np.testing.assert_allclose(found[:, 2:], sample(noise)[:, 2:], atol=1e-6)


def test_at_every_level_above_it_the_network_gets_the_rendering():
    inputs = []

    def watch(x, time_B, weight):
        jax.debug.callback(lambda x, t: inputs.append((float(t[0]), np.asarray(x))), x, time_B)
        return denoise(x, time_B, weight)

    noise = dataclasses.replace(NOISE, rendered_until=1.0, ends="clean")
    noise.sample(watch, drawn(0), held=(drawn(1), COVERED)).block_until_ready()
    jax.effects_barrier()
    assert len(inputs) == NOISE.sample_steps
    for sigma, x in inputs:
        expected = drawn(1) + sigma * drawn(0)
        near = np.abs(x[:, :2] - expected[:, :2]).max() < 1e-4
        assert near == (sigma >= 1)


def test_off_changes_nothing():
    np.testing.assert_array_equal(
        sample(NOISE), sample(dataclasses.replace(NOISE, rendered_until=2.0))
    )


@pytest.mark.slow
def test_a_world_keeps_what_its_memory_shows():
    """Where the memory was seen, imagined latents are those of the rendering; elsewhere not."""
    noise = dataclasses.replace(NOISE, rendered_until=0.01, sigma_min=0.02)
    model = tiny_model(codec=EACH, memory=MEMORY, noise=noise)
    params = random_world(model)
    frame, camera = observed_frame()
    state = worlds.start(model, params, jax.tree.map(lambda x: x[0], frame))
    readout = memories.readout(model, state.map, jax.tree.map(lambda x: x[0], camera))
    readout = jax.tree.map(lambda x: x[None], readout)
    given = condition(model, params, frame, Control(camera))
    latents, covered = world_model.rendered_latents(model, params, readout)
    assert 0.05 < np.mean(covered) < 0.95
    draw = jax.jit(world_model.draw, static_argnums=0)
    found = draw(model, params, given, readout, jax.random.key(0))
    off = np.abs(found - latents)
    there = np.broadcast_to(covered, off.shape)
    assert off[there].max() < 0.02 * 5
    free = dataclasses.replace(model, noise=dataclasses.replace(noise, rendered_until=0.0))
    usual = draw(free, params, given, readout, jax.random.key(0))
    assert np.abs(usual - latents)[there].mean() > 3 * off[there].mean()
    without = draw(model, params, given, None, jax.random.key(0))
    assert np.isfinite(without).all()


def test_a_memory_that_is_not_rendered_in_colours_is_refused():
    with pytest.raises(ConfigError, match=r"rendered_until is 1\.0, .* memory\.kind surfels"):
        tiny_model(noise=EDMConfig(rendered_until=1.0))
    with pytest.raises(ConfigError, match=r"rendered_until is -1"):
        EDMConfig(rendered_until=-1)
    tiny_model(memory=MEMORY, noise=EDMConfig(rendered_until=1.0))
