"""The command line of the data: ``pewm-jax data``, or ``python -m pewm_jax.data``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pewm_jax.config import command_line as cli

USAGE = """usage: {prog} COMMAND …

commands:
  collect   let an agent walk through houses and write its frames as episodes; with
            --env MODULE:NAME, through your own environment
  import    import a recording: a folder of colour, depth and a trajectory
  validate  check a dataset: files, counts, units, poses, geometry
  show      draw an episode as a contact sheet and its path from above

Each has --help. The format of the files is described in docs/data_format.md."""
COMMANDS = ("collect", "import", "validate", "show")


def main(argv: Sequence[str] | None = None, prog: str = "python -m pewm_jax.data") -> int:
    """Run one command.

    Args:
        argv: the arguments, by default those of the process.
        prog: the words that it was called by, for help and refusals.

    Returns:
        The exit code: 0, 1 problems found, 2 bad input, 130 interrupted.
    """
    return cli.run(lambda given: _main(given, prog), argv)


def _main(argv: Sequence[str], prog: str) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(USAGE.format(prog=prog))
        return 0 if argv else 2
    command, flags = cli.choose(argv[0], COMMANDS, "command"), argv[1:]
    try:
        return _run(command, flags, f"{prog} {command}")
    except KeyboardInterrupt:
        again = "; run the same command again to resume" if command == "collect" else ""
        raise KeyboardInterrupt(f"Interrupted{again}.") from None


def _run(command: str, flags: Sequence[str], prog: str) -> int:
    """Run one command; returns the exit code."""
    # Imported here and not above: help comes at once, and only collecting loads the renderer.
    if command == "collect" and any(flag.split("=")[0] == "--env" for flag in flags):
        from pewm_jax.data.collect_env import CollectEnvConfig, collect_env

        collect_env(cli.parse_command(CollectEnvConfig, flags, f"{prog} --env"))
    elif command == "collect":
        from pewm_jax.data.collect import collect
        from pewm_jax.data.make_episode import CollectConfig

        flags = ["--voxels.record" if flag == "--voxels" else flag for flag in flags]
        collect(cli.parse_command(CollectConfig, flags, prog))
    elif command == "import":
        from pewm_jax.data.importer import ImportConfig, import_recording

        import_recording(cli.parse_command(ImportConfig, flags, prog))
    elif command == "show":
        from pewm_jax.data.show import ShowConfig, show

        show(cli.parse_command(ShowConfig, flags, prog))
    else:
        from pewm_jax.data.validate import ValidateConfig, validate

        return 1 if validate(cli.parse_command(ValidateConfig, flags, prog)).problems else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
