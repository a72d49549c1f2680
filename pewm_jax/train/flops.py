"""FLOPs of a training step, counted by walking its jaxpr.

Matrix products and convolutions are counted, with 2 FLOPs per multiply-add; element-wise operations
are not. A loop body is counted once per iteration; of the branches of a ``cond``, only the most
expensive one is counted. There are two counts:

- ``executed``: the products in the jaxpr of the whole step. That includes what ``jax.checkpoint``
  recomputes in the backward pass.
- ``needed``: the products that the mathematics requires. The jaxpr of the loss alone is walked, and
  each product is counted once for its value and once for each operand that depends on trained
  parameters, because these operands need a gradient. Model FLOPs utilization (MFU) uses this count.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core
from jax.interpreters import partial_eval

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.io import tree
from pewm_jax.train.stages import Stage
from pewm_jax.train.step import create
from pewm_jax.types import Params

LINEAR, ATTENTION, CONVOLUTION = "linear", "attention", "convolution"
"""Kinds of products, because hardware runs them at different speeds. Products with a batch
dimension in both operands count as attention."""
Axes = tuple[str | None, ...]
"""The mesh axis along which each dimension of a weight is sharded."""
_FUSED = "dot_product_attention"
"""Substring of the names of cuDNN's attention primitives."""
_SAME = ("convert_element_type", "copy", "optimization_barrier", "sharding_constraint")
_SLICES = ("slice", "dynamic_slice")


@dataclasses.dataclass(frozen=True)
class Work:
    """The products of a program, summed over all devices.

    Attributes:
        flops: kind of product → FLOPs.
        traffic: bytes that linear products and convolutions read and write.
        summed: bytes of results that are all-reduced along ``tensor``, because the weight is
            sharded along it in a contracted dimension.
        repeated: kind of product → FLOPs that devices along ``tensor`` and ``context`` repeat: no
            weight is sharded along ``tensor`` and the input does not depend on trained parameters,
            as in encoders and embeddings.
        unsplit: kind of product → other FLOPs that devices along ``tensor`` repeat, because no
            weight is sharded along it.
        unknown: descriptions of loops with products whose number of iterations the jaxpr does not
            determine; they count as one iteration.
    """

    flops: Mapping[str, float] = dataclasses.field(default_factory=dict)
    traffic: float = 0.0
    summed: float = 0.0
    repeated: Mapping[str, float] = dataclasses.field(default_factory=dict)
    unsplit: Mapping[str, float] = dataclasses.field(default_factory=dict)
    unknown: tuple[str, ...] = ()

    @property
    def total(self) -> float:
        """Return the FLOPs of all kinds."""
        return math.fsum(self.flops.values())

    def __add__(self, other: Work) -> Work:
        return Work(
            _sum(self.flops, other.flops),
            self.traffic + other.traffic,
            self.summed + other.summed,
            _sum(self.repeated, other.repeated),
            _sum(self.unsplit, other.unsplit),
            tuple(dict.fromkeys((*self.unknown, *other.unknown))),
        )

    def times(self, count: float) -> Work:
        """Return the work of ``count`` repetitions."""
        flops, repeated, unsplit = (
            {kind: count * value for kind, value in part.items()}
            for part in (self.flops, self.repeated, self.unsplit)
        )
        traffic, summed = count * self.traffic, count * self.summed
        return Work(flops, traffic, summed, repeated, unsplit, self.unknown)


