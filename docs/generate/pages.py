"""Pages made from code and from recorded results."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docs.generate import code, links

NUMBERS = """# Results

All numbers on this page are read from files that commands of the repository wrote.
"""
GLOSSARY = """# Letters

Names of arrays end in one letter per axis: `tokens_BND` is batch × tokens × width. A digit is an
axis of that size: `points_world_M3`. Arbitrary leading axes are omitted.

| letter | axis | in the data types |
|---|---|---|
"""
OWN = """
## Letters of single files

Some files use further letters; their docstrings define them.

| letter | where |
|---|---|
"""
SCORES = ("sim", "success", "position_error", "yaw_error")
"""Of `results.json`, in the order of the table's columns."""
SUFFIX = re.compile(r"\b[a-z][a-z0-9_]*_([A-Ztwhnqk]*[A-Z][A-Ztwhnqk]*)[0-9]*\b")
"""The letters at the end of an array's name."""


def reference(root: Path = code.ROOT) -> dict[str, str]:
    """Return the pages of the reference: one per package, from the docstrings."""
    pages, rows = {}, []
    for package, content in links.packages(root):
        modules = list(modules_of(package, root))
        body = "".join(f"\n::: {name}\n" for name in modules)
        pages[f"reference/{package}.md"] = (
            f"# {package}\n\n{content[:1].upper()}{content[1:]}.\n{body}"
        )
        rows.append(f"| [{package}]({package}.md) | {content} | {len(modules)} |")
    head = "# Reference\n\nA package imports only packages above it in this table.\n\n"
    table = "| package | content | files |\n|---|---|---|\n"
    pages["reference/index.md"] = head + table + "\n".join(rows) + "\n"
    return pages


def modules_of(package: str, root: Path = code.ROOT) -> Iterator[str]:
    """List the dotted names of a package's modules, its own first."""
    folder = root / ("configs" if package == "presets" else f"pewm_jax/{package}")
    if not folder.is_dir():
        yield f"pewm_jax.{package}"
        return
    for path in sorted(folder.rglob("*.py"), key=lambda p: (p.name != "__init__.py", p)):
        if path.name != "__main__.py":
            inside = path.relative_to(folder).with_suffix("").parts
            names = [name for name in inside if name != "__init__"]
            yield ".".join(["pewm_jax", package, *names])


def letters(root: Path = code.ROOT) -> dict[str, str]:
    """Return the meaning of each letter, from the docstring of ``types``."""
    text = (root / "pewm_jax" / "types.py").read_text("utf-8")
    (said,) = re.findall(r"^Letters: (.+?)\.$", text, re.MULTILINE | re.DOTALL)
    found: dict[str, str] = {}
    for entry in " ".join(said.split()).split(", "):
        *names, meaning = re.match(r"((?:\w )+)(.+)", entry).groups()  # type: ignore[union-attr]
        for name in "".join(names).split():
            found[name] = meaning
    return found


def suffixes(text: str) -> set[str]:
    """Return the letters at the ends of the names in a file."""
    return {letter for ending in SUFFIX.findall(text) for letter in ending}


def glossary(root: Path = code.ROOT) -> str:
    """Return the page of the letters."""
    meanings = letters(root)
    text = (root / "pewm_jax" / "types.py").read_text("utf-8")
    names = sorted({found[0] for found in re.finditer(SUFFIX, text) if "__" not in found[0]})
    rows = []
    for letter, meaning in meanings.items():
        among = [name for name in names if letter in re.search(r"_([A-Za-z0-9]+)$", name)[1]]  # type: ignore[index]
        rows.append(f"| {letter} | {meaning} | {', '.join(f'`{name}`' for name in among[:4])} |")
    own: dict[str, list[str]] = {}
    for path in sorted((root / "pewm_jax").rglob("*.py")):
        for letter in sorted(suffixes(path.read_text("utf-8")) - meanings.keys()):
            own.setdefault(letter, []).append(str(path.relative_to(root)))
    more = []
    for letter, files in sorted(own.items()):
        shown = ", ".join(f"`{file}`" for file in files[:6])
        rest = f" and {len(files) - 6} more" if len(files) > 6 else ""
        more.append(f"| {letter} | {shown}{rest} |")
    return GLOSSARY + "\n".join(rows) + "\n" + OWN + "\n".join(more) + "\n"


def numbers(root: Path = code.ROOT) -> str:
    """Return the page of the recorded results."""
    parts = [NUMBERS]
    for name in ("small", "codec", "codec-2"):
        card = (root / "pewm_jax" / "shipped" / name / "README.md").read_text("utf-8")
        scores = section(card, "Scores")
        parts.append(f"## The model `{name}`\n\nFrom [its card](cards/{name}.md).\n\n{scores}")
    found = json.loads((root / "docs" / "table2" / "results.json").read_text("utf-8"))
    parts.append("## Planning with a world model\n\n" + table2(found))
    recorded = (root / "benchmarks" / "RESULTS.md").read_text("utf-8").split("\n", 1)[1]
    recorded = re.sub(r"^<!--.*?-->\n", "", recorded, flags=re.MULTILINE)
    recorded = re.sub(r"^## ", "### ", recorded, flags=re.MULTILINE)
    parts.append(f"## Speed against named baselines\n{recorded}")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def table2(found: dict[str, Any]) -> str:
    """Return the scores of `results.json` as a table, means and 95 % intervals over houses."""
    lines = [
        "From `docs/table2/results.json`, which `pewm-jax table2` writes; 95 % confidence",
        "intervals over houses. [Definition of the rows](planning.md#table-2).",
        "",
        "| row | SIM, % | success, % | final position, m | final heading, ° |",
        "|---|---|---|---|---|",
    ]
    for name, row in found["rows"].items():
        cells = [interval(row[score]) for score in SCORES]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def interval(score: dict[str, float]) -> str:
    """Return a mean and its interval, with two digits behind the point below ten."""
    digits = 2 if abs(score["mean"]) < 10 else 1
    return "{:.{d}f} ({:.{d}f} to {:.{d}f})".format(
        score["mean"], score["low"], score["high"], d=digits
    )


def section(text: str, title: str) -> str:
    """Return the text below a heading of the second level."""
    (body,) = re.findall(
        rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE
    )
    return body.strip()


def notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its pictures by name."""
    parts, pictures = [], {}
    for number, cell in enumerate(json.loads(path.read_text("utf-8"))["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for place, output in enumerate(cell["outputs"]):
            for kind, data in output.get("data", {}).items():
                if kind.startswith("image/"):
                    name = f"{path.stem}-{number}-{place}.{kind.removeprefix('image/')}"
                    pictures[name] = base64.b64decode(data)
                    parts.append(f"![What the cell above shows.]({name})")
        said = [o["text"] for o in cell["outputs"] if o["output_type"] == "stream"]
        if said:
            parts.append(f"```text\n{''.join(map(''.join, said)).rstrip()}\n```")
    head = f"*[Notebook](../../notebooks/{path.name})*"
    return "\n\n".join([parts[0], head, *parts[1:]]) + "\n", pictures
