import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import ConfigError, TrainConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.types import Clip, Control, MemoryReadout
from pewm_jax.worlds import objective, world_model
from tests.helpers import TINY, random_frames, random_world, tiny_model
from tests.worlds.test_world_model import setup


def drawn(config, denoise, noise, key=None, **more):
    """Sample with a denoiser that ignores the weight of guidance."""
    return config.sample(lambda x, levels, _weight: denoise(x, levels), noise, key, **more)


def dpm(**settings):
    return DDPMConfig(sampler="dpm", **settings)


def test_the_schedule_ends_in_pure_noise_and_falls():
    alphas = DDPMConfig().alphas_cumprod()
    assert alphas[-1] == 0
    assert np.all(np.diff(alphas) < 0)
    assert 0.99 < alphas[0] < 1
    shifted = DDPMConfig(snr_shift=3.0).alphas_cumprod()
    assert np.all(shifted[1:-1] < alphas[1:-1]), "a shift above 1 means more noise"


@pytest.mark.parametrize("kind", ["x0", "v", "eps"])
def test_every_target_leads_back_to_x0(kind):
    config = DDPMConfig(target=kind, zero_terminal_snr=kind != "eps")
    rng = np.random.default_rng(0)
    x0, noise = rng.normal(size=(2, 5, 3)).astype(np.float32)
    times = jnp.array([0, 3, 500, 900, 999])
    x_t = config.corrupt(x0, noise, times)
    asked = config.prediction_target(x0, noise, times)
    np.testing.assert_allclose(config.to_x0(asked, x_t, times), x0, atol=2e-3)


def test_weighted_x0_error_equals_v_error():
    config = DDPMConfig(max_weight=1e9)
    rng = np.random.default_rng(0)
    x0, noise, guess = rng.normal(size=(3, 4, 6)).astype(np.float32)
    times = jnp.array([100, 400, 700, 999])
    a = np.sqrt(config.alphas_cumprod())[np.asarray(times)][:, None]
    x_t = np.asarray(config.corrupt(x0, noise, times))
    v_guess = (a * x_t - guess) / np.sqrt(1 - a**2)
    v = dataclasses.replace(config, target="v").prediction_target(x0, noise, times)
    by_v = ((v_guess - v) ** 2).mean(-1)
    by_x0 = config.weight(times) * ((guess - x0) ** 2).mean(-1)
    np.testing.assert_allclose(by_x0, by_v, rtol=1e-3)


def test_epsilon_with_zero_terminal_snr_is_refused():
    with pytest.raises(ConfigError, match="use v or x0"):
        DDPMConfig(target="eps")


@pytest.mark.parametrize("steps", [1, 7, 50])
def test_ddim_with_a_perfect_denoiser_finds_the_truth(steps):
    config = DDPMConfig(sample_steps=steps)
    x0 = np.random.default_rng(0).normal(size=(2, 3)).astype(np.float32)
    noise = jax.random.normal(jax.random.key(0), (2, 3))
    out = jax.jit(lambda n: drawn(config, lambda _x, _t: jnp.asarray(x0), n))(noise)
    np.testing.assert_allclose(out, x0, atol=1e-6)


def test_ddim_keeps_the_noise_of_its_path():
    """With the exact x0 known, every intermediate x_t is add_noise(x0, the same noise)."""
    config = DDPMConfig(sample_steps=10)
    x0 = jnp.full((1, 4), 0.5)
    noise = jax.random.normal(jax.random.key(1), (1, 4))
    seen = []

    def denoise(x, times):
        jax.debug.callback(lambda a, b: seen.append((np.array(a), np.array(b))), x, times)
        return x0

    jax.block_until_ready(drawn(config, denoise, noise))
    jax.effects_barrier()
    assert len(seen) == 10
    for x, times in seen:
        np.testing.assert_allclose(x, config.corrupt(x0, noise, times), atol=1e-4)


def test_steps_trail():
    steps = DDPMConfig(sample_steps=10).levels()
    np.testing.assert_array_equal(steps, np.arange(999, 0, -100))


def test_every_number_of_steps_is_exactly_that_many_and_starts_at_pure_noise():
    for count in range(1, 1001):
        steps = DDPMConfig(sample_steps=count).levels()
        assert len(steps) == count
        assert steps[0] == 999
        assert steps[-1] >= 0
        assert np.all(np.diff(steps) < 0), count


