"""One table, written as HTML, Markdown, LaTeX, CSV or aligned text.

A table is a header and rows of cells. A cell is a text or a number with its uncertainty, so every
format shows the same digits. ``benchmarks``, reports and studies all build their tables here.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Literal, TypeAlias

MISSING = "–"
"""Text of a cell without a value."""
_LATEX = {
    "–": "--",
    "%": r"\%",
    "·": "--",
    "×": r"$\times$",
    "↓": r"$\downarrow$",
    "↑": r"$\uparrow$",
}
"""Characters and their LaTeX escapes."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A text, or a number with its uncertainty.

    Attributes:
        value: the text or the number; None shows a dash.
        digits: decimals of the number and of its uncertainty.
        error: half-width or standard error, shown as ``± error``.
        interval: lower and upper bound, shown in brackets.
        sign: whether a plus sign is shown.
        mark: text at the end, such as ``*``.
        best: whether the cell is emphasized.
    """

    value: float | str | None = None
    digits: int = 2
    error: float | None = None
    interval: tuple[float, float] | None = None
    sign: bool = False
    mark: str = ""
    best: bool = False

    @property
    def main(self) -> str:
        """Return the value without its uncertainty."""
        if self.value is None:
            return MISSING
        return self.value if isinstance(self.value, str) else self._format(self.value)

    @property
    def uncertainty(self) -> str:
        """Return the uncertainty as ``± 0.1`` or ``[0.1, 0.3]``; "" if there is none."""
        if self.value is None:
            return ""
        if self.error is not None:
            return f"± {self.error:.{self.digits}f}"
        if self.interval is not None:
            return f"[{', '.join(self._format(end) for end in self.interval)}]"
        return ""

    def _format(self, number: float) -> str:
        return f"{number:{'+' if self.sign else ''}.{self.digits}f}"

    def __str__(self) -> str:
        """Return the cell as plain text."""
        return " ".join(filter(None, (self.main, self.uncertainty))) + self.mark

    def html(self) -> str:
        """Return the cell's content as HTML."""
        text = escape(str(self))
        return f"<strong>{text}</strong>" if self.best else text

    def markdown(self) -> str:
        """Return the cell as Markdown."""
        return f"**{self}**" if self.best else str(self)

    def latex(self) -> str:
        """Return the cell as LaTeX, the uncertainty in small type."""
        number = not isinstance(self.value, str)
        text = _latex(self.main.replace("-", "$-$") if number else self.main)
        if self.uncertainty:
            small = self.uncertainty.replace("-", "$-$").replace("±", r"$\pm$")
            text += rf" {{\tiny {small}}}"
        text += _latex(self.mark)
        return rf"\textbf{{{text}}}" if self.best else text


