"""``pewm-jax compare``: two scored runs side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pewm_jax.cli import plugins as imports
from pewm_jax.config import command_line as cli

ABOUT = (
    "Set two runs side by side that `pewm-jax evaluate` has scored by the same protocol, and write "
    "a page with paired differences, 95 % intervals over houses, and pictures. A run may also be "
    "the folder of one of its reports. Runs that were scored by different protocols are refused."
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """What may be added."""

    also_a: tuple[str, ...] = ()
    """Runs that differ from the first in --train.seed alone: intervals over training seeds are then
    given too, apart from those over houses."""
    also_b: tuple[str, ...] = ()
    """Runs that differ from the second in --train.seed alone."""
    out: Path | None = None
    """Folder of the page; by default compare-NAME in the first run's folder."""


def main(argv: Sequence[str], prog: str = "pewm-jax compare") -> int:
    """Write the page and print its path.

    Args:
        argv: the arguments: two runs, and what is to be added.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    asks = any(word in ("-h", "--help") for word in argv)
    named = [word for word in argv[:2] if not word.startswith("-")]
    if not asks and len(named) < 2:
        raise cli.ConfigError(f"Name two scored runs first: {prog} runs/a runs/b.")
    flags = ["--help"] if asks else argv[2:]
    named_prog = f"{prog} RUN_A RUN_B"
    about = f"{ABOUT} Beside these settings:\n{imports.HELP}"
    settings = cli.parse(Settings, flags, default=Settings(), prog=named_prog, description=about)
    # Imported here and not above: help and refusals come at once.
    from pewm_jax.eval.compare import compare

    also = {"also_one": settings.also_a, "also_two": settings.also_b}
    page = compare(*argv[:2], out=settings.out, **also)
    print(f"comparison: {page}")
    return 0
