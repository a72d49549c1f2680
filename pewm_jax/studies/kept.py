"""What a study keeps in its folder: its settings, and one file for each finished piece."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pewm_jax.config import UserError
from pewm_jax.io import atomic

SETTINGS = "settings.json"


def require_same(
    out: Path, about: Mapping[str, Any], may_change: Collection[str], what: str
) -> None:
    """Refuse a folder with pieces of other settings, or weights; else write the settings there.

    Args:
        out: the folder.
        about: the settings by name.
        may_change: names that no kept piece depends on.
        what: what the pieces are, for the message.

    Raises:
        UserError: naming the settings that differ.
    """
    file = out / SETTINGS
    now = json.dumps({n: value for n, value in about.items() if n not in may_change}, indent=1)
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file: name a folder by --out.")
    if file.exists():
        before = read(file)
        if before is None:
            raise UserError(f"{file} is damaged: delete it, if its settings are still these.")
        wrong = [name for name, value in json.loads(now).items() if before.get(name) != value]
        if wrong:
            raise UserError(
                f"{out} holds {what} of other settings ({', '.join(wrong)}): name another "
                "folder by --out, or put them back."
            )
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(file, now + "\n")


def read(file: Path) -> dict[str, Any] | None:
    """Return a finished piece; None where there is none, or something else."""
    try:
        found = json.loads(file.read_text("utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def write(file: Path, piece: Mapping[str, Any]) -> None:
    """Write a finished piece."""
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(file, json.dumps(piece, allow_nan=False) + "\n")
