"""Atomic folders, progress in megabytes, and imports of optional conversion libraries."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter

_MEGABYTE = 1 << 20


def refuse_existing(dst: Path) -> None:
    """Raise an error if a path exists.

    Raises:
        UserError: ``dst`` exists.
    """
    if dst.exists() or dst.is_symlink():
        raise UserError(f"{dst} exists already; choose a new folder or remove that one.")


@contextlib.contextmanager
def new_folder(dst: Path) -> Iterator[Path]:
    """Write a folder under a temporary name and rename it when it is complete.

    If writing fails, no folder is left.

    Raises:
        UserError: ``dst`` exists.
    """
    refuse_existing(dst)
    with atomic.replacing(dst) as partial:
        partial.mkdir(parents=True)
        yield partial


@contextlib.contextmanager
def megabytes(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show progress in megabytes.

    Args:
        label: name of the work.
        total: total number of bytes.

    Yields:
        A function that adds a number of finished bytes.
    """
    done = 0
    with Meter(label, -(-total // _MEGABYTE), "MiB") as meter:

        def advance(count: int) -> None:
            nonlocal done
            before, done = done, done + count
            if whole := done // _MEGABYTE - before // _MEGABYTE:
                meter.advance(whole)

        yield advance


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON table as diffusers does: sorted keys."""
    path.write_text(json.dumps(values, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def convert_extra(name: str) -> Any:
    """Import a library of the extra ``convert``.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(
            f"{name} is needed for this command and cannot be imported ({error}); run "
            "pip install 'pewm-jax[convert]'."
        ) from None
