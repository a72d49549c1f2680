"""Import recordings as episodes, one frame at a time; each episode is checked before it is written.

``formats`` finds the sequences, ``import_frames`` makes records of their frames, ``import_files``
keeps finished files when an import is interrupted and lists them when all are there.
"""

from __future__ import annotations

from collections.abc import Callable

from pewm_jax.config import UserError
from pewm_jax.data import formats
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import Entry
from pewm_jax.data.import_files import ImportFiles, plan
from pewm_jax.data.import_frames import (
    BadFrames,
    RecordMaker,
    planar_actions,
    world_from_recording,
)
from pewm_jax.data.pose_check import PoseCheck
from pewm_jax.io.progress import Meter

__all__ = ["ImportConfig", "import_recording", "planar_actions", "world_from_recording"]


def import_recording(config: ImportConfig, log: Callable[[str], None] = print) -> None:
    """Read, convert, check and add recordings to a dataset; ``log`` receives the lines to print.

    If a recording has problems, nothing is added to the dataset.

    Raises:
        UserError: files are missing or do not match, or an episode fails validation.
    """
    if not config.src.is_dir():
        raise UserError(f"{config.src} is not a folder; give the folder of a recording.")
    if config.format == formats.AUTO:
        found, why = formats.recognise(config.src)
        log(f"{config.src}: recognised as {found.NAME}, because there is {why}.")
    else:
        found = formats.named(config.format)
    known = found.USES if found.DEPTH_SCALE is None else (*found.USES, "depth_scale")
    config.require_used(known, found.NAME)
    entries = _chosen(found.entries(config), config)
    frames = sum(-(-entry.frames // config.stride) for entry in entries)
    if not frames:
        raise UserError(f"{config.src} has no frames in the layout of {found.NAME}.")
    files = ImportFiles(config, plan(entries, config))
    check = PoseCheck() if config.check else None
    bad = BadFrames(config.skip_bad)
    maker = RecordMaker(found, config, bad, check)
    try:
        with Meter(f"importing {config.called}", frames, "frames") as meter:
            for path, parts in files.missing(meter).items():
                files.write(path, (one for part in parts for one in maker.records(part, meter)))
    finally:
        if check is not None:
            check.report(config.out / f"{config.called}-check.png", log)
    files.publish()
    notes = [f"note: {note}." for note in maker.notes]
    for line in (
        *notes,
        *bad.lines(),
        *files.lines(maker.made, maker.moves),
        f"{meter.summary()}.",
    ):
        log(line)


def _chosen(entries: list[Entry], config: ImportConfig) -> list[Entry]:
    """Return the sequences that ``--names`` lists, by default all."""
    if config.names is None:
        return entries
    try:
        lines = config.names.read_text("utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--names {config.names} cannot be read as text ({error}).") from None
    wanted = [line.strip() for line in lines if line.strip()]
    known = {entry.name: entry for entry in entries}
    absent = [name for name in wanted if name not in known]
    if absent or not wanted:
        what = f"lists {absent[0]}, which is not in {config.src}" if absent else "is empty"
        raise UserError(f"--names {config.names} {what}; list names of sequences, one per line.")
    return [known[name] for name in dict.fromkeys(wanted)]
