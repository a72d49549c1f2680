import pytest

from pewm_jax.config import UserError
from pewm_jax.convert import schedulers
from pewm_jax.diffusion.ddpm import DDPMConfig

PUBLISHED = {  # CogVideoX-2b's file
    "_class_name": "CogVideoXDDIMScheduler",
    "_diffusers_version": "0.30.0.dev0",
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "clip_sample": False,
    "clip_sample_range": 1.0,
    "num_train_timesteps": 1000,
    "prediction_type": "v_prediction",
    "rescale_betas_zero_snr": True,
    "sample_max_value": 1.0,
    "set_alpha_to_one": True,
    "snr_shift_scale": 3.0,
    "steps_offset": 0,
    "timestep_spacing": "trailing",
    "trained_betas": None,
}


def test_the_published_settings_become_ours():
    assert schedulers.cogvideox_from_diffusers(PUBLISHED) == DDPMConfig(
        snr_shift=3.0, target="v", sample_steps=50, stride="fixed"
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"_class_name": "DDIMScheduler"}, "'DDIMScheduler'; supported are CogVideoXDDIM"),
        ({"_class_name": None}, "_class_name is None"),
        ({"_class_name": ["x"]}, "_class_name is"),
        ({"use_karras_sigmas": True}, "not known: use_karras_sigmas"),
        ({"beta_schedule": "linear"}, "only 'scaled_linear' is supported"),
        ({"trained_betas": [0.1]}, "trained_betas"),
        ({"prediction_type": "flow"}, "supported are epsilon, sample, v_prediction"),
        ({"prediction_type": ["v_prediction"]}, "supported are epsilon"),
        ({"timestep_spacing": "karras"}, "supported are trailing"),
        ({"num_train_timesteps": 1000.0}, "num_train_timesteps is 1000.0; give a value like 1000"),
        ({"set_alpha_to_one": 1}, "a value like True"),
        ({"snr_shift_scale": "3"}, "a value like 3.0"),
        ({"snr_shift_scale": 0}, "snr_shift must be above 0"),
        ({"prediction_type": "epsilon"}, "pure noise"),
        ({"timestep_spacing": "leading", "steps_offset": 20}, "use 0 to 19"),
    ],
)
def test_what_is_not_supported_is_refused_in_a_sentence(change, sentence):
    with pytest.raises(UserError, match=sentence) as told:
        schedulers.cogvideox_from_diffusers({**PUBLISHED, **change})
    assert "\n" not in str(told.value)
