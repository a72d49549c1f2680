"""Links of Markdown files: find, check and rewrite them for the site.

Files of the repository link to each other by their paths. The site has most of them as pages at
other paths; links to other files are replaced by their text.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from docs.generate import code

LINK = re.compile(r"(?P<shown>!?\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\])\((?P<to>[^)\s]+)\)")
FENCE = re.compile(r"^( *)(```+|~~~+).*?^\1\2 *$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`[^`\n]+`")
HOMES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "LICENSE": "license.txt",
    "benchmarks/RESULTS.md": "numbers.md",
    "pewm_jax/shipped/small/README.md": "cards/small.md",
    "pewm_jax/shipped/egowm/README.md": "cards/egowm.md",
    "pewm_jax/shipped/egowm-humanoid/README.md": "cards/egowm-humanoid.md",
    "pewm_jax/shipped/persist/README.md": "cards/persist.md",
    "pewm_jax/shipped/codec/README.md": "cards/codec.md",
    "pewm_jax/shipped/codec-2/README.md": "cards/codec-2.md",
}
"""Files outside of docs/ that are pages of the site."""
MADE = ("numbers.md", "glossary.md", "reference/index.md")
"""Pages that only the site has, to which pages of docs/ may link."""


def links(text: str) -> Iterator[str]:
    """List where a page's links and pictures lead, outside of code."""
    for found in LINK.finditer(INLINE.sub("", FENCE.sub("", text))):
        yield found["to"]


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MkDocs make them of plain words."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} (.+?)(?: #+)?$", FENCE.sub("", text), re.MULTILINE):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", words.strip().lower()).replace(" ", "-")
        number = 1
        while slug in found:
            slug, number = f"{slug.rsplit('_', 1)[0]}_{number}", number + 1
        found.add(slug)
    return found


def is_outside(link: str) -> bool:
    """Tell whether a link leads to another place on the network."""
    return re.match(r"[a-z]+:", link) is not None


def broken(origin: str, text: str, root: Path = code.ROOT) -> list[str]:
    """List the links of a file that lead nowhere in the repository.

    Args:
        origin: the file, from the root of the repository.
        text: its Markdown.
        root: the repository.
    """
    wrong = []
    for link in links(text):
        if is_outside(link):
            continue
        path, _, anchor = link.partition("#")
        there = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
        there = there if path else origin
        if there.startswith("docs/") and there.removeprefix("docs/") in MADE:
            continue
        target = root / there
        if path and (there.startswith("..") or not target.exists()):
            wrong.append(f"{origin}: {link} does not exist")
        elif anchor and anchor not in anchors(text if not path else target.read_text("utf-8")):
            wrong.append(f"{origin}: {link} has no such heading")
    return wrong


def page_of(path: str, root: Path = code.ROOT) -> str | None:
    """Return where the site has a file of the repository, None if it has not.

    Args:
        path: from the root of the repository; a folder is a package.
        root: the repository.
    """
    if path in HOMES:
        return HOMES[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path.startswith("notebooks/") and path.endswith(".ipynb"):
        return str(Path(path).with_suffix(".md"))
    parts = Path(path).parts
    if parts[0] == "configs":
        return "reference/presets.md"
    if parts[0] == "pewm_jax" and len(parts) > 1:
        package = Path(parts[1]).stem
        if package in dict(packages(root)):
            anchor = f"#{code.module_of(path)}" if path.endswith(".py") else ""
            return f"reference/{package}.md{anchor}"
    return None


def moved(origin: str, page: str, text: str, root: Path = code.ROOT) -> str:
    """Return a file's Markdown with its links as the site needs them.

    Args:
        origin: the file, from the root of the repository.
        page: where the site has it.
        text: its Markdown.
        root: the repository.
    """

    def rewrite(found: re.Match[str]) -> str:
        link = found["to"]
        if is_outside(link) or link.startswith("#"):
            return found[0]
        path, _, anchor = link.partition("#")
        there = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
        home = page_of(there, root)
        if home is None:
            return found["text"]
        home = home if not anchor else f"{home.partition('#')[0]}#{anchor}"
        return f"{found['shown']}({posixpath.relpath(home, posixpath.dirname(page) or '.')})"

    kept: list[str] = []

    def keep(found: re.Match[str]) -> str:
        kept.append(found[0])
        return f"\x00{len(kept) - 1}\x00"

    text = FENCE.sub(keep, text)
    text = LINK.sub(rewrite, text)
    return re.sub(r"\x00(\d+)\x00", lambda found: kept[int(found[1])], text)


def packages(root: Path = code.ROOT) -> list[tuple[str, str]]:
    """List the packages and their content, in the order of the table in docs/architecture.md."""
    text = (root / "docs" / "architecture.md").read_text("utf-8").split("## Packages", 1)[1]
    rows = re.findall(
        r"^\| `([a-z_0-9.]+?)/?` \| (.+?) \|$", text.split("\n## ", 1)[0], re.MULTILINE
    )
    names = ((name.removesuffix(".py"), content) for name, content in rows)
    return [("presets" if name == "configs" else name, content) for name, content in names]
