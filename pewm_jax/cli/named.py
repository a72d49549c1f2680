"""A command's first word: the run or preset that it is about."""

from __future__ import annotations

from collections.abc import Sequence

from pewm_jax.config import ConfigError

HELP = ("-h", "--help")


def take(argv: Sequence[str], stands_for: str, missing: str) -> tuple[str, list[str]]:
    """Take the name off the arguments.

    Args:
        argv: the arguments.
        stands_for: what is written in its place where help is asked for, such as ``RUN``.
        missing: the sentence that refuses arguments without a name.

    Returns:
        The name and the other arguments; ``stands_for`` and ``--help`` where help comes first.

    Raises:
        ConfigError: the first argument is not a name.
    """
    if argv and argv[0] in HELP:
        return stands_for, ["--help"]
    if not argv or argv[0].startswith("-"):
        raise ConfigError(missing)
    return argv[0], list(argv[1:])
