"""FLOPs and communication of a compiled program, counted from its HLO text.

XLA's own ``cost_analysis`` counts the body of a loop once; here it is counted once per iteration.
Only matrix products and convolutions are counted, with 2 FLOPs per multiply-add. All figures are
for one device.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterator

import numpy as np

KINDS = ("all-gather", "reduce-scatter", "all-reduce", "all-to-all", "collective-permute")
"""The kinds of collective communication."""
THROUGH = ("bitcast", "copy", "convert", "transpose", "reshape")
"""Operations that forward an array without using its values."""
PRODUCTS = ("dot", "convolution")
"""Operations that are matrix products or convolutions."""

_CALLED = re.compile(r"\b(?:calls|to_apply|body)=%?([\w.$-]+)")
BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")
EITHER = re.compile(r"\b(?:true|false)_computation=%?([\w.$-]+)")
TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
"""How an instruction names its branches, and how often a loop runs."""
BITS = {"pred": 8, "s4": 4, "u4": 4, "bf16": 16, "c64": 64, "c128": 128}
"""Bits of the types whose name does not state them."""

_COMPUTATION = re.compile(r"^(?:ENTRY )?%?([\w.$-]+) .*\{$")
_NAME = re.compile(r"^\s+(?:ROOT )?%?([\w.$-]+) = ")
_OPCODE = re.compile(r"\s*([\w-]+)\(")
_ARRAY = re.compile(r"([a-z]+\d*(?:e\dm\d\w*)?)\[([\d,<=]*)\]")
_LISTED = re.compile(r"replica_groups=\{(\{[\d,{} ]*\})\}")
_COUNTED = re.compile(r"replica_groups=\[([\d,]+)\]<=\[([\d,]+)\](?:T\(([\d,]+)\))?")
_MESH = re.compile(
    r"replica_groups=mesh\[([^\]]*)\](?:, device_ids=\(([^()]*(?:\([\d,]+\))?)\))? ?\{([^}]*)\}"
)
_ORDER = re.compile(r"\[([\d,]+)\](?:T\(([\d,]+)\))?")
_PAIRS = re.compile(r"source_target_pairs=\{\{(\d+),(\d+)\}")
_LABEL = re.compile(r'op_name="([^"]*)"')


@dataclasses.dataclass(frozen=True)
class Line:
    """An instruction.

    Attributes:
        shape: its type, such as ``f32[2,3]{1,0}``.
        opcode: its opcode, such as ``dot``.
        operands: names of the instructions whose results it uses.
        rest: its attributes, as text.
    """

    shape: str
    opcode: str
    operands: tuple[str, ...]
    rest: str

    @property
    def label(self) -> str:
        """Return JAX's name for its place in the program, or ""."""
        found = _LABEL.search(self.rest)
        return found[1] if found else ""


@dataclasses.dataclass(frozen=True)
class Product:
    """A matrix product or convolution.

    Attributes:
        label: JAX's name for its place in the program.
        flops: FLOPs of all its executions.
    """

    label: str
    flops: float


@dataclasses.dataclass(frozen=True)
class Collective:
    """A collective communication between devices.

    Attributes:
        kind: one of ``KINDS``.
        label: JAX's name for its place in the program.
        group: one of the groups of devices that communicate, by their index in the mesh.
        sent: bytes that a device sends in all its executions, with ring algorithms.
    """

    kind: str
    label: str
    group: tuple[int, ...]
    sent: float


@dataclasses.dataclass(frozen=True)
class Program:
    """The work of one device in one execution of a program.

    Attributes:
        products: its matrix products and convolutions.
        collectives: its communication.
        unknown: labels of loops with products or communication whose number of iterations is not in
            the text; they count as one iteration.
    """

    products: tuple[Product, ...]
    collectives: tuple[Collective, ...]
    unknown: tuple[str, ...]

    @property
    def flops(self) -> float:
        """Return the FLOPs of all products."""
        return sum(product.flops for product in self.products)

    def sent(self, kind: str) -> float:
        """Return the bytes that a device sends in communication of one kind."""
        return sum(item.sent for item in self.collectives if item.kind == kind)


