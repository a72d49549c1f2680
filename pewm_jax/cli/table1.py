"""``pewm-jax table1``: which memory works? The paper's Table 1 and its ablations."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pewm_jax import presets
from pewm_jax.cli import plugins as imports
from pewm_jax.config import command_line as cli
from pewm_jax.io import heap

ABOUT = (
    "Train and score every memory with every reader that applies, from the same backbones, for "
    "equal time, on the same held-out clips, and write a table (Markdown, LaTeX, CSV) and a plot. "
    "Everything that is done is kept: the same command goes on after an interruption, and with "
    "more seeds it adds to what is there."
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is trained and scored."""

    out: Path = Path("runs/table1")
    """Folder that everything is kept in."""
    data: Path | None = None
    """Folder of the data set; by default the preset's."""
    preset: str = "table1"
    """Settings that all rows share; its memory is the paper's map."""
    minutes: tuple[float, float] = (8.0, 6.0)
    """Processor minutes of training steps: of the backbone of each seed, and of each row."""
    steps: tuple[int, int] | None = None
    """Numbers of steps instead: equal steps, and not equal time."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds."""
    rows: tuple[str, ...] = ()
    """Only these rows, such as --rows none voxel-attend."""
    ablate: Literal["cell", "extent", "tokens", "features", "time"] | None = None
    """Instead of the table vary a setting of the voxel map that attention reads: side of a cell on
    the ground, m; side of the map, m; tokens that condition a clip; what a cell holds (colours,
    latents, points, or dinov2=FOLDER of `convert import dinov2`); or train the paper's own form
    longer (times the others' time)."""
    values: tuple[str, ...] = ()
    """Values to try in the place of the ablation's own."""
    clips: int | None = None
    """Held-out clips; by default the preset's."""
    dreamsim: Path | None = None
    """Folder with the weights of DreamSim 0.2 (ensemble), which no package has."""


def main(argv: Sequence[str], prog: str = "pewm-jax table1") -> int:
    """Make the table and print its path.

    Args:
        argv: the arguments.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    about = f"{ABOUT} Beside these settings:\n{imports.HELP}"
    settings = cli.parse(Settings, argv, default=Settings(), prog=prog, description=about)
    config = presets.load(cli.choose(settings.preset, presets.names(), "preset"))
    if settings.data is not None:
        data = dataclasses.replace(config.data, path=str(settings.data))
        config = dataclasses.replace(config, data=data)
    if settings.clips is not None:
        evaluate = dataclasses.replace(config.evaluate, clips=settings.clips)
        config = dataclasses.replace(config, evaluate=evaluate)
    heap.keep_large()
    # Imported here and not above: help and refusals come at once.
    from pewm_jax.studies import table1

    cli.cache_compilation(settings.out)
    page = table1.run(
        config,
        settings.out,
        minutes=settings.minutes,
        steps=settings.steps,
        seeds=settings.seeds,
        only=settings.rows,
        ablation=settings.ablate or "",
        values=settings.values,
        weights={"dreamsim": settings.dreamsim} if settings.dreamsim else None,
    )
    print(f"table: {page}")
    return 0
