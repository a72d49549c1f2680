"""Every kind of noise keeps the same promises: back to x0, at any time, by any of its samplers."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax import registry as kinds
from pewm_jax.config import TrainConfig
from pewm_jax.config.parts import Noise
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.diffusion.flow import FlowConfig, FrameFlowConfig
from pewm_jax.worlds import objective
from tests.diffusion.test_ddpm import make_clip
from tests.helpers import TINY, random_world, tiny_model
from tests.properties import examples

KINDS = {
    "ddpm_x0": DDPMConfig(target="x0"),
    "ddpm_v": DDPMConfig(target="v"),
    "ddpm_eps": DDPMConfig(target="eps", zero_terminal_snr=False),
    "edm": EDMConfig(),
    "edm_v": EDMConfig(target="v"),
    "edm_heun": EDMConfig(sampler="heun"),
    "flow": FlowConfig(),
    "flow_shifted": FlowConfig(shift=3.0, times="logit_normal"),
    "frame_flow": FrameFlowConfig(),
}
every = pytest.mark.parametrize("config", KINDS.values(), ids=KINDS)


def draw(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_every_registered_noise_is_tested():
    ours = {
        name
        for name in kinds.names("noise")
        if kinds.named("noise", name).settings.__module__.startswith("pewm_jax.")
    }
    assert {kinds.of(config).name for config in KINDS.values()} == ours


@every
def test_the_target_leads_back_to_x0_at_every_level(config):
    times = jnp.asarray(dataclasses.replace(config, sample_steps=25).levels())
    if isinstance(config, DDPMConfig):
        times = jnp.arange(0, 1000, 37)
    x0, eps = draw(0, 2, len(times), 3, 4)
    x_t = config.corrupt(x0, eps, times)
    asked = config.prediction_target(x0, eps, times)
    scale = max(1.0, float(np.abs(x_t).max()))
    found = config.to_x0(asked, x_t, times)
    # ε divides by √ᾱ, which is small where noise is heavy.
    np.testing.assert_allclose(found, x0, atol=scale * (2e-3 if "ddpm" in repr(config) else 2e-6))


@every
def test_levels_fall_and_begin_at_the_most_noise(config):
    levels = np.asarray(dataclasses.replace(config, sample_steps=7).levels())
    assert levels.shape == (7,)
    assert (np.diff(levels) < 0).all()
    most = {"ddpm": 999, "edm": 80.0, "flow": 1.0, "frame_flow": 1.0}[kinds.of(config).name]
    np.testing.assert_allclose(levels[0], most, rtol=1e-6)


def test_no_noise_leaves_latents_alone_and_most_noise_leaves_nothing_of_them():
    x0, eps = draw(0, 2, 3, 4)
    for config in (EDMConfig(), FlowConfig()):
        np.testing.assert_array_equal(config.corrupt(x0, eps, jnp.zeros(3)), x0)
    least = DDPMConfig().corrupt(x0, eps, jnp.zeros(3, int))
    np.testing.assert_allclose(least, x0, atol=0.15)
    for config, most in ((DDPMConfig(), jnp.full(3, 999)), (FlowConfig(), jnp.ones(3))):
        np.testing.assert_array_equal(config.corrupt(x0, eps, most), eps)
    drowned = EDMConfig().corrupt(x0, eps, jnp.full(3, 80.0)) / 80
    np.testing.assert_allclose(drowned, eps, atol=0.05)


@every
@pytest.mark.parametrize("steps", [1, 5])
def test_a_perfect_denoiser_is_followed_to_the_truth(config, steps):
    config = dataclasses.replace(config, sample_steps=steps)
    x0, start = draw(0, 2, 2, 3, 4)

    @jax.jit
    def run(start):
        return config.sample(lambda *_: jnp.asarray(x0), start)

    # At σ = 80 a float32 keeps 80·2⁻²⁴.
    np.testing.assert_allclose(run(start), x0, atol=3e-5 if isinstance(config, EDMConfig) else 1e-6)


@every
def test_the_sampler_goes_through_the_whole_interface(config):
    """A network that knows the answer to what it is asked ends at the truth, at every level."""
    config = dataclasses.replace(config, sample_steps=4)
    x0, start = draw(0, 2, 2, 3, 4)
    told = []

    def denoise(x, times, weight):
        told.append((times.shape, jnp.shape(weight)))
        shown, _ = config.precondition(x, times)
        assert shown.shape == x.shape
        now = Noise.expand(times, x.ndim)
        if isinstance(config, EDMConfig):
            eps = (x - x0) / now
        elif isinstance(config, FlowConfig):
            eps = (x - (1 - now) * x0) / now
        else:
            a = dataclasses.replace(config, target="v").to_x0(jnp.zeros_like(x), x, times)
            a = (a / x).mean((1, 2), keepdims=True)
            eps = (x - a * x0) / jnp.sqrt(1 - a**2)
        return config.to_x0(config.prediction_target(x0, eps, times), x, times)

    found = jax.jit(lambda start: config.sample(denoise, start))(start)
    np.testing.assert_allclose(found, x0, atol=5e-3)
    assert set(told) == {((2,), ())}


@every
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_the_sample_has_the_precision_of_the_noise(config, dtype):
    start = jnp.ones((1, 2, 3), dtype)
    out = dataclasses.replace(config, sample_steps=2).sample(lambda x, *_: jnp.tanh(x), start)
    assert out.dtype == dtype


@pytest.mark.parametrize(
    "config", [EDMConfig(sigma_data=0.5), EDMConfig(sigma_data=1.7)], ids=["half", "wide"]
)
@pytest.mark.parametrize("sigma", [0.01, 0.5, 3.0, 40.0])
def test_what_edm_shows_and_asks_for_has_unit_variance(config, sigma):
    """Monte Carlo, 40,000 values: a variance is known to 0.7 %."""
    x0, eps = draw(0, 2, 1, 40_000)
    x0 = config.sigma_data * x0
    times = jnp.full((1,), sigma)
    shown, told = config.precondition(config.corrupt(x0, eps, times), times)
    assert abs(float(shown.var()) - 1) < 0.03
    assert abs(float(config.prediction_target(x0, eps, times).var()) - 1) < 0.03
    np.testing.assert_allclose(told, np.log(sigma) / 4, rtol=1e-5)


@examples(20)
@given(
    steps=st.integers(2, 40),
    least=st.floats(1e-3, 0.1),
    most=st.floats(1.0, 200.0),
    rho=st.floats(1.0, 9.0),
)
def test_edm_visits_the_levels_of_equation_5(steps, least, most, rho):
    config = EDMConfig(sigma_min=least, sigma_max=most, rho=rho, sample_steps=steps)
    wanted = [
        (most ** (1 / rho) + i / (steps - 1) * (least ** (1 / rho) - most ** (1 / rho))) ** rho
        for i in range(steps)
    ]
    np.testing.assert_allclose(config.levels(), wanted, rtol=1e-9)


def test_edm_steps_by_algorithm_1():
    """Karras et al., Alg. 1, in plain NumPy."""
    start = draw(0, 1, 2, 3)
    for kind in ("euler", "heun"):
        config = EDMConfig(sampler=kind, sample_steps=6)
        sigmas = np.append(config.levels(), 0)
        x = start.astype(np.float64) * sigmas[0]
        for now, then in itertools.pairwise(sigmas):
            slope = (x - np.tanh(x)) / now
            ahead = x + (then - now) * slope
            if kind == "heun" and then > 0:
                ahead = x + (then - now) * (slope + (ahead - np.tanh(ahead)) / then) / 2
            x = ahead
        found = config.sample(lambda x, *_: jnp.tanh(x), start)
        np.testing.assert_allclose(found, x, rtol=1e-4, atol=1e-5)


SOLVED = {
    "euler": EDMConfig(sample_steps=400),
    "heun": EDMConfig(sample_steps=60, sampler="heun"),
    "flow": FlowConfig(sample_steps=400),
    "flow_shifted": FlowConfig(sample_steps=400, shift=2.0),
}


def gaussian_denoiser(config, mean, spread):
    """The best denoiser where data are N(mean, spread²)."""

    def denoise(x, times, _weight):
        now = Noise.expand(times, x.ndim)
        signal = 1 - now if isinstance(config, FlowConfig) else 1.0
        gain = signal * spread**2 / (signal**2 * spread**2 + now**2)
        return mean + gain * (x - signal * mean)

    return denoise


@pytest.mark.parametrize("config", SOLVED.values(), ids=SOLVED)
def test_samplers_end_in_the_distribution_of_the_data(config):
    start = jnp.asarray(draw(0, 1, 1, 4000))
    denoise = gaussian_denoiser(config, 0.7, 0.2)
    out = jax.jit(lambda x: config.sample(denoise, x))(start)
    assert abs(float(out.mean()) - 0.7) < 0.03
    assert abs(float(out.std()) - 0.2) < 0.03


def test_heun_is_nearer_to_the_exact_path_than_euler():
    """For Gaussian data the flow is known: x − m shrinks like √(s² + σ²)."""
    start, order = draw(0, 1, 1, 50), {}
    for kind in ("euler", "heun"):
        far = []
        for steps in (24, 48):
            config = EDMConfig(sampler=kind, sample_steps=steps, sigma_max=20.0)
            end = config.sample(gaussian_denoiser(config, 0.7, 0.2), jnp.asarray(start))
            exact = 0.7 + (20 * start - 0.7) * 0.2 / np.hypot(0.2, 20)
            far.append(np.abs(np.asarray(end) - exact).max())
        order[kind] = np.log2(far[0] / far[1])
    assert 0.8 < order["euler"] < 1.3, "of first order"
    assert order["heun"] > 1.7, "of second order"


def test_flow_takes_a_time_for_every_frame():
    config = FlowConfig()
    x0, eps = draw(0, 2, 2, 3, 4, 5)
    times = jnp.asarray(np.random.default_rng(1).uniform(size=(2, 3)), jnp.float32)
    x_t = config.corrupt(x0, eps, times)
    for b in range(2):
        for k in range(3):
            alone = config.corrupt(x0[b : b + 1, k], eps[b : b + 1, k], times[b, k][None])
            np.testing.assert_array_equal(x_t[b, k], alone[0])
    asked = config.prediction_target(x0, eps, times)
    np.testing.assert_allclose(config.to_x0(asked, x_t, times), x0, atol=1e-6)
    _, told = config.precondition(x_t, times)
    np.testing.assert_allclose(told, 1000 * times)
    assert config.weight(times).shape == (2, 3)
    same = jnp.broadcast_to(times[:, :1], (2, 3))
    np.testing.assert_array_equal(
        config.corrupt(x0, eps, same), config.corrupt(x0, eps, times[:, 0])
    )


@every
def test_training_draws_one_time_for_a_clip_from_the_whole_range(config):
    times = np.asarray(config.draw(jax.random.key(0), 4000, 3))
    assert times.shape == (4000,)
    if isinstance(config, EDMConfig):
        np.testing.assert_allclose(np.log(times).mean(), config.log_mean, atol=0.1)
        np.testing.assert_allclose(np.log(times).std(), config.log_std, atol=0.1)
        return
    top = 1000 if isinstance(config, DDPMConfig) else 1
    assert times.min() >= 0
    assert times.max() <= top
    assert times.min() < 0.1 * top < 0.9 * top < times.max()


def test_flow_draws_a_time_for_every_frame_if_asked():
    for times in ("uniform", "logit_normal"):
        config = FlowConfig(per_frame=True, times=times)
        drawn = np.asarray(config.draw(jax.random.key(0), 50, 3))
        assert drawn.shape == (50, 3)
        assert np.abs(np.diff(drawn, axis=1)).min() > 0


@pytest.mark.slow
def test_training_with_a_time_for_every_frame(monkeypatch):
    clip, key, train = make_clip(), jax.random.key(0), TrainConfig()
    params = random_world(TINY, memory=False)

    def loss(config):
        model = tiny_model(noise=config)
        compute = jax.jit(lambda params: objective.without_memory(model, train, params, clip, key))
        return float(compute(params)[0])

    apart, together = (loss(FlowConfig(per_frame=each)) for each in (True, False))
    assert np.isfinite([apart, together]).all()
    assert apart != together
    fixed = jnp.asarray([0.3, 0.8])
    monkeypatch.setattr(FlowConfig, "draw", lambda *_: fixed)
    one = loss(FlowConfig())
    monkeypatch.setattr(FlowConfig, "draw", lambda *_: jnp.broadcast_to(fixed[:, None], (2, 3)))
    np.testing.assert_allclose(loss(FlowConfig()), one, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("config", [EDMConfig(), FlowConfig(per_frame=True)], ids=["edm", "flow"])
def test_both_stages_train_with_every_noise(config):
    model, clip = tiny_model(noise=config), make_clip()
    params = random_world(TINY)

    @jax.jit
    def slopes(params):
        def total(params):
            return objective.with_memory(model, TrainConfig(), params, clip, jax.random.key(0))[0]

        return jax.value_and_grad(total)(params)

    value, slope = slopes(params)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    for part in ("backbone", "memory"):
        assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope[part])) > 0
