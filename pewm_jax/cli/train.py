"""Run ``pewm-jax train`` and ``pewm-jax plan``: a preset, with any setting changed by a flag."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from pewm_jax import config as configuration
from pewm_jax import presets, registry, shipped
from pewm_jax.cli import parser
from pewm_jax.cli.parser import Arguments, Flat
from pewm_jax.config import Config, Launch, World
from pewm_jax.errors import ConfigError
from pewm_jax.io import runtime

LAUNCH = Launch()
EXAMPLES = {
    "train": (
        "demo --train.run runs/mine --train.stage1.steps 1000",
        "pewm_5b --plan --devices 64 --chip h200",
    ),
    "plan": (
        "pewm_5b --devices 64 --chip h200",
        "pewm_2b --devices 8 --chip h100 --train.mesh.fsdp 8",
        "pewm_2b --devices 8 --chip v5p --compiler target --json plan.json",
        "pewm_2b --devices 8 --chip h100 --compiler target --fit",
        "pewm_2b --chip h100 --compiler target --inference",
    ),
}
ABOUT = {
    "train": "Train a world model. The same command resumes an interrupted training.",
    "plan": "Predict memory and time of a training on other hardware. Nothing is trained or "
    "written.",
}


@dataclasses.dataclass(frozen=True)
class Chosen:
    """The preset, and how it is launched."""

    preset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PRESET")]
    """A preset; the name of a world registered by a plugin; or a folder made by `pewm-jax convert
    import`, whose settings and weights are the start of training."""
    launch: Flat[Launch] = LAUNCH
    """How it is launched."""


def arguments(argv: Sequence[str], prog: str) -> Arguments:
    """Return the arguments of ``train`` and ``plan``; the settings depend on the preset.

    Raises:
        ConfigError: the arguments name no preset.
    """
    command = "plan" if prog.endswith("plan") else "train"
    known = presets.names()
    chosen = {"chosen": (Chosen, None)}
    if argv and argv[0] in parser.HELP:
        return Arguments(chosen, ABOUT[command], _epilog(prog, EXAMPLES[command]))
    if not argv or argv[0].startswith("-"):
        raise ConfigError(f"Give a preset first: {prog} demo ({', '.join(known)}).")
    name = argv[0]
    default, about = settings_of(name, "preset")
    folder = shipped.find(name)
    if name not in known and (folder / "config.json").is_file():
        default = _starting_from(folder, default)
    groups = {**chosen, "config": (type(default), default)}
    return Arguments(groups, about, hint=f"{prog} {name}")


def settings_of(name: str, what: str) -> tuple[Config, str]:
    """Return the settings with a name, and what they are.

    It names a preset; the folder of a run or of weights, or weights that ship with the library; or
    a world that a plugin or an installed package registers. ``what`` describes the first ones, for
    the message.

    Raises:
        ConfigError: nothing has this name.
    """
    known, file = presets.names(), shipped.find(name) / "config.json"
    if name in known:
        return presets.load(name), presets.describe(name)
    if file.is_file():
        return configuration.load(file), f"The settings in {Path(name)}."
    try:
        world = registry.named("world", name).settings
    except ConfigError as error:
        try:
            parser.choose(name, known, what)
        except ConfigError as first:
            raise ConfigError(f"{first} {error}") from None
        raise
    return Config(model=world(), train=world.TRAIN()), f"The world {name}, with its own defaults."


def run(chosen: Chosen, config: Config) -> None:
    """Train, or print a plan with ``--plan``."""
    launch = chosen.launch
    if launch.plan:
        plan(chosen, config)
        return
    runtime.keep_large()
    # Imported lazily: help and errors are fast, and Ctrl-C is clean meanwhile.
    from pewm_jax.train import processes

    with processes.joined(launch):
        # After joining: these imports take seconds, and JAX must not be used before it.
        from pewm_jax.eval import preview as pictures
        from pewm_jax.eval import protocol as protocols
        from pewm_jax.train import loop

        if isinstance(config.model, World):
            protocols.apply_protocol_file(config, {})  # fail before training
        folder = Path(config.train.run)
        runtime.cache_compilation(folder.parent)
        preview = pictures.make_preview(config, folder) if config.train.preview_every else None
        loop.train(config, preview=preview, profile=launch.profile)


def plan(chosen: Chosen, config: Config) -> None:
    """Print the predicted memory and time of a training on other hardware."""
    from pewm_jax.plan import plan as planning

    planning.show(config, dataclasses.replace(chosen.launch, plan=True))


def _epilog(prog: str, examples: Sequence[str]) -> str:
    """Return the list of presets, and examples."""
    lines = [f"  {name:<12} {presets.describe(name)}" for name in presets.names()]
    called = [f"  {prog} {example}" for example in examples]
    more = f"`{prog} PRESET --help` lists every setting with its meaning and its value."
    return "\n".join(["Presets:", *lines, "", "Examples:", *called, "", more])


def _starting_from(folder: Path, config: Config) -> Config:
    """Return the settings in a folder of weights, for training from those weights.

    A run's own folder keeps its original start weights: the same command resumes it.
    """
    if Path(config.train.run).resolve() == folder.resolve():
        return config
    return dataclasses.replace(config, train=dataclasses.replace(config.train, start=str(folder)))
