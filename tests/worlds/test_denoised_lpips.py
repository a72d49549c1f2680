"""LPIPS of denoised frames: what it measures, its weight in the loss, and who may use it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.codecs.signals import signal_from_rgb
from pewm_jax.config import ConfigError, TrainConfig, UserError
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.lpips import convert
from pewm_jax.models.lpips import model as lpips
from pewm_jax.types import Clip
from pewm_jax.worlds import objective
from tests.helpers import TINY, init_world, random_frames, tiny_config

SIZE = 32
MODEL = dataclasses.replace(
    TINY,
    clip=dataclasses.replace(TINY.clip, frames=3, height=SIZE, width=SIZE),
    codec=PixelConfig(spatial=4, temporal=1),
    noise=EDMConfig(sigma_data=1.0),
)
NETWORK = lpips.init("alex", jax.random.key(0))
TRAIN = TrainConfig(denoised_lpips=0.5, denoised_lpips_net="alex")


def clips(batch=2):
    rng = np.random.default_rng(0)
    made = [
        Clip(random_frames(rng, 3, SIZE, SIZE), random_frames(rng, 2, SIZE, SIZE), np.ones(2, bool))
        for _ in range(batch)
    ]
    return jax.tree.map(lambda *x: np.stack(x), *made)


def test_it_is_that_of_one_frame_and_counts_less_in_noise():
    clip = clips()
    params = {"codec": {}, "lpips": NETWORK}
    colours = signal_from_rgb(jnp.asarray(clip.frames.rgb_THWC))
    x0 = jnp.concatenate([MODEL.codec.encode({}, colours)] * 2, -1)

    @jax.jit
    def measured(x0, sigma, key):
        times = jnp.full((2,), sigma)
        denoised = objective.one_frame(MODEL, clip, x0, times, key)
        return objective.denoised_distance(MODEL, "alex", params, denoised)

    key, off = jax.random.key(1), x0.at[..., 0].add(0.5)
    assert float(measured(x0, 1e-3, key)) == pytest.approx(0, abs=1e-5)
    near = float(measured(off, 1e-3, key))
    assert near > 1e-4
    assert float(measured(off, 1.0, key)) == pytest.approx(near / 2, rel=1e-3)
    assert float(measured(off, 20.0, key)) == pytest.approx(near / 401, rel=1e-2)
    last = x0.at[:, 2, ..., 0].add(0.5)  # only the last frame differs
    found = [float(measured(last, 1e-3, jax.random.key(seed))) for seed in range(8)]
    assert min(found) < 1e-5 < max(found)
    first = x0.at[:, 0].add(0.5)  # it was observed, and is never compared
    assert all(float(measured(first, 1e-3, jax.random.key(s))) < 1e-5 for s in range(8))


@pytest.mark.slow
def test_it_is_added_with_its_weight_in_the_stages_that_have_it():
    params = init_world(MODEL) | {"lpips": NETWORK}
    clip, key = clips(), jax.random.key(2)

    def losses(train, loss):
        return jax.jit(lambda p: loss(MODEL, train, p, clip, key))(params)

    plain, few = losses(TrainConfig(), objective.joint)
    whole, parts = losses(TRAIN, objective.joint)
    assert "lpips" not in few
    assert float(whole) == pytest.approx(float(plain) + 0.5 * float(parts["lpips"]), rel=1e-5)
    equal = dataclasses.replace(TRAIN, denoised_lpips_weights="equal")
    whole, all_parts = losses(equal, objective.joint)
    assert float(all_parts["lpips"]) > float(parts["lpips"])
    assert float(whole) == pytest.approx(float(plain) + 0.5 * float(all_parts["lpips"]), rel=1e-5)
    other, few = losses(TRAIN, objective.with_memory)
    assert "lpips" not in few
    np.testing.assert_allclose(other, plain, rtol=1e-6)


def test_it_is_outside_the_choice_between_whole_clips_and_drawn_frames():
    params = init_world(MODEL) | {"lpips": NETWORK}
    clip, key = clips(), jax.random.key(2)
    stage = dataclasses.replace(TRAIN.joint, frames=1, whole=0.5)
    kernels = [params["lpips"]["net"][f"conv_{k}"]["kernel"].shape for k in range(5)]

    def inside(train):
        traced = jax.make_jaxpr(lambda p: objective.joint(MODEL, train, p, clip, key))(params)
        return str([e for e in traced.eqns if e.primitive.name == "cond"])

    train = dataclasses.replace(TRAIN, joint=stage)
    text = inside(train)
    assert text != "[]"
    for shape in kernels:
        assert f"f32[{','.join(map(str, shape))}]" not in text


def test_its_network_is_loaded_for_these_stages_alone(monkeypatch):
    config = dataclasses.replace(tiny_config(), model=MODEL, train=TRAIN)
    monkeypatch.setattr(convert, "find", lambda *_: None)
    monkeypatch.setattr(convert, "read", lambda _, net: (net, NETWORK))
    stages = {stage.name: stage for stage in worlds.stages(config)}
    assert stages["joint"].extra_weights(MODEL, TRAIN) == {"lpips": NETWORK}
    assert stages["joint"].extra_weights(MODEL, TrainConfig()) is None
    assert stages["stage2"].extra_weights is None


def test_it_needs_a_codec_of_single_frames_and_a_weight_of_0_or_more():
    with pytest.raises(UserError, match="one latent frame of 4 frames"):
        objective.perceptual_weights(TINY, TRAIN)
    with pytest.raises(ConfigError, match=r"train\.denoised_lpips is -1"):
        dataclasses.replace(TRAIN, denoised_lpips=-1)
