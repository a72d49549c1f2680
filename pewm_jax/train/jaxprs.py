"""Facts about the equations of a jaxpr, for counting the products in it (``flops``)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jax.extend import core

LINEAR, ATTENTION, CONVOLUTION = "linear", "attention", "convolution"
"""Kinds of products, because hardware runs them at different speeds. Products with a batch
dimension in both operands count as attention."""
Axes = tuple[str | None, ...]
"""The mesh axis along which each dimension of a weight is sharded."""
FUSED = "dot_product_attention"
"""Substring of the names of cuDNN's attention primitives."""
_SAME = ("convert_element_type", "copy", "optimization_barrier", "sharding_constraint")
_SLICES = ("slice", "dynamic_slice")


def differentiable(var: Any) -> bool:
    """Return whether a value has a gradient."""
    return jnp.issubdtype(getattr(var.aval, "dtype", bool), jnp.inexact)


def is_product(name: str) -> bool:
    """Return whether a primitive of this name is a matrix product or a convolution."""
    return name in ("dot_general", "conv_general_dilated") or name.startswith(FUSED)


def reaching(jaxpr: Any, wanted: Sequence[bool]) -> frozenset[Any]:
    """Return the variables on which the wanted results depend differentiably."""
    found: set[Any] = set()

    def add(variables: Sequence[Any], flags: Sequence[bool]) -> None:
        for var, flag in zip(variables, flags, strict=True):
            if flag and not isinstance(var, core.Literal) and differentiable(var):
                found.add(var)

    add(jaxpr.outvars, wanted)
    for eqn in reversed(jaxpr.eqns):
        out = [var in found for var in eqn.outvars]
        if any(out) and eqn.primitive.name != "stop_gradient":
            add(eqn.invars, _wanted_inputs(eqn, out))
    return frozenset(found)


def scan_sizes(params: Mapping[str, Any]) -> tuple[int, int]:
    """Return the number of a scan's constants and of its carry values."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()  # JAX 0.12
    return len(list(consts)), len(list(carry))


def _wanted_inputs(eqn: Any, wanted: Sequence[bool]) -> list[bool]:
    """Return, per input of an equation, whether a wanted result depends on it."""
    name, params, count = eqn.primitive.name, eqn.params, len(eqn.invars)
    if name == "scan":
        body = params["jaxpr"].jaxpr
        inside = wanted_in_loop(body, *scan_sizes(params), wanted)
        return _inputs_of(body, inside)
    if name == "while":
        body, skipped = params["body_jaxpr"].jaxpr, params["cond_nconsts"]
        inside = wanted_in_loop(body, params["body_nconsts"], len(wanted), wanted)
        return [False] * skipped + _inputs_of(body, inside)
    if name == "cond":
        branches = [_inputs_of(branch.jaxpr, wanted) for branch in params["branches"]]
        return [False, *(any(each) for each in zip(*branches, strict=True))]
    found = [False] * count
    for jaxpr in inner(params):
        if len(jaxpr.invars) != count or len(jaxpr.outvars) != len(wanted):
            return [True] * count
        found = [a or b for a, b in zip(found, _inputs_of(jaxpr, wanted), strict=True)]
    return found if any(True for _ in inner(params)) else [True] * count


def _inputs_of(jaxpr: Any, wanted: Sequence[bool]) -> list[bool]:
    found = reaching(jaxpr, wanted)
    return [var in found for var in jaxpr.invars]


def wanted_in_loop(jaxpr: Any, consts: int, carries: int, wanted: Sequence[bool]) -> list[bool]:
    """Return, per result of a loop's body, whether it is wanted in any iteration."""
    wanted = list(wanted)
    while True:
        inputs = _inputs_of(jaxpr, wanted)[consts : consts + carries]
        after = [a or b for a, b in zip(wanted[:carries], inputs, strict=True)] + wanted[carries:]
        if after == wanted:
            return wanted
        wanted = after