CellLike: TypeAlias = Cell | str


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table.

    A ``heading`` has one cell, which spans all columns; a ``highlight`` is tinted. LaTeX draws a
    ``rule`` above it.
    """

    cells: tuple[Cell, ...]
    kind: Literal["plain", "heading", "highlight"] = "plain"
    rule: bool = False


def row(*cells: CellLike, highlight: bool = False, rule: bool = False) -> Row:
    """Return a row; texts are converted to cells."""
    return Row(_cells(cells), "highlight" if highlight else "plain", rule)


def heading(text: str) -> Row:
    """Return a row that spans the table and names the rows below it."""
    return Row((Cell(text),), "heading")


@dataclasses.dataclass(frozen=True)
class Table:
    """A header and rows; see ``row`` and ``heading``."""

    header: Sequence[str]
    rows: Sequence[Row]

    @classmethod
    def of(cls, header: Sequence[str], rows: Iterable[Sequence[CellLike]]) -> Table:
        """Return a table of plain rows."""
        return cls(tuple(header), [row(*cells) for cells in rows])

    def html(self) -> str:
        """Return a ``<table>`` in a box that scrolls horizontally if the page is too narrow."""
        lines = []
        for line in self.rows:
            if line.kind == "heading":
                content = f'<td colspan="{len(self.header)}">{line.cells[0].html()}</td>'
            else:
                content = "".join(f"<td>{cell.html()}</td>" for cell in line.cells)
            kind = "" if line.kind == "plain" else f' class="{line.kind}"'
            lines.append(f"<tr{kind}>{content}</tr>")
        heads = "".join(f"<th>{escape(head)}</th>" for head in self.header)
        return (
            f'<div class="scroll"><table><thead><tr>{heads}</tr></thead>\n<tbody>'
            + "\n".join(lines)
            + "</tbody></table></div>"
        )

    def markdown(self) -> str:
        """Return the table as Markdown; headings are rows whose other cells are empty."""
        lines = [list(self.header), ["---"] * len(self.header)]
        for line in self.rows:
            empty = [""] * (len(self.header) - len(line.cells))
            lines.append([*(cell.markdown() for cell in line.cells), *empty])
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    def latex(self) -> str:
        """Return a ``tabular`` for LaTeX with the package booktabs."""
        lines = [
            r"\begin{tabular}{l" + "r" * (len(self.header) - 1) + "}",
            r"\toprule",
            " & ".join(_latex(head) for head in self.header) + r" \\",
            r"\midrule",
        ]
        for line in self.rows:
            if line.rule:
                lines.append(r"\midrule")
            if line.kind == "heading":
                lines.append(
                    rf"\multicolumn{{{len(self.header)}}}{{l}}{{{line.cells[0].latex()}}} \\"
                )
            else:
                lines.append(" & ".join(cell.latex() for cell in line.cells) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def csv(self) -> str:
        """Return the cells as comma-separated text."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows([str(cell) for cell in line.cells] for line in self.rows)
        return file.getvalue()

    def text(self) -> list[str]:
        """Return aligned lines for a terminal: the first column left, the others right.

        A heading is a line of its own.
        """
        lines = [list(self.header), *([str(cell) for cell in line.cells] for line in self.rows)]
        whole = [line for line in lines if len(line) == len(self.header)]
        widths = [max(len(line[k]) for line in whole) for k in range(len(self.header))]

        def aligned(line: list[str]) -> str:
            others = zip(line[1:], widths[1:], strict=False)
            first = f"{line[0]:<{widths[0]}}" if line[1:] else line[0]
            return first + "".join(f"  {text:>{width}}" for text, width in others)

        return [aligned(line) for line in lines]


def with_error(entry: Mapping[str, Any] | None, digits: int, *, sign: bool = False) -> Cell:
    """Return the cell of ``{mean, stderr}``: ``mean ± stderr``, or a dash."""
    if entry is None:
        return Cell()
    return Cell(entry["mean"], digits, error=entry["stderr"], sign=sign)


def with_interval(entry: Mapping[str, Any] | None, digits: int, *, sign: bool = False) -> Cell:
    """Return the cell of ``{mean, low, high}``: ``mean [low, high]``, or a dash."""
    if entry is None:
        return Cell()
    ends = None if entry["low"] is None else (entry["low"], entry["high"])
    return Cell(entry["mean"], digits, interval=ends, sign=sign)


def with_frames(
    whole: Mapping[str, Any],
    steps: Mapping[str, Any],
    frames: Sequence[int],
    digits: int,
    *,
    sign: bool = False,
) -> list[Cell]:
    """Return the cells of a mean and of its values at some frames, with their intervals."""
    at = [{key: steps[key][t] for key in ("mean", "low", "high")} for t in frames]
    return [with_interval(entry, digits, sign=sign) for entry in (whole, *at)]


def with_half_width(entry: Mapping[str, Any] | None, digits: int, *, sign: bool = False) -> Cell:
    """Return the cell of ``{mean, low, high}``: ``mean ± half of the interval``, or a dash."""
    if entry is None:
        return Cell()
    half = None if entry["low"] is None else (entry["high"] - entry["low"]) / 2
    return Cell(entry["mean"], digits, error=half, sign=sign)


def score_cells(
    columns: Mapping[str, tuple[str, int]], entries: Mapping[str, Any], *, sign: bool = False
) -> list[Cell]:
    """Return the cells of scores with half of their interval; a column is a heading and digits."""
    return [
        with_half_width(entries[score], digits, sign=sign) for score, (_, digits) in columns.items()
    ]


def _cells(cells: Iterable[CellLike]) -> tuple[Cell, ...]:
    return tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in cells)


def _latex(text: str) -> str:
    return text.translate(str.maketrans(_LATEX))
