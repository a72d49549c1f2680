"""The command line of the memory: ``pewm-jax memory``, or ``python -m pewm_jax.memory``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pewm_jax.config import command_line as cli

USAGE = """usage: {prog} COMMAND …

commands:
  cache     compute the image encoder's features of every frame once, and keep them

It has --help."""
COMMANDS = ("cache",)


def main(argv: Sequence[str] | None = None, prog: str = "python -m pewm_jax.memory") -> int:
    """Run one command.

    Args:
        argv: the arguments, by default those of the process.
        prog: the command as the user typed it, for help and error messages.

    Returns:
        The exit code: 0, 2 bad input, 130 interrupted.
    """
    return cli.run(lambda given: _main(given, prog), argv)


def _main(argv: Sequence[str], prog: str) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(USAGE.format(prog=prog))
        return 0 if argv else 2
    command, flags = cli.choose(argv[0], COMMANDS, "command"), argv[1:]
    # Imported late, so that help and refusals are fast.
    from pewm_jax.memory.feature_cache import CacheConfig, cache

    config = cli.parse_command(CacheConfig, flags, f"{prog} {command}")
    try:
        cache(config)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("Interrupted; the same command goes on where it was.") from None
    return 0


if __name__ == "__main__":
    sys.exit(main())