def _sum(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    return {kind: one.get(kind, 0.0) + other.get(kind, 0.0) for kind in {**one, **other}}


def executed(step: Any, platform: str = "cpu") -> Work:
    """Count the products of a program.

    Args:
        step: a closed jaxpr, such as ``jax.make_jaxpr(f)(…)`` or ``jax.jit(f).trace(…).jaxpr``.
        platform: the platform it runs on: "cpu", "cuda" or "tpu".
    """
    jaxpr, _ = partial_eval.dce_jaxpr(step.jaxpr, [True] * len(step.jaxpr.outvars))
    walk = _Walk(gradients=False, platform=platform)
    return walk.jaxpr(jaxpr, [_Mark() for _ in jaxpr.invars])[0]


def needed(loss: Any, trained: Sequence[bool], axes: Sequence[Axes | None] | None = None) -> Work:
    """Count the products that a loss and its gradient need.

    Args:
        loss: the closed jaxpr of a function, not of its gradient. Its first result is the loss.
        trained: for each input of the jaxpr, whether a gradient with respect to it is needed.
        axes: for each input that is a sharded weight, the mesh axes of its dimensions.
    """
    axes = [None] * len(trained) if axes is None else axes
    marks = [_Mark(*each) for each in zip(trained, axes, strict=True)]
    wanted = [k == 0 for k in range(len(loss.jaxpr.outvars))]
    return _Walk(gradients=True).jaxpr(loss.jaxpr, marks, wanted)[0]


def of_stage(config: Config, stage: Stage, clip: Any, given: Params | None = None) -> Work:
    """Return the work that one step of a stage needs, for a whole batch.

    Args:
        config: the experiment.
        stage: the stage.
        clip: the batch, or its shapes.
        given: weights needed only by the loss, see ``Stage.extra_weights``.
    """
    clip, given = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (clip, given or {})
    )
    state = jax.eval_shape(functools.partial(create, config, stage), jax.random.key(0))
    params, key = state.params, jax.eval_shape(jax.random.key, 0)
    args = (params, clip, key, given)

    def loss(params: Params, clip: Any, key: Any, given: Params) -> Any:
        return stage.loss(config.model, config.train, tree.merge(params, given), clip, key)

    jaxpr = jax.make_jaxpr(loss)(*args)
    trained = tree.flatten(tree.split(params, stage.trained)[0])
    specs = tree.flatten(tree.assign(worlds.sharding(config.model), params, "sharding rules"))
    leaves = tree.flatten(params)
    others = len(jax.tree.leaves(args)) - len(leaves)
    marks = [path in trained for path in leaves] + [False] * others
    # A rule gives the mesh axes of a leaf's last dimensions.
    axes: list[Axes | None] = [
        (None,) * (leaf.ndim - len(specs[path])) + tuple(specs[path])
        for path, leaf in leaves.items()
    ]
    return needed(jaxpr, marks, axes + [None] * others)


@dataclasses.dataclass(frozen=True)
class _Mark:
    """Properties of a value in a jaxpr.

    Attributes:
        trained: whether it depends on trained parameters, so that it needs a gradient.
        axes: the mesh axes of its dimensions, if it is a weight.
        platforms: the platforms it selects between, if it is the index of a platform-dependent
            branch; None among them stands for all other platforms.
    """

    trained: bool = False
    axes: Axes | None = None
    platforms: tuple[Any, ...] = ()