def make_clip(seed=0, batch=2, context=3):
    rng = np.random.default_rng(seed)
    clips = [
        Clip(
            random_frames(rng, TINY.clip.frames),
            random_frames(rng, context),
            np.arange(context) > 0,
        )
        for _ in range(batch)
    ]
    return jax.tree.map(lambda *x: np.stack(x), *clips)


sample = jax.jit(world_model.sample, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def conditioning_of(model, params, clip):
    """What the clips' first frames and cameras say."""
    frames = jax.tree.map(jnp.asarray, as_signal(clip.frames))
    observed = jax.tree.map(lambda x: x[:, :1], frames)
    return world_model.condition(model, params, observed, Control(frames.camera))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["x0", "v"])
def test_the_loss_is_finite_and_stage_1_ignores_the_memory(kind):
    model, train = tiny_model(noise=DDPMConfig(target=kind)), TrainConfig()
    clip, key = make_clip(), jax.random.key(0)
    params = random_world(model)
    other = dataclasses.replace(clip, context=jax.tree.map(np.zeros_like, clip.context))
    loss = jax.jit(objective.loss, static_argnums=(0, 1), static_argnames="memory")
    stage1 = [float(loss(model, train, params, c, key, memory=False)[0]) for c in (clip, other)]
    stage2 = [float(loss(model, train, params, c, key, memory=True)[0]) for c in (clip, other)]
    assert np.isfinite(stage1 + stage2).all()
    assert stage1[0] == stage1[1]
    assert stage2[0] != stage2[1]


def test_pixels_without_depth_do_not_train_depth():
    clip, key = make_clip(), jax.random.key(0)
    params = random_world(TINY, memory=False)
    loss = jax.jit(objective.without_memory, static_argnums=(0, 1))
    blank = dataclasses.replace(
        clip, frames=dataclasses.replace(clip.frames, depth_THW=clip.frames.depth_THW * 0)
    )
    _, parts = loss(TINY, TrainConfig(), params, blank, key)
    assert float(parts["loss_depth"]) == 0
    _, parts = loss(TINY, TrainConfig(), params, clip, key)
    assert float(parts["loss_depth"]) > 0


@pytest.mark.slow
def test_invalid_context_frames_are_not_remembered():
    clip = make_clip()
    tokens = objective.clip_readout(TINY, {}, clip).tokens
    changed = np.array(clip.context.rgb_THWC)
    changed[:, 0] = 255 - changed[:, 0]
    context = dataclasses.replace(clip.context, rgb_THWC=changed)
    again = objective.clip_readout(TINY, {}, dataclasses.replace(clip, context=context)).tokens
    np.testing.assert_array_equal(tokens.features_MF, again.features_MF)
    assert tokens.valid_M.any()


@pytest.mark.slow(but="a function")
@pytest.mark.parametrize("network", ["a function", "the transformer"])
def test_guidance_interpolates_between_with_and_without_map(network, monkeypatch):
    model, conditioning, tokens, noise, _ = setup()
    params, readout = random_world(model), MemoryReadout(tokens)

    def function(model, params, x, given, times, readout=None):
        return jnp.sin(x) if readout is None else jnp.cos(x) * readout.tokens.features_MF.mean()

    if network == "a function":
        monkeypatch.setattr(world_model, "apply", function)

    def run(guidance, readout, **more):
        settings = dataclasses.replace(TINY.noise, guidance=guidance, sample_steps=1, **more)
        guided = dataclasses.replace(model, noise=settings)
        # Traced anew: what was traced before holds the other network.
        traced = jax.jit(lambda *inputs: world_model.sample(guided, *inputs))
        return traced(params, conditioning, readout, noise)

    with_map, without = run(1.0, readout), run(1.0, None)
    np.testing.assert_allclose(run(0.0, readout), without, atol=1e-5)
    np.testing.assert_allclose(run(3.0, readout), without + 3 * (with_map - without), atol=1e-3)
    assert np.abs(with_map - without).max() > 1e-4
    settings = DDPMConfig(sample_steps=1, guidance=3.0, dynamic_guidance=True)
    (weight,) = settings.guidance_weights()
    assert 1 <= weight <= 4
    swung = run(3.0, readout, dynamic_guidance=True)
    np.testing.assert_allclose(swung, without + weight * (with_map - without), atol=1e-3)


