"""``base.json``: what converted weights were made from, so that they can be made into it again.

It holds the three settings files of the original pipeline unchanged, its licence if the folder
states one, and the prompts that were encoded.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pewm_jax.config import UserError
from pewm_jax.convert import output, sources

BASE = "base.json"
"""The file's name, beside ``config.json`` or the folders of the networks."""
PARTS = ("transformer", "vae", "scheduler")
UNSTATED = "not stated in the folder it came from; ask where you got it before you pass it on"
_CARD = re.compile(r"^(license|license_name|license_link):\s*(\S.*)$", re.MULTILINE)


def describe(
    src: Path,
    settings: dict[str, dict[str, Any]],
    prompts: Sequence[str],
    dtype: str | None,
) -> dict[str, Any]:
    """Return what ``base.json`` shall hold.

    Args:
        src: the pipeline's folder.
        settings: the original settings of ``PARTS``.
        prompts: the prompts that were encoded, in the order in which they are stored.
        dtype: the dtype that was asked for, None for the stored one.
    """
    index = src / "model_index.json"
    return {
        **{part: settings[part] for part in PARTS},
        "model_index": sources.read_json(index) if index.is_file() else None,
        "name": src.resolve().name,
        "licence": licence(src),
        "prompts": list(prompts),
        "dtype": dtype or "as stored",
    }


def licence(src: Path) -> str:
    """Return what the folder's card or licence file says, in one line."""
    card = src / "README.md"
    if card.is_file():
        head = card.read_text(encoding="utf-8", errors="replace").split("\n---", 1)[0]
        stated = dict(_CARD.findall(head))
        names = [stated[key].strip("'\" ") for key in ("license_name", "license") if key in stated]
        link = stated.get("license_link")
        if names:
            return names[0] + (f" ({link})" if link else "")
    for name in ("LICENSE", "LICENSE.txt", "LICENSE.md"):
        if (src / name).is_file():
            text = (src / name).read_text(encoding="utf-8", errors="replace")
            lines = [line.strip(" #") for line in text.splitlines() if line.strip(" #")]
            if lines:
                return f"{lines[0]} (see the file {name} of the original)"
    return UNSTATED


def load(folder: Path) -> dict[str, Any]:
    """Read ``base.json``.

    Raises:
        UserError: it is absent or lacks a part.
    """
    path = folder / BASE
    if not path.is_file():
        raise UserError(
            f"{path} does not exist, so what these weights were made from is unknown; name the "
            "imported folder with --base."
        )
    values = sources.read_json(path)
    lacking = [part for part in PARTS if not isinstance(values.get(part), dict)]
    if lacking:
        raise UserError(f"{path} lacks {', '.join(lacking)}; copy it again from the import.")
    return values


def save(folder: Path, values: dict[str, Any]) -> None:
    """Write ``base.json``."""
    output.write_json(folder / BASE, values)
