"""The text of a compiled program (HLO) as computations of instructions."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np

BITS = {"pred": 8, "s4": 4, "u4": 4, "bf16": 16, "c64": 64, "c128": 128}
"""Bits of the types whose name does not state them."""

_COMPUTATION = re.compile(r"^(?:ENTRY )?%?([\w.$-]+) .*\{$")
_NAME = re.compile(r"^\s+(?:ROOT )?%?([\w.$-]+) = ")
_OPCODE = re.compile(r"\s*([\w-]+)\(")
_ARRAY = re.compile(r"([a-z]+\d*(?:e\dm\d\w*)?)\[([\d,<=]*)\](\{[^{}]*\})?")
_ON_CHIP = re.compile(r"S\([1-9]")
_CALLED = re.compile(r"\b(?:calls|to_apply|called_computations|body)=\{?%?([\w.$-]+)")
_CONDITION = re.compile(r"\bcondition=%?([\w.$-]+)")
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
class Line:
    """An instruction.

    Attributes:
        name: its name in its computation.
        shape: its type, such as ``f32[2,3]{1,0}``.
        opcode: its opcode, such as ``dot``.
        operands: names of the instructions whose results it uses.
        rest: its attributes, as text.
    """

    name: str
    shape: str
    opcode: str
    operands: tuple[str, ...]
    rest: str

    @property
    def label(self) -> str:
        """Return JAX's name for its place in the program, or ""."""
        found = _LABEL.search(self.rest)
        return found[1] if found else ""

    @property
    def called(self) -> str:
        """Return the name of the computation that it calls, or ""."""
        found = _CALLED.search(self.rest)
        return found[1] if found else ""

    @property
    def branches(self) -> list[str]:
        """Return the names of the computations between which a conditional chooses."""
        found = _BRANCHES.search(self.rest)
        return re.findall(r"[\w.$-]+", found[1]) if found else _EITHER.findall(self.rest)

    @property
    def group(self) -> tuple[int, ...]:
        """Return the first group of devices that communicate."""
        if counted := _COUNTED.search(self.rest):
            shape, dims = (_numbers(counted[k]) for k in (1, 2))
            return tuple(_order(dims, counted[3]).reshape(shape)[0].tolist())
        if mesh := _MESH.search(self.rest):
            return _along(mesh[1], mesh[3], mesh[2] or "")
        if listed := _LISTED.search(self.rest):
            return tuple(_numbers(listed[1].split("}")[0].strip("{ ")))
        if pairs := _PAIRS.search(self.rest):
            return int(pairs[1]), int(pairs[2])
        return ()

    def numbers(self, name: str) -> list[int]:
        """Return the numbers of an attribute such as ``dimensions={0,2}``, or none."""
        found = re.search(name + r"=\{([\d,]*)\}", self.rest)
        return _numbers(found[1]) if found else []


Lines = dict[str, Line]
"""The instructions of a computation by their names; the last one is its result."""


def split(text: str) -> tuple[dict[str, Lines], str]:
    """Split a program, ``compiled.as_text()``, into its computations.

    Returns:
        The computations by their names, and the name of the entry computation.
    """
    computations: dict[str, Lines] = {}
    entry, lines = "", {}
    for row in text.splitlines():
        if row.endswith("{") and (found := _COMPUTATION.match(row)):
            lines = computations.setdefault(found[1], {})
            entry = found[1] if row.startswith("ENTRY") else entry
        elif found := _NAME.match(row):
            lines[found[1]] = _parse(found[1], row[found.end() :])
    return computations, entry


def _parse(name: str, text: str) -> Line:
    """Parse an instruction: ``TYPE opcode(operands), attributes``."""
    end = _close(text, 0) if text.startswith("(") else text.find(" ")
    shape, text = text[:end], text[end:]
    found = _OPCODE.match(text)
    if found is None:
        return Line(name, shape, "", (), text)
    close = _close(text, found.end() - 1)
    inside = re.sub(r"/\*.*?\*/", "", text[found.end() : close - 1])
    operands = tuple(part.strip().split(" ")[-1].lstrip("%") for part in inside.split(", "))
    return Line(name, shape, found[1], operands, text[close:])


def _close(text: str, start: int) -> int:
    """Return the index after the parenthesis that closes the one at ``start``."""
    depth = 0
    for place in range(start, len(text)):
        depth += (text[place] == "(") - (text[place] == ")")
        if depth == 0:
            return place + 1
    return len(text)


def result(lines: Lines) -> Line:
    """Return the instruction whose value is the result of a computation."""
    return lines[next(reversed(lines))]


def trips(line: Line, computations: dict[str, Lines]) -> int | None:
    """Return how often a loop runs, by its annotation or its condition ``i < n``, or None."""
    if known := _TRIPS.search(line.rest):
        return int(known[1])
    condition = _CONDITION.search(line.rest)
    lines = computations.get(condition[1], {}) if condition else {}
    if lines and result(lines).opcode == "compare" and "direction=LT" in result(lines).rest:
        limit = lines.get(result(lines).operands[1])
        if limit is not None and limit.opcode == "constant" and limit.operands[0].isdigit():
            return int(limit.operands[0])
    return None


def dims(shape: str) -> tuple[int, ...]:
    """Return the dimensions of an array type; of a tuple type those of its first array."""
    found = _ARRAY.search(shape)
    return tuple(_numbers(found[2])) if found else ()


def sizes(shape: str, *, on_chip: bool = True) -> list[float]:
    """Return the bytes of each array of a type such as ``(f32[2,3]{1,0}, s32[])``.

    Args:
        shape: the type.
        on_chip: whether arrays that XLA keeps in on-chip memory count, too.
    """
    found = []
    for kind, dims, layout in _ARRAY.findall(shape):
        digits = re.search(r"\d+", kind)
        bits = BITS.get(kind, int(digits[0]) if digits else 0)
        counts = on_chip or not _ON_CHIP.search(layout)
        found.append(bits / 8 * math.prod(_numbers(dims)) if counts else 0.0)
    return found


def size(shape: str, *, on_chip: bool = True) -> float:
    """Return the bytes of a type; see ``sizes``."""
    return math.fsum(sizes(shape, on_chip=on_chip))


def _numbers(text: str) -> list[int]:
    return [int(n) for n in text.split(",") if n.strip()]


def _order(dims: list[int], axes: str | None) -> np.ndarray:
    """Return device numbers in the shape ``dims``, transposed to ``axes`` if there are any."""
    devices = np.arange(math.prod(dims)).reshape(dims)
    return devices.transpose(_numbers(axes)) if axes else devices


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
        devices = _order(_numbers(turned[1]), turned[2])
    elif order:
        devices = np.array(_numbers(order))
    return tuple(devices.ravel()[group].tolist())
