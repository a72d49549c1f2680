"""Weights that ship with the library, by name; they need no network access.

Each is a folder here, in the format of ``pewm-jax convert export inference``: ``config.json``,
``weights.safetensors`` in 16 or 8 bits, and ``README.md``, its card. ``pewm_jax.load("codec")`` and
``train.start codec`` find them. Names such as ``org/name`` are looked up on a hub (``io.hub``).
"""

from __future__ import annotations

from pathlib import Path

from pewm_jax.errors import UserError
from pewm_jax.io import hub

HERE = Path(__file__).parent


def names() -> list[str]:
    """Return the names of all shipped weights."""
    return sorted(path.parent.name for path in HERE.glob("*/weights.safetensors"))


def find(path: str | Path, revision: str | None = None) -> Path:
    """Return the folder of a path or a name.

    Args:
        path: a folder, returned unchanged if it exists; a name in ``names()``; or the name of a
            model on a hub, ``org/name`` or ``org/name@revision``.
        revision: of a model on a hub: a branch, a tag or a commit.

    Raises:
        UserError: the model cannot be had from the hub (see ``hub.find``), or a revision is given
            for a folder.
    """
    folder = Path(path)
    if folder.exists():
        found: Path | None = folder
    elif str(path) in names():
        found = HERE / str(path)
    else:
        found = hub.find(path, revision=revision)
        revision = None
    if revision is not None:
        raise UserError(f"{path} is a folder, which has no revision {revision}; omit the revision.")
    return found or folder


def home(path: str | Path) -> Path:
    """Return the folder for reports: beside the weights, or ``runs/NAME`` for those found by name.

    The folders of shipped weights and of the hub's cache are not written to.
    """
    folder = find(path)
    title = hub.title(folder)
    if folder.parent == HERE or "@" in title:
        return Path("runs") / title.partition("@")[0].rpartition("/")[2]
    return folder
