"""The settings of diffusers' schedulers ↔ our noise settings; schedulers have no weights.

A setting missing in a file has the default of the scheduler's class, which differs in places from
what the published models use. References, all of diffusers:

- CogVideoX: ``scheduling_ddim_cogvideox.py`` and ``scheduling_dpm_cogvideox.py``.
- Stable Video Diffusion: ``EulerDiscreteScheduler`` in the one form that this model uses: noise
  levels of Karras et al., a continuous time log σ / 4, and v-prediction. This is EDM with
  ``sigma_data`` 1 and the opposite sign.
- Cosmos-Predict2: ``FlowMatchEulerDiscreteScheduler`` with Karras' levels, as
  ``Cosmos2VideoToWorldPipeline`` uses it. The pipeline sets the range of levels itself, from 80 to
  0.002, regardless of the file; it repeats the last level instead of ending at 0, and prepares the
  network's input and output. This is EDM with the target ``flow``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pewm_jax import config as configuration
from pewm_jax.config import ConfigError, UserError
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.io import published, sources


@dataclasses.dataclass(frozen=True)
class Scheduler:
    """The scheduler of a family's pipelines.

    Attributes:
        classes: its classes in diffusers.
        read_config: ``(values of scheduler_config.json) -> our settings``.
        write_config: the inverse. Settings without an equivalent in diffusers are omitted: the
            number of steps and the guidance, which its pipelines take as arguments, and settings
            that only training needs.
    """

    classes: tuple[str, ...]
    read_config: Callable[[Mapping[str, Any]], Any]
    write_config: Callable[[Any], dict[str, Any]]


def read(scheduler: Scheduler, folder: str | Path) -> Any:
    """Read the scheduler of a checkpoint.

    Args:
        scheduler: the family's scheduler.
        folder: a diffusers pipeline's folder, or the scheduler's folder in it.

    Raises:
        UserError: a class or setting is unknown.
    """
    return scheduler.read_config(published_config(scheduler, Path(folder)))


def published_config(scheduler: Scheduler, folder: Path) -> dict[str, Any]:
    """Read the scheduler's settings in diffusers' format."""
    path = sources.component(folder, "scheduler") / "scheduler_config.json"
    return sources.read_config(path, scheduler.classes)


COGVIDEOX_CLASSES = {"CogVideoXDDIMScheduler": "ddim", "CogVideoXDPMScheduler": "dpm"}
"""diffusers' class → our sampler."""
TARGETS = {"epsilon": "eps", "sample": "x0", "v_prediction": "v"}
"""diffusers' prediction type → our target."""
COGVIDEOX_STEPS = 50
"""Steps of an imported scheduler: the default of CogVideoX's pipelines, because no file states
it."""

