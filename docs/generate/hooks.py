"""Hooks of MkDocs: add generated pages, and rewrite links for the site."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parents[2]))

from docs.generate import code, links, pages

OUTSIDE = {page: origin for origin, page in links.HOMES.items() if origin != "README.md"}


def on_config(config: Any) -> Any:
    """Add the packages of the reference, and pages missing from the navigation, to the menu."""
    menu = {title: entries for part in config.nav for title, entries in part.items()}
    named = set(re.findall(r"[\w/]+\.md", str(menu)))
    pages_here = sorted(path.name for path in (code.ROOT / "docs").glob("*.md"))
    menu["How-to"] += [name for name in pages_here if name not in named]
    packages = [{name: f"reference/{name}.md"} for name, _ in links.packages()]
    menu["Reference"] += [{"Modules": ["reference/index.md", *packages]}]
    return config


def on_files(files: Files, *, config: Any) -> Files:
    """Add the pages generated from code, results, cards and notebooks."""
    made: dict[str, str | bytes] = {**pages.reference()}
    for page, origin in OUTSIDE.items():
        made[page] = (code.ROOT / origin).read_text("utf-8")
    made["numbers.md"] = pages.numbers()
    made["glossary.md"] = pages.glossary()
    for path in sorted((code.ROOT / "notebooks").glob("*.ipynb")):
        text, pictures = pages.notebook(path)
        made[f"notebooks/{path.stem}.md"] = text.replace(f"../../notebooks/{path.name}", path.name)
        made |= {f"notebooks/{name}": data for name, data in pictures.items()}
        made[f"notebooks/{path.name}"] = path.read_bytes()
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:  # noqa: ARG001
    """Insert the code that a page names, and rewrite its links for the site."""
    here = page.file.src_uri
    if here.startswith("reference/") or here in ("glossary.md", "numbers.md"):
        return markdown
    if here.startswith("notebooks/"):
        origin = here.replace(".md", ".ipynb")
        own = f"]({Path(here).stem}"
        kept = markdown.replace(own, "](https:" + own[2:])
        return links.moved(origin, here, kept).replace("](https:" + own[2:], own)
    origin = OUTSIDE.get(here, f"docs/{here}")
    return links.moved(origin, here, code.expand(markdown))