def inner(params: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the jaxprs among an equation's parameters."""
    for value in params.values():
        for item in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(item, core.ClosedJaxpr):
                yield item.jaxpr
            elif isinstance(item, core.Jaxpr):
                yield item


def _names(part: Any) -> tuple[str, ...]:
    """Return the mesh axes in one entry of a ``PartitionSpec``."""
    return part if isinstance(part, tuple) else (part,) if part else ()


def copies(eqn: Any) -> int:
    """Return the number of executions of an equation's inner jaxpr: devices, or points of a grid.

    Devices along mesh axes that shard neither inputs nor results repeat the same work, which is
    counted once.
    """
    name, params = eqn.primitive.name, eqn.params
    if name == "shard_map":
        mesh, specs = params["mesh"].shape, (*params["in_specs"], *params["out_specs"])
        named = {axis for spec in specs for part in spec for axis in _names(part)}
        return math.prod(mesh[axis] for axis in named)
    if name == "pallas_call":
        return math.prod(n for n in params["grid_mapping"].grid if isinstance(n, int))
    return 1


def product(eqn: Any) -> tuple[str, float, float]:
    """Return kind, FLOPs and memory traffic of a product, without its gradients."""
    name, params = eqn.primitive.name, eqn.params
    left, right = (var.aval.shape for var in eqn.invars[:2])
    out = eqn.outvars[0].aval.shape
    traffic = sum(size(var) for var in (*eqn.invars[:2], eqn.outvars[0]))
    if name == "dot_general":
        (contracted, _), (batch, _) = params["dimension_numbers"]
        flops = 2.0 * math.prod(out) * math.prod(left[dim] for dim in contracted)
        return (ATTENTION, flops, 0.0) if batch else (LINEAR, flops, traffic)
    if name == "conv_general_dilated":
        kernel = params["dimension_numbers"].rhs_spec
        summed = math.prod(right[dim] for dim in kernel[1:])  # all but the output channels
        return CONVOLUTION, 2.0 * math.prod(out) * summed, traffic
    keys = right[1 if params.get("layout", 0) in (0, None) else 2]
    passes = 2.5 if "_bwd" in name else 1.0  # five products instead of two
    return ATTENTION, passes * 4.0 * math.prod(left) * keys, 0.0


def size(var: Any) -> float:
    """Return the bytes of a value."""
    return float(math.prod(var.aval.shape) * var.aval.dtype.itemsize)


def trips(eqn: Any) -> int | None:
    """Return the iterations of ``while i < n: …; i += step`` with constant bounds, or None."""
    params = eqn.params
    cond, body = params["cond_jaxpr"].jaxpr, params["body_jaxpr"].jaxpr
    starts = eqn.invars[params["cond_nconsts"] + params["body_nconsts"] :]
    constants = dict(zip(cond.invars, eqn.invars[: params["cond_nconsts"]], strict=False))
    if len(cond.eqns) != 1 or cond.eqns[0].primitive.name != "lt":
        return None
    counter, limit = cond.eqns[0].invars
    carried = cond.invars[params["cond_nconsts"] :]
    limit = constants.get(limit, limit) if not isinstance(limit, core.Literal) else limit
    if isinstance(counter, core.Literal) or counter not in carried:
        return None
    place = carried.index(counter)
    inside, after = body.invars[params["body_nconsts"] + place], body.outvars[place]
    added = [e for e in body.eqns if e.primitive.name == "add" and e.outvars[0] is after]
    if not added or added[0].invars[0] is not inside:
        return None
    values = [starts[place], limit, added[0].invars[1]]
    if not all(isinstance(value, core.Literal) for value in values):
        return None
    start, end, step = (int(value.val) for value in values)
    return max(0, -(-(end - start) // step)) if step > 0 else None


def moved(eqn: Any, axes: Axes | None) -> Axes | None:
    """Return the mesh axes of a weight after an equation that only moves or converts it."""
    name, params = eqn.primitive.name, eqn.params
    if axes is None:
        return None
    before, after = eqn.invars[0].aval.shape, eqn.outvars[0].aval.shape
    if name in _SAME or (name in _SLICES and len(before) == len(after)):
        return axes
    if name == "transpose":
        return tuple(axes[dim] for dim in params["permutation"])
    if name == "squeeze":
        return tuple(axis for dim, axis in enumerate(axes) if dim not in params["dimensions"])
    if name == "reshape":
        return _reshaped(before, after, axes)
    return None


def _reshaped(before: Sequence[int], after: Sequence[int], axes: Axes) -> Axes:
    """Return the mesh axes after a reshape; a split dimension passes its axis to the first part."""
    found: list[str | None] = [None] * len(after)
    done, ends = 1, {}
    for dim, size in enumerate(after):
        ends.setdefault(done, dim)
        done *= size
    done = 1
    for size, axis in zip(before, axes, strict=True):
        if axis is not None and done in ends:
            found[ends[done]] = axis
        done *= size
    return tuple(found)
