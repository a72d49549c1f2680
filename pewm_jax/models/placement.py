"""Where activations live: names of an array's axes → axes of the mesh.

The networks say what an axis *is* (``batch``, ``tokens``, ``heads``, ``hidden``), and the table
below says over which axes of the mesh such an axis is split. The mesh is the one in context
(``jax.set_mesh``). Without one, on a mesh of one device, and inside of what already runs device by
device (``local``, ``by_batch``), everything here does nothing.

An axis that its part of the mesh does not divide evenly is left whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import AxisType
from jax.sharding import PartitionSpec as P

from pewm_jax.types import Array

BATCH = ("data", "fsdp")
"""The mesh axes along which batches are split."""

AXES_OF: dict[str, tuple[str, ...]] = {
    "batch": BATCH,
    "tokens": ("context",),
    "heads": ("tensor",),
    "hidden": ("tensor",),
}
"""The mesh axes along which an axis of this name is split."""

Names = Sequence[str | None]
"""The name of each leading axis of an array; None, and what is not named, stays whole."""


def _sizes() -> dict[str, int]:
    """Return the sizes of the mesh's axes that the compiler distributes over; empty without any."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1 or any(kind != AxisType.Auto for kind in mesh.axis_types):
        return {}
    return dict(mesh.shape)


def parts(name: str) -> int:
    """Return into how many parts an axis of this name is split here."""
    sizes = _sizes()
    return math.prod(sizes.get(axis, 1) for axis in AXES_OF[name])


def _split(name: str | None, size: int) -> tuple[str, ...] | None:
    """Return the mesh axes for an axis of this name and size; None leaves it whole."""
    if name is None or size % parts(name):
        return None
    return tuple(axis for axis in AXES_OF[name] if _sizes().get(axis, 1) > 1) or None


def constrain(x: Array, *names: str | None) -> Array:
    """Keep an array split as its axes' names say.

    Args:
        x: any array.
        names: one per leading axis.
    """
    if not _sizes():
        return x
    spec = P(*(_split(name, size) for name, size in zip(names, x.shape, strict=False)))
    return jax.lax.with_sharding_constraint(x, spec)


def local(function: Callable[..., Any], takes: Sequence[Names], gives: Names) -> Callable[..., Any]:
    """Run a function on each device's part of its arguments.

    What is not split is gathered before, and computed by each of the devices that share it. The
    compiler does not look inside, so loops over batch or heads stay on the device.

    Args:
        function: of arrays, or trees of arrays whose leaves are all split alike.
        takes: the names of the axes of each argument. An axis is split where all that bear its
            name can be.
        gives: those of the result, or of all results.

    Returns:
        The function of whole arrays.
    """

    def run(*arguments: Any) -> Any:
        if not _sizes():
            return function(*arguments)
        sizes: dict[str, set[int]] = {}
        for argument, names in zip(arguments, takes, strict=True):
            for leaf in jax.tree.leaves(argument):
                for name, size in zip(names, leaf.shape, strict=False):
                    sizes.setdefault(name or "", set()).add(size)

        alone = tuple(axis for axis, size in _sizes().items() if size == 1)

        def spec(names: Names) -> P:
            axes = [_split(n, math.gcd(*sizes[n])) if n else None for n in names]
            if names and names[0]:  # else gradients would be summed over these axes, for nothing
                axes[0] = (*(axes[0] or ()), *(a for a in alone if a not in (axes[0] or ())))
            return P(*axes)

        mapped = jax.shard_map(
            function,
            in_specs=tuple(spec(names) for names in takes),
            out_specs=spec(gives),
            check_vma=False,
        )
        return mapped(*arguments)

    return run


def by_batch(function: Callable[..., Any], whole: Any, *batched: Any) -> Any:
    """Run ``function(whole, *batched)`` on each device's part of a batch.

    Args:
        function: pure; its results have the batch as their leading axis.
        whole: what every example needs, as weights: gathered, once.
        batched: trees of arrays with the batch as their leading axis; all of one batch.

    Returns:
        ``function``'s results, split along the batch.
    """
    names: list[Names] = [(), *(("batch",) for _ in batched)]
    return local(function, names, ("batch",))(whole, *batched)
