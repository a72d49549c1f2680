"""FLOPs, memory traffic, kernels and communication of a compiled program, from its HLO text.

XLA's own ``cost_analysis`` counts the body of a loop once; here it is counted once per iteration.
FLOPs are those of matrix products and convolutions, 2 per multiply-add. Memory traffic is that of
the device's memory: what an instruction reads and writes beyond its own fusion, without arrays that
XLA keeps in on-chip memory. Of an array that is only sliced, or updated in place, the slice counts.
All figures are for one device.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator

from pewm_jax.plan import hlo
from pewm_jax.plan.hlo import Line, Lines, size

COLLECTIVES = ("all-gather", "reduce-scatter", "all-reduce", "all-to-all", "collective-permute")
"""The kinds of collective communication."""
ATTENTION, CONVOLUTION, GEMM = "attention", "convolution", "gemm"
"""Kinds of kernels."""

_PRODUCTS = ("dot", "convolution")
_SLICES = ("dynamic-slice", "slice", "gather")
_MOVES = ("bitcast", "copy", "reshape", "transpose")
_FORWARDS = (*_MOVES, "convert")
_NO_TRAFFIC = (
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
_TARGET = re.compile(r'custom_call_target="([^"]+)"')
_FUSION = re.compile(r'"fusion_backend_config":\{"kind":"_*([\w$]+)"')
_SPLASH = re.compile(r"splash_\w+")
_CONTINUED = re.compile(r'"flag_start":"(?!-1")')
_BETWEEN_SLICES = re.compile(
    r'megascale_target="\{([\d,]+)\}x\{(\d+)(?::(\d+))?\}",_xla_megascale_transfer_type="(\w+)"'
)
_KERNEL = re.compile(r"dim_labels=\w+_(\w+)->")


@dataclasses.dataclass(frozen=True)
class Collective:
    """A collective communication (``COLLECTIVES``) between devices.

    Attributes:
        kind: its kind.
        group: one of the groups of devices that communicate, by their index in the mesh.
        sent: bytes that a device sends in all its executions, with ring algorithms.
    """

    kind: str
    group: tuple[int, ...]
    sent: float


@dataclasses.dataclass
class Program:
    """The work of one device in one execution of a program, or of a part of one.

    Attributes:
        flops: FLOPs of matrix products and convolutions.
        bytes: bytes that are read from and written to the device's memory.
        launches: (kind, name of a kernel) → number of its launches.
        collectives: its communication.
        unknown: labels of loops with work whose number of iterations is not in the text; they count
            as one iteration.
    """

    flops: float = 0.0
    bytes: float = 0.0
    launches: Counter[tuple[str, str]] = dataclasses.field(default_factory=Counter)
    collectives: list[Collective] = dataclasses.field(default_factory=list)
    unknown: list[str] = dataclasses.field(default_factory=list)

    @property
    def kernels(self) -> dict[str, dict[str, int]]:
        """Return kind → name of a kernel → number of its launches."""
        found: dict[str, dict[str, int]] = {}
        for (kind, name), count in sorted(self.launches.items()):
            found.setdefault(kind, {})[name] = count
        return found

    def sent(self, kind: str) -> float:
        """Return the bytes that a device sends in communication of one kind."""
        return sum(item.sent for item in self.collectives if item.kind == kind)

    def add(self, other: Program, times: int = 1) -> None:
        """Add the work of a number of executions of another part."""
        self.flops += other.flops * times
        self.bytes += other.bytes * times
        for key, count in other.launches.items():
            self.launches[key] += count * times
        self.collectives += [
            dataclasses.replace(item, sent=item.sent * times) for item in other.collectives
        ]


def read(text: str, *, for_chip: bool = False) -> Program:
    """Count the work of a compiled program.

    Args:
        text: ``compiled.as_text()``.
        for_chip: whether it was compiled for a chip, so that its communication is what happens. The
            compiler for CPUs leaves sums of which only slices are used; a chip's compiler makes
            them reduce-scatters, and they are counted as such.
    """
    walk = _Walk(text, for_chip=for_chip)
    return dataclasses.replace(walk.computation(walk.entry), unknown=walk.unknown)


class _Walk:
    """A walk through the computations of a program."""

    def __init__(self, text: str, *, for_chip: bool):
        self.computations, self.entry = hlo.split(text)
        self.unknown: list[str] = []
        self.for_chip = for_chip
        self.computation = functools.cache(self._computation)
        self.users = functools.cache(self._users)

    def _computation(self, name: str, fused: bool = False) -> Program:
        """Count one execution of a computation; ``fused``: it is the content of a kernel."""
        work, lines = Program(), self.computations.get(name, {})
        for line in lines.values():
            opcode = line.opcode
            if opcode == "while":
                body, trips = self.computation(line.called), hlo.trips(line, self.computations)
                counts = body.flops or body.collectives or (self.for_chip and body.bytes)
                if trips is None and counts:
                    self.unknown.append(line.label)
                work.add(body, 1 if trips is None else trips)
            elif opcode == "conditional":
                branches = [self.computation(branch) for branch in line.branches]
                work.add(max(branches, key=lambda one: (one.flops, one.bytes), default=Program()))
            elif opcode in ("call", "async-start"):
                work.add(self.computation(line.called))
            elif opcode not in _NO_TRAFFIC and not opcode.endswith(("-done", "-update")):
                work.flops += _flops(line, lines)
                work.collectives += self._collectives(line, name, fused=fused)
                if opcode == "fusion":
                    inner = self.computation(line.called, True)
                    work.flops += inner.flops
                    work.collectives += inner.collectives
                if not fused:
                    work.bytes += self._traffic(line, lines)
                    if kernel := self._kernel(line):
                        work.launches[kernel] += 1
        return work

    def _inside(self, line: Line) -> Iterator[Line]:
        """Yield the instructions of a fusion, and of fusions in it."""
        for inner in self.computations.get(line.called, {}).values():
            yield inner
            if inner.opcode == "fusion":
                yield from self._inside(inner)

    def _kernel(self, line: Line) -> tuple[str, str] | None:
        """Return the kind and name of the kernel that an instruction launches."""
        if line.opcode == "custom-call":
            return _library_kernel(line, line.name)
        if line.opcode in _PRODUCTS:
            return _kind(line), f"XLA {line.opcode}"
        if line.opcode != "fusion":
            return None
        for inner in self._inside(line):
            if inner.opcode in _PRODUCTS:
                found = _FUSION.search(line.rest)
                return _kind(inner), found[1] if found else "XLA fusion"
        calls = (inner for inner in self._inside(line) if inner.opcode == "custom-call")
        inner = next(calls, None)
        return _library_kernel(inner, line.name) if inner else None

    def _collectives(self, line: Line, computation: str, *, fused: bool) -> Iterator[Collective]:
        """Yield a ``Collective`` for each operand of a communication instruction.

        A TPU splits communication into parts that run beside other work; the first part counts.
        Between slices of TPUs it is a ``send`` through the hosts, whose attributes say what it is.
        """
        kind, group = line.opcode.removesuffix("-start"), line.group
        if line.opcode == "send":
            kind, group = _between_slices(line)
            line = dataclasses.replace(line, operands=line.operands[:1])
        if kind not in COLLECTIVES or _CONTINUED.search(line.rest):
            return
        lines, ring = self.computations[computation], (len(group) - 1) / max(len(group), 1)
        for index, operand in enumerate(line.operands):
            taken = size(lines[operand].shape) if operand in lines else 0.0
            merges = kind == "all-reduce" and (fused or not self.for_chip)
            sliced = merges and self._only_sliced(computation, _element(line.name, index, lines))
            effective = "reduce-scatter" if sliced else kind
            sent = {
                "all-gather": taken * (len(group) - 1),
                "reduce-scatter": taken * ring,
                "all-reduce": 2 * taken * ring,
                "all-to-all": taken * ring,
                "collective-permute": taken,
            }[effective]
            yield Collective(effective, group, sent)

    def _users(self, computation: str) -> dict[str, list[Line]]:
        """Return, for each name, the instructions that use it as an operand."""
        found: dict[str, list[Line]] = {}
        for line in self.computations[computation].values():
            for operand in set(line.operands):
                found.setdefault(operand, []).append(line)
        return found

    def _only_sliced(
        self, computation: str, name: str, result_is_sliced: Callable[[], bool] = lambda: False
    ) -> bool:
        """Return whether every use of an array is a slice of it.

        If the array is the computation's result, ``result_is_sliced`` answers for the caller.
        """
        if name == hlo.result(self.computations[computation]).name:
            return result_is_sliced()

        def sliced(user: Line) -> bool:
            follow = functools.partial(self._only_sliced, computation, user.name, result_is_sliced)
            return (
                (user.opcode == "dynamic-slice" and user.operands[0] == name)
                or (user.opcode in _FORWARDS and follow())
                or any(self._only_sliced(*one, follow) for one in self._parameters(user, name))
            )

        users = self.users(computation).get(name, [])
        return bool(users) and all(map(sliced, users))

    def _parameters(self, line: Line, name: str) -> Iterator[tuple[str, str]]:
        """Yield the parameter of a fusion or call that an operand becomes: (computation, name)."""
        if line.opcode not in ("fusion", "call"):
            return
        places = {str(k) for k, operand in enumerate(line.operands) if operand == name}
        for inner in self.computations.get(line.called, {}).values():
            if inner.opcode == "parameter" and inner.operands[0] in places:
                yield line.called, inner.name

    def _traffic(self, line: Line, lines: Lines) -> float:
        """Return the bytes that an instruction moves from and to memory."""
        operands = [lines[name] for name in line.operands if name in lines]
        if line.opcode in _SLICES:
            return 2 * _in_memory(line)
        if line.opcode in ("dynamic-update-slice", "scatter"):
            return 2 * _in_memory(operands[-1 if line.opcode == "scatter" else 1])
        if line.opcode != "fusion":
            return _in_memory(line) + sum(map(_in_memory, operands))
        inner = self.computations.get(line.called, {})
        parameters = {
            int(other.operands[0]): other for other in inner.values() if other.opcode == "parameter"
        }
        return _written(line, inner) + sum(
            _read(parameters[place], _in_memory(lines[name]), inner)
            for place, name in enumerate(line.operands)
            if name in lines and place in parameters
        )


def _between_slices(send: Line) -> tuple[str, tuple[int, ...]]:
    """Return kind and group of communication between slices, or "" and none for another ``send``.

    Its target, such as ``{1,2}x{0:3}``, lists slices from 1 and the devices of a slice, each of
    which communicates with those of the same number in the other slices.
    """
    found = _BETWEEN_SLICES.search(send.rest)
    if found is None:
        return "", ()
    first = int(found[2])
    size = int(found[3] or first) + 1
    group = tuple((int(number) - 1) * size + first for number in found[1].split(","))
    return found[4].lower().replace("_", "-"), group


def _in_memory(line: Line) -> float:
    """Return the bytes of a result in the device's memory."""
    return size(line.shape, on_chip=False)