class _Walk:
    """Counts the products in a jaxpr.

    Args:
        gradients: whether to add the products of the gradients.
        platform: "cpu", "cuda" or "tpu"; selects among platform-dependent implementations. With
            ``gradients`` the cheapest one is counted: all compute the same, but some pad.
    """

    def __init__(self, *, gradients: bool, platform: str = ""):
        self.gradients, self.platform = gradients, platform

    def jaxpr(
        self, jaxpr: Any, marks: Sequence[_Mark], wanted: Sequence[bool] = ()
    ) -> tuple[Work, list[_Mark]]:
        """Return the work of a jaxpr and the marks of its results.

        Args:
            jaxpr: the jaxpr.
            marks: of its inputs.
            wanted: for each result whether the loss depends on it; used with ``gradients``.
        """
        known = dict(zip(jaxpr.invars, marks, strict=True))
        reaching = _reaching(jaxpr, wanted) if self.gradients else frozenset()
        total = Work()

        def mark(var: Any) -> _Mark:
            return _Mark() if isinstance(var, core.Literal) else known.get(var, _Mark())

        for eqn in jaxpr.eqns:
            reaches = [var in reaching for var in eqn.outvars]
            work, out = self.equation(eqn, [mark(var) for var in eqn.invars], reaches)
            total += work
            for var, found in zip(eqn.outvars, out, strict=True):
                known[var] = (
                    found if _differentiable(var) else dataclasses.replace(found, trained=False)
                )
        return total, [mark(var) for var in jaxpr.outvars]

    def equation(
        self, eqn: Any, marks: list[_Mark], wanted: list[bool]
    ) -> tuple[Work, list[_Mark]]:
        """Return the work of one equation and the marks of its results."""
        name, params = eqn.primitive.name, eqn.params
        found: tuple[Work, list[_Mark]] | None = None
        if name == "scan":
            found = self._scan(params, marks, wanted)
        elif name == "while":
            found = self._while(eqn, marks, wanted)
        elif name == "cond":
            found = self._cond(params, marks, wanted)
        elif _is_product(name):
            out = [_Mark(any(mark.trained for mark in marks))] * len(eqn.outvars)
            found = self._product(eqn, marks, any(wanted)), out
        elif inner := list(_jaxprs(params)):
            found = self._call(eqn, inner, marks, wanted)
        if found is not None:
            return found
        if name == "platform_index":
            return Work(), [_Mark(platforms=tuple(params["platforms"]))]
        trained = name != "stop_gradient" and any(mark.trained for mark in marks)
        axes = _moved(eqn, marks[0].axes) if marks else None
        return Work(), [_Mark(trained, axes)] * len(eqn.outvars)

    def _product(self, eqn: Any, marks: list[_Mark], wanted: bool) -> Work:
        kind, flops, traffic = _flops(eqn)
        backward = sum(mark.trained for mark in marks[:2])
        if eqn.primitive.name.startswith(_FUSED):  # logits of queries and keys, times values
            q, k, v = (mark.trained for mark in marks[:3])
            backward = (q + k + (q or k) + v) / 2
        passes = 1 + backward * wanted
        summed = 0.0
        if eqn.primitive.name == "dot_general":
            contracted = eqn.params["dimension_numbers"][0]
            for mark, dims in zip(marks, contracted, strict=True):
                if mark.axes and any(mark.axes[dim] == "tensor" for dim in dims):
                    summed = _bytes(eqn.outvars[0])
        flops *= passes
        found, nothing = {kind: flops}, dict[str, float]()
        split = kind == ATTENTION or any("tensor" in (mark.axes or ()) for mark in marks)
        first = not any(mark.trained for mark in marks[:2] if mark.axes is None)
        repeated, unsplit = (found, nothing) if first else (nothing, found)
        if split:
            repeated = unsplit = nothing
        return Work(found, traffic * passes, summed, repeated, unsplit)

    def _scan(
        self, params: Mapping[str, Any], marks: list[_Mark], wanted: list[bool]
    ) -> tuple[Work, list[_Mark]]:
        consts, carries = _scan_sizes(params)
        before, each = marks[:consts], [_mark_of_slice(mark) for mark in marks[consts + carries :]]
        carry = [_Mark(mark.trained) for mark in marks[consts : consts + carries]]
        work, out = self._loop(params["jaxpr"].jaxpr, before, carry, each, wanted)
        return work.times(params["length"]), [_Mark(mark.trained) for mark in out]

    def _while(self, eqn: Any, marks: list[_Mark], wanted: list[bool]) -> tuple[Work, list[_Mark]]:
        params = eqn.params
        skipped, consts = params["cond_nconsts"], params["body_nconsts"]
        before, carry = marks[skipped : skipped + consts], marks[skipped + consts :]
        carry = [_Mark(mark.trained) for mark in carry]
        work, out = self._loop(params["body_jaxpr"].jaxpr, before, carry, [], wanted)
        trips = _trips(eqn)
        if trips is None and work.total:
            name = str(getattr(eqn.source_info, "name_stack", "")) or "a loop"
            work = dataclasses.replace(work, unknown=(*work.unknown, name))
        return work.times(1 if trips is None else trips), [_Mark(mark.trained) for mark in out]

    def _loop(
        self,
        jaxpr: Any,
        before: list[_Mark],
        carry: list[_Mark],
        each: list[_Mark],
        wanted: list[bool],
    ) -> tuple[Work, list[_Mark]]:
        """Walk the body of a loop until the marks of its carry no longer change."""
        wanted = _wanted_in_loop(jaxpr, len(before), len(carry), wanted) if self.gradients else []
        while True:
            work, out = self.jaxpr(jaxpr, [*before, *carry, *each], wanted)
            after = [
                _Mark(a.trained or b.trained) for a, b in zip(carry, out[: len(carry)], strict=True)
            ]
            if after == carry:
                return work, out
            carry = after

    def _cond(
        self, params: Mapping[str, Any], marks: list[_Mark], wanted: list[bool]
    ) -> tuple[Work, list[_Mark]]:
        found = [self.jaxpr(branch.jaxpr, marks[1:], wanted) for branch in params["branches"]]
        works = [work for work, _ in found]
        platforms = params.get("branches_platforms") or marks[0].platforms
        if platforms and self.gradients:  # same mathematics: take the one with the least padding
            work = min(works, key=lambda work: work.total)
        elif platforms:
            work = works[self._choose(platforms)]
        else:
            work = max(works, key=lambda work: work.total)
        outs = zip(*(out for _, out in found), strict=True)
        return work, [_Mark(any(mark.trained for mark in each)) for each in outs]

    def _call(
        self, eqn: Any, inner: list[Any], marks: list[_Mark], wanted: list[bool]
    ) -> tuple[Work, list[_Mark]]:
        """Walk the inner jaxpr of an equation, such as ``jit`` and ``jax.checkpoint``."""
        trained = any(mark.trained for mark in marks)
        work, outs = Work(), [_Mark(trained)] * len(eqn.outvars)
        for jaxpr in inner:
            fits = len(jaxpr.invars) == len(marks)
            given = marks if fits else [_Mark(trained)] * len(jaxpr.invars)
            same = len(jaxpr.outvars) == len(wanted)
            found, out = self.jaxpr(
                jaxpr, given, wanted if same else [any(wanted)] * len(jaxpr.outvars)
            )
            work += found
            if fits and same:
                outs = out
        if eqn.primitive.name == "pallas_call":  # the library's only such kernels are attention's
            work = Work({ATTENTION: work.total}, unknown=work.unknown)
        return work.times(_copies(eqn)), outs

    def _choose(self, platforms: Sequence[Any]) -> int:
        """Return the index of the implementation for the walk's platform."""
        for index, names in enumerate(platforms):
            if names is None or self.platform in names:
                return index
        return len(platforms) - 1