def read(text: str) -> Program:
    """Count the work of a compiled program.

    Args:
        text: ``compiled.as_text()``.
    """
    computations, entry = split(text)
    users = {name: _users(lines) for name, lines in computations.items()}
    unknown: list[str] = []

    def only_sliced(
        computation: str, name: str, result_is_sliced: Callable[[], bool] = lambda: False
    ) -> bool:
        """Return whether every use of an array is a slice of it.

        If the array is the computation's result, ``result_is_sliced`` answers for the caller.
        """
        if name == next(reversed(computations[computation])):  # the computation's result
            return result_is_sliced()
        return bool(users[computation].get(name)) and all(
            _is_slice(line, name)
            or (line.opcode in THROUGH and only_sliced(computation, user, result_is_sliced))
            or any(
                only_sliced(
                    *parameter,
                    functools.partial(only_sliced, computation, user, result_is_sliced),
                )
                for parameter in _parameters(line, name, computations)
            )
            for user, line in users[computation][name]
        )

    @functools.cache
    def walk(name: str) -> tuple[tuple[Product, ...], tuple[Collective, ...]]:
        products: list[Product] = []
        collectives: list[Collective] = []
        lines = computations.get(name, {})
        for line in lines.values():
            if (flops := _flops(line, lines)) > 0:
                products.append(Product(line.label, flops))
            elif line.opcode.removesuffix("-start") in KINDS:
                collectives += collectives_of(line, lines, functools.partial(only_sliced, name))
            for (inner_products, inner_collectives), trips in _inside(line, walk):
                if trips == 0 and (inner_products or inner_collectives):
                    unknown.append(line.label)
                times = max(trips, 1)
                products += [Product(p.label, p.flops * times) for p in inner_products]
                collectives += [
                    dataclasses.replace(c, sent=c.sent * times) for c in inner_collectives
                ]
        return tuple(products), tuple(collectives)

    return Program(*walk(entry), tuple(unknown))


def _inside(line: Line, walk) -> Iterator[tuple]:
    """Yield the work of the computations that an instruction calls, with counts (0: unknown)."""
    if line.opcode == "while":
        trips = TRIPS.search(line.rest)
        body = _CALLED.search(line.rest)
        if body:
            yield walk(body[1]), int(trips[1]) if trips else 0
    elif line.opcode == "conditional":
        branches = BRANCHES.search(line.rest)
        names = re.findall(r"[\w.$-]+", branches[1]) if branches else EITHER.findall(line.rest)
        costs = [walk(name) for name in names]
        if costs:
            yield max(costs, key=lambda cost: sum(product.flops for product in cost[0])), 1
    elif line.opcode in ("fusion", "call", "async-start"):
        called = _CALLED.search(line.rest)
        if called:
            yield walk(called[1]), 1


def _flops(line: Line, lines: dict[str, Line]) -> float:
    """Return the FLOPs of one instruction, without the computations it calls."""
    matmul = line.opcode == "custom-call" and "matmul" in line.rest
    if line.opcode not in PRODUCTS and not matmul:
        return 0.0
    shapes = [dims(lines[name].shape) for name in line.operands[:2]]
    out = math.prod(dims(line.shape))
    if line.opcode == "dot":
        axes = numbers(line, "lhs_contracting_dims")
        summed = math.prod(shapes[0][axis] for axis in axes)
    elif matmul:
        summed = shapes[0][-1]
    else:
        labels = re.search(r"dim_labels=\w+_(\w+)->", line.rest)
        kernel = labels[1] if labels else "io"
        summed = math.prod(n for n, axis in zip(shapes[1], kernel, strict=True) if axis != "o")
    return 2.0 * out * summed


def collectives_of(
    line: Line, lines: dict[str, Line], only_sliced: Callable[[str], bool]
) -> Iterator[Collective]:
    """Yield a ``Collective`` for each operand of a communication instruction.

    An all-reduce whose result is only sliced counts as a reduce-scatter.
    """
    kind, group = line.opcode.removesuffix("-start"), _first_group(line)
    ring = (len(group) - 1) / max(len(group), 1)
    own = next((name for name, other in lines.items() if other is line), "")
    for index, operand in enumerate(line.operands):
        taken = size(lines[operand].shape) if operand in lines else 0.0
        effective = kind
        if kind == "all-reduce" and only_sliced(_element(own, index, lines)):
            effective = "reduce-scatter"
        sent = {
            "all-gather": taken * (len(group) - 1),
            "reduce-scatter": taken * ring,
            "all-reduce": 2 * taken * ring,
            "all-to-all": taken * ring,
            "collective-permute": taken,
        }[effective]
        yield Collective(effective, line.label, group, sent)


def _element(name: str, index: int, lines: dict[str, Line]) -> str:
    """Return the name of one of an instruction's results, by its index in the tuple."""
    for other, line in lines.items():
        taken = line.opcode == "get-tuple-element" and line.operands == (name,)
        if taken and re.search(rf"\bindex={index}\b", line.rest):
            return other
    return name


def _is_slice(line: Line, name: str) -> bool:
    return line.opcode == "dynamic-slice" and line.operands[0] == name


def _parameters(
    line: Line, name: str, computations: dict[str, dict[str, Line]]
) -> Iterator[tuple[str, str]]:
    """Yield the parameter of a fusion or call that an operand becomes: (computation, name)."""
    called = _CALLED.search(line.rest) if line.opcode in ("fusion", "call") else None
    if called is None:
        return
    places = {str(k) for k, operand in enumerate(line.operands) if operand == name}
    for inner, other in computations.get(called[1], {}).items():
        if other.opcode == "parameter" and other.operands[0] in places:
            yield called[1], inner


