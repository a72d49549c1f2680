"""EDM and flow matching beside EDMEulerScheduler and FlowMatchEulerDiscreteScheduler."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.config.parts import Noise
from pewm_jax.convert import schedulers, svd
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.diffusion.flow import FlowConfig

torch = pytest.importorskip("torch")
diffusers = pytest.importorskip("diffusers")

START = np.random.default_rng(0).normal(size=(2, 3, 4)).astype(np.float32)


def network(x, told, xp):
    """Stand in for the network F: smooth, and different at every level."""
    return xp.tanh(0.7 * x) + 0.3 * xp.cos(3 * x + told)


def our_path(config):
    """What the network is shown and told, and x0 of each step; and the sample."""

    def denoise(x, times, _weight):
        shown, told = config.precondition(x, times)
        told = Noise.expand(told, x.ndim)
        return config.to_x0(network(shown, told, jnp), x, times)

    return np.asarray(jax.jit(lambda x: config.sample(denoise, x))(START))


@pytest.mark.parametrize("steps", [1, 2, 18])
@pytest.mark.parametrize("settings", [(0.002, 80.0, 0.5, 7.0), (0.03, 30.0, 1.0, 3.0)], ids=str)
def test_edm_equals_the_reference(steps, settings):
    least, most, data, rho = settings
    theirs = diffusers.EDMEulerScheduler(sigma_min=least, sigma_max=most, sigma_data=data, rho=rho)
    config = EDMConfig(
        sigma_min=least, sigma_max=most, sigma_data=data, rho=rho, sample_steps=steps
    )
    theirs.set_timesteps(steps)
    np.testing.assert_allclose(config.levels(), theirs.sigmas[:-1].numpy(), rtol=1e-5)
    x = torch.from_numpy(START) * theirs.sigmas[0]
    for i, t in enumerate(theirs.timesteps):
        shown = theirs.scale_model_input(x, t)
        ours, told = config.precondition(x.numpy(), theirs.sigmas[i].numpy()[None].repeat(2))
        np.testing.assert_allclose(ours, shown.numpy(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(told, float(t), rtol=1e-5, atol=1e-6)
        x = theirs.step(network(shown, t, torch), t, x, return_dict=False)[0]
    got = our_path(config)
    assert np.abs(got - x.numpy()).max() <= 1e-5 * max(1, np.abs(x.numpy()).max(), most / 20)


SVD = {
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
    "sigma_min": 0.002,
    "sigma_max": 700.0,
    "steps_offset": 1,
    "timestep_spacing": "leading",
    "timestep_type": "continuous",
    "use_karras_sigmas": True,
}
"""The published settings of Stable Video Diffusion's scheduler."""


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # the reference's
@pytest.mark.parametrize("settings", [{}, {"sigma_max": 5.0}], ids=str)
@pytest.mark.parametrize("steps", [1, 25])
def test_edm_of_v_equals_stable_video_diffusion_s_scheduler(steps, settings, tmp_path):
    theirs = diffusers.EulerDiscreteScheduler(**SVD | settings)
    theirs.save_pretrained(tmp_path / "scheduler")
    config = svd.read_scheduler(tmp_path)
    assert config.sample_steps == 25
    config = dataclasses.replace(config, sample_steps=steps)
    theirs.set_timesteps(steps)
    np.testing.assert_allclose(config.levels(), theirs.sigmas[:-1].numpy(), rtol=1e-5)
    x = torch.from_numpy(START) * theirs.init_noise_sigma
    for i, t in enumerate(theirs.timesteps):
        sigma = theirs.sigmas[i].numpy()[None].repeat(2)
        shown = theirs.scale_model_input(x, t)
        ours, told = config.precondition(x.numpy(), sigma)
        np.testing.assert_allclose(ours, shown.numpy(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(told, float(t), rtol=1e-5, atol=1e-6)
        v = network(shown, t, torch)
        clean = config.to_x0(v.numpy(), x.numpy(), sigma)
        x, found = theirs.step(v, t, x, return_dict=False)
        np.testing.assert_allclose(clean, found.numpy(), rtol=1e-5, atol=1e-5)
    got = our_path(config)
    # A single step leads from samples as large as sigma_max, with their rounding, to small ones.
    large = config.sigma_max / 20 if steps == 1 else 1
    assert np.abs(got - x.numpy()).max() <= 1e-5 * max(1, np.abs(x.numpy()).max(), large)


def public(settings):
    return {key: value for key, value in settings.items() if not key.startswith("_")}


def test_stable_video_diffusion_s_scheduler_is_written_back(tmp_path):
    theirs = diffusers.EulerDiscreteScheduler(**SVD)
    theirs.save_pretrained(tmp_path)
    values = schedulers.svd_to_diffusers(svd.read_scheduler(tmp_path))
    again = diffusers.EulerDiscreteScheduler.from_config(values)
    assert public(again.config) == public(theirs.config)
    for key, value in (("prediction_type", "epsilon"), ("timestep_spacing", "trailing")):
        with pytest.raises(UserError, match=f"{key} is '{value}'; only"):
            schedulers.svd_from_diffusers(values | {key: value})
    with pytest.raises(UserError, match="sigma_max is None"):
        schedulers.svd_from_diffusers(values | {"sigma_max": None})
    with pytest.raises(UserError, match="not known: rho"):
        schedulers.svd_from_diffusers(values | {"rho": 7})
    with pytest.raises(UserError, match=r"sigma_data is 0\.5"):
        schedulers.svd_to_diffusers(EDMConfig(target="v"))


@pytest.mark.parametrize("steps", [1, 4, 20])
@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_flow_equals_the_reference(steps, shift):
    theirs = diffusers.FlowMatchEulerDiscreteScheduler(shift=shift)
    # As the pipelines ask for their times; left alone, this scheduler shifts twice.
    theirs.set_timesteps(sigmas=np.linspace(1, 1 / steps, steps))
    config = FlowConfig(shift=shift, sample_steps=steps)
    np.testing.assert_allclose(config.levels(), theirs.sigmas[:-1].numpy(), rtol=1e-5)
    _, told = config.precondition(START, jnp.asarray(config.levels()))
    np.testing.assert_allclose(told, theirs.timesteps.numpy(), rtol=1e-5)
    x = torch.from_numpy(START)
    for t in theirs.timesteps:
        x = theirs.step(network(x, t, torch), t, x, return_dict=False)[0]
    got = our_path(config)
    assert np.abs(got - x.numpy()).max() <= 1e-5 * max(1, np.abs(x.numpy()).max())