def _differentiable(var: Any) -> bool:
    return jnp.issubdtype(getattr(var.aval, "dtype", bool), jnp.inexact)


def _is_product(name: str) -> bool:
    return name in ("dot_general", "conv_general_dilated") or name.startswith(_FUSED)


def _reaching(jaxpr: Any, wanted: Sequence[bool]) -> frozenset[Any]:
    """Return the variables on which the wanted results depend differentiably."""
    found: set[Any] = set()

    def add(variables: Sequence[Any], flags: Sequence[bool]) -> None:
        for var, flag in zip(variables, flags, strict=True):
            if flag and not isinstance(var, core.Literal) and _differentiable(var):
                found.add(var)

    add(jaxpr.outvars, wanted)
    for eqn in reversed(jaxpr.eqns):
        out = [var in found for var in eqn.outvars]
        if any(out) and eqn.primitive.name != "stop_gradient":
            add(eqn.invars, _wanted_inputs(eqn, out))
    return frozenset(found)


def _scan_sizes(params: Mapping[str, Any]) -> tuple[int, int]:
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
        inside = _wanted_in_loop(body, *_scan_sizes(params), wanted)
        return _inputs_of(body, inside)
    if name == "while":
        body, skipped = params["body_jaxpr"].jaxpr, params["cond_nconsts"]
        inside = _wanted_in_loop(body, params["body_nconsts"], len(wanted), wanted)
        return [False] * skipped + _inputs_of(body, inside)
    if name == "cond":
        branches = [_inputs_of(branch.jaxpr, wanted) for branch in params["branches"]]
        return [False, *(any(each) for each in zip(*branches, strict=True))]
    found = [False] * count
    for jaxpr in _jaxprs(params):
        if len(jaxpr.invars) != count or len(jaxpr.outvars) != len(wanted):
            return [True] * count
        found = [a or b for a, b in zip(found, _inputs_of(jaxpr, wanted), strict=True)]
    return found if any(True for _ in _jaxprs(params)) else [True] * count


def _inputs_of(jaxpr: Any, wanted: Sequence[bool]) -> list[bool]:
    reaching = _reaching(jaxpr, wanted)
    return [var in reaching for var in jaxpr.invars]


def _wanted_in_loop(jaxpr: Any, consts: int, carries: int, wanted: Sequence[bool]) -> list[bool]:
    """Return, per result of a loop's body, whether it is wanted in any iteration."""
    wanted = list(wanted)
    while True:
        inputs = _inputs_of(jaxpr, wanted)[consts : consts + carries]
        after = [a or b for a, b in zip(wanted[:carries], inputs, strict=True)] + wanted[carries:]
        if after == wanted:
            return wanted
        wanted = after


def _jaxprs(params: Mapping[str, Any]) -> Iterator[Any]:
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


def _copies(eqn: Any) -> int:
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


def _flops(eqn: Any) -> tuple[str, float, float]:
    """Return kind, FLOPs and memory traffic of a product, without its gradients."""
    name, params = eqn.primitive.name, eqn.params
    left, right = (var.aval.shape for var in eqn.invars[:2])
    out = eqn.outvars[0].aval.shape
    traffic = sum(_bytes(var) for var in (*eqn.invars[:2], eqn.outvars[0]))
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


def _bytes(var: Any) -> float:
    return float(math.prod(var.aval.shape) * var.aval.dtype.itemsize)


def _trips(eqn: Any) -> int | None:
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


def _mark_of_slice(mark: _Mark) -> _Mark:
    """Return the mark of a slice along the first dimension."""
    return _Mark(mark.trained, mark.axes[1:] if mark.axes else None)


def _moved(eqn: Any, axes: Axes | None) -> Axes | None:
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
