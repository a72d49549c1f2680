"""The folder of a stage's checkpoints: which are whole, which are kept, what becomes of the others.

::

    checkpoints/stage1/200/            a whole checkpoint: renamed to its number when it was sealed
                       300.writing/    one being written; worthless once its writer is gone
                       100.removed/    one being deleted
                       damaged/300/    one that was damaged after it was written; never deleted here

Nothing here knows what a checkpoint holds, and only one process at a time may use it.

Orbax's ``CheckpointManager`` (orbax-checkpoint 0.12.8) was tried for this. It restores these
checkpoints, and ``AnyPreservationPolicy([LatestN(keep), EveryNSteps(keep_every)])`` keeps what
``prune`` keeps. It is not used, because

- a manifest of all files cannot be written before the checkpoint has its final name. The last
  public hook, ``AsyncOptions.post_finalization_callback``, is called before Orbax updates
  ``_CHECKPOINT_METADATA`` and adds ``commit_success.txt``; ``temporary_path_class`` is deprecated,
  and a class for it would repeat private code (``AtomicRenameTemporaryPath.finalize``);
- ``latest_step`` returns a step as soon as ``save`` is called, before anything is on disk, and
  also the step of a damaged checkpoint: which one counts would still be decided here;
- old checkpoints are deleted under their own names, so one that was half deleted when the process
  was killed still counts; ``todelete_subdir`` moves them away, and never deletes them;
- ``wait_until_finished`` has no timeout, which ``Checkpoints.settle`` needs.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from pewm_jax import tree
from pewm_jax.config import UserError
from pewm_jax.training import integrity

FOLDER = "checkpoints"
WEIGHTS = "weights"
"""The item of a checkpoint that inference uses."""
DAMAGED = "damaged"
WRITING = ".writing"
_REMOVED = ".removed"


def of(run: Path, stage: str) -> Path:
    """Return the folder of the checkpoints of a run's stage."""
    return run / FOLDER / stage


def steps(folder: Path) -> list[int]:
    """Return the numbers of the checkpoints that were once whole, in ascending order."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())


def writing(folder: Path, step: int) -> Path:
    """Return the folder in which the checkpoint of a step is written."""
    return folder / f"{step}{WRITING}"


def put(folder: Path, step: int) -> None:
    """Seal a checkpoint that is written in full, and give it its number: now it counts.

    Raises:
        OSError: that cannot be written.
    """
    integrity.seal(writing(folder, step))
    writing(folder, step).rename(folder / str(step))
    integrity.sync(folder)


def prune(folder: Path, keep: int, keep_every: int) -> None:
    """Delete old checkpoints.

    Args:
        folder: the stage's checkpoints.
        keep: how many of the newest stay.
        keep_every: multiples of this many steps stay as well; 0 for none.
    """
    for step in steps(folder)[:-keep]:
        if keep_every == 0 or step % keep_every:
            removed = folder / f"{step}{_REMOVED}"
            (folder / str(step)).rename(removed)
            shutil.rmtree(removed, ignore_errors=True)


def clear(folder: Path) -> None:
    """Delete what a killed process left half-written or half-deleted."""
    for ending in (WRITING, _REMOVED):
        for path in folder.glob(f"[0-9]*{ending}*"):
            shutil.rmtree(path, ignore_errors=True)


def newest(folder: Path, say: Callable[[str], None]) -> int | None:
    """Find the newest whole checkpoint, and set aside what is damaged on the way to it.

    Args:
        folder: the stage's checkpoints.
        say: told of each that is set aside.

    Returns:
        Its step, None if there never was one.

    Raises:
        UserError: all are damaged.
    """
    for step in reversed(steps(folder)):
        found = integrity.flaws(folder / str(step), say=say)
        if not found:
            return step
        kept = _set_aside(folder, step)
        say(
            f"The checkpoint {folder / str(step)} is damaged ({tree.listing(found, 2)}): it is "
            f"set aside as {kept}, and the one before it is used."
        )
    damaged = folder / DAMAGED
    if damaged.is_dir() and any(damaged.iterdir()):
        raise UserError(
            f"{folder} holds no whole checkpoint, only damaged ones in {damaged}: bring back a "
            "copy of one, or delete that folder to train this stage from its start."
        )
    return None


def _set_aside(folder: Path, step: int) -> Path:
    """Move a damaged checkpoint to where it is not counted; returns where it lies now."""
    damaged = folder / DAMAGED
    damaged.mkdir(exist_ok=True)
    names = (f"{step}" if n == 0 else f"{step}-{n}" for n in range(10**6))
    kept = next(damaged / name for name in names if not (damaged / name).exists())
    (folder / str(step)).rename(kept)
    return kept
