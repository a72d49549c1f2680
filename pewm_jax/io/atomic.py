"""Write aside, then rename: a reader sees the old file or the new one, never half of one."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to; when the block ends well, what lies there becomes ``path``.

    Several processes may do this to one path at once: each writes a file of its own, and the last
    rename wins. When the block fails, what it wrote is removed and ``path`` stays as it was.

    Args:
        path: a file, which may exist already, or a folder, which must not.

    Yields:
        A path beside it, ending in ``.partial``, where nothing exists yet.

    Raises:
        OSError: writing failed; the error names ``path`` if it names no other file (that of a full
            disk names none).
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    remove(partial)  # left by a process of the same number that was killed
    try:
        yield partial
        partial.replace(path)
    except BaseException as error:
        remove(partial)
        if isinstance(error, OSError) and error.filename in (None, str(partial)):
            error.filename = str(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(text, "utf-8")


def remove(path: Path) -> None:
    """Remove a file or a folder with all that is in it, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
