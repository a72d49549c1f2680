"""Every setting of the library: frozen dataclasses, validated when built, to and from JSON.

A field's docstring is its ``--help`` text. A value that cannot work is refused when the
configuration is built, with a sentence that names the fix; nothing is checked deeper down.
"""

from pewm_jax.config.clip import SMALLEST, ActionConfig, ClipConfig
from pewm_jax.config.codec import CodecConfig
from pewm_jax.config.diffusion import DiffusionConfig
from pewm_jax.config.dinov2 import DINOv2Config
from pewm_jax.config.dit import PUBLISHED, DiTConfig, published
from pewm_jax.config.errors import ConfigError, UserError
from pewm_jax.config.experiment import Config
from pewm_jax.config.launch import Launch
from pewm_jax.config.memory import MemoryConfig
from pewm_jax.config.mesh import AXES, MeshConfig
from pewm_jax.config.serialize import from_dict, load, save, to_dict
from pewm_jax.config.training import DataConfig, EvalConfig, StageConfig, TrainConfig
from pewm_jax.config.vae import VAEConfig

__all__ = [
    "AXES",
    "PUBLISHED",
    "SMALLEST",
    "ActionConfig",
    "ClipConfig",
    "CodecConfig",
    "Config",
    "ConfigError",
    "DINOv2Config",
    "DataConfig",
    "DiTConfig",
    "DiffusionConfig",
    "EvalConfig",
    "Launch",
    "MemoryConfig",
    "MeshConfig",
    "StageConfig",
    "TrainConfig",
    "UserError",
    "VAEConfig",
    "from_dict",
    "load",
    "published",
    "save",
    "to_dict",
]
