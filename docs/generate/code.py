"""Code in pages, read where it stands, so that it cannot grow old.

A page says ``<!-- code: pewm_jax/geometry/cameras.py plucker -->``, which a reader of the
repository does not see; the site shows there the source of what is named, with file and lines.
"""

from __future__ import annotations

import ast
import dataclasses
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
MARK = re.compile(r"^<!-- code: (\S+) (\S+) -->$", re.MULTILINE)
"""File and name, such as ``pewm_jax/types.py Camera`` or ``… MemoryBlock.__call__``."""


@dataclasses.dataclass(frozen=True)
class Snippet:
    """The source of a function, class, method or constant.

    Attributes:
        file: where it stands, from the root of the repository.
        name: its name in the file, with dots.
        first: its first line, from 1.
        last: its last line.
        text: its lines, without docstrings and without indentation.
    """

    file: str
    name: str
    first: int
    last: int
    text: str


def snippet(file: str, name: str, root: Path = ROOT) -> Snippet:
    """Read what a mark names.

    Args:
        file: path from the root of the repository.
        name: a name at the top of the file, or below a class with dots.
        root: the repository.

    Raises:
        KeyError: the file does not exist or has no such name.
    """
    path = root / file
    if not path.is_file():
        raise KeyError(f"{file} does not exist")
    source = path.read_text("utf-8")
    node: ast.AST = ast.parse(source)
    for part in name.split("."):
        below = [child for child in ast.iter_child_nodes(node) if part in _names(child)]
        if not below:
            raise KeyError(f"{file} has no {name}")
        node = below[0]
    first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
    lines, hidden = source.splitlines(), _docstring(node)
    shown = [
        lines[number - 1]
        for number in range(first, (node.end_lineno or first) + 1)
        if number not in hidden
    ]
    indent = len(shown[0]) - len(shown[0].lstrip())
    text = "\n".join(line[indent:] for line in shown)
    return Snippet(file, name, first, node.end_lineno or first, text)


def marks(text: str) -> list[tuple[str, str]]:
    """List the files and names that a page shows."""
    return MARK.findall(text)


def expand(text: str, root: Path = ROOT) -> str:
    """Put the code in the place of each mark."""
    return MARK.sub(lambda found: _block(snippet(found[1], found[2], root)), text)


def module_of(file: str) -> str:
    """Return the dotted name of a file's module; presets are in ``pewm_jax.presets``."""
    parts = Path(file).with_suffix("").parts
    parts = ("pewm_jax", "presets", *parts[1:]) if parts[0] == "configs" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _block(one: Snippet) -> str:
    title = f"{one.file}, lines {one.first} to {one.last}"
    return f'```python title="{title}"\n{one.text}\n```'


def _names(node: ast.AST) -> set[str]:
    if isinstance(node, ast.Assign):
        return {target.id for target in node.targets if isinstance(target, ast.Name)}
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return {node.target.id}
    return {name} if (name := getattr(node, "name", None)) else set()


def _docstring(node: ast.AST) -> range:
    """Return the lines of a docstring: the site has it in the reference."""
    body = getattr(node, "body", None)
    if not isinstance(body, list) or len(body) < 2 or not isinstance(body[0], ast.Expr):
        return range(0)
    value = body[0].value
    text = isinstance(value, ast.Constant) and isinstance(value.value, str)
    return range(body[0].lineno, (body[0].end_lineno or 0) + 1) if text else range(0)
