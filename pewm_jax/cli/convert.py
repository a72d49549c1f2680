"""The command line of conversion: ``pewm-jax convert``, or ``python -m pewm_jax.convert``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pewm_jax.config import command_line as cli

USAGE = """usage: {prog} COMMAND SRC DST …

commands:
  import cogvideox   a CogVideoX checkpoint in the layout of diffusers → our layout, or with
                     --rgbd --camera [--memory] a world model to train from
  import dinov2      DINOv2 (transformers or the original state dict) → the map's image encoder
  import svd         a checkpoint of Stable Video Diffusion → a world model steered by actions
  import cosmos2     a checkpoint of Cosmos-Predict2 for video → a world model steered by actions
  export diffusers   our CogVideoX weights, fine-tuned or not → a folder for from_pretrained
  export inference   a training run → averaged weights in bfloat16, settings and a card
  export stablehlo   a world model → programs that run without this library

Each has --help. DST is made whole or not at all."""
COMMANDS = (
    "import cogvideox",
    "import dinov2",
    "import svd",
    "import cosmos2",
    "export diffusers",
    "export inference",
    "export stablehlo",
)


def main(argv: Sequence[str] | None = None, prog: str = "python -m pewm_jax.convert") -> int:
    """Run one command.

    Args:
        argv: the arguments, by default those of the process.
        prog: the words that it was called by, for help and refusals.

    Returns:
        The exit code: 0, 2 bad input, 130 interrupted.
    """
    return cli.run(lambda given: _main(given, prog), argv)


def _main(argv: Sequence[str], prog: str) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(USAGE.format(prog=prog))
        return 0 if argv else 2
    verb = cli.choose(argv[0], sorted({name.split()[0] for name in COMMANDS}), "command")
    below = [name.split()[1] for name in COMMANDS if name.startswith(f"{verb} ")]
    if len(argv) < 2 or argv[1] in ("-h", "--help"):
        print(USAGE.format(prog=prog))
        return 0 if len(argv) > 1 else 2
    command = f"{verb} {cli.choose(argv[1], below, f'command {verb}')}"
    # Imported here and not above: help and refusals come at once.
    from pewm_jax.convert import commands

    kind, run = commands.COMMANDS[command]
    run(cli.parse_command(kind, _gather(argv[2:], "--prompt"), f"{prog} {command}"))
    return 0


def _gather(flags: Sequence[str], name: str) -> list[str]:
    """Let a flag of many values be given many times: ``--p a --p b`` becomes ``--p a b``."""
    values: list[str] = []
    rest: list[str] = []
    into = rest
    for flag in flags:
        if flag == name or flag.startswith(f"{name}="):
            into = values
            values += [flag.removeprefix(f"{name}=")] if flag != name else []
            continue
        into = rest if flag.startswith("--") else into
        into.append(flag)
    given = any(flag.split("=")[0] == name for flag in flags)
    return [*rest, name, *values] if given else rest


if __name__ == "__main__":
    sys.exit(main())
