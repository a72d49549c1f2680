"""The learned codec: shapes, any number of frames, refusals, and a model that is built with it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ClipConfig, Codec, ConfigError, UserError, from_dict
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.worlds import objective
from pewm_jax.worlds.codec import CodecTask
from tests.helpers import init_world, random_frames, randomised, tiny_model

TINY = LearnedCodecConfig(latent_channels=4, fine=8, coarse=12, fine_blocks=1, coarse_blocks=1)
init = jax.jit(LearnedCodecConfig.init, static_argnums=0)
encode = jax.jit(LearnedCodecConfig.encode, static_argnums=0)
decode = jax.jit(LearnedCodecConfig.decode, static_argnums=0)


@pytest.fixture(scope="module")
def params():
    return randomised(TINY.init, jax.random.key(0))


def videos(*shape, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (*shape, 3)).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1, 8, 8), (1, 9, 16, 24), (3, 2, 24, 8)])
def test_latents_are_an_eighth_of_the_frame_each_way_and_come_back(params, shape):
    batch, frames, height, width = shape
    latents = encode(TINY, params, videos(*shape))
    assert latents.shape == (batch, frames, height // 8, width // 8, 4)
    assert decode(TINY, params, latents).shape == (*shape, 3)


def test_frames_are_coded_each_by_itself_under_jit_or_not(params):
    video = videos(2, 3, 16, 24)
    latents = encode(TINY, params, video)
    made = decode(TINY, params, latents)
    for b in range(2):
        for t in range(3):
            one = TINY.encode(params, video[b : b + 1, t : t + 1])
            np.testing.assert_allclose(one[0, 0], latents[b, t], atol=1e-5, rtol=1e-5)
            back = TINY.decode(params, one)
            np.testing.assert_allclose(back[0, 0], made[b, t], atol=1e-4, rtol=1e-4)


def test_normalised_latents_have_mean_0_and_variance_1_and_decode_the_same(params):
    video = videos(4, 2, 16, 24)
    raw = np.asarray(encode(TINY, params, video))
    fresh = init(TINY, jax.random.key(0))
    unit = params | {name: fresh[name] for name in ("latent_mean_C", "latent_scale_C")}
    raw = np.asarray(encode(TINY, unit, video))
    places = (0, 1, 2, 3)
    fitted = {**unit, "latent_mean_C": raw.mean(places), "latent_scale_C": raw.std(places)}
    latents = np.asarray(encode(TINY, fitted, video))
    np.testing.assert_allclose(latents.mean(places), 0, atol=1e-5)
    np.testing.assert_allclose(latents.var(places), 1, atol=1e-4)
    np.testing.assert_allclose(decode(TINY, fitted, latents), decode(TINY, unit, raw), atol=1e-4)


@pytest.mark.parametrize(
    ("video", "says"),
    [
        (videos(1, 2, 12, 16), "12×16 pixels and 3 colours .* multiples of 8 pixels"),
        (videos(1, 2, 16, 20), "16×20 pixels and 3 colours .* multiples of 8 pixels"),
        (videos(1, 2, 16, 16)[..., :1], "1 colours cannot be encoded"),
    ],
)
def test_sizes_that_do_not_fit_are_refused_in_a_sentence(params, video, says):
    with pytest.raises(UserError, match=says):
        TINY.encode(params, video)


def test_settings_that_cannot_work_are_refused_in_a_sentence():
    with pytest.raises(ConfigError, match=r"codec has no setting temporal; it has coarse, "):
        from_dict(Codec, {"kind": "learned", "temporal": 4}, "codec")
    with pytest.raises(ConfigError, match=r"codec\.coarse is 0: use at least 1"):
        LearnedCodecConfig(coarse=0)
    with pytest.raises(ConfigError, match=r"multiples of codec\.spatial × backbone\.patch = 16"):
        tiny_model(codec=TINY, clip=ClipConfig(height=24, width=24))
    with pytest.raises(ConfigError, match=r"multiples of codec\.spatial = 8"):
        CodecTask(codec=TINY, clip=ClipConfig(height=20, width=24))


def test_the_default_has_at_most_three_million_parameters_as_its_layout_says():
    config = LearnedCodecConfig()
    shapes = jax.eval_shape(lambda: config.init(jax.random.key(0)))
    count = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    assert 1e6 < count <= 3e6


def model():
    return tiny_model(
        codec=TINY,
        clip=ClipConfig(frames=3, height=16, width=32),
        backbone=DiTBackbone(
            layers=1, heads=2, head_dim=16, patch=1, text_length=1, text_dim=8, time_dim=16
        ),
    )


@pytest.mark.slow
def test_colour_and_depth_go_through_the_same_weights(params):
    world, rng = model(), np.random.default_rng(0)
    rgb = videos(2, 3, 16, 32)
    depth = rng.uniform(0.5, 4, (2, 3, 16, 32)).astype(np.float32)
    weights = {"codec": params}
    outside = rgbd.encode_rgbd(world, weights, rgb, depth)
    assert outside.shape == (2, *world.latent_shape, 8)
    inside = jax.jit(rgbd.encode_rgbd, static_argnums=0)(world, weights, rgb, depth)
    np.testing.assert_allclose(inside, outside, atol=1e-5)
    colours, metres = rgbd.decode_rgbd(world, weights, outside)
    assert colours.shape == rgb.shape
    assert metres.shape == depth.shape
    assert rgbd.measured(world, depth).shape == (2, *world.latent_shape, 1)


@pytest.mark.slow
def test_a_world_model_with_it_is_built_and_traced():
    world = model()
    assert isinstance(world.codec, LearnedCodecConfig)
    weights = init_world(world)
    frames = random_frames(np.random.default_rng(0), 3, 16, 32)
    clip = jax.tree.map(lambda x: jnp.asarray(x)[None], frames)
    batch = objective.Clip(clip, clip, jnp.ones((1, 3), bool))
    loss, parts = jax.eval_shape(
        lambda w: objective.with_memory(
            world, dataclasses.replace(world.TRAIN()), w, batch, jax.random.key(0)
        ),
        weights,
    )
    assert loss.shape == ()
    assert set(parts) == {"loss_rgb", "loss_depth"}
