"""Kernels, memory traffic and communication of a program compiled for a chip, from its HLO text.

What a loop runs counts as often as it runs. Memory traffic is that of the device's memory: what an
instruction reads and writes beyond its own fusion, without arrays that XLA keeps in on-chip memory.
Of an array that is only sliced, or updated in place, the slice counts. All figures are for one
device.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections import Counter
from collections.abc import Iterator

from pewm_jax.plan import hlo
from pewm_jax.plan.hlo import Line

NO_TRAFFIC = (
    "parameter",
    "constant",
    "tuple",
    "get-tuple-element",
    "bitcast",
    "after-all",
    "partition-id",
    "replica-id",
    "optimization-barrier",
)
"""Operations that move no data."""
ATTENTION, CONVOLUTION, GEMM = "attention", "convolution", "gemm"
"""Kinds of kernels."""

_CALLED = re.compile(r"\b(?:calls|to_apply|called_computations)=\{?%?([\w.$-]+)")
_BODY = re.compile(r"\bbody=%?([\w.$-]+)")
_CONDITION = re.compile(r"\bcondition=%?([\w.$-]+)")
_TARGET = re.compile(r'custom_call_target="([^"]+)"')
_FUSION = re.compile(r'"fusion_backend_config":\{"kind":"_*([\w$]+)"')
_SPLASH = re.compile(r"splash_\w+")
_LAID_OUT = re.compile(r"([a-z]+\d*(?:e\dm\d\w*)?\[[\d,<=]*\])(\{[^{}]*\})?")
_ELSEWHERE = re.compile(r"S\([1-9]")
_CONTINUED = re.compile(r'"flag_start":"(?!-1")')


@dataclasses.dataclass(frozen=True)
class ChipProgram:
    """What one device does when a program runs once.

    Attributes:
        kernels: kind → name of a kernel → number of its launches.
        bytes: bytes that are read from and written to the device's memory.
        collectives: its communication.
        unknown: labels of loops whose number of runs is not in the text; they count as one run.
    """

    kernels: dict[str, dict[str, int]]
    bytes: float
    collectives: tuple[hlo.Collective, ...]
    unknown: tuple[str, ...]


@dataclasses.dataclass
class _Cost:
    """What a computation does in one run."""

    kernels: Counter[tuple[str, str]] = dataclasses.field(default_factory=Counter)
    bytes: float = 0.0
    collectives: list[hlo.Collective] = dataclasses.field(default_factory=list)

    def add(self, other: _Cost, times: int = 1) -> None:
        """Add what another computation does in so many runs."""
        for key, count in other.kernels.items():
            self.kernels[key] += count * times
        self.bytes += other.bytes * times
        self.collectives += [
            dataclasses.replace(item, sent=item.sent * times) for item in other.collectives
        ]


def read(text: str) -> ChipProgram:
    """Read a compiled program.

    Args:
        text: ``compiled.as_text()``.
    """
    walk = _Walk(text)
    cost = walk.computation(walk.entry)
    kernels: dict[str, dict[str, int]] = {}
    for (kind, name), count in sorted(cost.kernels.items()):
        kernels.setdefault(kind, {})[name] = count
    return ChipProgram(kernels, cost.bytes, tuple(cost.collectives), tuple(walk.unknown))


class _Walk:
    """A walk through the computations of a program."""

    def __init__(self, text: str):
        self.computations, self.entry = hlo.split(text)
        self.unknown: list[str] = []
        self.computation = functools.cache(self._computation)

    def _computation(self, name: str) -> _Cost:
        cost, lines = _Cost(), self.computations.get(name, {})
        for own, line in lines.items():
            opcode = line.opcode
            if opcode == "while":
                body, trips = _BODY.search(line.rest), self._trips(line)
                if body:
                    cost.add(self.computation(body[1]), trips)
            elif opcode == "conditional":
                branches = [self.computation(branch) for branch in _branches(line)]
                if branches:
                    cost.add(max(branches, key=lambda branch: branch.bytes))
            elif opcode in ("call", "async-start"):
                called = _CALLED.search(line.rest)
                if called:
                    cost.add(self.computation(called[1]))
            elif opcode not in NO_TRAFFIC and not opcode.endswith(("-done", "-update")):
                cost.bytes += self._traffic(line, lines)
                cost.collectives += self._collectives(line, lines)
                kernel = self._kernel(own, line)
                if kernel:
                    cost.kernels[kernel] += 1
        return cost

    def _trips(self, line: Line) -> int:
        """Return how often a loop runs, from its annotation or its condition ``i < n``."""
        if known := hlo.TRIPS.search(line.rest):
            return int(known[1])
        condition = _CONDITION.search(line.rest)
        lines = self.computations.get(condition[1], {}) if condition else {}
        root = lines[next(reversed(lines))] if lines else None
        if root is not None and root.opcode == "compare" and "direction=LT" in root.rest:
            limit = lines.get(root.operands[1])
            if limit is not None and limit.opcode == "constant" and limit.operands[0].isdigit():
                return int(limit.operands[0])
        self.unknown.append(line.label)
        return 1

    def _inside(self, line: Line) -> Iterator[tuple[dict[str, Line], Line]]:
        """Yield the instructions of a fusion, with their computations; also of inner ones."""
        called = _CALLED.search(line.rest)
        lines = self.computations.get(called[1], {}) if called else {}
        for inner in lines.values():
            yield lines, inner
            if inner.opcode == "fusion":
                yield from self._inside(inner)

    def _collectives(self, line: Line, lines: dict[str, Line]) -> Iterator[hlo.Collective]:
        """Yield the communication of an instruction or inside of a fusion.

        A TPU splits communication into parts that run beside other work; the first part counts.
        """
        pairs = [(lines, line)]
        if line.opcode == "fusion":
            pairs = list(self._inside(line))
        for around, inner in pairs:
            if inner.opcode.removesuffix("-start") not in hlo.KINDS:
                continue
            if _CONTINUED.search(inner.rest):
                continue
            scattered = line.opcode == "fusion" and any(
                other.opcode == "dynamic-slice" for other in around.values()
            )
            yield from hlo.collectives_of(inner, around, lambda _, sliced=scattered: sliced)

    def _kernel(self, own: str, line: Line) -> tuple[str, str] | None:
        """Return the kind and name of the kernel that an instruction launches.

        Args:
            own: the name of the instruction.
            line: the instruction.
        """
        if line.opcode == "custom-call":
            return _library_kernel(own, line)
        if line.opcode in hlo.PRODUCTS:
            return _kind(line), f"XLA {line.opcode}"
        if line.opcode != "fusion":
            return None
        products = [inner for _, inner in self._inside(line) if inner.opcode in hlo.PRODUCTS]
        if not products:
            inner = next(
                (one for _, one in self._inside(line) if one.opcode == "custom-call"), None
            )
            return _library_kernel(own, inner) if inner else None
        found = _FUSION.search(line.rest)
        return _kind(products[0]), found[1] if found else "XLA fusion"

    def _traffic(self, line: Line, lines: dict[str, Line]) -> float:
        """Return the bytes that an instruction moves from and to memory."""
        opcode, operands = line.opcode, [lines[name] for name in line.operands if name in lines]
        if opcode in ("dynamic-slice", "slice", "gather"):
            return 2 * size(line.shape)
        if opcode in ("dynamic-update-slice", "scatter"):
            return 2 * size(operands[-1 if opcode == "scatter" else 1].shape)
        if opcode != "fusion":
            return size(line.shape) + sum(size(operand.shape) for operand in operands)
        called = _CALLED.search(line.rest)
        inner = self.computations.get(called[1], {}) if called else {}
        parameters = {
            int(other.operands[0]): name
            for name, other in inner.items()
            if other.opcode == "parameter"
        }
        total = self._written(line, inner)
        for place, name in enumerate(line.operands):
            if name in lines and place in parameters:
                total += _read_of(parameters[place], lines[name].shape, inner)
        return total

    def _written(self, line: Line, inner: dict[str, Line]) -> float:
        """Return the bytes that a fusion writes; of an update in place, the update."""
        if not inner:
            return size(line.shape)
        root = inner[next(reversed(inner))]
        roots = [inner[name] for name in root.operands] if root.opcode == "tuple" else [root]
        if len(roots) == 1:
            return _result(line.shape, roots[0], inner)
        parts = list(_LAID_OUT.finditer(line.shape))
        if len(parts) != len(roots):
            return size(line.shape)
        return sum(_result(part[0], one, inner) for part, one in zip(parts, roots, strict=True))


def _result(shape: str, root: Line, inner: dict[str, Line]) -> float:
    while root.opcode in hlo.THROUGH and root.operands[0] in inner:
        root = inner[root.operands[0]]
    if root.opcode == "dynamic-update-slice" and size(shape):
        return min(size(shape), size(inner[root.operands[1]].shape, everywhere=True))
    return size(shape)


def _read_of(parameter: str, shape: str, inner: dict[str, Line]) -> float:
    """Return the bytes of an operand that a fusion reads."""
    whole = size(shape)
    if not whole:
        return 0.0
    names, read = [parameter], 0.0
    while names:
        name = names.pop()
        for user, line in inner.items():
            if name not in line.operands:
                continue
            if line.opcode in ("bitcast", "copy", "reshape", "transpose"):
                names.append(user)
            elif line.opcode in ("dynamic-slice", "slice", "gather") and line.operands[0] == name:
                read += size(line.shape, everywhere=True)
            elif line.opcode == "dynamic-update-slice" and line.operands[0] == name:
                continue  # updated in place
            else:
                return whole
    return min(read, whole)


def size(shape: str, *, everywhere: bool = False) -> float:
    """Return the bytes of a type in the device's memory.

    Args:
        shape: the type of an array or tuple, with layouts.
        everywhere: whether arrays in on-chip memory count too.
    """
    return math.fsum(
        hlo.size(found[1])
        for found in _LAID_OUT.finditer(shape)
        if everywhere or not (found[2] and _ELSEWHERE.search(found[2]))
    )


def _branches(line: Line) -> list[str]:
    branches = hlo.BRANCHES.search(line.rest)
    return re.findall(r"[\w.$-]+", branches[1]) if branches else hlo.EITHER.findall(line.rest)


def _kind(product: Line) -> str:
    """Return whether a product is a convolution; TPUs have matrix products in that form too."""
    label = product.label.rsplit("/", 1)[-1]
    if product.opcode == "dot" or "dot_general" in label:
        return GEMM
    return CONVOLUTION


def _library_kernel(own: str, line: Line) -> tuple[str, str] | None:
    """Return the kind and name of a kernel that a library or Pallas provides.

    Pallas names the instruction after the kernel.
    """
    found = _TARGET.search(line.rest)
    name = found[1] if found else ""
    if splash := _SPLASH.search(own):
        return ATTENTION, splash[0]
    for part, kind in (("fmha", ATTENTION), ("conv", CONVOLUTION), ("cublas", GEMM)):
        if part in name.lower():
            return kind, name.strip("_")
    return None
