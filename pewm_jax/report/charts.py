"""Charts as PNG files, drawn by matplotlib without its global state.

Equal values give equal bytes. Every chart has a light and a dark version; the light one has a white
background, the dark one is for pages in a dark colour scheme.
"""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

METHOD_COLOURS = {
    "memory": "#1f6feb",
    "empty": "#e8731a",
    "model": "#1f6feb",
    "none": "#b8479c",
    "reproject": "#1a9a6c",
    "copy": "#8a8f98",
    "truth": "#8a8f98",
}
"""The colour of each method, distinguishable for colour-blind readers. The evaluated model has the
same colour with and without a memory."""
DOTS_PER_INCH = 200
BAND_OPACITY = 0.16
MARKED = 16
"""Largest number of points for which a curve has markers."""
OFFSET: dict[str, Any] = {"xytext": (6, 0), "textcoords": "offset points"}
BESIDE = {**OFFSET, "va": "center", "fontsize": 8}
"""How a text is placed to the right of a point."""
LABEL_GAP = 0.045
"""Smallest distance between the labels of two curves, as a fraction of the height."""


@dataclasses.dataclass(frozen=True)
class _Theme:
    """Colours of text, background and grid lines."""

    ink: str
    quiet: str
    paper: str
    line: str


LIGHT = _Theme("#1c2028", "#666d7a", "#ffffff", "#dfe2e8")
DARK = _Theme("#e8eaee", "#9aa2b1", "#15181d", "#333944")


class Chart(Protocol):
    """A chart on a page."""

    @property
    def title(self) -> str:
        """Return the title."""
        ...

    @property
    def is_empty(self) -> bool:
        """Return whether there is nothing to draw."""
        ...

    def png(self, *, dark: bool = False) -> bytes:
        """Return the chart as a PNG file."""
        ...


@dataclasses.dataclass(frozen=True)
class Line:
    """A curve with a band around it.

    Values and edges of the band are one per position, None where there is none; ``name`` is the
    label at its end.
    """

    name: str
    colour: str
    values: Sequence[float | None]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()

    @classmethod
    def with_errors(
        cls, name: str, colour: str, values: Sequence[float | None], errors: Sequence[float | None]
    ) -> Line:
        """Return a curve with the band value ± error."""
        pairs = list(zip(values, errors, strict=True))
        low = [None if v is None else v - (e or 0) for v, e in pairs]
        high = [None if v is None else v + (e or 0) for v, e in pairs]
        return cls(name, colour, values, low, high)

    @classmethod
    def with_interval(cls, name: str, colour: str, entry: Mapping[str, Any]) -> Line:
        """Return the curve ``mean`` with the band from ``low`` to ``high``."""
        return cls(name, colour, entry["mean"], entry["low"], entry["high"])


@dataclasses.dataclass(frozen=True)
class LineChart:
    """Curves over positions.

    Attributes:
        lines: the curves, with one value per position.
        x: the positions; 1, 2, 3, … by default.
        unit: unit of the values, shown in the title.
        label_lines: whether each curve is labelled at its end.
        size: width and height, inches.
    """

    title: str
    x_label: str
    lines: Sequence[Line]
    x: Sequence[float] = ()
    unit: str = ""
    label_lines: bool = False
    size: tuple[float, float] = (4.4, 2.8)

    @property
    def is_empty(self) -> bool:
        """Return whether no curve has a value."""
        return all(value is None for line in self.lines for value in line.values)

    def png(self, *, dark: bool = False) -> bytes:
        """Return the chart as a PNG file."""
        theme = DARK if dark else LIGHT
        figure, axes = _axes(self.size, theme)
        count = len(self.lines[0].values)
        x = list(self.x or range(1, count + 1))
        for line in reversed(self.lines):  # the first one on top
            marker = "o" if sum(value is not None for value in line.values) <= MARKED else ""
            style = {"color": line.colour, "linewidth": 1.6, "marker": marker, "markersize": 3}
            axes.plot(x, _numbers(line.values), **style)
            if line.low:
                low, high = _band(line)
                axes.fill_between(x, low, high, color=line.colour, alpha=BAND_OPACITY, linewidth=0)
        title = f"{self.title}, {self.unit}" if self.unit else self.title
        axes.set_title(title, loc="left", fontsize=9, fontweight="bold", color=theme.ink)
        axes.set_xlabel(self.x_label, fontsize=8, color=theme.quiet)
        axes.grid(axis="y", color=theme.line, linewidth=0.6)
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        if self.x:
            every = max(1, round(count / 8))
            axes.set_xticks(x[::every])
        else:
            axes.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
        if self.label_lines:
            _label_lines(axes, self.lines, x)
        return _png(figure)


