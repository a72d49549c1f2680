"""The settings of Cosmos-Predict2's scheduler ↔ ours; schedulers have no weights.

Reference: ``FlowMatchEulerDiscreteScheduler`` of diffusers with Karras' levels, as
``Cosmos2VideoToWorldPipeline`` uses it. The pipeline sets the range of levels itself, from 80 to
0.002, whatever the file says; it repeats the last level instead of ending at 0, and prepares the
network's input and output. This is EDM with the target ``flow``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pewm_jax.config import UserError
from pewm_jax.convert import settings
from pewm_jax.diffusion.edm import EDMConfig

CLASS = "FlowMatchEulerDiscreteScheduler"
"""The reference's class."""
WHAT = "The scheduler"
SAMPLE_STEPS = 35
"""Steps of an imported scheduler: the default of the pipeline; no file says it."""
_OURS: dict[str, Any] = {
    "target": "flow",
    "sigma_data": 1.0,
    "sigma_min": 0.002,
    "sigma_max": 80.0,
    "rho": 7.0,
    "ends": "sigma_min",
}
"""What the pipeline does, in our settings."""
_ONLY: dict[str, tuple[Any, Any]] = {
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
"""Settings of which one value is supported: that value, and what stands for an absent one."""
_WITHOUT_EFFECT: dict[str, Any] = {
    "num_train_timesteps": 1000,
    "shift": 1.0,
    "base_shift": 0.5,
    "max_shift": 1.15,
    "base_image_seq_len": 256,
    "max_image_seq_len": 4096,
    "time_shift_type": "exponential",
}
"""Settings that Karras' levels do not depend on, and what is written for them."""


def config_from_diffusers(values: Mapping[str, Any]) -> EDMConfig:
    """Read the settings of ``scheduler/scheduler_config.json``.

    Args:
        values: the file's content.

    Returns:
        The sampler of equal steps, 35 of them; what the file does not speak of, such as the noise
        in training, has our defaults. The pipeline's ``guidance_scale`` g is ``guidance`` 1 + g.

    Raises:
        UserError: another class, a setting that does not exist, or a value that is not supported.
    """
    defaults = {key: default for key, (_, default) in _ONLY.items()}
    given = settings.of_network(values, WHAT, CLASS, defaults, _WITHOUT_EFFECT)
    settings.require_only(given, WHAT, {key: only for key, (only, _) in _ONLY.items()})
    return EDMConfig(**_OURS, sample_steps=SAMPLE_STEPS)


def config_to_diffusers(config: EDMConfig) -> dict[str, Any]:
    """Write the settings as ``scheduler_config.json`` has them, the inverse of reading.

    The number of steps, the guidance and the noise in training stay behind: diffusers has no names
    for them.

    Raises:
        UserError: a setting that the pipeline does not have.
    """
    for key, only in {**_OURS, "sampler": "euler"}.items():
        if getattr(config, key) != only:
            raise UserError(
                f"noise.{key} is {getattr(config, key)!r}; Cosmos-Predict2 has {only!r} and "
                "nothing else."
            )
    return {
        "_class_name": CLASS,
        **{key: only for key, (only, _) in _ONLY.items()},
        **_WITHOUT_EFFECT,
    }
