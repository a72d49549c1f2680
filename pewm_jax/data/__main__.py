"""The command line of the data: ``python -m pewm_jax.data collect | import | validate | show``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TypeVar

from pewm_jax import cli
from pewm_jax.config import UserError
from pewm_jax.data.collect import collect
from pewm_jax.data.importer import ImportConfig, import_recording
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.data.show import ShowConfig, show
from pewm_jax.data.validate import ValidateConfig, validate

T = TypeVar("T")

USAGE = """usage: python -m pewm_jax.data COMMAND …

commands:
  collect   walk an agent through houses and write what it sees as episodes
  import    import a recording: a folder of colour, depth and a trajectory
  validate  check a dataset: files, counts, units, poses, geometry
  show      draw an episode as a contact sheet and its path from above

Each has --help. The format of the files is described in docs/data_format.md."""
COMMANDS = ("collect", "import", "validate", "show")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 1 problems found, 2 bad input, 130 interrupted."""
    return cli.run(_main, argv)


def _main(argv: Sequence[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if argv else 2
    command, flags = cli.choose(argv[0], COMMANDS, "command"), argv[1:]
    try:
        if command == "collect":
            collect(_parse(CollectConfig, command, flags))
        elif command == "import":
            import_recording(_parse(ImportConfig, command, flags))
        elif command == "show":
            show(_parse(ShowConfig, command, flags))
        else:
            return 1 if validate(_parse(ValidateConfig, command, flags)).problems else 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise UserError(f"{where}{error.strerror or error}.") from None
    except KeyboardInterrupt:
        again = "; the same command goes on where it was" if command == "collect" else ""
        raise KeyboardInterrupt(f"Interrupted{again}.") from None
    return 0


def _parse(kind: type[T], command: str, flags: Sequence[str]) -> T:
    """Read the flags of one command."""
    return cli.parse_command(kind, flags, f"-m pewm_jax.data {command}")


if __name__ == "__main__":
    sys.exit(main())
