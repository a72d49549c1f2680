"""Persistent embodied world models in JAX.

Start here::

    import pewm_jax

    config, params = pewm_jax.load("runs/demo")
    state = pewm_jax.start(config, params, frames)
    state, clip = pewm_jax.rollout(config, params, state, actions, key)

The names below are the public surface; they are imported when first used, so that a worker that
only renders houses does not load the networks.
"""

import importlib
import warnings
from typing import TYPE_CHECKING, Any

from pewm_jax import _moved

if TYPE_CHECKING:
    from pewm_jax.codecs.signals import rgb_from_signal
    from pewm_jax.config import Config
    from pewm_jax.errors import ConfigError, UserError
    from pewm_jax.geometry.actions import integrate
    from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
    from pewm_jax.io.runtime import cache_compilation
    from pewm_jax.train.loading import load
    from pewm_jax.types import Camera, Clip, Control, Frames, VoxelMap, WorldState
    from pewm_jax.worlds import imagine, imagine_many, observe, start
    from pewm_jax.worlds.pewm.world import PEWM
    from pewm_jax.worlds.rollouts import rollout

__version__ = "0.2.0.dev0"

_HOME = {
    "Camera": "types",
    "Clip": "types",
    "Config": "config",
    "Control": "types",
    "ConfigError": "errors",
    "Frames": "types",
    "PEWM": "worlds.pewm.world",
    "UserError": "errors",
    "VoxelMap": "types",
    "WorldState": "types",
    "cache_compilation": "io.runtime",
    "integrate": "geometry.actions",
    "imagine": "worlds",
    "imagine_many": "worlds",
    "intrinsics_from_fov": "geometry.cameras",
    "load": "train.loading",
    "observe": "worlds",
    "pose_from_yaw": "geometry.cameras",
    "rgb_from_signal": "codecs.signals",
    "rollout": "worlds.rollouts",
    "start": "worlds",
}

__all__ = [
    "PEWM",
    "Camera",
    "Clip",
    "Config",
    "ConfigError",
    "Control",
    "Frames",
    "UserError",
    "VoxelMap",
    "WorldState",
    "cache_compilation",
    "imagine",
    "imagine_many",
    "integrate",
    "intrinsics_from_fov",
    "load",
    "observe",
    "pose_from_yaw",
    "rgb_from_signal",
    "rollout",
    "start",
]

_moved.install()


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name == "ModelConfig":  # as version 0.1 had it
        warnings.warn(
            "pewm_jax.ModelConfig is deprecated: import PEWM from pewm_jax.",
            DeprecationWarning,
            stacklevel=2,
        )
        name = "PEWM"
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value
