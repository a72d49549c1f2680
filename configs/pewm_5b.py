"""The paper's method on CogVideoX-5b: 9 frames of 512×512, 2.8 billion parameters of memory."""

from pewm_jax.config import Config
from pewm_jax.presets import pewm_2b


def config() -> Config:
    """Return the settings of ``pewm_2b`` with the larger backbone."""
    return pewm_2b.on("5b")
