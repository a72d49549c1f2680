"""Line charts as plain SVG, without scripts, legible on light and dark pages."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from html import escape

COLOURS = {
    "memory": "#1f6feb",
    "empty": "#e8731a",
    "model": "#1f6feb",
    "none": "#b8479c",
    "reproject": "#1a9a6c",
    "copy": "#8a8f98",
}
"""The colour of each method; distinguishable for the colour-blind. The model itself has one colour,
with a memory or without."""
WIDTH, HEIGHT = 440, 280
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 36, 44


@dataclasses.dataclass(frozen=True)
class Line:
    """One curve.

    Attributes:
        name: for the legend.
        colour: any CSS colour.
        values: one per x, None if missing.
        errors: half height of the band around the curve, or None.
    """

    name: str
    colour: str
    values: Sequence[float | None]
    errors: Sequence[float | None]


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Return round numbers that span [low, high]; the first and last enclose it."""
    span = max(high - low, 1e-9)
    step = 10 ** math.floor(math.log10(span / about))
    step = min((s * step for s in (1, 2, 5, 10)), key=lambda s: abs(span / s - about))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [index * step for index in range(first, max(last, first + 1) + 1)]


def chart(
    title: str,
    x_label: str,
    lines: Sequence[Line],
    *,
    unit: str = "",
    places: Sequence[int] = (),
) -> str:
    """Draw curves over the frame index, which starts at 1, or over other numbers.

    Args:
        title: what is drawn.
        x_label: under the horizontal axis.
        lines: the curves, with the same number of values.
        unit: of the values, shown in the title.
        places: what stands under each value, evenly spread; by default 1, 2, 3, …

    Returns:
        An ``<svg>`` element, or a sentence if there is nothing to draw.
    """
    tops = [v + (e or 0) for line in lines for v, e in _pairs(line) if v is not None]
    lows = [v - (e or 0) for line in lines for v, e in _pairs(line) if v is not None]
    if not tops:
        return f"<p>{escape(title)}: no clip has enough such pixels.</p>"
    marks = ticks(min(lows), max(tops))
    low, high = marks[0], marks[-1]
    count = len(lines[0].values)

    def x(index: int) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (index / max(count - 1, 1))

    def y(value: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - value) / (high - low)

    heading = escape(f"{title}, {unit}" if unit else title)
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{heading}">',
        f'<text x="{LEFT}" y="16" class="t">{heading}</text>',
    ]
    for mark in marks:
        parts += [
            f'<path d="M{LEFT} {y(mark):.1f}H{WIDTH - RIGHT}" class="g"/>',
            f'<text x="{LEFT - 8}" y="{y(mark) + 4:.1f}" class="e">{mark:.6g}</text>',
        ]
    every = max(1, round(count / 8))
    for index in range(0, count, every):
        under = places[index] if places else index + 1
        parts.append(
            f'<text x="{x(index):.1f}" y="{HEIGHT - BOTTOM + 18}" class="m">{under}</text>'
        )
    parts.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" class="m">'
        f"{escape(x_label)}</text>"
    )
    for line in lines:
        parts += _curve(line, x, y)
    return "\n".join([*parts, "</svg>"])


def _pairs(line: Line) -> list[tuple[float | None, float | None]]:
    return list(zip(line.values, line.errors, strict=True))


def _curve(line: Line, x, y) -> list[str]:
    """Return the band and the curve, interrupted at missing values."""
    parts, run = [], []
    known = [(i, v, e or 0) for i, (v, e) in enumerate(_pairs(line)) if v is not None]
    runs: list[list[tuple[int, float, float]]] = []
    for point in known:
        if run and point[0] != run[-1][0] + 1:
            runs.append(run)
            run = []
        run.append(point)
    runs.append(run)
    for points in filter(None, runs):
        above = [f"{x(i):.1f},{y(v + e):.1f}" for i, v, e in points]
        below = [f"{x(i):.1f},{y(v - e):.1f}" for i, v, e in reversed(points)]
        middle = " ".join(f"{x(i):.1f},{y(v):.1f}" for i, v, _ in points)
        parts += [
            f'<polygon points="{" ".join(above + below)}" fill="{line.colour}" opacity="0.16"/>',
            f'<polyline points="{middle}" fill="none" stroke="{line.colour}" stroke-width="2.2"/>',
        ]
        parts += [
            f'<circle cx="{x(i):.1f}" cy="{y(v):.1f}" r="2.4" fill="{line.colour}"/>'
            for i, v, _ in points
            if len(known) <= 16
        ]
    return parts
