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
from collections.abc import Callable, Collection, Mapping
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
    """Read the scheduler of a checkpoint: settings only, it has no weights.

    Args:
        folder: a diffusers pipeline's folder, or the scheduler's folder in it.

    Raises:
        UserError: a class or setting is unknown.
    """
    return scheduler.read_config(published_config(scheduler, Path(folder)))


def published_config(scheduler: Scheduler, folder: Path) -> dict[str, Any]:
    """Read the scheduler's settings in diffusers' format."""
    path = sources.component(folder, "scheduler") / "scheduler_config.json"
    return sources.read_config(path, scheduler.classes)


WHAT = "The scheduler"


def _require_class(values: Mapping[str, Any], classes: Collection[str]) -> str:
    name = values.get("_class_name")
    if not isinstance(name, str) or name not in classes:
        raise UserError(f"{WHAT}'s _class_name is {name!r}; supported are {' and '.join(classes)}.")
    return name


def _settings(kind: type, values: dict[str, Any]) -> Any:
    """Return our settings, or refuse the scheduler."""
    try:
        return configuration.from_dict(kind, values, "scheduler")
    except ConfigError as error:
        raise UserError(f"{WHAT} cannot be used: {error}") from None


def _require_ours(config: Any, only: Mapping[str, Any], who: str) -> None:
    """Refuse settings of ours that have no equivalent in the reference."""
    for key, value in only.items():
        if getattr(config, key) != value:
            raise UserError(
                f"noise.{key} is {getattr(config, key)!r}; {who} supports only {value!r}."
            )


COGVIDEOX_CLASSES = {"CogVideoXDDIMScheduler": "ddim", "CogVideoXDPMScheduler": "dpm"}
"""diffusers' class → our sampler."""
TARGETS = {"epsilon": "eps", "sample": "x0", "v_prediction": "v"}
"""diffusers' prediction type → our target."""
COGVIDEOX_STEPS = 50
"""Steps of an imported scheduler: the default of CogVideoX's pipelines, because no file states
it."""

_COGVIDEOX_FIELDS: dict[str, tuple[str, Any]] = {
    "num_train_timesteps": ("train_steps", 1000),
    "beta_start": ("beta_start", 0.00085),
    "beta_end": ("beta_end", 0.012),
    "set_alpha_to_one": ("set_alpha_to_one", True),
    "steps_offset": ("steps_offset", 0),
    "timestep_spacing": ("spacing", "leading"),
    "rescale_betas_zero_snr": ("zero_terminal_snr", False),
    "snr_shift_scale": ("snr_shift", 3.0),
}
"""Their setting → our field, and what diffusers takes for one that a file leaves out."""
_COGVIDEOX_FIXED = {"beta_schedule": "scaled_linear", "trained_betas": None}
_COGVIDEOX_WITHOUT_EFFECT = {
    "clip_sample": False,
    "clip_sample_range": 1.0,
    "sample_max_value": 1.0,
}
"""Settings that the reference accepts but never uses."""


def cogvideox_from_diffusers(values: Mapping[str, Any]) -> DDPMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Returns:
        The sampler with the same steps: ``stride`` is ``fixed`` and ``sample_steps`` 50, as in
        CogVideoX's pipelines; settings that are not in the file have our defaults.

    Raises:
        UserError: another class, an unknown setting, or an unsupported value.
    """
    name = _require_class(values, COGVIDEOX_CLASSES)
    checked = {**published.defaults(_COGVIDEOX_FIELDS), "prediction_type": "epsilon"}
    defaults = {**checked, **_COGVIDEOX_FIXED}
    published.require_known(values, WHAT, {*defaults, *_COGVIDEOX_WITHOUT_EFFECT})
    given = {key: values.get(key, default) for key, default in defaults.items()}
    published.require_only(given, WHAT, _COGVIDEOX_FIXED)
    published.require_choice(given, WHAT, "prediction_type", tuple(TARGETS))
    spacings = ("trailing", "leading", "linspace")
    published.require_choice(given, WHAT, "timestep_spacing", spacings)
    published.require_kinds(given, WHAT, checked)
    ours = {
        **published.read_fields(_COGVIDEOX_FIELDS, given),
        "target": TARGETS[given["prediction_type"]],
        "sample_steps": min(COGVIDEOX_STEPS, given["num_train_timesteps"]),
        "sampler": COGVIDEOX_CLASSES[name],
        "stride": "fixed",
    }
    return _settings(DDPMConfig, ours)


def cogvideox_to_diffusers(config: DDPMConfig) -> dict[str, Any]:
    """Return the settings in the format of ``scheduler_config.json``; the inverse of reading."""
    names = {ours: theirs for theirs, ours in COGVIDEOX_CLASSES.items()}
    targets = {ours: theirs for theirs, ours in TARGETS.items()}
    return {
        "_class_name": names[config.sampler],
        **published.write_fields(_COGVIDEOX_FIELDS, config),
        "prediction_type": targets[config.target],
        **_COGVIDEOX_FIXED,
        **_COGVIDEOX_WITHOUT_EFFECT,
    }


SVD_CLASS = "EulerDiscreteScheduler"
"""The reference's class."""
SVD_STEPS = 25
"""Steps of an imported scheduler: the default of the pipeline, because no file states it."""
_SVD_OURS: dict[str, Any] = {"target": "v", "sigma_data": 1.0, "rho": 7.0}
"""What the reference has no setting for, in our settings."""
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

    Returns:
        The sampler with the same steps, 25 of them; settings that are not in the file, such as the
        noise in training, have our defaults.

    Raises:
        UserError: another class, an unknown setting, or an unsupported value.
    """
    _require_class(values, [SVD_CLASS])
    levels = ("sigma_min", "sigma_max")
    known = {*levels, *_SVD_ONLY, *_SVD_WITHOUT_EFFECT, *_SVD_FORMER}
    published.require_known(values, WHAT, known)
    given = {key: values.get(key) or default for key, (_, default) in _SVD_ONLY.items()}
    published.require_only(given, WHAT, {key: only for key, (only, _) in _SVD_ONLY.items()})
    found: dict[str, Any] = {key: values.get(key) for key in levels}
    published.require_kinds(found, WHAT, {"sigma_min": 0.002, "sigma_max": 700.0})
    ours = {**_SVD_OURS, **{key: float(value) for key, value in found.items()}}
    return _settings(EDMConfig, {**ours, "sample_steps": SVD_STEPS})


def svd_to_diffusers(config: EDMConfig) -> dict[str, Any]:
    """Return the settings in the format of ``scheduler_config.json``; the inverse of reading.

    Raises:
        UserError: a setting has no equivalent in the reference.
    """
    _require_ours(config, {**_SVD_OURS, "sampler": "euler"}, SVD_CLASS)
    return {
        "_class_name": SVD_CLASS,
        "sigma_min": config.sigma_min,
        "sigma_max": config.sigma_max,
        **{key: only for key, (only, _) in _SVD_ONLY.items()},
        **_SVD_WITHOUT_EFFECT,
    }


COSMOS_CLASS = "FlowMatchEulerDiscreteScheduler"
"""The reference's class."""
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

    Raises:
        UserError: a setting has no equivalent in the pipeline.
    """
    _require_ours(config, {**_COSMOS_OURS, "sampler": "euler"}, "Cosmos-Predict2")
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
