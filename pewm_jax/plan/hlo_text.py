"""The text of a compiled program (HLO), read into instructions, their types and their devices."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np

BITS = {"pred": 8, "s4": 4, "u4": 4, "bf16": 16, "c64": 64, "c128": 128}
"""Bits of the types whose name does not tell."""

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
        opcode: what it does, such as ``dot``.
        operands: names of the instructions whose results it takes.
        rest: its attributes, as text.
    """

    shape: str
    opcode: str
    operands: tuple[str, ...]
    rest: str

    @property
    def label(self) -> str:
        """JAX's name for its place in the program, or nothing."""
        found = _LABEL.search(self.rest)
        return found[1] if found else ""


def split(text: str) -> tuple[dict[str, dict[str, Line]], str]:
    """Split a program into its computations, each its instructions by their names.

    Returns:
        The computations by their names, and the name of the one that the program begins with.
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


def users(lines: dict[str, Line]) -> dict[str, list[tuple[str, Line]]]:
    """Return, for each name, the instructions that use it as an operand."""
    found: dict[str, list[tuple[str, Line]]] = {}
    for name, line in lines.items():
        for operand in set(line.operands):
            found.setdefault(operand, []).append((name, line))
    return found


def group(line: Line) -> tuple[int, ...]:
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
