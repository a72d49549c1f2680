"""Score a trained run on held-out houses: python evaluate.py runs/demo."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import tyro

from pewm_jax.config import UserError
from pewm_jax.evaluation.report import evaluate


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Score a trained run and write RUN/report/index.html. Absent options come from the run."""

    run: tyro.conf.Positional[Path]
    """Folder made by train.py, e.g. runs/demo."""
    data: Path | None = None
    """Folder of the data set."""
    split: str | None = None
    """Folder inside it with the episodes to score."""
    clips: int | None = None
    """Clips scored per seed."""
    seeds: tuple[int, ...] | None = None
    """Seeds of the sampling noise, e.g. --seeds 0 1 2."""
    steps: int | None = None
    """DDIM steps."""
    chain: int | None = None
    """Clips generated one after the other in what the table scores."""
    stride: int | None = None
    """Recorded actions between two frames of a clip."""
    videos: int | None = None
    """Long rollouts shown side by side."""
    video_clips: int | None = None
    """Clips generated one after the other in a long rollout."""
    batch: int | None = None
    """Clips sampled at once."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = vars(tyro.cli(Arguments, args=arguments)).copy()
    try:
        page = evaluate(options.pop("run"), **options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; run the same command again to go on from here", file=sys.stderr)
        return 130
    print(f"report: {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
