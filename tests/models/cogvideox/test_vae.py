"""What the autoencoder promises by itself: counts, causality, refusals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import ConfigError, UserError
from pewm_jax.models.cogvideox import vae, vae_layers
from pewm_jax.models.cogvideox.convert import VAE
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.nn import layers, target, video_convolution
from tests.helpers import randomised

TINY = VAECodec(
    widths=(4, 4, 4), resnets=1, groups=2, latent_channels=2, sample_height=16, sample_width=16
)


@pytest.fixture(scope="module")
def params():
    return randomised(vae.init, TINY, jax.random.key(0), scale=0.3)


def video(frames, height=8, width=8, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(-1, 1, (1, frames, height, width, 3)), jnp.float32)


def reach(params, frames, latents):
    """Return (latents, frames): whether a latent's sum of squares has a gradient at a frame."""
    config = dataclasses.replace(TINY, convolution="taps")

    def totals(x):
        return jnp.square(vae.encode(config, params, x)[0][:, :latents]).sum((0, 2, 3, 4))

    slopes = jax.jit(jax.jacrev(totals))(video(frames))
    return np.asarray(jnp.abs(slopes).sum((1, 3, 4, 5)) > 0)


@pytest.mark.slow
def test_with_statistics_held_fixed_a_latent_depends_on_no_later_frame(params, monkeypatch):
    statistics = vae_layers.group_norm_affine

    def fixed(p, x, *settings):
        return jax.lax.stop_gradient(statistics(p, x, *settings))

    monkeypatch.setattr(vae_layers, "group_norm_affine", fixed)
    jax.clear_caches()
    seen = reach(params, 9, 3)
    jax.clear_caches()
    latent, frame = np.mgrid[:3, :9]
    assert not seen[frame > 4 * latent].any()
    assert seen[(frame <= 4 * latent) & (frame > 4 * latent - 4)].all()


@pytest.mark.slow
def test_statistics_reach_to_the_end_of_the_chunk_and_no_further(params):
    seen = reach(params, 17, 1)
    np.testing.assert_array_equal(seen[0], np.arange(17) < 9)


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1, 9])
def test_weights_stored_in_fewer_bits_are_computed_with_in_full(params, frames):
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), params)
    full = jax.tree.map(lambda x: x.astype(jnp.float32), half)
    config = dataclasses.replace(TINY, convolution="winograd")
    x = video(frames, 16, 16)
    pairs = []
    for weights in (half, full):
        mean, _ = vae.encode(config, weights, x)
        pairs.append((mean, vae.decode(config, weights, x[:, : mean.shape[1], ::4, ::4, :2])))
    for got, wanted in zip(*pairs, strict=True):
        assert got.dtype == jnp.float32
        np.testing.assert_allclose(got, wanted, atol=1e-5 * np.abs(wanted).max())


@given(latents=st.integers(1, 60))
def test_odd_counts_of_latents_come_back_and_even_ones_do_not(latents):
    frames = vae.frames_of(TINY, latents)
    assert vae.latents_of(TINY, frames) == latents
    assert (frames % 8 == 1) == (latents % 2 == 1)


@pytest.mark.parametrize("frames", [0, 2, 3, 4, 6, 7, 10, 12])
def test_frames_that_would_be_folded_askew_are_refused(params, frames):
    with pytest.raises(UserError, match="8N \\+ 1"):
        vae.encode(TINY, params, video(frames))


def test_surprising_sizes_are_told(params, caplog):
    mean, _ = vae.encode(TINY, params, video(5, 9, 8))
    assert mean.shape == (1, 2, 2, 2, 2)
    assert "5 frames become 2 latents" in caplog.text
    assert "9×8 pixels is no multiple of 4: it will decode to 8×8" in caplog.text


def test_tiles_that_do_not_join_are_told(caplog):
    config = dataclasses.replace(TINY, tiling=True, tile_height=12, tile_overlap_height=0.5)
    for height, told in ((24, True), (12, False)):
        caplog.clear()
        x = jnp.zeros((1, 1, height, 8, 3))
        vae.in_tiles(lambda x: x[:, :, ::4, ::4], x, config, shrink=True)
        assert ("do not join" in caplog.text) == told


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (video(9)[0], "five axes"),
        (video(9)[..., :2], "3 channels last"),
        (jnp.zeros((1, 9, 8, 8, 3), jnp.uint8), "floats"),
        (video(9, 2, 8), "smaller than one latent"),
    ],
)
def test_what_is_no_video_is_refused(params, wrong, sentence):
    with pytest.raises(UserError, match=sentence):
        vae.encode(TINY, params, wrong)


def test_the_log_variance_is_clipped(params):
    bias = params["encoder"]["conv_out"]["bias"].at[2:].set(jnp.array([1e3, -1e3]))
    conv_out = {**params["encoder"]["conv_out"], "bias": bias}
    _, logvar = vae.encode(TINY, {"encoder": {**params["encoder"], "conv_out": conv_out}}, video(1))
    np.testing.assert_array_equal(logvar[..., 0], 20)
    np.testing.assert_array_equal(logvar[..., 1], -30)


