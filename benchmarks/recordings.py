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
import json
from pathlib import Path
from typing import Annotated

import numpy as np
import record
import tyro

from pewm_jax.data import sensor
from pewm_jax.data.dataset import EpisodeSource, Manifest, write_manifest, write_shard
from pewm_jax.data.episodes import Episode, EpisodeArrays, write_episode
from pewm_jax.errors import UserError
from pewm_jax.eval import evaluate
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
        if (folder / "dataset.json").exists():
            continue
        folder.mkdir(parents=True, exist_ok=True)
        episodes = [source[index] for index in range(min(count, len(source)))]
        shard = write_shard(
            folder / "recorded.array_record",
            (recorded(one, kinds, (number, index)) for index, one in enumerate(episodes)),
        )
        about = {"errors": list(kinds), "from": data.name}
        write_manifest(
            folder, Manifest(split, (shard,), about, sum(one.length for one in episodes))
        )


def main(settings: Settings) -> None:
    """Evaluate all cases and print the table."""
    if unknown := [case for case in settings.cases if case not in CASES]:
        raise UserError(f"--cases has {unknown[0]!r}: use some of {', '.join(CASES)}.")
    rows = []
    with Meter("recordings", len(settings.cases), "evaluations") as meter:
        for case in settings.cases:
            folder = settings.out / case
            write(settings.data, folder / "data", CASES[case], settings.clips)
            evaluate.evaluate(
                settings.run,
                out=folder / "report",
                log=_silent,
                data=folder / "data",
                split="revisit",
                clips=settings.clips,
                seeds=(0,),
                videos=1,
                video_clips=1,
                mirror=0,
                fvd="off",
            )
            rows.append(_row(case, folder / "report" / "metrics.json"))
            print(" | ".join(rows[-1]), flush=True)
            meter.advance(1)
    head = ("errors", "PSNR", "reprojection", "difference", "LPIPS", "reprojection")
    table = record.table(head, rows)
    print(table)
    if settings.record:
        about = f"`{settings.run}`, {settings.clips} clips of `revisit`, one seed; "
        record.record(NAME, f"## Recordings\n\n{about}{record.machine('jax')}\n\n{table}")


def _silent(line: str) -> None:
    del line


def _row(case: str, file: Path) -> list[str]:
    """Return the cells of one case, from its report's numbers."""
    metrics = json.loads(file.read_text("utf-8"))
    found, margin = metrics["results"], metrics["margins"]["reproject"]["seen"]["psnr"]
    model, other = (found[name]["seen"] for name in ("memory", "reproject"))
    psnr = [f"{one['psnr']['mean']:.2f}" for one in (model, other)]
    lpips = [f"{one['lpips']['mean']:.3f}" for one in (model, other)]
    return [case, *psnr, f"{margin['mean']:+.2f} ± {margin['stderr']:.2f}", *lpips]


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
