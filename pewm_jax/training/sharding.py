"""Where arrays live: a mesh with one axis, and a table from paths to placements.

Batches are split over the devices along B; parameters and optimizer state are copied to each. To
shard them instead, add a rule above the last (``(r".*/kernel", P("data"))`` is fully sharded data
parallelism): nothing else has to change, the compiler inserts the communication.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax import tree
from pewm_jax.config import Config, ConfigError
from pewm_jax.training.stages import Stage

DATA = "data"
"""The mesh axis along which batches are split."""

STATE_RULES: tuple[tuple[str, P], ...] = (
    (r"step", P()),
    (r"(params|ema|opt_state)/.*", P()),
)
"""Placement of each leaf of a ``TrainState`` by its path; every leaf must be matched."""


def make_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Make the mesh over the given devices, by default all there are."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), (DATA,), (AxisType.Auto,), devices=devices)


def of_state(mesh: Mesh, state: Any) -> Any:
    """Return the shardings of a (possibly abstract) state, as a tree of its structure."""
    specs = tree.assign(STATE_RULES, state, "sharding rules")
    return jax.tree.map(
        lambda spec: NamedSharding(mesh, spec), specs, is_leaf=lambda node: isinstance(node, P)
    )


def of_batch(mesh: Mesh) -> NamedSharding:
    """Return the sharding of every array of a batch: split along B."""
    return NamedSharding(mesh, P(DATA))


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
    batch, devices = stage.settings(config).batch, mesh.shape[DATA]
    if batch % devices:
        raise ConfigError(
            f"train.{stage.name}.batch is {batch}, which {devices} devices cannot share evenly: "
            f"use a multiple of {devices}."
        )
