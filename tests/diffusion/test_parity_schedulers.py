"""DDIM and DPM beside CogVideoXDDIMScheduler and CogVideoXDPMScheduler, step by step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.convert import schedulers

torch = pytest.importorskip("torch")
diffusers = pytest.importorskip("diffusers")

CLASSES = {
    "ddim": diffusers.CogVideoXDDIMScheduler,
    "dpm": diffusers.CogVideoXDPMScheduler,
}
SHAPE = (2, 3, 4, 2)
# snr shift, zero terminal SNR, steps, spacing, offset, end at a clean sample
SETTINGS = [
    (1.0, True, 50, "trailing", 0, True),
    (3.0, True, 10, "trailing", 0, True),
    (3.0, False, 50, "trailing", 0, True),
    (1.0, False, 10, "leading", 1, True),
    (3.0, False, 50, "linspace", 0, False),
    (1.0, True, 30, "trailing", 0, False),
    (1.0, False, 7, "trailing", 0, True),
    (3.0, True, 1, "trailing", 0, True),
]


def reference(kind, target, settings):
    snr, rescale, _, spacing, offset, clean = settings
    return CLASSES[kind](
        prediction_type=target,
        snr_shift_scale=snr,
        rescale_betas_zero_snr=rescale,
        timestep_spacing=spacing,
        steps_offset=offset,
        set_alpha_to_one=clean,
    )


def ours(theirs, steps):
    values = {**theirs.config, "_class_name": type(theirs).__name__}
    return dataclasses.replace(schedulers.cogvideox_from_diffusers(values), sample_steps=steps)


def network(x, t, xp):
    """Stand in for the denoiser: smooth, and different at every level."""
    return xp.tanh(0.7 * x) + 0.3 * xp.cos(3 * x + t / 100)


def draw(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def their_path(theirs, steps, start, step_noise, monkeypatch):
    theirs.set_timesteps(steps)
    given = {}
    monkeypatch.setattr(
        "diffusers.schedulers.scheduling_dpm_cogvideox.randn_tensor",
        lambda *_, **__: given["noise"],
    )
    x, earlier, before, path = torch.from_numpy(start), None, None, []
    for i, t in enumerate(theirs.timesteps):
        prediction = network(x, t, torch)
        if isinstance(theirs, CLASSES["dpm"]):
            given["noise"] = torch.from_numpy(step_noise[i])
            x, earlier = theirs.step(prediction, earlier, t, before, x)
            before = t
        else:
            x = theirs.step(prediction, t, x, return_dict=False)[0]
        path.append(x.numpy())
    return np.stack(path)


def our_path(config, start, step_noise):
    def denoise(x, times, _weight):
        prediction = network(x, times.reshape(-1, 1, 1, 1), jnp)
        return config.to_x0(prediction, x, times)

    def run(x, noise):
        return config.sample(denoise, x, step_noise=noise, every_step=True)

    return jax.jit(run)(start, step_noise)


CASES = [
    (target, settings)
    for target in ("v_prediction", "epsilon", "sample")
    for settings in SETTINGS
    # ε says nothing of x0 where there is no signal: that pair of settings is refused
    if target != "epsilon" or not settings[1]
]


@pytest.mark.parametrize(("target", "settings"), CASES, ids=str)
@pytest.mark.parametrize("kind", ["ddim", "dpm"])
def test_every_step_equals_the_reference(kind, target, settings, monkeypatch):
    steps = settings[2]
    theirs = reference(kind, target, settings)
    config = ours(theirs, steps)
    start, step_noise = draw(0, *SHAPE), draw(1, steps, *SHAPE)
    want = their_path(theirs, steps, start, step_noise, monkeypatch)
    got = np.asarray(our_path(config, start, step_noise))
    np.testing.assert_array_equal(config.levels(), theirs.timesteps.numpy())
    assert np.isfinite(got).all()
    assert got.shape == want.shape
    for i in range(steps):
        assert np.abs(got[i] - want[i]).max() <= 1e-5 * np.abs(want[i]).max(), f"step {i}"


@pytest.mark.parametrize("settings", SETTINGS[:5], ids=str)
def test_levels_noising_and_velocity_equal_the_reference(settings):
    theirs = reference("ddim", "v_prediction", settings)
    config = ours(theirs, settings[2])
    alphas = config.alphas_cumprod()
    np.testing.assert_allclose(alphas, theirs.alphas_cumprod.numpy(), rtol=1e-9, atol=1e-15)
    x0, noise = draw(2, 2, 7, 3, 4)
    times = np.array([0, 1, 250, 500, 750, 998, 999])
    given = [torch.from_numpy(x) for x in (x0, noise, times)]
    noised = np.asarray(config.corrupt(x0, noise, times))
    velocity = np.asarray(config.prediction_target(x0, noise, times))
    for got, want in [
        (noised, theirs.add_noise(*given).numpy()),
        (velocity, theirs.get_velocity(*given).numpy()),
    ]:
        assert np.abs(got - want).max() <= 1e-5 * np.abs(want).max()


@pytest.mark.parametrize("spacing", ["trailing", "leading", "linspace"])
def test_the_visited_levels_equal_the_reference_for_every_count(spacing):
    theirs = reference("ddim", "v_prediction", (1.0, True, 1, spacing, 0, True))
    config = ours(theirs, 1)
    for count in [*range(1, 130), 200, 250, 333, 500, 1000]:
        theirs.set_timesteps(count)
        got = dataclasses.replace(config, sample_steps=count).levels()
        # for a few counts the reference has an element too many, a level of −1
        np.testing.assert_array_equal(got, theirs.timesteps.numpy()[:count], str(count))


def test_dynamic_guidance_is_what_the_pipeline_applies():
    """Runs CogVideoX's own pipeline, with a tiny random transformer, and watches the weight."""
    torch.manual_seed(0)
    transformer = diffusers.CogVideoXTransformer3DModel(
        num_attention_heads=1,
        attention_head_dim=16,
        in_channels=4,
        out_channels=4,
        time_embed_dim=4,
        text_embed_dim=8,
        num_layers=1,
        sample_width=4,
        sample_height=4,
        sample_frames=5,
        max_text_seq_length=3,
    )
    theirs = CLASSES["ddim"](
        prediction_type="v_prediction",
        rescale_betas_zero_snr=True,
        timestep_spacing="trailing",
    )
    pipeline = diffusers.CogVideoXPipeline(
        tokenizer=None, text_encoder=None, vae=None, transformer=transformer, scheduler=theirs
    )
    pipeline.set_progress_bar_config(disable=True)
    seen = []

    def watch(pipe, _index, _t, _tensors):
        seen.append(pipe.guidance_scale)
        return {}

    pipeline(
        prompt_embeds=torch.randn(1, 3, 8),
        negative_prompt_embeds=torch.randn(1, 3, 8),
        height=32,
        width=32,
        num_frames=5,
        num_inference_steps=10,
        guidance_scale=6.0,
        use_dynamic_cfg=True,
        output_type="latent",
        callback_on_step_end=watch,
        callback_on_step_end_tensor_inputs=["latents"],
    )
    config = dataclasses.replace(ours(theirs, 10), guidance=6.0, dynamic_guidance=True)
    np.testing.assert_allclose(config.guidance_weights(), seen, rtol=1e-9)
    assert np.ptp(seen) > 1


@pytest.mark.parametrize("kind", ["ddim", "dpm"])
def test_settings_survive_the_way_there_and_back(kind):
    for settings in SETTINGS[:5]:
        theirs = reference(kind, "v_prediction", settings)
        written = schedulers.cogvideox_to_diffusers(ours(theirs, 50))
        assert schedulers.cogvideox_from_diffusers(written) == ours(theirs, 50)
        again = type(theirs).from_config(written).config
        for name, value in theirs.config.items():
            if name not in {"clip_sample", "_use_default_values"}:  # no step reads the former
                assert again[name] == value, name
