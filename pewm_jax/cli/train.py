"""``pewm-jax train`` and ``pewm-jax plan``: a preset, with any setting changed by a flag."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import config as configuration
from pewm_jax import presets, registry
from pewm_jax.cli import plugins as imports
from pewm_jax.config import Config, Launch, World
from pewm_jax.config import command_line as cli
from pewm_jax.io import heap

USAGE = """usage: {prog} PRESET [--config FILE.json] [--SETTING VALUE …]

Presets:
{presets}
  WORLD        the name of a world that a plugin registers, with its own defaults
  FOLDER       made by `pewm-jax convert import`: the settings in it, starting from its weights

Beside the settings there are
{launch}
{imports}

Examples:
{examples}

`{prog} PRESET --help` lists every setting with its meaning and its value there.
{more}"""
TRAIN_EXAMPLES = (
    "demo --train.run runs/mine --train.stage1.steps 1000",
    "pewm_5b --plan --devices 64 --chip h200",
)
PLAN_EXAMPLES = (
    "pewm_5b --devices 64 --chip h200",
    "pewm_2b --devices 8 --chip h100 --train.mesh.fsdp 8",
)
PLANNING = "with --plan: "
"""How the help of a flag of `Launch` begins that is of plans alone."""


def main(argv: Sequence[str], prog: str = "python train.py") -> int:
    """Train what the arguments say.

    Args:
        argv: the arguments: a preset, settings, and the flags of ``Launch``.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    if argv and argv[0] in ("-h", "--help"):
        more = "The same command again goes on where an interrupted training stopped."
        print(_usage(prog, TRAIN_EXAMPLES, cli.list_flags(Launch), more))
        return 0
    config, launch = _read(argv, prog)
    if not launch.plan:
        heap.keep_large()
    # Imported here and not above: help and refusals come at once, and Ctrl-C is clean meanwhile.
    if launch.plan:
        from pewm_jax.plan import plan as planning

        planning.show(config, launch)
        return 0
    from pewm_jax.train import processes

    with processes.joined(launch):
        # After joining: these imports take seconds, and JAX must not be used before it.
        from pewm_jax.eval import preview as pictures
        from pewm_jax.eval import protocol as protocols
        from pewm_jax.train import loop

        if isinstance(config.model, World):
            protocols.apply_protocol_file(config, {})  # refused now, and not after the training
        run = loop.runs.check(config)
        cli.cache_compilation(run.parent)
        preview = pictures.make_preview(config, run) if config.train.preview_every else None
        loop.train(config, preview=preview, profile=launch.profile)
    return 0


def plan(argv: Sequence[str], prog: str = "pewm-jax plan") -> int:
    """Say what a training would take on hardware that is not here; ``main`` with ``--plan``."""
    if argv and argv[0] in ("-h", "--help"):
        flags = [line for line in cli.list_flags(Launch).splitlines() if PLANNING in line]
        launch = "\n".join(flags).replace(PLANNING, "")
        print(_usage(prog, PLAN_EXAMPLES, launch, "Nothing is trained, read or written."))
        return 0
    return main([*argv, "--plan"], prog)


def _usage(prog: str, examples: Sequence[str], launch: str, more: str) -> str:
    lines = [f"  {name:<12} {presets.describe(name)}" for name in presets.names()]
    return USAGE.format(
        prog=prog,
        presets="\n".join(lines),
        launch=launch,
        imports=imports.HELP,
        examples="\n".join(f"  {prog} {example}" for example in examples),
        more=more,
    )


def _read(argv: Sequence[str], prog: str) -> tuple[Config, Launch]:
    """Return the settings, and how they are to be launched.

    Raises:
        ConfigError: the arguments name no preset, or a setting that does not exist or cannot work.
    """
    known = presets.names()
    if not argv or argv[0].startswith("-"):
        raise cli.ConfigError(f"Name a preset first: {prog} demo ({', '.join(known)}).")
    name, folder = argv[0], Path(argv[0])
    launch, argv = cli.take(Launch, argv)
    if name not in known and (folder / "config.json").is_file():
        default, about = _settings_in(folder), f"The settings in {folder}."
    elif name not in known and name in registry.names("world"):
        world = registry.named("world", name).settings
        default = Config(model=world(), train=world.TRAIN())
        about = f"The world {name}, with its own defaults."
    else:
        default = presets.load(cli.choose(name, known, "preset"))
        about = presets.describe(name)
    config = cli.parse(
        type(default),
        argv[1:],
        default=default,
        prog=f"{prog} {name}",
        description=f"{about} Settings also come from --config FILE.json. "
        f"Beside these settings:\n{cli.list_flags(Launch)}\n{imports.HELP}",
    )
    return config, launch


def _settings_in(folder: Path) -> Config:
    """Return the settings in a folder of weights, to start from those weights.

    A run's own folder starts from what it started from: the same command goes on with it.
    """
    config = configuration.load(folder / "config.json")
    if Path(config.train.run).resolve() == folder.resolve():
        return config
    return dataclasses.replace(config, train=dataclasses.replace(config.train, start=str(folder)))