def split(text: str) -> tuple[dict[str, dict[str, Line]], str]:
    """Split a program into its computations, each its instructions by their names.

    Returns:
        The computations by their names, and the name of the entry computation.
    """
    computations: dict[str, dict[str, Line]] = {}
    entry, lines = "", {}
    for row in text.splitlines():
        if row.endswith("{") and (found := _COMPUTATION.match(row)):
            lines = computations.setdefault(found[1], {})
            entry = found[1] if row.startswith("ENTRY") else entry
        elif found := _NAME.match(row):
            lines[found[1]] = _parse(row[found.end() :])
    return computations, entry


def _parse(text: str) -> Line:
    """Parse an instruction: ``TYPE opcode(operands), attributes``."""
    end = _close(text, 0) if text.startswith("(") else text.find(" ")
    shape, text = text[:end], text[end:]
    found = _OPCODE.match(text)
    if found is None:
        return Line(shape, "", (), text)
    close = _close(text, found.end() - 1)
    inside = re.sub(r"/\*.*?\*/", "", text[found.end() : close - 1])
    operands = tuple(part.strip().split(" ")[-1].lstrip("%") for part in inside.split(", "))
    return Line(shape, found[1], operands, text[close:])


def _close(text: str, start: int) -> int:
    """Return the index after the parenthesis that closes the one at ``start``."""
    depth = 0
    for place in range(start, len(text)):
        depth += (text[place] == "(") - (text[place] == ")")
        if depth == 0:
            return place + 1
    return len(text)


def dims(shape: str) -> tuple[int, ...]:
    """Return the dimensions of an array type; of a tuple type those of its first array."""
    found = _ARRAY.search(shape)
    return tuple(int(n) for n in found[2].split(",") if n) if found else ()


def size(shape: str) -> float:
    """Return the bytes of an array or tuple type such as ``(f32[2,3]{1,0}, s32[])``."""
    total = 0.0
    for kind, dims in _ARRAY.findall(shape):
        digits = re.search(r"\d+", kind)
        bits = BITS.get(kind, int(digits[0]) if digits else 0)
        total += bits / 8 * math.prod(int(n) for n in dims.split(",") if n)
    return total


def numbers(line: Line, name: str) -> list[int]:
    """Return the numbers of an attribute such as ``dimensions={0,2}``, or none."""
    found = re.search(name + r"=\{([\d,]*)\}", line.rest)
    return [int(n) for n in found[1].split(",") if n] if found else []


def _users(lines: dict[str, Line]) -> dict[str, list[tuple[str, Line]]]:
    """Return, for each name, the instructions that use it as an operand."""
    found: dict[str, list[tuple[str, Line]]] = {}
    for name, line in lines.items():
        for operand in set(line.operands):
            found.setdefault(operand, []).append((name, line))
    return found


def _first_group(line: Line) -> tuple[int, ...]:
    """Return the first group of devices that communicate."""
    if counted := _COUNTED.search(line.rest):
        shape, dims = ([int(n) for n in counted[k].split(",")] for k in (1, 2))
        devices = np.arange(math.prod(dims)).reshape(dims)
        if counted[3]:
            devices = devices.transpose([int(n) for n in counted[3].split(",")])
        return tuple(int(n) for n in devices.reshape(shape)[0])
    if mesh := _MESH.search(line.rest):
        return _along(mesh[1], mesh[3], mesh[2] or "")
    if listed := _LISTED.search(line.rest):
        first = listed[1].split("}")[0].strip("{ ")
        return tuple(int(n) for n in first.split(",") if n.strip())
    if pairs := _PAIRS.search(line.rest):
        return int(pairs[1]), int(pairs[2])
    return ()


def _along(mesh: str, axes: str, order: str) -> tuple[int, ...]:
    """Return the first group along mesh axes, or along parts of them.

    Args:
        mesh: sizes, such as ``'a'=4,'b'=2``.
        axes: such as ``'a'``, or ``'a':(2)2`` for a sub-axis of size 2 after one of size 2.
        order: device order if it is not 0, 1, 2 …: ``[4,2]T(1,0)`` or ``0,2,4,6``.
    """
    sizes = {name: int(count) for name, count in re.findall(r"'([^']*)'=(\d+)", mesh)}
    strides, stride = {}, 1
    for name in reversed(sizes):
        strides[name], stride = stride, stride * sizes[name]
    group = np.zeros(1, int)
    for name, before, count in re.findall(r"'([^']*)'(?::\((\d+)\)(\d+))?", axes):
        steps = int(count) if count else sizes[name]
        inner = sizes[name] // (int(before) * steps) if count else 1
        places = np.arange(steps) * inner * strides[name]
        group = (group[:, None] + places).ravel()
    devices = np.arange(stride)
    if turned := _ORDER.fullmatch(order):
        devices = devices.reshape([int(n) for n in turned[1].split(",")])
        if turned[2]:
            devices = devices.transpose([int(n) for n in turned[2].split(",")])
    elif order:
        devices = np.array([int(n) for n in order.split(",")])
    return tuple(int(n) for n in devices.ravel()[group])