@given(frames=st.integers(1, 64))
def test_tiles_of_time_cover_every_frame_and_save_a_third(frames):
    cut = video_convolution._split(frames)
    assert sum(size * count for size, count in cut) == frames
    convolutions = sum((size + 2) * count for size, count in cut)
    assert convolutions == min(
        6 * a + 5 * b + 4 * c + 3 * (frames - 4 * a - 3 * b - 2 * c)
        for a in range(frames // 4 + 1)
        for b in range((frames - 4 * a) // 3 + 1)
        for c in range((frames - 4 * a - 3 * b) // 2 + 1)
    )


@given(size=st.sampled_from([2, 3, 4]), seed=st.integers(0, 99))
def test_the_minimal_filter_is_a_filter(size, seed):
    rng = np.random.default_rng(seed)
    taps, inputs = rng.normal(size=3), rng.normal(size=size + 2)
    out_of, weigh, into = video_convolution.minimal_filter(size)
    out = out_of @ ((weigh @ taps) * (into @ inputs))
    np.testing.assert_allclose(out, np.correlate(inputs, taps), atol=1e-12)


@pytest.mark.parametrize("frames", [3, 5, 6])
def test_every_form_of_a_convolution_agrees(frames):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(2, frames + 2, 11, 9, 3)), jnp.float32)
    kernel = {
        "kernel": jnp.asarray(rng.normal(size=(3, 3, 3, 3, 2)), jnp.float32),
        "bias": jnp.asarray(rng.normal(size=2), jnp.float32),
    }
    volume, *others = (
        video_convolution.convolve(form, kernel, x)
        for form in ("volume", "stacked", "frames", "taps", "winograd")
    )
    for other in others:
        np.testing.assert_allclose(other, volume, atol=1e-4)


@pytest.mark.slow(but="1")
@pytest.mark.parametrize("frames", [1, 17])
def test_frames_are_normalised_and_convolved_one_after_the_other(params, frames):
    forms = [dataclasses.replace(TINY, convolution=form) for form in ("volume", "frames")]
    means = [vae.encode(config, params, video(frames))[0] for config in forms]
    np.testing.assert_allclose(*means, atol=1e-4)
    decoded = [vae.decode(config, params, means[0]) for config in forms]
    np.testing.assert_allclose(*decoded, atol=1e-4)


def test_on_tpus_the_decoder_computes_frame_by_frame():
    with target.use(target.Target("tpu")):
        found = [
            video_convolution.form("auto", jnp.bfloat16, videos, decodes=decodes)
            for videos, decodes in ((1, True), (2, True), (2, False), (1, False))
        ]
    assert found == ["frames", "frames", "stacked", "volume"]


def test_a_doubled_frame_is_convolved_without_being_made():
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(2, 2, 3, 5, 3)), jnp.float32)
    kernel = {
        "kernel": jnp.asarray(rng.normal(size=(3, 3, 3, 4)), jnp.float32),
        "bias": jnp.asarray(rng.normal(size=4), jnp.float32),
    }
    doubled = jnp.repeat(jnp.repeat(x, 2, axis=2), 2, axis=3)
    wanted = video_convolution.convolve_frames(kernel, doubled, 1, video_convolution.SAME)
    np.testing.assert_allclose(
        video_convolution.convolve_upsampled(kernel, x), wanted, rtol=1e-4, atol=1e-4
    )


def test_group_norm_keeps_its_digits_far_from_zero():
    x = np.random.default_rng(0).normal(size=(1, 3, 4, 4, 4))
    p = {"scale": jnp.ones(4), "bias": jnp.zeros(4)}
    far = jnp.asarray(x + 1000, jnp.float32)
    factor, offset = layers.group_norm_affine(p, far, 2, 1e-6)
    grouped = x.reshape(1, -1, 2, 2)
    wanted = 1 / grouped.std((1, 3))
    np.testing.assert_allclose(factor[0, ::2], wanted[0], rtol=1e-3)
    np.testing.assert_allclose(-offset / factor, 1000, rtol=1e-3)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"widths": ()}, "at least one level"),
        ({"widths": (6, 8, 8)}, "does not divide"),
        ({"temporal": 3}, "1, 2, 4 or 8"),
        ({"temporal": 8}, "as many halvings"),
        ({"scaling_factor": 0.0}, "positive factor"),
        ({"tile_overlap_width": 1.0}, "below 1"),
        ({"tiling": True, "tile_height": 3}, "advance by no latent"),
        ({"eps": 0.0}, "small positive"),
    ],
)
def test_settings_that_cannot_work_are_refused(change, sentence):
    base = dataclasses.asdict(TINY) | {"groups": 4}
    with pytest.raises(ConfigError, match=sentence):
        VAECodec(**{**base, **change})


def test_only_published_names_are_known():
    assert VAECodec.published("1.5-5B-I2V").invert_scale_latents
    assert VAECodec.published("2b").scaling_factor == 1.15258426
    with pytest.raises(ConfigError, match=r"1\.5-5B-I2V"):
        VAECodec.published("7b")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"_class_name": "AutoencoderKL"}, "AutoencoderKL"),
        ({"colour": 1}, "not known: colour"),
        ({"use_quant_conv": True}, "use_quant_conv"),
        ({"act_fn": "gelu"}, "act_fn"),
        ({"scaling_factor": "much"}, "scaling_factor"),
        ({"latent_channels": 2.5}, "latent_channels"),
        ({"block_out_channels": 128}, "block_out_channels"),
        ({"up_block_types": ["CogVideoXUpBlock3D"]}, "up_block_types"),
        ({"invert_scale_latents": 1}, "invert_scale_latents"),
    ],
)
def test_settings_of_a_checkpoint_are_read_strictly(change, sentence):
    values = VAE.write_config(VAECodec())
    with pytest.raises(UserError, match=sentence):
        VAE.read_config({**values, **change})


def test_settings_come_back_from_a_checkpoints_json():
    config = dataclasses.replace(TINY, invert_scale_latents=True, scaling_factor=0.7)
    values = {**VAE.write_config(config), "_diffusers_version": "0.30.0"}
    assert VAE.read_config(values) == config
    assert VAE.read_config({}) == VAECodec()
