"""Flow matching with a time per frame: its formulas, its times, what it shares with flow."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import ConfigError
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.diffusion.flow import PERSIST_PIXELS, PERSIST_VOXELS, FlowConfig, FrameFlowConfig
from pewm_jax.worlds.persist.state import noisy_context

PLAIN = FrameFlowConfig(shift=1.0, smallest=0.0)


def draw(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_without_noise_left_at_0_it_is_flow():
    x0, eps = draw(0, 2, 3, 4), draw(1, 2, 3, 4)
    times = np.random.default_rng(2).uniform(0.1, 1, (2, 3)).astype(np.float32)
    config = FlowConfig(per_frame=True)
    x_t = config.corrupt(x0, eps, times)
    np.testing.assert_allclose(PLAIN.corrupt(x0, eps, times), x_t, atol=1e-6)
    wanted = config.prediction_target(x0, eps, times)
    np.testing.assert_allclose(PLAIN.prediction_target(x0, eps, times), wanted, atol=1e-6)
    for made in (PLAIN.to_x0(wanted, x_t, times), config.to_x0(wanted, x_t, times)):
        np.testing.assert_allclose(made, x0, atol=1e-6)


def test_the_target_is_the_slope_of_the_path_whatever_is_left_at_0():
    config = FrameFlowConfig(smallest=0.3)
    x0, eps = draw(0, 2, 3, 4), draw(1, 2, 3, 4)

    def at(time):
        return config.corrupt(x0, eps, jnp.full((2, 3), time))

    x_t, slope = jax.jvp(at, (0.4,), (1.0,))
    wanted = config.prediction_target(x0, eps, None)
    np.testing.assert_allclose(slope, wanted, atol=1e-6)
    np.testing.assert_allclose(x_t, 0.6 * x0 + (0.3 + 0.7 * 0.4) * eps, atol=1e-6)
    times = jnp.full((2, 3), 0.4)
    np.testing.assert_allclose(config.to_x0(wanted, x_t, times), x0, atol=1e-6)
    np.testing.assert_allclose(config.velocity(x0, x_t, times), wanted, atol=1e-5)
    np.testing.assert_allclose(at(0.0) - x0, 0.3 * eps, atol=1e-6)


def test_where_x0_is_predicted_samples_follow_the_same_path():
    config = FrameFlowConfig(predicts="x0", sample_steps=3)
    x0, eps, times = draw(0, 2, 3, 4), draw(1, 2, 3, 4), np.full((2, 3), 0.4, np.float32)
    np.testing.assert_array_equal(config.prediction_target(x0, eps, times), x0)
    np.testing.assert_array_equal(config.to_x0(x0, eps, times), x0)
    velocity = dataclasses.replace(config, predicts="velocity")

    def sample(config):
        def network(x, time):  # some x0, and the velocity that leads to it
            made = 0.5 * x + x0
            if config.predicts == "x0":
                return made
            return config.velocity(made, x, time)

        return config.sample(lambda x, t, w: config.to_x0(network(x, t), x, t), eps)

    np.testing.assert_allclose(sample(config), sample(velocity), atol=1e-5)


def test_times_are_drawn_per_frame_and_only_the_sampler_shifts_them():
    config = PERSIST_VOXELS
    times = np.asarray(config.draw(jax.random.key(0), 400, 5))
    assert times.shape == (400, 5)
    assert np.unique(times).size > 1990
    logit = np.log(times / (1 - times))
    assert abs(logit.mean()) < 0.1
    assert abs(logit.std() - 1) < 0.1
    shifted = dataclasses.replace(config, shifted_times=True).draw(jax.random.key(0), 400, 5)
    np.testing.assert_allclose(shifted, 3 * times / (1 + 2 * times), rtol=1e-5)
    even = np.linspace(1, 0, 21)[:-1]
    np.testing.assert_allclose(config.levels(), 3 * even / (1 + 2 * even), rtol=1e-6)
    assert FrameFlowConfig.levels is FlowConfig.levels


@pytest.mark.parametrize("config", [FlowConfig(), FrameFlowConfig(), EDMConfig()])
def test_with_a_temperature_the_sampler_starts_from_less_noise(config):
    noise = jax.random.normal(jax.random.key(3), (2, 3, 4))

    def denoise(x, time_B, weight):
        return 0.3 * x

    cold = dataclasses.replace(config, temperature=0.4)
    wanted = config.sample(denoise, 0.4 * noise)
    np.testing.assert_allclose(cold.sample(denoise, noise), wanted, rtol=1e-6)
    assert np.abs(wanted).max() < 0.5 * np.abs(config.sample(denoise, noise)).max()


def test_given_frames_have_a_little_noise_and_say_so():
    config = PERSIST_PIXELS
    x0 = np.zeros((2, 3, 50, 40), np.float32)
    x_t, times = noisy_context(config, x0, jax.random.key(0))
    np.testing.assert_allclose(times, np.full((2, 3), 0.1), rtol=1e-6)
    np.testing.assert_allclose(np.asarray(x_t).std(), 0.1, rtol=0.05)


@pytest.mark.parametrize(
    "wrong", [{"smallest": 1.0}, {"context_noise": -0.1}, {"shift": 0.0}, {"temperature": 1.5}]
)
def test_settings_that_cannot_work_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        FrameFlowConfig(**wrong)


def test_a_temperature_of_edm_above_1_is_refused():
    with pytest.raises(ConfigError, match=r"noise\.temperature is 1\.5"):
        EDMConfig(temperature=1.5)


def test_times_at_the_ends_are_those_that_one_step_meets():
    config = FrameFlowConfig(per_frame=True, times="ends", sample_steps=1, context_noise=0.1)
    times = np.asarray(config.draw(jax.random.key(0), 500, 4))
    assert times.shape == (500, 4)
    assert set(np.unique(times)) == {np.float32(0.1), np.float32(1)}
    np.testing.assert_allclose(times.mean(0), 0.55, atol=0.05)
    asked = []

    def denoise(x, time_B, weight):
        jax.debug.callback(lambda t: asked.append(float(t)), time_B[0])
        return 0 * x

    config.sample(denoise, jnp.ones((1, 1, 2)))
    jax.effects_barrier()
    assert set(asked) <= {1.0}
    for change in ({"sample_steps": 2}, {"per_frame": False}):
        with pytest.raises(ConfigError, match=r"noise\.times is ends"):
            dataclasses.replace(config, **change)


def test_a_share_of_frames_has_the_time_of_given_frames():
    noise = FrameFlowConfig(per_frame=True, history=0.25, context_noise=0.02, shifted_times=True)
    times = np.asarray(noise.draw(jax.random.key(0), 400, 5))
    share = (times == np.float32(0.02)).mean()
    assert 0.2 < share < 0.3
    plain = dataclasses.replace(noise, history=0.0).draw(jax.random.key(0), 400, 5)
    other = times != np.float32(0.02)
    np.testing.assert_array_equal(times[other], np.asarray(plain)[other])
    with pytest.raises(ConfigError, match=r"noise\.history is 1"):
        FrameFlowConfig(per_frame=True, history=1.0)
