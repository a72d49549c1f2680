"""The settings of Stable Video Diffusion's scheduler ↔ ours; schedulers have no weights.

Reference: ``EulerDiscreteScheduler`` of diffusers, in the one form that this model uses: levels of
noise after Karras et al., a continuous time log σ / 4, and predictions of v. This is EDM with
``sigma_data`` 1 and the opposite sign.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pewm_jax import config as configuration
from pewm_jax.config import ConfigError, UserError
from pewm_jax.convert import settings
from pewm_jax.diffusion.edm import EDMConfig

CLASS = "EulerDiscreteScheduler"
"""The reference's class."""
SAMPLE_STEPS = 25
"""Steps of an imported scheduler: the default of the pipeline; no file says it."""
RHO = 7.0
"""Exponent of the levels; the reference has no setting for it."""
_ONLY: dict[str, tuple[Any, Any]] = {
    "prediction_type": ("v_prediction", "epsilon"),
    "timestep_type": ("continuous", "discrete"),
    "timestep_spacing": ("leading", "linspace"),
    "use_karras_sigmas": (True, False),
    "use_exponential_sigmas": (False, False),
    "use_beta_sigmas": (False, False),
    "final_sigmas_type": ("zero", "zero"),
}
"""Settings of which one value is supported: that value, and what diffusers takes if none stands."""
_WITHOUT_EFFECT = {
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "trained_betas": None,
    "interpolation_type": "linear",
    "steps_offset": 1,
    "rescale_betas_zero_snr": False,
}
"""Settings that the levels do not depend on, and what is written for them."""
_FORMER = ("clip_sample", "set_alpha_to_one", "skip_prk_steps")
"""Settings that the published file has and the reference never reads."""


def config_from_diffusers(values: Mapping[str, Any]) -> EDMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Args:
        values: the file's content.

    Returns:
        The sampler of equal steps, 25 of them; what the file does not speak of, such as the noise
        in training, has our defaults.

    Raises:
        UserError: another class, a setting that does not exist, or a value that is not supported.
    """
    name = values.get("_class_name")
    if name != CLASS:
        raise UserError(f"The scheduler's _class_name is {name!r}; supported is {CLASS}.")
    known = {"sigma_min", "sigma_max", *_ONLY, *_WITHOUT_EFFECT, *_FORMER}
    settings.require_known(values, "The scheduler", known)
    for key, (only, default) in _ONLY.items():
        if (value := values.get(key, default) or default) != only:
            raise UserError(f"The scheduler's {key} is {value!r}; only {only!r} is supported.")
    ours: dict[str, Any] = {
        "target": "v",
        "sigma_data": 1.0,
        "rho": RHO,
        "sample_steps": SAMPLE_STEPS,
    }
    for key in ("sigma_min", "sigma_max"):
        value = values.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise UserError(f"The scheduler's {key} is {value!r}; it must be a number.")
        ours[key] = float(value)
    try:
        return configuration.from_dict(EDMConfig, ours, "scheduler")
    except ConfigError as error:
        raise UserError(f"The scheduler cannot be used: {error}") from None


def config_to_diffusers(config: EDMConfig) -> dict[str, Any]:
    """Write the settings as ``scheduler_config.json`` has them, the inverse of reading.

    The number of steps, the guidance and the noise in training stay behind: diffusers has no names
    for them.

    Raises:
        UserError: a setting that the reference does not have.
    """
    wanted = {"target": "v", "sigma_data": 1.0, "rho": RHO, "sampler": "euler"}
    for key, only in wanted.items():
        if getattr(config, key) != only:
            raise UserError(
                f"noise.{key} is {getattr(config, key)!r}; {CLASS} has {only!r} and nothing else."
            )
    return {
        "_class_name": CLASS,
        "sigma_min": config.sigma_min,
        "sigma_max": config.sigma_max,
        **{key: only for key, (only, _) in _ONLY.items()},
        **_WITHOUT_EFFECT,
    }