@dataclasses.dataclass(frozen=True)
class IntervalRow:
    """A mean with its interval, and the single values."""

    label: str
    mean: float
    low: float | None
    high: float | None
    dots: Sequence[float] = ()
    quiet: bool = False


@dataclasses.dataclass(frozen=True)
class IntervalChart:
    """Means with their intervals, stacked vertically from top to bottom."""

    title: str
    caption: str
    rows: Sequence[IntervalRow]

    @property
    def is_empty(self) -> bool:
        """Return whether there are no rows."""
        return not self.rows

    def png(self, *, dark: bool = False) -> bytes:
        """Return the chart as a PNG file."""
        theme = DARK if dark else LIGHT
        figure, axes = _axes((7.2, 0.9 + 0.3 * len(self.rows)), theme)
        for place, item in enumerate(self.rows):
            colour = theme.quiet if item.quiet else METHOD_COLOURS["memory"]
            low = item.mean if item.low is None else item.low
            high = item.mean if item.high is None else item.high
            axes.plot([low, high], [place, place], color=colour, linewidth=2)
            axes.plot([item.mean], [place], color=colour, marker="o", markersize=6)
            below = [place + 0.28] * len(item.dots)
            axes.plot(item.dots, below, color=colour, marker="o", markersize=2.5, linestyle="")
            axes.annotate(f"{item.mean:.2f}", (high, place), color=theme.ink, **BESIDE)
        axes.set_yticks(range(len(self.rows)), [item.label for item in self.rows], fontsize=8)
        axes.tick_params(axis="y", labelcolor=theme.ink)
        axes.set_ylim(len(self.rows) - 0.4, -0.6)
        axes.margins(x=0.12)
        axes.grid(axis="x", color=theme.line, linewidth=0.6)
        axes.set_title(self.title, loc="left", fontsize=10, fontweight="bold", color=theme.ink)
        axes.set_xlabel(self.caption, fontsize=8, color=theme.quiet)
        return _png(figure)


def _axes(size: tuple[float, float], theme: _Theme) -> tuple[Figure, Axes]:
    """Return an empty figure, and axes without a frame."""
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH, facecolor=theme.paper, layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor(theme.paper)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0, labelsize=8, labelcolor=theme.quiet)
    return figure, axes


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def _numbers(values: Sequence[float | None]) -> list[float]:
    return [math.nan if value is None else value for value in values]


def _band(line: Line) -> tuple[list[float], list[float]]:
    """Return the edges of a band; equal to the curve where there is no interval."""
    edges = zip(line.values, line.low, line.high, strict=True)
    pairs = [(v, v) if low is None or high is None else (low, high) for v, low, high in edges]
    return _numbers([pair[0] for pair in pairs]), _numbers([pair[1] for pair in pairs])


def _label_lines(axes: Axes, lines: Sequence[Line], x: Sequence[float]) -> None:
    """Label each curve at its end, without overlap."""
    bottom, top = axes.get_ylim()
    ends = [
        (known[-1], line)
        for line in lines
        if (known := [value for value in line.values if value is not None])
    ]
    place = -math.inf
    for value, line in sorted(ends, key=lambda end: end[0]):
        place = max(value, place + LABEL_GAP * (top - bottom))
        end = (x[-1], place)
        axes.annotate(line.name, end, color=line.colour, annotation_clip=False, **BESIDE)
