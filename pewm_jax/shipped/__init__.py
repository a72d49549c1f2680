"""Weights that come with the library, by name; they need no network.

Each is a folder here, as ``pewm-jax convert export inference`` makes it: ``config.json``,
``weights.safetensors`` in 16 bits, and ``README.md``, its card. ``pewm_jax.load("codec")`` and
``train.start codec`` find them.
"""

from __future__ import annotations

from pathlib import Path

HERE = Path(__file__).parent


def names() -> list[str]:
    """Return the names of all that is here."""
    return sorted(path.parent.name for path in HERE.glob("*/weights.safetensors"))


def find(path: str | Path) -> Path:
    """Return the folder that a path or a name stands for.

    Args:
        path: a folder, which is returned as it is if it exists, or a name in ``names()``.
    """
    folder = Path(path)
    if not folder.exists() and str(path) in names():
        return HERE / str(path)
    return folder


def home(path: str | Path) -> Path:
    """Return where reports of weights go: beside them, or to ``runs/NAME`` if they came along."""
    folder = find(path)
    return Path("runs") / folder.name if folder.parent == HERE else folder
