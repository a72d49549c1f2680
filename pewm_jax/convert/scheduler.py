"""The settings of CogVideoX's two schedulers ↔ ours; schedulers have no weights.

References: ``diffusers/schedulers/scheduling_ddim_cogvideox.py`` and
``scheduling_dpm_cogvideox.py``. A setting that a file leaves out has the default of their class,
which is not always what the published models use.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pewm_jax import config as configuration
from pewm_jax.config import ConfigError, UserError
from pewm_jax.convert import settings
from pewm_jax.diffusion.ddpm import DDPMConfig

CLASSES = {"CogVideoXDDIMScheduler": "ddim", "CogVideoXDPMScheduler": "dpm"}
"""Their classes and our samplers."""
TARGETS = {"epsilon": "eps", "sample": "x0", "v_prediction": "v"}
"""Their prediction types and our targets."""
SAMPLE_STEPS = 50
"""Steps of an imported scheduler: the default of CogVideoX's pipelines; no file says it."""

_DEFAULTS: dict[str, Any] = {
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "trained_betas": None,
    "set_alpha_to_one": True,
    "steps_offset": 0,
    "prediction_type": "epsilon",
    "timestep_spacing": "leading",
    "rescale_betas_zero_snr": False,
    "snr_shift_scale": 3.0,
}
_FIXED = {"beta_schedule": "scaled_linear", "trained_betas": None}
_WITHOUT_EFFECT = {"clip_sample": False, "clip_sample_range": 1.0, "sample_max_value": 1.0}
"""Settings that the reference accepts and its steps never read."""
_KINDS = {
    "num_train_timesteps": int,
    "steps_offset": int,
    "beta_start": float,
    "beta_end": float,
    "snr_shift_scale": float,
    "set_alpha_to_one": bool,
    "rescale_betas_zero_snr": bool,
}


def config_from_diffusers(values: Mapping[str, Any]) -> DDPMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Args:
        values: the file's content.

    Returns:
        The sampler of equal steps: ``stride`` is ``fixed`` and ``sample_steps`` 50, as in
        CogVideoX's pipelines; what the file does not speak of has our defaults.

    Raises:
        UserError: another class, a setting that does not exist, or a value that is not supported.
    """
    name = values.get("_class_name")
    if not isinstance(name, str) or name not in CLASSES:
        raise UserError(
            f"The scheduler's _class_name is {name!r}; supported are {' and '.join(CLASSES)}."
        )
    known = _DEFAULTS.keys() | _WITHOUT_EFFECT.keys()
    settings.require_known(values, "The scheduler", known)
    given = {key: values.get(key, default) for key, default in _DEFAULTS.items()}
    _require_supported(given)
    ours = {
        "train_steps": given["num_train_timesteps"],
        "beta_start": given["beta_start"],
        "beta_end": given["beta_end"],
        "snr_shift": given["snr_shift_scale"],
        "zero_terminal_snr": given["rescale_betas_zero_snr"],
        "target": TARGETS[given["prediction_type"]],
        "sample_steps": min(SAMPLE_STEPS, given["num_train_timesteps"]),
        "sampler": CLASSES[name],
        "spacing": given["timestep_spacing"],
        "steps_offset": given["steps_offset"],
        "stride": "fixed",
        "set_alpha_to_one": given["set_alpha_to_one"],
    }
    try:
        return configuration.from_dict(DDPMConfig, ours, "scheduler")
    except ConfigError as error:
        raise UserError(f"The scheduler cannot be used: {error}") from None


def config_to_diffusers(config: DDPMConfig) -> dict[str, Any]:
    """Write the settings as ``scheduler_config.json`` has them, the inverse of reading.

    What diffusers has no name for stays behind: the number of steps and the guidance, which its
    pipelines take as arguments, and what only training needs.
    """
    names = {ours: theirs for theirs, ours in CLASSES.items()}
    targets = {ours: theirs for theirs, ours in TARGETS.items()}
    return {
        "_class_name": names[config.sampler],
        "num_train_timesteps": config.train_steps,
        "beta_start": config.beta_start,
        "beta_end": config.beta_end,
        "prediction_type": targets[config.target],
        "rescale_betas_zero_snr": config.zero_terminal_snr,
        "set_alpha_to_one": config.set_alpha_to_one,
        "snr_shift_scale": config.snr_shift,
        "steps_offset": config.steps_offset,
        "timestep_spacing": config.spacing,
        **_FIXED,
        **_WITHOUT_EFFECT,
    }


def _require_supported(given: Mapping[str, Any]) -> None:
    """Refuse values that do not exist, or that the reference knows and we do not."""
    for key, value in _FIXED.items():
        if given[key] != value:
            raise UserError(
                f"The scheduler's {key} is {given[key]!r}; only {value!r} is supported."
            )
    choices = {
        "prediction_type": tuple(TARGETS),
        "timestep_spacing": ("trailing", "leading", "linspace"),
    }
    for key, known in choices.items():
        if given[key] not in known:
            raise UserError(
                f"The scheduler's {key} is {given[key]!r}; supported are {', '.join(known)}."
            )
    for key, kind in _KINDS.items():
        value = given[key]
        number = isinstance(value, int) and not isinstance(value, bool)
        fits = number or isinstance(value, float) if kind is float else type(value) is kind
        if not fits:
            raise UserError(
                f"The scheduler's {key} is {value!r}; it must be of type {kind.__name__}."
            )
