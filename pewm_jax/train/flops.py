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
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from jax.extend import core
from jax.interpreters import partial_eval

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.io import tree
from pewm_jax.train import jaxprs
from pewm_jax.train.step import create
from pewm_jax.types import Params
from pewm_jax.worlds.stages import Stage


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
    """Count the products of a program for a platform: "cpu", "cuda" or "tpu".

    ``step`` is a closed jaxpr, such as ``jax.make_jaxpr(f)(…)`` or ``jax.jit(f).trace(…).jaxpr``.
    """
    jaxpr, _ = partial_eval.dce_jaxpr(step.jaxpr, [True] * len(step.jaxpr.outvars))
    walk = _Walk(gradients=False, platform=platform)
    return walk.jaxpr(jaxpr, [_Mark() for _ in jaxpr.invars])[0]


def needed(
    loss: Any, trained: Sequence[bool], axes: Sequence[jaxprs.Axes | None] | None = None
) -> Work:
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

    ``clip`` is the batch, or its shapes; ``given`` the weights of ``Stage.extra_weights``.
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
    axes: list[jaxprs.Axes | None] = [
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
        platforms: the platforms (None: all others) between which it selects, if it is the index of
            a platform-dependent branch.
    """

    trained: bool = False
    axes: jaxprs.Axes | None = None
    platforms: tuple[Any, ...] = ()


class _Walk:
    """Counts the products in a jaxpr, with ``gradients`` those of the gradients, too.

    ``platform`` selects among platform-dependent implementations. With ``gradients`` the cheapest
    one is counted: all compute the same, but some pad.
    """

    def __init__(self, *, gradients: bool, platform: str = ""):
        self.gradients, self.platform = gradients, platform

    def jaxpr(
        self, jaxpr: Any, marks: Sequence[_Mark], wanted: Sequence[bool] = ()
    ) -> tuple[Work, list[_Mark]]:
        """Return the work of a jaxpr and the marks of its results, from those of its inputs.

        With ``gradients``, ``wanted`` says for each result whether the loss depends on it.
        """
        known = dict(zip(jaxpr.invars, marks, strict=True))
        reaching = jaxprs.reaching(jaxpr, wanted) if self.gradients else frozenset()
        total = Work()

        def mark(var: Any) -> _Mark:
            return _Mark() if isinstance(var, core.Literal) else known.get(var, _Mark())

        for eqn in jaxpr.eqns:
            reaches = [var in reaching for var in eqn.outvars]
            work, out = self.equation(eqn, [mark(var) for var in eqn.invars], reaches)
            total += work
            for var, found in zip(eqn.outvars, out, strict=True):
                trained = found.trained and jaxprs.differentiable(var)
                known[var] = dataclasses.replace(found, trained=trained)
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
        elif jaxprs.is_product(name):
            out = [_Mark(any(mark.trained for mark in marks))] * len(eqn.outvars)
            found = self._product(eqn, marks, any(wanted)), out
        elif inner := list(jaxprs.inner(params)):
            found = self._call(eqn, inner, marks, wanted)
        if found is not None:
            return found
        if name == "platform_index":
            return Work(), [_Mark(platforms=tuple(params["platforms"]))]
        trained = name != "stop_gradient" and any(mark.trained for mark in marks)
        axes = jaxprs.moved(eqn, marks[0].axes) if marks else None
        return Work(), [_Mark(trained, axes)] * len(eqn.outvars)

    def _product(self, eqn: Any, marks: list[_Mark], wanted: bool) -> Work:
        kind, flops, traffic = jaxprs.product(eqn)
        backward = sum(mark.trained for mark in marks[:2])
        if eqn.primitive.name.startswith(jaxprs.FUSED):  # logits of queries and keys, times values
            q, k, v = (mark.trained for mark in marks[:3])
            backward = (q + k + (q or k) + v) / 2
        passes = 1 + backward * wanted
        summed = 0.0
        if eqn.primitive.name == "dot_general":
            contracted = eqn.params["dimension_numbers"][0]
            for mark, dims in zip(marks, contracted, strict=True):
                if mark.axes and any(mark.axes[dim] == "tensor" for dim in dims):
                    summed = jaxprs.size(eqn.outvars[0])
        flops *= passes
        found, nothing = {kind: flops}, dict[str, float]()
        split = kind == jaxprs.ATTENTION or any("tensor" in (mark.axes or ()) for mark in marks)
        first = not any(mark.trained for mark in marks[:2] if mark.axes is None)
        repeated, unsplit = (found, nothing) if first else (nothing, found)
        if split:
            repeated = unsplit = nothing
        return Work(found, traffic * passes, summed, repeated, unsplit)

    def _scan(
        self, params: Mapping[str, Any], marks: list[_Mark], wanted: list[bool]
    ) -> tuple[Work, list[_Mark]]:
        consts, carries = jaxprs.scan_sizes(params)
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
        trips = jaxprs.trips(eqn)
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
        wanted = (
            jaxprs.wanted_in_loop(jaxpr, len(before), len(carry), wanted) if self.gradients else []
        )
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
        """Walk the inner jaxprs of an equation, such as ``jit`` and ``jax.checkpoint``."""
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
            work = Work({jaxprs.ATTENTION: work.total}, unknown=work.unknown)
        return work.times(jaxprs.copies(eqn)), outs

    def _choose(self, platforms: Sequence[Any]) -> int:
        """Return the index of the implementation for the walk's platform."""
        for index, names in enumerate(platforms):
            if names is None or self.platform in names:
                return index
        return len(platforms) - 1


def _mark_of_slice(mark: _Mark) -> _Mark:
    """Return the mark of a slice along the first dimension."""
    return _Mark(mark.trained, mark.axes[1:] if mark.axes else None)
