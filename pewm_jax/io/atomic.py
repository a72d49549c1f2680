"""Atomic writes by renaming: a reader sees the old file or the new one, never a partial one."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` when the block ends without an error.

    Several processes may do this to one path at once: each writes its own file in the same folder,
    and the last rename wins. If the block fails, the temporary file is removed and ``path`` is
    unchanged.

    Args:
        path: a file, which may already exist, or a folder, which must not.

    Raises:
        OSError: writing failed; it names ``path`` if it names no other file (as for a full disk).
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    remove(partial)  # left by a killed process with the same id
    try:
        yield partial
        partial.replace(path)
    except BaseException as error:
        remove(partial)
        if isinstance(error, OSError) and error.filename in (None, str(partial)):
            error.filename = str(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, atomically."""
    with replacing(path) as partial:
        partial.write_text(text, "utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically, and flush it to disk."""
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def remove(path: Path) -> None:
    """Remove a file or a folder with its contents, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