def _written(line: Line, inner: Lines) -> float:
    """Return the bytes that a fusion writes; of an update in place, the update."""
    if not inner:
        return _in_memory(line)
    root, parts = hlo.result(inner), hlo.sizes(line.shape, on_chip=False)
    roots = [inner[name] for name in root.operands] if root.opcode == "tuple" else [root]
    if len(roots) == 1:
        parts = [math.fsum(parts)]
    if len(parts) != len(roots):
        return math.fsum(parts)
    return sum(_updated(*one, inner) for one in zip(parts, roots, strict=True))


def _updated(whole: float, root: Line, inner: Lines) -> float:
    """Return how many of the ``whole`` bytes of one result a fusion writes."""
    while root.opcode in _FORWARDS and root.operands[0] in inner:
        root = inner[root.operands[0]]
    if root.opcode == "dynamic-update-slice" and whole:
        return min(whole, size(inner[root.operands[1]].shape))
    return whole


def _read(parameter: Line, whole: float, inner: Lines) -> float:
    """Return how many of the ``whole`` bytes of an operand a fusion reads."""
    names, read = [parameter.name], 0.0
    while names and whole:
        name = names.pop()
        for user in inner.values():
            if name not in user.operands:
                continue
            if user.opcode in _MOVES:
                names.append(user.name)
            elif user.opcode in _SLICES and user.operands[0] == name:
                read += size(user.shape)
            elif user.opcode != "dynamic-update-slice" or user.operands[0] != name:
                return whole  # an update in place reads nothing
    return min(read, whole)


