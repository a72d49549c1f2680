"""Weights that ship with the library, by name; they need no network access.

Each is a folder here, in the format of ``pewm-jax convert export inference``: ``config.json``,
``weights.safetensors`` in 16 bits, and ``README.md``, its card. ``pewm_jax.load("codec")`` and
``train.start codec`` find them.
"""

from __future__ import annotations

from pathlib import Path

HERE = Path(__file__).parent


def names() -> list[str]:
    """Return the names of all shipped weights."""
    return sorted(path.parent.name for path in HERE.glob("*/weights.safetensors"))


def find(path: str | Path) -> Path:
    """Return the folder of a path or a name.

    Args:
        path: a folder, returned unchanged if it exists, or a name in ``names()``.
    """
    folder = Path(path)
    if not folder.exists() and str(path) in names():
        return HERE / str(path)
    return folder


def home(path: str | Path) -> Path:
    """Return the folder for reports: beside the weights, or ``runs/NAME`` for shipped ones."""
    folder = find(path)
    return Path("runs") / folder.name if folder.parent == HERE else folder
