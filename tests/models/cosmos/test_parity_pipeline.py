"""Cosmos-Predict2's scheduler and its pipeline, step by step, with tiny random networks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler

from pewm_jax.config import ConfigError, UserError
from pewm_jax.convert import cosmos, schedulers
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.cosmos import model
from pewm_jax.models.wan import vae as wan_vae
from tests.models.cosmos.references import channels_first, channels_last, scheduler, small_pipeline
from tests.models.svd.references import distance, draw

STEPS, GUIDANCE, FPS, GIVEN_SIGMA = 5, 3.0, 16, 1e-4
FRAMES, SIZE = 9, 16


@pytest.fixture(scope="module")
def pipeline():
    return small_pipeline()


@pytest.fixture(scope="module")
def folder(pipeline, tmp_path_factory):
    found = tmp_path_factory.mktemp("cosmos")
    for part in ("transformer", "vae", "scheduler"):
        getattr(pipeline, part).save_pretrained(found / part)
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # the reference's
def test_what_the_pipeline_samples_is_what_we_sample(pipeline, folder, monkeypatch):
    texts = draw(2, 1, 5, 24)
    start = draw(1, 3, 4, 4, 4, seed=1)
    first = np.tanh(draw(1, 1, SIZE, SIZE, 3, seed=2))
    monkeypatch.setattr(  # the mode instead of a draw
        "diffusers.pipelines.cosmos.pipeline_cosmos2_video2world.retrieve_latents",
        lambda output, _: output.latent_dist.mode(),
    )
    seen = []

    def watch(_pipe, _index, _t, tensors):
        seen.append(channels_last(tensors["latents"]))
        return {}

    pipeline(
        video=torch.tensor((first + 1) / 2).movedim(-1, 2),
        prompt_embeds=torch.tensor(texts[0]),
        negative_prompt_embeds=torch.tensor(texts[1]),
        height=SIZE,
        width=SIZE,
        num_frames=FRAMES,
        num_inference_steps=STEPS,
        guidance_scale=GUIDANCE,
        fps=FPS,
        latents=channels_first(start),
        output_type="latent",
        callback_on_step_end=watch,
    )

    config, params = cosmos.read_transformer(folder)
    codec, codec_params = cosmos.read_vae(folder)
    settings = dataclasses.replace(
        cosmos.read_scheduler(folder), sample_steps=STEPS, guidance=1 + GUIDANCE
    )
    clip = np.repeat(first, FRAMES, 1)
    known = wan_vae.normalise(codec, wan_vae.encode(codec, codec_params, clip)[0])
    is_given = (jnp.arange(3) == 0).astype(jnp.float32)
    mask = is_given[:, None, None, None]

    def denoise(x, sigma_B, weight):
        shown, told = settings.precondition(x, sigma_B)
        _, told_given = settings.precondition(x, jnp.full_like(sigma_B, GIVEN_SIGMA))
        shown = jnp.where(mask > 0, known, shown)
        times = jnp.where(is_given > 0, told_given[:, None], told[:, None])
        marks = jnp.broadcast_to(mask, (*x.shape[:4], 1))
        shown, times, marks = (jnp.repeat(value, 2, 0) for value in (shown, times, marks))
        predicted = model.apply(config, params, shown, times, texts[:, 0], marks, fps=FPS)
        with_text, without = settings.to_x0(predicted, x, sigma_B)
        return jnp.where(mask > 0, known, without + weight * (with_text - without))

    got = jax.jit(functools.partial(settings.sample, denoise))(start)
    assert len(seen) == STEPS
    assert distance(got, seen[-1]) < 1e-4
    assert distance(seen[-1], seen[-2]) == 0  # the reference's last step leads nowhere


def test_every_step_of_the_scheduler_is_ours(folder):
    theirs = FlowMatchEulerDiscreteScheduler.from_pretrained(folder / "scheduler")
    config = cosmos.read_scheduler(folder)
    assert config.sample_steps == 35
    theirs.set_timesteps(sigmas=np.linspace(0, 1, 35))
    sigmas = theirs.sigmas.numpy()
    np.testing.assert_allclose(config.levels(), sigmas[:-1], rtol=1e-5)
    x = torch.tensor(draw(2, 3, 4)) * 80
    for i, t in enumerate(theirs.timesteps[:-1]):
        sigma = sigmas[i][None].repeat(2)
        now = torch.tensor(sigma[0] / (sigma[0] + 1))
        shown, told = config.precondition(x.numpy(), sigma)
        np.testing.assert_allclose(shown, (x * (1 - now)).numpy(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(told, now, rtol=1e-5)
        velocity = torch.tanh(0.7 * x * (1 - now)) + 0.3 * torch.cos(now)
        clean = (1 - now) * x - now * velocity
        ours = config.to_x0(velocity.numpy(), x.numpy(), sigma)
        np.testing.assert_allclose(ours, clean.numpy(), rtol=1e-4, atol=1e-5)
        stepped = theirs.step((x - clean) / sigmas[i], t, x, return_dict=False)[0]
        factor = sigmas[i + 1] / sigmas[i]
        np.testing.assert_allclose(stepped, ours + factor * (x.numpy() - ours), atol=1e-4)
        x = stepped


def test_what_is_corrupted_has_the_velocity_as_its_target():
    config = EDMConfig(target="flow", sigma_data=1.0)
    x0, fresh, sigma = draw(2, 3, 4), draw(2, 3, 4, seed=1), np.float32([0.3, 7])
    noisy = config.corrupt(x0, fresh, sigma)
    target = config.prediction_target(x0, fresh, sigma)
    np.testing.assert_allclose(target, fresh - x0, atol=1e-5)
    np.testing.assert_allclose(config.to_x0(target, noisy, sigma), x0, atol=1e-5)
    shown, told = config.precondition(noisy, sigma)
    mixed = (1 - told)[:, None, None] * x0 + told[:, None, None] * fresh
    np.testing.assert_allclose(shown, mixed, atol=1e-5)


def public(settings):
    return {key: value for key, value in settings.items() if not key.startswith("_")}


def test_the_scheduler_is_written_back(pipeline, folder):
    config = cosmos.read_scheduler(folder)
    values = schedulers.cosmos_to_diffusers(config)
    assert schedulers.cosmos_from_diffusers(values) == config
    again = FlowMatchEulerDiscreteScheduler.from_config(values)
    assert public(again.config).items() <= public(pipeline.scheduler.config).items()
    assert schedulers.cosmos_from_diffusers(dict(scheduler().config)) == config
    for key, value in (("use_karras_sigmas", False), ("sigma_max", 200), ("shift_terminal", 0.1)):
        with pytest.raises(UserError, match=f"{key} is {value}; only"):
            schedulers.cosmos_from_diffusers(values | {key: value})
    with pytest.raises(UserError, match="not known: rho"):
        schedulers.cosmos_from_diffusers(values | {"rho": 7})
    with pytest.raises(UserError, match=r"target is 'edm'; Cosmos-Predict2 supports only 'flow'"):
        schedulers.cosmos_to_diffusers(EDMConfig())


def test_settings_of_the_noise_that_cannot_work_are_refused():
    with pytest.raises(ConfigError, match=r"noise\.target flow goes with 1"):
        EDMConfig(target="flow")
    with pytest.raises(ConfigError, match="use at least 2"):
        EDMConfig(ends="sigma_min", sample_steps=1)
