"""Where arrays live: a mesh with one axis, and a table from paths to placements.

Batches are split over the devices along B; parameters and optimizer state are copied to each. To
shard them instead, add a rule above the last (``(r".*/kernel", P("data"))`` is fully sharded data
parallelism): nothing else has to change, the compiler inserts the communication.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax import tree
from pewm_jax.config import AXES, Config, ConfigError, MeshConfig
from pewm_jax.training.stages import Stage

BATCH = ("data", "fsdp")
"""The mesh axes along which batches are split."""

ALL_DATA = MeshConfig()
"""All devices along ``data``."""

STATE_RULES: tuple[tuple[str, P], ...] = (
    (r"step", P()),
    (r"(params|ema|opt_state)/.*", P()),
)
"""Placement of each leaf of a ``TrainState`` by its path; every leaf must be matched."""


def make_mesh(devices: Sequence[Any] | None = None, arranged: MeshConfig = ALL_DATA) -> Mesh:
    """Make the mesh over the given devices, by default all there are, all along ``data``.

    Raises:
        ConfigError: the devices cannot be arranged as asked.
    """
    devices = jax.devices() if devices is None else devices
    types = (AxisType.Auto,) * len(AXES)
    return jax.make_mesh(arranged.shape(len(devices)), AXES, types, devices=devices)


def of_state(mesh: Mesh, state: Any) -> Any:
    """Return the shardings of a (possibly abstract) state, as a tree of its structure."""
    specs = tree.assign(STATE_RULES, state, "sharding rules")
    return jax.tree.map(
        lambda spec: NamedSharding(mesh, spec), specs, is_leaf=lambda node: isinstance(node, P)
    )


def of_batch(mesh: Mesh) -> NamedSharding:
    """Return the sharding of every array of a batch: split along B."""
    return NamedSharding(mesh, P(BATCH))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of an array that every device holds whole."""
    return NamedSharding(mesh, P())


def abstract(shapes: Any, shardings: Any) -> Any:
    """Attach shardings to a tree of abstract arrays, as restoring and compiling want them."""
    return jax.tree.map(
        lambda leaf, where: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where),
        shapes,
        shardings,
    )


def require_divisible(config: Config, stage: Stage, mesh: Mesh) -> None:
    """Refuse a batch that cannot be split evenly.

    Raises:
        ConfigError: the batch is not a multiple of the number of devices.
    """
    batch, devices = stage.settings(config).batch, math.prod(mesh.shape[axis] for axis in BATCH)
    if batch % devices:
        raise ConfigError(
            f"train.{stage.name}.batch is {batch}, which {devices} devices cannot share evenly: "
            f"use a multiple of {devices}."
        )
