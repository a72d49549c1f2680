"""PERSIST's four networks together: their parameters, sharding rules and costs.

They are a backbone in that a model names their settings there; each runs by functions of its own
(``voxel_vae``, ``voxel_dit``, ``camera_model``, ``voxel_renderer``).
"""

from __future__ import annotations

from typing import Any

import jax
from jax.sharding import PartitionSpec as P

from pewm_jax.config import PersistNetsConfig
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer, voxel_vae
from pewm_jax.types import Array, Params

SHARDING = (
    *voxel_dit.SHARDING,
    *camera_model.SHARDING,
    *voxel_renderer.SHARDING,
    (r"voxel_vae/.*/kernel", P(None, "fsdp")),
    (r"voxel_vae/.*/(bias|scale)", P()),
    (r"voxel_vae/latent_(mean|scale)_C", P()),
)
"""Rules over the paths of all their parameters."""
NETWORKS = ("voxel_vae", "voxel_dit", "camera_model", "renderer")
"""The networks, as their parameters are named, in the order in which they learn."""


def init(config: PersistNetsConfig, key: Array, networks: tuple[str, ...] = NETWORKS) -> Params:
    """Return random parameters of some of the networks, under their names."""
    makers: dict[str, Any] = {
        "voxel_vae": (voxel_vae, config.voxel_vae),
        "voxel_dit": (voxel_dit, config.world_frames),
        "camera_model": (camera_model, config.camera_model),
        "renderer": (voxel_renderer, config.renderer),
    }
    keys: dict[str, Array] = dict(zip(NETWORKS, jax.random.split(key, len(NETWORKS)), strict=True))
    return {name: makers[name][0].init(makers[name][1], keys[name]) for name in networks}
