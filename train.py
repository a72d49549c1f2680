"""Train a world model: `python train.py demo`, with any setting changed by a flag."""

import importlib
import sys
from collections.abc import Sequence

import configs
from pewm_jax import cli
from pewm_jax.config import Launch

USAGE = """usage: python train.py PRESET [--config FILE.json] [--SETTING VALUE …]

Presets (one file each in configs/):
{presets}

Beside the settings there are
{launch}

Examples:
  python train.py demo --train.run runs/mine --train.stage1.steps 1000
  python train.py pewm_5b --plan --devices 64 --chip h200

`python train.py PRESET --help` lists every setting with its meaning and its value there.
The same command again goes on where an interrupted training stopped."""


def main(argv: Sequence[str]) -> int:
    """Train what the arguments say; returns the exit code."""
    known = configs.names()
    if argv and argv[0] in ("-h", "--help"):
        lines = [f"  {name:<10}{configs.describe(name)}" for name in known]
        print(USAGE.format(presets="\n".join(lines), launch=cli.list_flags(Launch)))
        return 0
    if not argv or argv[0].startswith("-"):
        raise cli.ConfigError(
            f"Name a preset first: python train.py {known[0]} ({', '.join(known)})."
        )
    preset = cli.choose(argv[0], known, "preset")
    launch, argv = cli.take(Launch, argv)
    config = cli.parse(
        type(configs.load(preset)),
        argv[1:],
        default=configs.load(preset),
        prog=f"train.py {preset}",
        description=f"{configs.describe(preset)} Settings also come from --config FILE.json. "
        f"Beside these settings:\n{cli.list_flags(Launch)}",
    )
    # Imported here and not above: help and refusals come at once, and Ctrl-C is clean meanwhile.
    if launch.plan:
        importlib.import_module("pewm_jax.scaling.plan").show(config, launch)
        return 0
    with importlib.import_module("pewm_jax.training.processes").joined(launch):
        loop = importlib.import_module("pewm_jax.training.loop")
        pictures = importlib.import_module("pewm_jax.evaluation.preview")
        run = loop.runs.check(config)
        cli.cache_compilation(run.parent)
        preview = pictures.make_preview(config, run) if config.train.preview_every else None
        loop.train(config, preview=preview, profile=launch.profile)
    return 0


if __name__ == "__main__":
    sys.exit(cli.run(main))
