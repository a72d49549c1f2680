"""``pewm-jax practice``: does a policy learn a new house in imagination?"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pewm_jax.cli import plugins as imports
from pewm_jax.config import command_line as cli

ABOUT = (
    "Let a trained policy (NoMaD) practise in held-out houses of which it has few pictures: in the "
    "world that they begin, with its memory and without, and in the house itself. Then send it to "
    "goals there, and write a table and a picture. What is done is kept: the same command goes on."
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Who practises, where, and for how long."""

    policy: Path = Path("runs/nomad")
    """The run of a NoMaD (pewm-jax train nomad)."""
    model: str = "small"
    """A run's folder, or a model that comes with the library."""
    out: Path = Path("runs/practice")
    """Folder that everything is kept in."""
    houses: int = 12
    """Held-out houses."""
    tasks: int = 12
    """Goals in each house."""
    walks: int = 32
    """Walks of a practice."""
    blocks: int = 4
    """Proposals that are carried out in a walk, one after the other."""
    steps: int = 150
    """Steps of training on the walks."""
    learning_rate: float = 2e-4
    """Learning rate of that training."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of practice and training."""


def main(argv: Sequence[str], prog: str = "pewm-jax practice") -> int:
    """Run the study and print the path of its table.

    Args:
        argv: the arguments.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    about = f"{ABOUT} Beside these settings:\n{imports.HELP}"
    settings = cli.parse(Settings, argv, default=Settings(), prog=prog, description=about)
    # Imported here and not above: help and refusals come at once.
    from pewm_jax.planning.practice import Practice
    from pewm_jax.studies import practice
    from pewm_jax.studies.practice_piece import PracticeConfig

    errand = PracticeConfig(
        houses=settings.houses,
        tasks=settings.tasks,
        practice=Practice(walks=settings.walks, blocks=settings.blocks),
        steps=settings.steps,
        learning_rate=settings.learning_rate,
        seeds=settings.seeds,
    )
    cli.cache_compilation(settings.out)
    page = practice.run(settings.model, settings.policy, settings.out, errand)
    print(f"table: {page}")
    return 0
