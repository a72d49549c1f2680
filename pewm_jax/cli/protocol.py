"""``pewm-jax protocol``: choose what runs will be scored by, before they are trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import config as configuration
from pewm_jax import presets, shipped
from pewm_jax.cli import named
from pewm_jax.cli import plugins as imports
from pewm_jax.config import Config, World
from pewm_jax.config import command_line as cli

ABOUT = (
    "Choose the clips that runs are scored by and write them to a file with a hash, before "
    "training: which episodes, starts, context, motion, noise and horizon. What is not given here "
    "is as in the settings of the preset or run. Then `pewm-jax train … --evaluate.protocol FILE`, "
    "or `pewm-jax evaluate RUN --protocol FILE`."
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """What may differ from the settings of the preset or run."""

    data: Path | None = None
    """Folder of the data set."""
    split: str | None = None
    """Folder inside it with the episodes to score."""
    clips: int | None = None
    """Clips scored per seed, at most."""
    seeds: tuple[int, ...] | None = None
    """Seeds of the sampling noise, e.g. --seeds 0 1 2."""
    context: int | None = None
    """Frames observed before each clip."""
    chain: int | None = None
    """Clips generated one after the other from each start: the horizon in clips."""
    stride: int | None = None
    """Recorded actions between two frames of a clip."""
    video_clips: int | None = None
    """Clips generated one after the other in a long rollout, at most."""
    out: Path = Path("protocol.json")
    """The file to write; one that holds another protocol is not written over."""


def main(argv: Sequence[str], prog: str = "pewm-jax protocol") -> int:
    """Write a protocol's file and print its hash.

    Args:
        argv: the arguments: a preset or a run, and what is to differ from its settings.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    missing = f"Name a preset or a run first: {prog} demo --out protocol.json."
    name, flags = named.take(imports.take(argv), "PRESET_OR_RUN", missing)
    prog = f"{prog} {name}"
    about = f"{ABOUT} Beside these settings:\n{imports.HELP}"
    settings = cli.parse(Settings, flags, default=Settings(), prog=prog, description=about)
    config = _laid(_settings_of(name), settings)
    # Imported here and not above: help and refusals come at once.
    from pewm_jax.eval import protocol as protocols

    protocols.write_protocol(config, settings.out, print)
    print(f"protocol: {settings.out}")
    return 0


def _settings_of(name: str) -> Config:
    """Return the settings of a preset, or of a run or weights that come with the library."""
    file = shipped.find(name) / "config.json"
    if name not in presets.names() and file.is_file():
        config = configuration.load(file)
    else:
        config = presets.load(cli.choose(name, presets.names(), "preset or run"))
    if not isinstance(config.model, World):
        raise cli.ConfigError(
            f"{name} trains no world model, and protocols are of rollouts: leave it to "
            "`pewm-jax evaluate`."
        )
    return config


def _laid(config: Config, settings: Settings) -> Config:
    """Return the settings with those that were given in their place."""
    given = {name: value for name, value in vars(settings).items() if value is not None}
    given.pop("out")
    data = {"path": str(given.pop("data"))} if "data" in given else {}
    data |= {"context": given.pop("context")} if "context" in given else {}
    return dataclasses.replace(
        config,
        data=dataclasses.replace(config.data, **data),
        evaluate=dataclasses.replace(config.evaluate, **given),
    )
