"""The demo: procedural houses at 64×64 pixels, minutes on two cores."""

from pewm_jax.config import Config


def config() -> Config:
    """Return the settings of the demo."""
    return Config()
