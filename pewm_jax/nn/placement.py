"""Sharding of activations: names of array axes → axes of the mesh.

Networks name the axes of their arrays (``batch``, ``tokens``, ``heads``, ``hidden``). The table
below says over which mesh axes each name is split. The mesh is the current one (``jax.set_mesh``).
These functions do nothing without a mesh, on a mesh of one device, and inside code that already
runs device by device (``local``, ``by_batch``).

An axis is left whole if its size is not a multiple of its mesh axes.
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
"""The names of an array's leading axes; axes named None, and the remaining axes, stay whole."""


def _sizes() -> dict[str, int]:
    """Return the sizes of the mesh axes that the compiler shards over; {} if there are none."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1 or any(kind != AxisType.Auto for kind in mesh.axis_types):
        return {}
    return dict(mesh.shape)


def is_split() -> bool:
    """Tell whether the current mesh splits arrays over several devices here."""
    return bool(_sizes())


def parts(name: str) -> int:
    """Return the number of parts that the current mesh splits an axis of this name into."""
    sizes = _sizes()
    return math.prod(sizes.get(axis, 1) for axis in AXES_OF[name])


def _split(name: str | None, size: int) -> tuple[str, ...] | None:
    """Return the mesh axes that split an axis of this name and size; None if it stays whole."""
    if name is None or size % parts(name):
        return None
    return tuple(axis for axis in AXES_OF[name] if _sizes().get(axis, 1) > 1) or None


def constrain(x: Array, *names: str | None) -> Array:
    """Constrain an array's sharding by the names of its leading axes."""
    if not _sizes():
        return x
    spec = P(*(_split(name, size) for name, size in zip(names, x.shape, strict=False)))
    return jax.lax.with_sharding_constraint(x, spec)


def local(function: Callable[..., Any], takes: Sequence[Names], gives: Names) -> Callable[..., Any]:
    """Make a function of whole arrays run on each device's part of its arguments.

    Axes that are not split are gathered first, and every device computes them. The compiler does
    not shard inside the function, so loops over batch or heads stay on the device.

    Args:
        function: takes arrays, or trees of arrays whose leaves are all split alike.
        takes: the axis names of each argument. A name is split only if all axes with that name
            can be.
        gives: the axis names of the result, or of every result.
    """

    def run(*arguments: Any) -> Any:
        if not _sizes():
            return function(*arguments)
        sizes: dict[str, set[int]] = {}
        for argument, names in zip(arguments, takes, strict=True):
            for leaf in jax.tree.leaves(argument):
                for name, size in zip(names, leaf.shape, strict=False):
                    sizes.setdefault(name or "", set()).add(size)

        unsplit = tuple(axis for axis, size in _sizes().items() if size == 1)

        def spec(names: Names) -> P:
            axes = [_split(n, math.gcd(*sizes[n])) if n else None for n in names]
            if names and names[0]:  # avoids summing gradients over axes of size 1
                axes[0] = (*(axes[0] or ()), *(a for a in unsplit if a not in (axes[0] or ())))
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
    """Run ``function(whole, *batched)`` on each device's part of a batch, the leading axis.

    ``whole`` is what every example needs, such as weights; it is gathered once. The results are
    split along the batch.
    """
    names: list[Names] = [(), *(("batch",) for _ in batched)]
    return local(function, names, ("batch",))(whole, *batched)
