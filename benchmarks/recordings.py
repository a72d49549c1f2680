"""Which error of a real recording costs a model its lead over reprojection.

    python benchmarks/recordings.py small --data data/small

The true frames of held-out episodes are recorded anew with one kind of error of a hand-held depth
camera at a time (``pewm_jax/data/sensor.py``), with all of them, and with none, and a run is
evaluated on each. As in a real recording, frames with errors are also what imagined frames are
compared with. Printed are PSNR and LPIPS over pixels seen before, of the model and of the
reprojection, whose settings are chosen on ``validation`` with the same errors.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import record
import sampling
import tyro

from pewm_jax.data import sensor
from pewm_jax.data.dataset import (
    MANIFEST,
    EpisodeSource,
    Manifest,
    read_manifest,
    write_manifest,
    write_shard,
)
from pewm_jax.data.episodes import Episode, EpisodeArrays, write_episode
from pewm_jax.errors import UserError
from pewm_jax.io.progress import Meter

NAME = "recordings"
SPLITS = ("validation", "revisit")
CASES: dict[str, tuple[str, ...]] = {
    "none": (),
    **{kind: (kind,) for kind in sensor.ERRORS},
    "all": sensor.ERRORS,
}
"""Name of a row → kinds of errors."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is compared."""

    run: Annotated[str, tyro.conf.Positional] = "small"
    """Folder of a run, or the name of a model that ships."""
    data: Path = Path("data/small")
    """Data set without errors, with validation/ and revisit/."""
    cases: tuple[str, ...] = tuple(CASES)
    """Rows."""
    clips: int = 24
    """Clips."""
    out: Path = Path("runs/recordings")
    """Folder of the recorded data and of the reports."""
    record: bool = False
    """Write the table into RESULTS.md."""


def recorded(episode: Episode, kinds: tuple[str, ...], seed: tuple[int, ...]) -> bytes:
    """Return the record of an episode whose frames have kinds of errors."""
    frames = episode.frames()
    rng = np.random.default_rng(seed) if kinds else None
    rgb, depth, pose = (
        np.asarray(x) for x in (frames.rgb_THWC, frames.depth_THW, episode.world_from_camera)
    )
    made = sensor.record(rng, rgb, depth, pose, kinds)
    arrays = EpisodeArrays(
        made.rgb_THWC,
        made.depth_THW,
        episode.intrinsics_4,
        made.pose_T44,
        episode.actions,
        episode.action_ids,
    )
    return write_episode(arrays, episode.name, episode.scene, episode.info)


def write(data: Path, out: Path, kinds: tuple[str, ...], count: int) -> None:
    """Write the first ``count`` episodes of both splits with kinds of errors, if not yet there."""
    for number, split in enumerate(SPLITS):
        folder, source = out / split, EpisodeSource(data / split)
        episodes = [source[index] for index in range(min(count, len(source)))]
        about = {"errors": list(kinds), "from": str(data.resolve())}
        if (folder / MANIFEST).exists():
            there = read_manifest(folder)
            if there.settings == about and there.records == len(episodes):
                continue
        frames = sum(one.length for one in episodes)
        made = (recorded(one, kinds, (number, index)) for index, one in enumerate(episodes))
        (folder / MANIFEST).unlink(missing_ok=True)
        shard = write_shard(folder / "recorded.array_record", made)
        write_manifest(folder, Manifest(split, (shard,), about, frames))


def main(settings: Settings) -> None:
    """Evaluate all cases and print the table."""
    if unknown := [case for case in settings.cases if case not in CASES]:
        raise UserError(f"--cases has {unknown[0]!r}: use some of {', '.join(CASES)}.")
    if settings.clips < 1:
        raise UserError(f"--clips is {settings.clips}: score at least 1.")
    rows = []
    with Meter("recordings", len(settings.cases), "evaluations") as meter:
        for case in settings.cases:
            folder = settings.out / case
            write(settings.data, folder / "data", CASES[case], settings.clips)
            metrics = sampling.scored(
                settings.run,
                folder / "report",
                data=folder / "data",
                split="revisit",
                clips=settings.clips,
                fvd="off",
            )
            rows.append(_row(case, metrics))
            print(" | ".join(rows[-1]), flush=True)
            meter.advance(1)
    head = ("errors", "PSNR", "reprojection", "difference", "LPIPS", "reprojection")
    table = record.table(head, rows)
    print(table)
    if settings.record:
        about = f"`{settings.run}`, {settings.clips} clips of `revisit`, one seed; "
        record.record(NAME, f"## Recordings\n\n{about}{record.machine('jax')}\n\n{table}")


def _row(case: str, metrics: dict[str, Any]) -> list[str]:
    """Return the cells of one case, from its report's numbers."""
    found = metrics["results"]
    if missing := {"memory", "reproject"} - set(found):
        raise UserError(f"the report has no scores of {missing.pop()}: use a model with a memory.")
    model, other = (found[name]["seen"] for name in ("memory", "reproject"))
    if "lpips" not in model:
        raise UserError("the report has no LPIPS: pip install 'pewm-jax[metrics]'.")
    margin = metrics["margins"]["reproject"]["seen"]["psnr"]
    psnr = [f"{one['psnr']['mean']:.2f}" for one in (model, other)]
    lpips = [f"{one['lpips']['mean']:.3f}" for one in (model, other)]
    return [case, *psnr, f"{margin['mean']:+.2f} ± {margin['stderr']:.2f}", *lpips]


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
