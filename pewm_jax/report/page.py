"""A self-contained HTML page: sections of text, tables, figures and charts, from one template.

A page needs no other file unless a figure names one, and it is legible in light and dark mode.
Texts are plain; text between backticks is shown as code.
"""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import ClassVar, TypeAlias

import jinja2

from pewm_jax.io import atomic
from pewm_jax.report.charts import Chart
from pewm_jax.report.table import Row, Table

TEMPLATE = Path(__file__).with_name("page.html.jinja")


@dataclasses.dataclass(frozen=True)
class Text:
    """A paragraph; ``style`` is "", ``lead`` or ``quiet``."""

    kind: ClassVar[str] = "text"
    text: str
    style: str = ""


@dataclasses.dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]


@dataclasses.dataclass(frozen=True)
class TableBlock:
    """A table."""

    kind: ClassVar[str] = "table"
    table: Table


@dataclasses.dataclass(frozen=True)
class Figure:
    """An image or a video.

    Attributes:
        content: the file's bytes, which the page embeds, or the name of a file beside the page.
        media: its media type, such as ``image/png``.
        alt: alternative text of an image.
        caption: a text below it.
    """

    kind: ClassVar[str] = "figure"
    content: bytes | str
    media: str = "image/png"
    alt: str = ""
    caption: str = ""

    @property
    def source(self) -> str:
        """Return the figure's address."""
        if isinstance(self.content, str):
            return self.content
        return data_uri(self.content, self.media)


@dataclasses.dataclass(frozen=True)
class Charts:
    """Charts in columns, with one legend: name → colour."""

    kind: ClassVar[str] = "charts"
    charts: Sequence[Chart]
    legend: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Facts:
    """A list of names and values."""

    kind: ClassVar[str] = "facts"
    facts: Sequence[tuple[str, str]]


@dataclasses.dataclass(frozen=True)
class Details:
    """A block that is shown when its summary is clicked."""

    kind: ClassVar[str] = "details"
    summary: str
    content: Block


Block: TypeAlias = Text | Bullets | TableBlock | Figure | Charts | Facts | Details


@dataclasses.dataclass(frozen=True)
class Section:
    """A heading, which may be empty, and its content."""

    title: str
    blocks: Sequence[Block]

    @classmethod
    def of_table(
        cls, title: str, header: Sequence[str], rows: Sequence[Row], note: str = "", text: str = ""
    ) -> Section:
        """Return a section with a text, a table and a note below it, as far as they are given."""
        above = [Text(text)] if text else []
        below = [Text(note, "quiet")] if note else []
        return cls(title, [*above, TableBlock(Table(header, rows)), *below])

    @classmethod
    def of_note(cls, note: str) -> Section:
        """Return a section of one quiet sentence, such as why something was not measured."""
        return cls("", [Text(note, "quiet")])


def render(title: str, opening: Sequence[Block], sections: Sequence[Section | None]) -> str:
    """Return a page as HTML.

    A line break in the title starts a new line. A section that is None is skipped.
    """
    return _template().render(
        title=title.replace("\n", ", "),
        title_lines=title.split("\n"),
        opening=opening,
        sections=[section for section in sections if section is not None],
    )


def write_study(page: Path, markdown: str, scores: Table, numbers: Table, chart: Chart) -> None:
    """Write a page in Markdown and, beside it, scores (.tex), numbers (.csv) and a chart (.png)."""
    atomic.write_text(page, markdown)
    atomic.write_text(page.with_suffix(".tex"), scores.latex())
    atomic.write_text(page.with_suffix(".csv"), numbers.csv())
    with atomic.replacing(page.with_suffix(".png")) as partial:
        partial.write_bytes(chart.png())


def data_uri(content: bytes, media: str = "image/png") -> str:
    """Return bytes as a data URI."""
    return f"data:{media};base64,{base64.b64encode(content).decode()}"


def _prose(text: str) -> str:
    """Return text as HTML, with ``code`` between backticks."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text, quote=False))


def _template() -> jinja2.Template:
    environment = jinja2.Environment(autoescape=True, keep_trailing_newline=True)
    environment.filters |= {"prose": _prose, "data_uri": data_uri}
    return environment.from_string(TEMPLATE.read_text("utf-8"))