_COGVIDEOX_DEFAULTS: dict[str, Any] = {
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
_COGVIDEOX_FIXED = {"beta_schedule": "scaled_linear", "trained_betas": None}
_COGVIDEOX_WITHOUT_EFFECT = {
    "clip_sample": False,
    "clip_sample_range": 1.0,
    "sample_max_value": 1.0,
}
"""Settings that the reference accepts but never uses."""
_KINDS = {
    "num_train_timesteps": int,
    "steps_offset": int,
    "beta_start": float,
    "beta_end": float,
    "snr_shift_scale": float,
    "set_alpha_to_one": bool,
    "rescale_betas_zero_snr": bool,
}


def cogvideox_from_diffusers(values: Mapping[str, Any]) -> DDPMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Args:
        values: the file's content.

    Returns:
        The sampler with the same steps: ``stride`` is ``fixed`` and ``sample_steps`` 50, as in
        CogVideoX's pipelines; settings that are not in the file have our defaults.

    Raises:
        UserError: another class, an unknown setting, or an unsupported value.
    """
    name = values.get("_class_name")
    if not isinstance(name, str) or name not in COGVIDEOX_CLASSES:
        raise UserError(
            f"The scheduler's _class_name is {name!r}; supported are "
            f"{' and '.join(COGVIDEOX_CLASSES)}."
        )
    known = _COGVIDEOX_DEFAULTS.keys() | _COGVIDEOX_WITHOUT_EFFECT.keys()
    published.require_known(values, "The scheduler", known)
    values = {key: values.get(key, default) for key, default in _COGVIDEOX_DEFAULTS.items()}
    _require_supported(values)
    ours = {
        "train_steps": values["num_train_timesteps"],
        "beta_start": values["beta_start"],
        "beta_end": values["beta_end"],
        "snr_shift": values["snr_shift_scale"],
        "zero_terminal_snr": values["rescale_betas_zero_snr"],
        "target": TARGETS[values["prediction_type"]],
        "sample_steps": min(COGVIDEOX_STEPS, values["num_train_timesteps"]),
        "sampler": COGVIDEOX_CLASSES[name],
        "spacing": values["timestep_spacing"],
        "steps_offset": values["steps_offset"],
        "stride": "fixed",
        "set_alpha_to_one": values["set_alpha_to_one"],
    }
    try:
        return configuration.from_dict(DDPMConfig, ours, "scheduler")
    except ConfigError as error:
        raise UserError(f"The scheduler cannot be used: {error}") from None


def cogvideox_to_diffusers(config: DDPMConfig) -> dict[str, Any]:
    """Return the settings in the format of ``scheduler_config.json``; the inverse of reading.

    Settings without an equivalent are omitted: the number of steps and the guidance, which
    diffusers' pipelines take as arguments, and those that only training needs.
    """
    names = {ours: theirs for theirs, ours in COGVIDEOX_CLASSES.items()}
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
        **_COGVIDEOX_FIXED,
        **_COGVIDEOX_WITHOUT_EFFECT,
    }


def _require_supported(values: Mapping[str, Any]) -> None:
    """Raise an error for values that the reference or this library does not support."""
    for key, value in _COGVIDEOX_FIXED.items():
        if values[key] != value:
            raise UserError(
                f"The scheduler's {key} is {values[key]!r}; only {value!r} is supported."
            )
    choices = {
        "prediction_type": tuple(TARGETS),
        "timestep_spacing": ("trailing", "leading", "linspace"),
    }
    for key, known in choices.items():
        if values[key] not in known:
            raise UserError(
                f"The scheduler's {key} is {values[key]!r}; supported are {', '.join(known)}."
            )
    for key, kind in _KINDS.items():
        value = values[key]
        number = isinstance(value, int) and not isinstance(value, bool)
        fits = number or isinstance(value, float) if kind is float else type(value) is kind
        if not fits:
            raise UserError(
                f"The scheduler's {key} is {value!r}; it must be of type {kind.__name__}."
            )


SVD_CLASS = "EulerDiscreteScheduler"
"""The reference's class."""
SVD_STEPS = 25
"""Steps of an imported scheduler: the default of the pipeline, because no file states it."""
RHO = 7.0
"""Exponent of the levels; the reference has no setting for it."""
_SVD_ONLY: dict[str, tuple[Any, Any]] = {
    "prediction_type": ("v_prediction", "epsilon"),
    "timestep_type": ("continuous", "discrete"),
    "timestep_spacing": ("leading", "linspace"),
    "use_karras_sigmas": (True, False),
    "use_exponential_sigmas": (False, False),
    "use_beta_sigmas": (False, False),
    "final_sigmas_type": ("zero", "zero"),
}
"""Settings with one supported value: that value, and diffusers' default."""
_SVD_WITHOUT_EFFECT = {
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "trained_betas": None,
    "interpolation_type": "linear",
    "steps_offset": 1,
    "rescale_betas_zero_snr": False,
}
"""Settings that do not affect the levels, and the values written for them."""
_SVD_FORMER = ("clip_sample", "set_alpha_to_one", "skip_prk_steps")
"""Settings of the published file that the reference never uses."""


def svd_from_diffusers(values: Mapping[str, Any]) -> EDMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Args:
        values: the file's content.

    Returns:
        The sampler with the same steps, 25 of them; settings that are not in the file, such as the
        noise in training, have our defaults.

    Raises:
        UserError: another class, an unknown setting, or an unsupported value.
    """
    name = values.get("_class_name")
    if name != SVD_CLASS:
        raise UserError(f"The scheduler's _class_name is {name!r}; supported is {SVD_CLASS}.")
    known = {"sigma_min", "sigma_max", *_SVD_ONLY, *_SVD_WITHOUT_EFFECT, *_SVD_FORMER}
    published.require_known(values, "The scheduler", known)
    for key, (only, default) in _SVD_ONLY.items():
        if (value := values.get(key, default) or default) != only:
            raise UserError(f"The scheduler's {key} is {value!r}; only {only!r} is supported.")
    ours: dict[str, Any] = {
        "target": "v",
        "sigma_data": 1.0,
        "rho": RHO,
        "sample_steps": SVD_STEPS,
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


def svd_to_diffusers(config: EDMConfig) -> dict[str, Any]:
    """Return the settings in the format of ``scheduler_config.json``; the inverse of reading.

    The number of steps, the guidance and the noise in training are omitted: diffusers has no
    settings for them.

    Raises:
        UserError: a setting has no equivalent in the reference.
    """
    wanted = {"target": "v", "sigma_data": 1.0, "rho": RHO, "sampler": "euler"}
    for key, only in wanted.items():
        if getattr(config, key) != only:
            raise UserError(
                f"noise.{key} is {getattr(config, key)!r}; {SVD_CLASS} supports only {only!r}."
            )
    return {
        "_class_name": SVD_CLASS,
        "sigma_min": config.sigma_min,
        "sigma_max": config.sigma_max,
        **{key: only for key, (only, _) in _SVD_ONLY.items()},
        **_SVD_WITHOUT_EFFECT,
    }


COSMOS_CLASS = "FlowMatchEulerDiscreteScheduler"
"""The reference's class."""
WHAT = "The scheduler"
COSMOS_STEPS = 35
"""Steps of an imported scheduler: the default of the pipeline, because no file states it."""
_COSMOS_OURS: dict[str, Any] = {
    "target": "flow",
    "sigma_data": 1.0,
    "sigma_min": 0.002,
    "sigma_max": 80.0,
    "rho": 7.0,
    "ends": "sigma_min",
}
"""The pipeline's behaviour, in our settings."""
_COSMOS_ONLY: dict[str, tuple[Any, Any]] = {
    "use_karras_sigmas": (True, False),
    "use_exponential_sigmas": (False, False),
    "use_beta_sigmas": (False, False),
    "use_dynamic_shifting": (False, False),
    "invert_sigmas": (False, False),
    "stochastic_sampling": (False, False),
    "shift_terminal": (None, None),
    "sigma_max": (80.0, 80.0),
    "sigma_min": (0.002, 0.002),
    "sigma_data": (1.0, 1.0),
    "final_sigmas_type": ("sigma_min", "sigma_min"),
}
"""Settings with one supported value: that value, and the default of a missing one."""
_COSMOS_WITHOUT_EFFECT: dict[str, Any] = {
    "num_train_timesteps": 1000,
    "shift": 1.0,
    "base_shift": 0.5,
    "max_shift": 1.15,
    "base_image_seq_len": 256,
    "max_image_seq_len": 4096,
    "time_shift_type": "exponential",
}
"""Settings that do not affect Karras' levels, and the values written for them."""


def cosmos_from_diffusers(values: Mapping[str, Any]) -> EDMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Args:
        values: the file's content.

    Returns:
        The sampler with the same steps, 35 of them; settings that are not in the file, such as the
        noise in training, have our defaults. The pipeline's ``guidance_scale`` g is ``guidance``
        1 + g.

    Raises:
        UserError: another class, an unknown setting, or an unsupported value.
    """
    defaults = {key: default for key, (_, default) in _COSMOS_ONLY.items()}
    values = published.read_settings(values, WHAT, COSMOS_CLASS, defaults, _COSMOS_WITHOUT_EFFECT)
    published.require_only(values, WHAT, {key: only for key, (only, _) in _COSMOS_ONLY.items()})
    return EDMConfig(**_COSMOS_OURS, sample_steps=COSMOS_STEPS)


def cosmos_to_diffusers(config: EDMConfig) -> dict[str, Any]:
    """Return the settings in the format of ``scheduler_config.json``; the inverse of reading.

    The number of steps, the guidance and the noise in training are omitted: diffusers has no
    settings for them.

    Raises:
        UserError: a setting has no equivalent in the pipeline.
    """
    for key, only in {**_COSMOS_OURS, "sampler": "euler"}.items():
        if getattr(config, key) != only:
            raise UserError(
                f"noise.{key} is {getattr(config, key)!r}; Cosmos-Predict2 supports only {only!r}."
            )
    return {
        "_class_name": COSMOS_CLASS,
        **{key: only for key, (only, _) in _COSMOS_ONLY.items()},
        **_COSMOS_WITHOUT_EFFECT,
    }


COGVIDEOX = Scheduler(
    tuple(sorted(COGVIDEOX_CLASSES)), cogvideox_from_diffusers, cogvideox_to_diffusers
)
SVD = Scheduler((SVD_CLASS,), svd_from_diffusers, svd_to_diffusers)
COSMOS = Scheduler((COSMOS_CLASS,), cosmos_from_diffusers, cosmos_to_diffusers)
