import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.codecs import rgbd, signals
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig, ConfigError
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.memory.surfels import SurfelConfig
from tests.helpers import TINY, tiny_config
from tests.properties import examples

encode = jax.jit(PixelConfig.encode, static_argnums=0)
decode = jax.jit(PixelConfig.decode, static_argnums=0)


@examples(15)
@given(
    k=st.integers(0, 3),
    h=st.integers(1, 3),
    w=st.integers(1, 3),
    s=st.sampled_from([1, 2, 4]),
    c=st.integers(1, 3),
)
def test_decode_inverts_encode(k, h, w, s, c):
    config = PixelConfig(spatial=s)
    video = np.random.default_rng(k).normal(size=(2, 4 * k + 1, h * s, w * s, c))
    latents = encode(config, {}, video.astype(np.float32))
    assert latents.shape == (2, k + 1, h, w, 4 * s * s * c)
    np.testing.assert_allclose(decode(config, {}, latents), video, atol=1e-6)


def test_a_latent_frame_holds_only_its_own_frames():
    config = PixelConfig()
    video = np.zeros((1, 9, 8, 8, 1), np.float32)
    video[:, 5] = 1
    changed = np.abs(np.asarray(config.encode({}, video))).sum((0, 2, 3, 4)) > 0
    np.testing.assert_array_equal(changed, [False, False, True])


def test_a_frame_count_that_cannot_be_folded_is_refused():
    with pytest.raises(ValueError, match="4k \\+ 1"):
        PixelConfig().encode({}, np.zeros((1, 8, 8, 8, 3), np.float32))


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_depth_maps_to_the_signal_range_and_back(scale):
    config = ClipConfig(near_m=0.2, far_m=8.0, depth_scale=scale)
    depth = np.linspace(0.2, 8.0, 50, dtype=np.float32)
    signal = signals.signal_from_depth(config, depth)
    np.testing.assert_allclose([signal[0], signal[-1]], [-1, 1], atol=1e-6)
    assert np.all(np.diff(signal) > 0)
    np.testing.assert_allclose(signals.depth_from_signal(config, signal), depth, rtol=1e-4)
    clipped = signals.signal_from_depth(config, np.array([0.0, 99.0], np.float32))
    np.testing.assert_allclose(clipped, [-1, 1], atol=1e-6)


def test_colours_survive_the_way_there_and_back():
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(signals.rgb_from_signal(signals.signal_from_rgb(every)), every)


def test_rgbd_is_encoded_separately_and_concatenated():
    rng = np.random.default_rng(0)
    rgb = rng.uniform(-1, 1, (1, 9, 16, 24, 3)).astype(np.float32)
    depth = rng.uniform(0.2, 8, (1, 9, 16, 24)).astype(np.float32)
    latents = rgbd.encode_rgbd(TINY, {}, rgb, depth)
    other = rgbd.encode_rgbd(TINY, {}, rgb, depth * 0.5)
    split = TINY.codec.rgb_channels
    np.testing.assert_array_equal(latents[..., :split], other[..., :split])
    rgb_back, depth_back = rgbd.decode_rgbd(TINY, {}, latents)
    np.testing.assert_allclose(rgb_back, rgb, atol=1e-6)
    np.testing.assert_allclose(depth_back, depth, rtol=1e-4)


def test_a_gate_needs_an_even_height_and_width():
    odd = {
        "clip": ClipConfig(frames=5, height=15, width=21),
        "memory": SurfelConfig(encoder=PatchColoursConfig(patch=3)),
        "backbone": dataclasses.replace(TINY.backbone, patch=1),
    }
    tiny_config(codec=PixelConfig(spatial=3), **odd)
    with pytest.raises(ConfigError, match=r"clip is 15×21: codec\.gate needs an even height"):
        tiny_config(codec=PixelConfig(spatial=3, gate=8), **odd)
