"""Seals that tell files of this user from others, for files that are executed when they are read.

A compiled program is machine code. JAX's compilation cache loads it from a folder without asking
who wrote it, and that folder lies beside runs, which people copy and share. So each file gets a
seal: an HMAC-SHA256 of its name and content, with a random key that only this user can read. A file
without a valid seal was written elsewhere, changed or truncated, and is removed before JAX can load
it.

The key is in ``$XDG_STATE_HOME/pewm_jax`` (by default ``~/.local/state/pewm_jax``).
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
import stat
import time
from pathlib import Path

from pewm_jax.io import atomic

SUFFIX = ".seal"
KEY_BYTES = 32
NEW_S = 2.0
"""Seconds within which a process seals a file that it has written."""
PRIVATE, PRIVATE_FILE = 0o700, 0o600


class Seals:
    """The seals of the files with one suffix in a private folder.

    Args:
        folder: created if it does not exist, readable by this user alone.
        suffix: the end of the names of the sealed files.
        key: from ``read_key``.

    Raises:
        OSError: the folder cannot be created, or belongs to another user.
    """

    def __init__(self, folder: Path, suffix: str, key: bytes):
        self.folder, self.suffix = folder, suffix
        self._key = key
        self._known: set[str] = set()
        _make_private(folder)

    def remove_foreign(self) -> int:
        """Remove all files without a valid seal, and return their number.

        Links are removed and not followed. Seals without a file are removed, too.
        """
        removed = 0
        files = self._files()
        if any(_is_new(path) and not self._is_sealed(path) for path in files):
            time.sleep(NEW_S)  # another process of this user may be about to seal it
        for path in files:
            if self._is_sealed(path):
                self._known.add(path.name)
                continue
            atomic.remove(path)
            atomic.remove(_seal_of(path))
            removed += 1
        for seal in self.folder.glob(f"*{self.suffix}{SUFFIX}"):
            if seal.name.removesuffix(SUFFIX) not in self._known:
                atomic.remove(seal)
        return removed

    def add_new(self) -> None:
        """Seal the files that this process has written since the last call.

        The folder is private, so they were written by this user. Another process that writes a file
        at this moment seals it again when it is complete.
        """
        for path in self._files():
            if path.name not in self._known and path.is_file() and not path.is_symlink():
                with contextlib.suppress(OSError):  # the disk is full, or it is gone again
                    atomic.write_text(_seal_of(path), self._seal(path))
                    self._known.add(path.name)

    def _files(self) -> list[Path]:
        with contextlib.suppress(OSError):
            return sorted(self.folder.glob(f"*{self.suffix}"))
        return []

    def _is_sealed(self, path: Path) -> bool:
        if path.is_symlink():
            return False
        try:
            found = _seal_of(path).read_text("utf-8")
            return hmac.compare_digest(found.encode(), self._seal(path).encode())
        except (OSError, ValueError):
            return False

    def _seal(self, path: Path) -> str:
        code = hmac.new(self._key, path.name.encode() + b"\0", hashlib.sha256)
        code.update(path.read_bytes())
        return code.hexdigest()


def _is_new(path: Path) -> bool:
    try:
        return abs(time.time() - path.lstat().st_mtime) < NEW_S
    except OSError:
        return False


def _seal_of(path: Path) -> Path:
    return path.with_name(path.name + SUFFIX)


def _make_private(folder: Path) -> None:
    """Create a folder of this user alone, or check that an existing one is."""
    folder.mkdir(parents=True, exist_ok=True, mode=PRIVATE)
    if not hasattr(os, "getuid"):
        return
    if folder.stat().st_uid != os.getuid():
        raise PermissionError(f"{folder} belongs to another user")
    if stat.S_IMODE(folder.stat().st_mode) != PRIVATE:
        folder.chmod(PRIVATE)


def read_key() -> bytes:
    """Return this user's key, drawn at random when it is first needed.

    Raises:
        OSError: it cannot be read or written, or its folder belongs to another user.
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    base = Path(base) if Path(base).is_absolute() else Path.home() / ".local" / "state"
    file = base / "pewm_jax" / "key"
    _make_private(file.parent)
    if not file.exists():
        partial = file.with_name(f"{file.name}.{secrets.token_hex(8)}.partial")
        handle = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, PRIVATE_FILE)
        with os.fdopen(handle, "wb") as opened:
            opened.write(secrets.token_bytes(KEY_BYTES))
        with contextlib.suppress(FileExistsError):  # another process was first: its key counts
            os.link(partial, file)
        atomic.remove(partial)
    key = file.read_bytes()
    if len(key) != KEY_BYTES:
        raise PermissionError(f"{file} is damaged: delete it")
    return key