@pytest.mark.parametrize("kind", ["ddim", "dpm"])
@pytest.mark.parametrize("target", ["x0", "v", "eps"])
def test_the_sampler_finds_the_mean_of_a_gaussian_whatever_the_network_predicts(kind, target):
    """For data N(m, s²) the best prediction is known: both samplers end in that distribution."""
    config = DDPMConfig(
        target=target, sampler=kind, sample_steps=200, zero_terminal_snr=target != "eps"
    )
    mean, spread = 0.7, 0.2
    alphas = jnp.asarray(config.alphas_cumprod(), jnp.float32)

    def denoise(x, times):
        a = alphas[times][:, None]
        gain = jnp.sqrt(a) * spread**2 / (a * spread**2 + 1 - a)
        x0 = mean + gain * (x - jnp.sqrt(a) * mean)
        noise = (x - jnp.sqrt(a) * x0) / jnp.sqrt(1 - a)
        asked = {"x0": x0, "eps": noise, "v": jnp.sqrt(a) * noise - jnp.sqrt(1 - a) * x0}[target]
        return config.to_x0(asked, x, times)

    start, key = jax.random.normal(jax.random.key(0), (1, 4000)), jax.random.key(1)
    out = drawn(config, denoise, start, key)
    assert abs(float(out.mean()) - mean) < 0.03
    assert abs(float(out.std()) - spread) < 0.03


def test_dpm_draws_its_noise_from_the_key_or_takes_it():
    config = dpm(sample_steps=4)
    start, key = jax.random.normal(jax.random.key(0), (2, 3)), jax.random.key(1)
    steps = jnp.stack([jax.random.normal(jax.random.fold_in(key, k), (2, 3)) for k in range(4)])

    def denoise(x, _times):
        return jnp.tanh(x)

    by_key = drawn(config, denoise, start, key)
    given = drawn(config, denoise, start, step_noise=steps)
    np.testing.assert_allclose(by_key, given, atol=1e-6)
    assert np.abs(by_key - drawn(config, denoise, start, jax.random.key(2))).max() > 1e-3
    path = drawn(config, denoise, start, key, every_step=True)
    assert path.shape == (4, 2, 3)
    np.testing.assert_allclose(path[-1], by_key, atol=1e-6)


@pytest.mark.parametrize("more", [{}, {"key": jax.random.key(0), "step_noise": np.zeros((4, 2))}])
def test_dpm_needs_a_key_or_noise(more):
    with pytest.raises(ValueError, match="give it a key"):
        drawn(dpm(sample_steps=4), lambda x, _t: x, jnp.zeros((2,)), **more)
    with pytest.raises(ValueError, match=r"it needs \(4, 2\)"):
        drawn(
            dpm(sample_steps=4),
            lambda x, _t: x,
            jnp.zeros((2,)),
            step_noise=np.zeros((3, 2)),
        )


def test_the_sample_has_the_precision_of_the_noise():
    start = jnp.ones((1, 2), jnp.bfloat16)
    for config in (DDPMConfig(sample_steps=4), dpm(sample_steps=4)):
        out = drawn(config, lambda x, _t: jnp.tanh(x), start, jax.random.key(0))
        assert out.dtype == jnp.bfloat16


def test_a_fixed_stride_differs_only_where_the_steps_do_not_divide():
    def path(steps, stride):
        config = DDPMConfig(sample_steps=steps, stride=stride)
        return drawn(config, lambda x, _t: jnp.tanh(x), jnp.ones((1, 2)))

    np.testing.assert_array_equal(path(10, "next"), path(10, "fixed"))
    assert np.abs(path(7, "next") - path(7, "fixed")).max() > 1e-4


@pytest.mark.slow
def test_the_world_model_samples_by_dpm_with_its_own_noise():
    model = tiny_model(noise=DDPMConfig(sampler="dpm", sample_steps=2))
    clip, key = make_clip(batch=1), jax.random.key(0)
    params = random_world(model, memory=False)
    conditioning = conditioning_of(model, params, clip)
    noise = jax.random.normal(key, (1, 3, 4, 6, 256))
    draw = [sample(model, params, conditioning, None, noise, jax.random.key(k)) for k in (0, 0, 1)]
    np.testing.assert_array_equal(draw[0], draw[1])
    assert np.isfinite(draw[0]).all()
    assert np.abs(draw[0] - draw[2]).max() > 1e-3
    with pytest.raises(ValueError, match="give it a key"):
        sample(model, params, conditioning, None, noise)
