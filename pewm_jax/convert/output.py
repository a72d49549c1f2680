"""Folders that are made whole or not at all, and libraries that only conversion needs."""

from __future__ import annotations

import contextlib
import importlib
import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pewm_jax.config import UserError


def refuse_existing(dst: Path) -> None:
    """Refuse to write over anything.

    Raises:
        UserError: ``dst`` exists.
    """
    if dst.exists() or dst.is_symlink():
        raise UserError(f"{dst} exists already; name a new folder or remove that one.")


@contextlib.contextmanager
def new_folder(dst: Path) -> Iterator[Path]:
    """Make a folder aside and rename it when it is complete; nothing stays of a failure.

    Raises:
        UserError: ``dst`` exists.
    """
    refuse_existing(dst)
    partial = dst.with_name(f".{dst.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a command that was killed
    partial.mkdir(parents=True)
    try:
        yield partial
        partial.rename(dst)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON table as diffusers does: sorted keys."""
    path.write_text(json.dumps(values, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def convert_extra(name: str) -> Any:
    """Import a library of the optional dependencies.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(
            f"{name} is needed for this and cannot be imported ({error}); run "
            "pip install 'pewm-jax[convert]'."
        ) from None
