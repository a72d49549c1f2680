"""Where the state lives: a mesh with four axes, and rules from paths to placements.

``data`` holds copies of the weights, ``fsdp`` splits weights, optimizer and average (a layer's
weights are gathered when it computes), ``tensor`` splits heads and feed-forward channels,
``context`` splits tokens and no weights. Where activations live is said in ``nn.placement``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax import worlds
from pewm_jax.config import AXES, Config, ConfigError, MeshConfig, World
from pewm_jax.io import tree
from pewm_jax.nn.placement import BATCH
from pewm_jax.train.stages import Stage
from pewm_jax.types import Params

ALL_DATA = MeshConfig()
"""All devices along ``data``."""

WHOLE = P()


def rules(model: World) -> tuple[tuple[str, P], ...]:
    """Return the rules of a ``TrainState``: average and moments lie with their parameter.

    A rule leads from the path of a parameter to the mesh axes of its *last* axes; those before them
    (stacked layers, taps of a convolution) are never split. The first match wins, and every
    parameter must be matched. Each network says its own (``SHARDING``, beside its functions).
    """
    parameters = worlds.sharding(model)
    return (
        *((rf"(params|ema|opt_state/.+)/{path}", spec) for path, spec in parameters),
        (r"opt_state/.*(count|ns_coeffs)", WHOLE),
        (r"step", WHOLE),
    )


def make_mesh(devices: Sequence[Any] | None = None, arranged: MeshConfig = ALL_DATA) -> Mesh:
    """Make the mesh over the given devices, by default all there are, all along ``data``.

    Raises:
        ConfigError: the devices cannot be arranged as asked.
    """
    devices = jax.devices() if devices is None else devices
    types = (AxisType.Auto,) * len(AXES)
    return jax.make_mesh(arranged.shape(len(devices)), AXES, types, devices=devices)


def of_state(model: World, mesh: Mesh | AbstractMesh, state: Any) -> Any:
    """Return the shardings of a (possibly abstract) state, as a tree of its structure.

    An axis of the mesh that does not divide its axis of a leaf is left out for that leaf;
    ``left_out`` lists these.

    Raises:
        TreeError: leaves that no rule matches.
    """
    return jax.tree.map(
        lambda leaf, spec: NamedSharding(mesh, _fitted(mesh, leaf, spec)[0]),
        state,
        _specs(model, state),
    )


def constrain(model: World, params: Params) -> Params:
    """Keep a tree of parameters, or of their gradients, where the table says; within a step."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1:
        return params
    specs = tree.assign(rules(model), {"params": params}, "sharding rules")["params"]
    return jax.tree.map(
        lambda x, spec: jax.lax.with_sharding_constraint(x, _fitted(mesh, x, spec)[0]),
        params,
        specs,
    )


def left_out(model: World, mesh: Mesh | AbstractMesh, state: Any) -> dict[str, tuple[str, ...]]:
    """Return the leaves that are not split as their rule says, and the mesh axes left out.

    Args:
        model: says where its parameters lie.
        mesh: the devices.
        state: a (possibly abstract) state.
    """
    leaves, specs = tree.flatten(state), tree.flatten(_specs(model, state))
    missed = {path: _fitted(mesh, leaf, specs[path])[1] for path, leaf in leaves.items()}
    return {path: axes for path, axes in missed.items() if axes}


def _specs(model: World, state: Any) -> Any:
    return tree.assign(rules(model), state, "sharding rules")


def _fitted(mesh: Mesh | AbstractMesh, leaf: Any, spec: P) -> tuple[P, tuple[str, ...]]:
    """Align a spec to a leaf's last axes; returns it, and the mesh axes that do not divide them."""
    shape = tuple(getattr(leaf, "shape", ()))
    kept: list[str | None] = [None] * len(shape)
    missed: list[str] = []
    for place in range(1, len(spec) + 1):  # from the last axis forward
        axis = spec[-place]
        if axis is None:
            continue
        if place <= len(shape) and shape[-place] % mesh.shape[axis] == 0:
            kept[-place] = axis
        else:
            missed.append(axis)
    return P(*kept), tuple(missed)


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


def place(values: Any, like: Any) -> Any:
    """Put weights where they belong: leaf by leaf, and of each leaf only this process's parts.

    Args:
        values: nested dictionaries of arrays: NumPy arrays, also of files that are mapped and not
            read yet (``weights.lazy``), or JAX arrays, which move between devices.
        like: abstract arrays with shardings, for at least these paths.

    Returns:
        The same tree as JAX arrays, in the dtypes of ``like``.
    """
    given, wanted = tree.flatten(values), tree.flatten(like)
    moved = {path: leaf for path, leaf in given.items() if isinstance(leaf, jax.Array)}
    read = {
        path: jax.make_array_from_callback(
            leaf.shape, wanted[path].sharding, functools.partial(_part, leaf, wanted[path].dtype)
        )
        for path, leaf in given.items()
        if path not in moved
    }
    if moved:
        there = {path: wanted[path].sharding for path in moved}
        cast = jax.jit(
            lambda leaves: {path: x.astype(wanted[path].dtype) for path, x in leaves.items()},
            out_shardings=there,
        )
        moved = cast(moved)
    return tree.unflatten({path: moved.get(path, read.get(path)) for path in given})


def _part(leaf: np.ndarray, dtype: np.dtype, index: tuple[slice, ...] | None) -> np.ndarray:
    return np.asarray(leaf[index or ...], dtype)


def require_divisible(config: Config, stage: Stage, mesh: Mesh | AbstractMesh) -> None:
    """Refuse what cannot be split evenly.

    Raises:
        ConfigError: the batch is not a multiple of the devices that share it, or heads and hidden
            channels are no multiple of those that share them.
    """
    batch, devices = stage.settings(config).batch, math.prod(mesh.shape[axis] for axis in BATCH)
    if batch % devices:
        raise ConfigError(
            f"train.{stage.name}.batch is {batch}, which {devices} devices cannot share evenly: "
            f"use a multiple of {devices}."
        )
    tensor = mesh.shape["tensor"]
    heads: Mapping[str, int] = worlds.split_heads(config.model, stage)
    for name, count in heads.items():
        if count % tensor:
            raise ConfigError(
                f"train.mesh.tensor is {tensor}, which does not divide {name} ({count}): use a "
                f"divisor of {count}."
            )
