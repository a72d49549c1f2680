"""Sharding of the training state: a mesh with four axes, and rules by parameter path.

``data`` replicates the weights, ``fsdp`` shards weights, optimizer state and EMA (a layer's weights
are gathered when it computes), ``tensor`` shards heads and feed-forward channels, ``context``
shards tokens but no weights. ``nn.placement`` defines the sharding of activations.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import mesh_utils
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax import worlds
from pewm_jax.config import AXES, Config, ConfigError, MeshConfig, World
from pewm_jax.io import tree
from pewm_jax.nn.placement import BATCH
from pewm_jax.types import Params
from pewm_jax.worlds.stages import Stage

ALL_DATA = MeshConfig()
"""All devices along ``data``."""

WHOLE = P()


def rules(model: World) -> tuple[tuple[str, P], ...]:
    """Return the sharding rules of a ``TrainState``; EMA and moments follow their parameter.

    A rule maps the path of a parameter to the mesh axes of its *last* dimensions; earlier
    dimensions (stacked layers, taps of a convolution) are never sharded. The first match applies,
    and every parameter must be matched. Each network defines its own rules (``SHARDING``, beside
    its functions).
    """
    parameters = worlds.sharding(model)
    return (
        *((rf"(params|ema|opt_state/.+)/{path}", spec) for path, spec in parameters),
        (r"opt_state/.*(count|ns_coeffs)", WHOLE),
        (r"step", WHOLE),
    )


def make_mesh(devices: Sequence[Any] | None = None, arranged: MeshConfig = ALL_DATA) -> Mesh:
    """Make the mesh over the given devices; by default all devices, all along ``data``.

    TPUs of several slices, which the data-centre network joins, are put together along ``data``.

    Raises:
        ConfigError: the number of devices, or of slices, does not fit the requested mesh.
    """
    devices = jax.devices() if devices is None else devices
    types, sizes = (AxisType.Auto,) * len(AXES), arranged.shape(len(devices))
    slices = len({getattr(one, "slice_index", 0) for one in devices if one.platform == "tpu"})
    if slices <= 1:
        return jax.make_mesh(sizes, AXES, types, devices=devices)
    data, *rest = sizes
    if data % slices:
        raise ConfigError(
            f"train.mesh.data is {data}: use a multiple of the number of slices, {slices}, because "
            "only data is split over slices; change it, or fsdp, tensor or context."
        )
    arranged_devices = mesh_utils.create_hybrid_device_mesh(
        (data // slices, *rest), (slices, *[1] * len(rest)), devices
    )
    return Mesh(arranged_devices, AXES, axis_types=types)


def of_state(model: World, mesh: Mesh | AbstractMesh, state: Any) -> Any:
    """Return the shardings of a (possibly abstract) state, as a tree of the same structure.

    A mesh axis that does not divide its dimension of a leaf is dropped for that leaf.

    Raises:
        TreeError: no rule matches some leaves.
    """
    return jax.tree.map(
        lambda leaf, spec: NamedSharding(mesh, _fit_spec(mesh, leaf, spec)),
        state,
        tree.assign(rules(model), state, "sharding rules"),
    )


def constrain(model: World, params: Params) -> Params:
    """Constrain parameters or their gradients to the sharding rules; call inside a jitted step."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1:
        return params
    specs = tree.assign(rules(model), {"params": params}, "sharding rules")["params"]
    return jax.tree.map(
        lambda x, spec: jax.lax.with_sharding_constraint(x, _fit_spec(mesh, x, spec)),
        params,
        specs,
    )


def _fit_spec(mesh: Mesh | AbstractMesh, leaf: Any, spec: P) -> P:
    """Align a spec to a leaf's last axes, without the mesh axes that do not divide them."""
    shape = tuple(getattr(leaf, "shape", ()))
    kept: list[str | None] = [None] * len(shape)
    for place in range(1, min(len(spec), len(shape)) + 1):  # from the last axis forward
        axis = spec[-place]
        if axis is not None and shape[-place] % mesh.shape[axis] == 0:
            kept[-place] = axis
    return P(*kept)


def of_batch(mesh: Mesh) -> NamedSharding:
    """Return the sharding of every array of a batch: sharded along B."""
    return NamedSharding(mesh, P(BATCH))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a replicated array."""
    return NamedSharding(mesh, P())


def abstract(shapes: Any, shardings: Any) -> Any:
    """Attach shardings to a tree of abstract arrays, as needed to restore and compile."""
    return jax.tree.map(
        lambda leaf, where: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where),
        shapes,
        shardings,
    )


def place(values: Any, like: Any) -> Any:
    """Place weights on the devices: leaf by leaf, and only this process's shards of each leaf.

    Args:
        values: nested dictionaries of NumPy arrays, including memory-mapped ones, or of JAX arrays,
            which are moved between devices.
        like: abstract arrays with dtypes and shardings, for at least these paths.
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
    """Raise an error if the batch, heads or channels cannot be sharded evenly.

    Raises:
        ConfigError: they are not multiples of the devices that share them.
    """
    settings, devices = stage.settings(config), math.prod(mesh.shape[axis] for axis in BATCH)
    batch, parts = settings.batch, settings.micro_batches
    if batch % (parts * devices):
        split = f" in {parts} micro-batches" if parts > 1 else ""
        raise ConfigError(
            f"train.{stage.name}.batch is {batch}{split}, which cannot be split evenly over "
            f"{devices} devices: use a multiple of {parts * devices}."
        )
    tensor = mesh.shape["tensor"]
    heads: Mapping[str, int] = worlds.split_heads(config.model, stage)
    for name, count in heads.items():
        if count % tensor:
            raise ConfigError(
                f"train.mesh.tensor is {tensor}, which does not divide {name} ({count}): use a "
                f"divisor of {count}."
            )
