"""The command line of conversion: ``python -m pewm_jax.convert import | export …``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from pewm_jax import cli
from pewm_jax.convert import commands

USAGE = """usage: python -m pewm_jax.convert COMMAND SRC DST …

commands:
  import cogvideox   a CogVideoX checkpoint in the layout of diffusers → our layout, or with
                     --rgbd --camera [--memory] a world model to train from
  import dinov2      DINOv2 (transformers or the original state dict) → the map's image encoder
  export diffusers   our CogVideoX weights, fine-tuned or not → a folder for from_pretrained
  export inference   a training run → averaged weights in bfloat16, settings and a card
  export stablehlo   a world model → programs that run without this library

Each has --help. DST is made whole or not at all."""
COMMANDS: dict[str, tuple[type, Callable[[Any], None]]] = {
    "import cogvideox": (commands.ImportCogVideoX, commands.import_cogvideox),
    "import dinov2": (commands.ImportDINOv2, commands.import_dinov2),
    "export diffusers": (commands.ExportDiffusers, commands.export_diffusers),
    "export inference": (commands.ExportInference, commands.export_inference),
    "export stablehlo": (commands.ExportStableHLO, commands.export_stablehlo),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 bad input, 130 interrupted."""
    return cli.run(_main, argv)


def _main(argv: Sequence[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if argv else 2
    verb = cli.choose(argv[0], sorted({name.split()[0] for name in COMMANDS}), "command")
    below = [name.split()[1] for name in COMMANDS if name.startswith(f"{verb} ")]
    if len(argv) < 2 or argv[1] in ("-h", "--help"):
        print(USAGE)
        return 0 if len(argv) > 1 else 2
    command = f"{verb} {cli.choose(argv[1], below, f'command {verb}')}"
    kind, run = COMMANDS[command]
    flags = _gather(argv[2:], "--prompt")
    run(cli.parse_command(kind, flags, f"-m pewm_jax.convert {command}"))
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