def _flops(line: Line, lines: Lines) -> float:
    """Return the FLOPs of one instruction, without the computations it calls."""
    matmul = line.opcode == "custom-call" and "matmul" in _target(line)
    if line.opcode not in _PRODUCTS and not matmul:
        return 0.0
    shapes = [hlo.dims(lines[name].shape) for name in line.operands[:2]]
    out = math.prod(hlo.dims(line.shape))
    if line.opcode == "dot":
        summed = math.prod(shapes[0][axis] for axis in line.numbers("lhs_contracting_dims"))
    elif matmul:
        summed = shapes[0][-1]
    else:
        labels = _KERNEL.search(line.rest)
        kernel = labels[1] if labels else "io"
        summed = math.prod(n for n, axis in zip(shapes[1], kernel, strict=True) if axis != "o")
    return 2.0 * out * summed


def _element(name: str, index: int, lines: Lines) -> str:
    """Return the name of one of an instruction's results, by its index in the tuple."""
    for line in lines.values():
        taken = line.opcode == "get-tuple-element" and line.operands == (name,)
        if taken and re.search(rf"\bindex={index}\b", line.rest):
            return line.name
    return name


def _kind(product: Line) -> str:
    """Return whether a product is a convolution; TPUs have matrix products in that form too."""
    label = product.label.rsplit("/", 1)[-1]
    return GEMM if product.opcode == "dot" or "dot_general" in label else CONVOLUTION


def _library_kernel(line: Line, launched: str) -> tuple[str, str] | None:
    """Return the kind and name of a kernel that a library or Pallas provides.

    Args:
        line: the call.
        launched: the name of the instruction that launches it; Pallas names it after the kernel.
    """
    if splash := _SPLASH.search(launched):
        return ATTENTION, splash[0]
    name = _target(line)
    for part, kind in (("fmha", ATTENTION), ("conv", CONVOLUTION), ("cublas", GEMM)):
        if part in name.lower():
            return kind, name.strip("_")
    return None


def _target(line: Line) -> str:
    """Return the name of the function that a custom call calls, or ""."""
    found = _TARGET.search(line.rest)
    return found[1] if found else ""
