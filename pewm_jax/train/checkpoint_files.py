"""The folder of a stage's checkpoints: naming, retention, and setting aside damaged ones.

::

    checkpoints/stage1/200/            complete: renamed to its number after its manifest is written
                       300.writing/    being written; useless once the writing process is gone
                       100.removed/    being deleted
                       damaged/300/    damaged after it was written; never deleted here

This module does not know what a checkpoint contains. Only one process at a time may use a folder.

Orbax's ``CheckpointManager`` (orbax-checkpoint 0.12.8) was tried for this. It restores these
checkpoints, and ``AnyPreservationPolicy([LatestN(keep), EveryNSteps(keep_every)])`` keeps what
``prune`` keeps. It is not used, because

- a manifest of all files cannot be written before the checkpoint is renamed to its final name. The
  last public hook, ``AsyncOptions.post_finalization_callback``, is called before Orbax updates
  ``_CHECKPOINT_METADATA`` and adds ``commit_success.txt``; ``temporary_path_class`` is deprecated,
  and a class for it would repeat private code (``AtomicRenameTemporaryPath.finalize``);
- ``latest_step`` returns a step as soon as ``save`` is called, before anything is on disk, and
  also the step of a damaged checkpoint, so this module would still have to choose the valid one;
- old checkpoints are deleted in place, so one that was half deleted when the process was killed
  still counts; ``todelete_subdir`` moves them away, and never deletes them;
- ``wait_until_finished`` has no timeout, which ``Checkpoints.settle`` needs.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pewm_jax.config import UserError
from pewm_jax.io import atomic, tree

FOLDER = "checkpoints"
WEIGHTS_ITEM = "weights"
"""The part of a checkpoint that inference uses, a folder inside it."""
DAMAGED = "damaged"
WRITING = ".writing"
_REMOVED = ".removed"


def of(run: Path, stage: str) -> Path:
    """Return the folder of the checkpoints of a run's stage."""
    return run / FOLDER / stage


