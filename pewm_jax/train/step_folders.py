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

from collections.abc import Callable
from pathlib import Path

from pewm_jax.config import UserError
from pewm_jax.io import atomic, tree
from pewm_jax.train import integrity

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
    """Write the manifest of a complete checkpoint, then rename it: from now on it counts.

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
            atomic.remove(removed)


def clear(folder: Path) -> None:
    """Delete what a killed process left half-written or half-deleted."""
    for ending in (WRITING, _REMOVED):
        for path in folder.glob(f"[0-9]*{ending}*"):
            atomic.remove(path)


def newest(folder: Path, say: Callable[[str], None]) -> int | None:
    """Find the newest undamaged checkpoint; newer, damaged ones are moved to ``damaged/``.

    Args:
        folder: the stage's checkpoints.
        say: called with a sentence for each that is moved.

    Returns:
        Its step, None if the folder has no checkpoint.

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
    """Move a damaged checkpoint to ``damaged/``; returns its new path."""
    damaged = folder / DAMAGED
    damaged.mkdir(exist_ok=True)
    names = (f"{step}" if n == 0 else f"{step}-{n}" for n in range(10**6))
    kept = next(damaged / name for name in names if not (damaged / name).exists())
    (folder / str(step)).rename(kept)
    return kept
