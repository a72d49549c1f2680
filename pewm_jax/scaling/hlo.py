"""What a compiled program does, counted from its text: FLOPs, and bytes between devices.

XLA's own ``cost_analysis`` counts the body of a loop once; here a body counts as often as it runs.
Only products and convolutions are counted, 2 FLOPs per multiply-add. Figures are of one device.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterator

import numpy as np

KINDS = ("all-gather", "reduce-scatter", "all-reduce", "all-to-all", "collective-permute")
"""The kinds of communication."""
THROUGH = ("bitcast", "copy", "convert", "transpose", "reshape")
"""Operations behind which an array is still the same one."""
BITS = {"pred": 8, "s4": 4, "u4": 4, "bf16": 16, "c64": 64, "c128": 128}
"""Bits of the types whose names do not end with them."""

_COMPUTATION = re.compile(r"^(?:ENTRY )?%?([\w.$-]+) .*\{$")
_NAME = re.compile(r"^\s+(?:ROOT )?%?([\w.$-]+) = ")
_OPCODE = re.compile(r"\s*([\w-]+)\(")
_ARRAY = re.compile(r"([a-z]+\d*(?:e\dm\d\w*)?)\[([\d,<=]*)\]")
_CALLED = re.compile(r"\b(?:calls|to_apply|body)=%?([\w.$-]+)")
_BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")
_EITHER = re.compile(r"\b(?:true|false)_computation=%?([\w.$-]+)")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_LISTED = re.compile(r"replica_groups=\{(\{[\d,{} ]*\})\}")
_COUNTED = re.compile(r"replica_groups=\[([\d,]+)\]<=\[([\d,]+)\](?:T\(([\d,]+)\))?")
_MESH = re.compile(
    r"replica_groups=mesh\[([^\]]*)\](?:, device_ids=\(([^()]*(?:\([\d,]+\))?)\))? ?\{([^}]*)\}"
)
_ORDER = re.compile(r"\[([\d,]+)\](?:T\(([\d,]+)\))?")
_PAIRS = re.compile(r"source_target_pairs=\{\{(\d+),(\d+)\}")
_LABEL = re.compile(r'op_name="([^"]*)"')


@dataclasses.dataclass(frozen=True)
class Product:
    """A matrix product or convolution.

    Attributes:
        label: where in the program it comes from, as JAX names it.
        flops: all its runs together.
    """

    label: str
    flops: float


@dataclasses.dataclass(frozen=True)
class Collective:
    """One communication between devices.

    Attributes:
        kind: one of ``KINDS``.
        label: where in the program it comes from.
        group: the devices of one of the groups that communicate, by their place in the mesh.
        sent: bytes that a device sends in all its runs together, going round in a ring.
    """

    kind: str
    label: str
    group: tuple[int, ...]
    sent: float


@dataclasses.dataclass(frozen=True)
class Program:
    """What one device does when a program runs once.

    Attributes:
        products: its matrix products and convolutions.
        collectives: its communication.
        unknown: labels of loops that hold products or communication and do not say how often they
            run; they are counted as one run.
    """

    products: tuple[Product, ...]
    collectives: tuple[Collective, ...]
    unknown: tuple[str, ...]

    @property
    def flops(self) -> float:
        """FLOPs of all products."""
        return sum(product.flops for product in self.products)

    def sent(self, kind: str) -> float:
        """Return the bytes that a device sends in communication of one kind."""
        return sum(one.sent for one in self.collectives if one.kind == kind)


@dataclasses.dataclass(frozen=True)
class _Line:
    """An instruction: its type, opcode, operands and the rest of its text."""

    shape: str
    opcode: str
    operands: tuple[str, ...]
    rest: str

    @property
    def label(self) -> str:
        found = _LABEL.search(self.rest)
        return found[1] if found else ""


def read(text: str) -> Program:
    """Count what a compiled program does.

    Args:
        text: ``compiled.as_text()``.
    """
    computations, entry = _split(text)
    users = {name: _users(lines) for name, lines in computations.items()}
    unknown: list[str] = []

    def sliced(where: str, name: str, beyond: Callable[[], bool] = lambda: False) -> bool:
        """Whether of an array only slices are used, here or ``beyond`` what gives it on."""
        if name == next(reversed(computations[where])):  # what the computation gives
            return beyond()
        return bool(users[where].get(name)) and all(
            _is_slice(line, name)
            or (line.opcode in THROUGH and sliced(where, user, beyond))
            or any(
                sliced(*place, functools.partial(sliced, where, user, beyond))
                for place in _parameters(line, name, computations)
            )
            for user, line in users[where][name]
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
                collectives += _collectives(line, lines, functools.partial(sliced, name))
            for (some, others), trips in _inside(line, walk):
                if trips == 0 and (some or others):
                    unknown.append(line.label)
                times = max(trips, 1)
                products += [Product(p.label, p.flops * times) for p in some]
                collectives += [dataclasses.replace(c, sent=c.sent * times) for c in others]
        return tuple(products), tuple(collectives)

    return Program(*walk(entry), tuple(unknown))


def _inside(line: _Line, walk) -> Iterator[tuple]:
    """Yield what an instruction runs, and how often: 0 where the program does not say."""
    if line.opcode == "while":
        trips = _TRIPS.search(line.rest)
        body = _CALLED.search(line.rest)
        if body:
            yield walk(body[1]), int(trips[1]) if trips else 0
    elif line.opcode == "conditional":
        branches = _BRANCHES.search(line.rest)
        names = re.findall(r"[\w.$-]+", branches[1]) if branches else _EITHER.findall(line.rest)
        costs = [walk(name) for name in names]
        if costs:
            yield max(costs, key=lambda cost: sum(product.flops for product in cost[0])), 1
    elif line.opcode in ("fusion", "call", "async-start"):
        called = _CALLED.search(line.rest)
        if called:
            yield walk(called[1]), 1


def _split(text: str) -> tuple[dict[str, dict[str, _Line]], str]:
    """Split a program into its computations, and name the one it begins with."""
    computations: dict[str, dict[str, _Line]] = {}
    entry, lines = "", {}
    for row in text.splitlines():
        if row.endswith("{") and (found := _COMPUTATION.match(row)):
            lines = computations.setdefault(found[1], {})
            entry = found[1] if row.startswith("ENTRY") else entry
        elif found := _NAME.match(row):
            lines[found[1]] = _parse(row[found.end() :])
    return computations, entry


def _parse(text: str) -> _Line:
    """Take an instruction apart: ``TYPE opcode(operands), attributes``."""
    end = _close(text, 0) if text.startswith("(") else text.find(" ")
    shape, text = text[:end], text[end:]
    found = _OPCODE.match(text)
    if found is None:
        return _Line(shape, "", (), text)
    close = _close(text, found.end() - 1)
    inside = re.sub(r"/\*.*?\*/", "", text[found.end() : close - 1])
    operands = tuple(part.strip().split(" ")[-1].lstrip("%") for part in inside.split(", "))
    return _Line(shape, found[1], operands, text[close:])


def _close(text: str, start: int) -> int:
    """Return the place after the parenthesis that closes the one at ``start``."""
    depth = 0
    for place in range(start, len(text)):
        depth += (text[place] == "(") - (text[place] == ")")
        if depth == 0:
            return place + 1
    return len(text)


def _dims(shape: str) -> tuple[int, ...]:
    found = _ARRAY.search(shape)
    return tuple(int(n) for n in found[2].split(",") if n) if found else ()


def size(shape: str) -> float:
    """Return the bytes of an array's or a tuple's type, such as ``(f32[2,3]{1,0}, s32[])``."""
    total = 0.0
    for kind, dims in _ARRAY.findall(shape):
        digits = re.search(r"\d+", kind)
        bits = BITS.get(kind, int(digits[0]) if digits else 0)
        total += bits / 8 * math.prod(int(n) for n in dims.split(",") if n)
    return total


def _numbers(line: _Line, name: str) -> list[int]:
    found = re.search(name + r"=\{([\d,]*)\}", line.rest)
    return [int(n) for n in found[1].split(",") if n] if found else []


def _flops(line: _Line, lines: dict[str, _Line]) -> float:
    """Return the FLOPs of one instruction by itself."""
    matmul = line.opcode == "custom-call" and "matmul" in line.rest
    if line.opcode not in ("dot", "convolution") and not matmul:
        return 0.0
    shapes = [_dims(lines[name].shape) for name in line.operands[:2]]
    out = math.prod(_dims(line.shape))
    if line.opcode == "dot":
        summed = math.prod(shapes[0][axis] for axis in _numbers(line, "lhs_contracting_dims"))
    elif matmul:
        summed = shapes[0][-1]
    else:
        labels = re.search(r"dim_labels=\w+_(\w+)->", line.rest)
        kernel = labels[1] if labels else "io"
        summed = math.prod(n for n, axis in zip(shapes[1], kernel, strict=True) if axis != "o")
    return 2.0 * out * summed


def _collectives(
    line: _Line, lines: dict[str, _Line], sliced: Callable[[str], bool]
) -> Iterator[Collective]:
    """Yield the communication that an instruction is: one for each array that it takes."""
    kind, group = line.opcode.removesuffix("-start"), _group(line)
    others = (len(group) - 1) / max(len(group), 1)
    own = next((name for name, other in lines.items() if other is line), "")
    for index, operand in enumerate(line.operands):
        taken = size(lines[operand].shape) if operand in lines else 0.0
        made = kind
        if kind == "all-reduce" and sliced(_element(own, index, lines)):
            made = "reduce-scatter"
        sent = {
            "all-gather": taken * (len(group) - 1),
            "reduce-scatter": taken * others,
            "all-reduce": 2 * taken * others,
            "all-to-all": taken * others,
            "collective-permute": taken,
        }[made]
        yield Collective(made, line.label, group, sent)


def _element(name: str, index: int, lines: dict[str, _Line]) -> str:
    """Return the name under which one of the results of an instruction goes on."""
    for other, line in lines.items():
        taken = line.opcode == "get-tuple-element" and line.operands == (name,)
        if taken and re.search(rf"\bindex={index}\b", line.rest):
            return other
    return name


def _users(lines: dict[str, _Line]) -> dict[str, list[tuple[str, _Line]]]:
    """Return, for each name, the instructions that take it."""
    found: dict[str, list[tuple[str, _Line]]] = {}
    for name, line in lines.items():
        for operand in set(line.operands):
            found.setdefault(operand, []).append((name, line))
    return found


def _is_slice(line: _Line, name: str) -> bool:
    return line.opcode == "dynamic-slice" and line.operands[0] == name


def _parameters(
    line: _Line, name: str, computations: dict[str, dict[str, _Line]]
) -> Iterator[tuple[str, str]]:
    """Yield where a fusion's or a call's operand goes on inside: (computation, name)."""
    called = _CALLED.search(line.rest) if line.opcode in ("fusion", "call") else None
    if called is None:
        return
    places = {str(k) for k, operand in enumerate(line.operands) if operand == name}
    for inner, other in computations.get(called[1], {}).items():
        if other.opcode == "parameter" and other.operands[0] in places:
            yield called[1], inner


def _group(line: _Line) -> tuple[int, ...]:
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
    """Return the first group along axes, or parts of axes, of a mesh.

    Args:
        mesh: sizes, as in ``'a'=4,'b'=2``.
        axes: as in ``'a'``, or ``'a':(2)2`` for two of its parts after the first two.
        order: of the devices, if not their own: ``[4,2]T(1,0)`` or ``0,2,4,6``.
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