def steps(folder: Path) -> list[int]:
    """Return the steps of the complete checkpoints, damaged or not, in ascending order."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())


def writing(folder: Path, step: int) -> Path:
    """Return the folder in which the checkpoint of a step is written."""
    return folder / f"{step}{WRITING}"


def put(folder: Path, step: int) -> None:
    """Write the manifest of a complete checkpoint, then rename it; from then on it counts."""
    seal(writing(folder, step))
    writing(folder, step).rename(folder / str(step))
    sync(folder)


def prune(folder: Path, keep: int, keep_every: int) -> None:
    """Delete all but the ``keep`` newest checkpoints.

    Multiples of ``keep_every`` steps are kept, too; 0 for none.
    """
    for step in steps(folder)[:-keep]:
        if keep_every == 0 or step % keep_every:
            removed = folder / f"{step}{_REMOVED}"
            (folder / str(step)).rename(removed)
            atomic.remove(removed)


def clear(folder: Path) -> None:
    """Delete what a killed process left half-written or half-deleted."""
    for ending in (WRITING, _REMOVED):
        for path in folder.glob(f"[0-9]*{ending}*"):
            atomic.remove(path)


def newest(folder: Path, log: Callable[[str], None]) -> int | None:
    """Return the step of the newest intact checkpoint, or None if there is none.

    Newer, damaged ones are moved to ``damaged/``; ``log`` gets a sentence for each.

    Raises:
        UserError: all are damaged.
    """
    for step in reversed(steps(folder)):
        found = flaws(folder / str(step), log=log)
        if not found:
            return step
        kept = _set_aside(folder, step)
        log(
            f"The checkpoint {folder / str(step)} is damaged ({tree.listing(found, 2)}): it is "
            f"moved to {kept}, and the previous one is used."
        )
    damaged = folder / DAMAGED
    if damaged.is_dir() and any(damaged.iterdir()):
        raise UserError(
            f"{folder} contains no intact checkpoint, only damaged ones in {damaged}: restore a "
            "copy of one, or delete that folder to train this stage from the start."
        )
    return None


def _set_aside(folder: Path, step: int) -> Path:
    """Move a damaged checkpoint to ``damaged/`` and return its new path."""
    damaged = folder / DAMAGED
    damaged.mkdir(exist_ok=True)
    names = (f"{step}" if n == 0 else f"{step}-{n}" for n in range(10**6))
    kept = next(damaged / name for name in names if not (damaged / name).exists())
    (folder / str(step)).rename(kept)
    return kept


MANIFEST = "manifest.json"

LARGE = 2 * 10**9
"""Size in bytes from which verification takes seconds and prints progress."""

_EVERY_S = 10.0


def seal(folder: Path) -> None:
    """Write the manifest of a complete folder, and flush the folder to disk."""
    paths = _files(folder)
    files = {
        name: {"bytes": paths[name].stat().st_size, "sha256": digest}
        for name, digest in _digests(paths)
    }
    with atomic.replacing(folder / MANIFEST) as partial, partial.open("w") as file:
        json.dump({"files": files, "sha256": _digest_of(files)}, file, sort_keys=True)
        file.flush()
        os.fsync(file.fileno())
    for inside in {folder, *(path.parent for path in paths.values())}:
        sync(inside)


def flaws(
    folder: Path,
    parts: Iterable[str] = (),
    log: Callable[[str], None] = lambda _: None,
) -> list[str]:
    """Compare a folder with the manifest that ``seal`` wrote.

    Args:
        folder: the folder.
        parts: verify only these subfolders; all files by default.
        log: prints progress if verification takes seconds.

    Returns:
        Descriptions of the damage, such as ``state/d/3f is cut short (10 of 505 bytes)``; empty if
        intact.
    """
    inside = tuple(f"{part}/" for part in parts)
    try:
        listed = _read(folder / MANIFEST)
        paths = {n: p for n, p in _files(folder).items() if not inside or n.startswith(inside)}
    except ValueError as error:
        return [str(error)]
    except OSError as error:
        return [f"{MANIFEST} cannot be read ({error.strerror})"]
    listed = {n: entry for n, entry in listed.items() if not inside or n.startswith(inside)}
    found = [f"{name} is missing" for name in listed.keys() - paths.keys()]
    found += [f"{name} is not listed in the manifest" for name in paths.keys() - listed.keys()]
    whole = {}
    for name in listed.keys() & paths.keys():
        have, want = paths[name].stat().st_size, listed[name]["bytes"]
        if have == want:
            whole[name] = paths[name]
        else:
            how = "is cut short" if have < want else "has grown"
            found.append(f"{name} {how} ({have} of {want} bytes)")
    if not found:
        total = sum(listed[name]["bytes"] for name in whole)
        progress = _progress(f"checking {folder}", total, log)
        for name, digest in _digests(whole, _digest_if_readable):
            if digest != listed[name]["sha256"]:
                found.append(f"{name} has a wrong checksum")
            progress(listed[name]["bytes"])
    return sorted(found)


def sync(folder: Path) -> None:
    """Flush a folder's directory entry to disk (fsync), so that it survives a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _read(path: Path) -> dict[str, Any]:
    """Return the files listed in a manifest; raise ValueError if it is missing or damaged."""
    try:
        found = json.loads(path.read_bytes())
        files, digest = found["files"], found["sha256"]
    except FileNotFoundError:
        raise ValueError(f"{MANIFEST} is missing") from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{MANIFEST} is damaged") from None
    if digest != _digest_of(files):
        raise ValueError(f"{MANIFEST} is damaged")
    return files


def _files(folder: Path) -> dict[str, Path]:
    """Return the files below a folder by relative name, except the manifest."""
    found = {
        path.relative_to(folder).as_posix(): path
        for path in sorted(folder.rglob("*"))
        if not path.is_dir()
    }
    return {name: path for name, path in found.items() if name != MANIFEST}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest_if_readable(path: Path) -> str:
    try:
        return _digest(path)
    except OSError:
        return "unreadable"


def _digests(
    paths: dict[str, Path], digest: Callable[[Path], str] = _digest
) -> Iterable[tuple[str, str]]:
    """Hash files in parallel threads: hashlib releases the GIL."""
    threads = min(8, os.cpu_count() or 1)
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        yield from zip(paths, pool.map(digest, paths.values()), strict=True)


def _digest_of(files: Any) -> str:
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


def _progress(label: str, total: int, log: Callable[[str], None]) -> Callable[[int], None]:
    """Return a function that counts bytes and prints progress every ``_EVERY_S`` seconds."""
    began = printed = time.monotonic()
    done = 0
    if total >= LARGE:
        log(f"{label}: {total / 1e9:.1f} GB …")

    def advance(count: int) -> None:
        nonlocal done, printed
        done, now = done + count, time.monotonic()
        if now - printed >= _EVERY_S:
            printed = now
            rate = done / (now - began)
            left = (total - done) / max(rate, 1.0)
            log(
                f"{label}: {done / 1e9:.1f}/{total / 1e9:.1f} GB, {rate / 1e9:.2f} GB/s, "
                f"{left:.0f} s left"
            )

    return advance
