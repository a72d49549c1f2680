"""Run ``pewm-jax demo``: data, training and report by one command."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import shlex
from pathlib import Path

from pewm_jax import presets
from pewm_jax.cli import main, parser
from pewm_jax.errors import ConfigError
from pewm_jax.worlds.pewm.world import PEWM

SIZE = 64
"""Width and height that `data collect` gives pictures by default, pixels."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Collect walks through generated houses, train a world model on them and score it.

    It is scored on imagined walks through houses that were not in training. If interrupted, run it
    again: it resumes.
    """

    preset: str = "demo"
    """Preset that is trained; `pewm-jax train --help` lists them."""
    data: Path = Path("data/demo")
    """Folder of the walks."""
    run: Path = Path("runs/demo")
    """Folder of the training and of the report."""
    houses: int = 144
    """Houses to train in; there are others to be scored in."""
    frames: int = 80
    """Frames of a walk."""

    def __post_init__(self):
        """Validate."""
        parser.choose(self.preset, presets.names(), "preset")
        for name in ("houses", "frames"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name} is {getattr(self, name)}: give at least 1.")
        _ = self.size

    @property
    def size(self) -> int:
        """Width and height of the preset's pictures, pixels.

        Raises:
            ConfigError: they are not square, or the preset is not of a world with a map.
        """
        model = presets.load(self.preset).model
        maps = type(model) is PEWM  # of other worlds, which need other data
        if not maps or model.clip.width != model.clip.height:
            raise ConfigError(
                f"--preset {self.preset} does not fit the demo, which trains a world with a map on "
                "square pictures: take demo, or the steps one by one."
            )
        return model.clip.width


def run(settings: Settings) -> int:
    """Run all steps, and print which files to open."""
    _require_folder(settings)
    parts = steps(settings)
    for number, (what, words) in enumerate(parts, 1):
        print(f"[{number}/{len(parts)}] {what}: {shlex.join(['pewm-jax', *words])}", flush=True)
        code = main.execute(words)
        if code:
            return code
    print(ending(settings.run, _viewer()), flush=True)
    return 0


def steps(settings: Settings) -> list[tuple[str, list[str]]]:
    """Return what each step does, and the words of its command."""
    walks, folder = str(settings.data), str(settings.run)
    collect = ["collect", walks, "--train", str(settings.houses), "--frames", str(settings.frames)]
    if settings.size != SIZE:
        collect += ["--size", str(settings.size)]
    learn = [settings.preset, "--data.path", walks, "--train.run", folder]
    return [
        ("Walking through generated houses", ["data", *collect]),
        ("Training a world model", ["train", *learn]),
        ("Imagining walks and scoring them", ["evaluate", folder]),
    ]


def ending(run: Path, viewer: bool) -> str:
    """Return the sentences that say which files to open.

    Args:
        run: the folder of the training.
        viewer: whether what the viewer needs is installed.
    """
    install = "" if viewer else "pip install 'pewm-jax[play]' && "
    return (
        f"Done. Open {run / 'report' / 'index.html'} in a browser: pictures, videos and scores of "
        f"what was imagined. {run / 'config.json'} holds the settings. Drive in it: "
        f"{install}pewm-jax play {shlex.quote(str(run))}"
    )


def _require_folder(settings: Settings) -> None:
    """Refuse a folder that training would refuse, before collecting; makes none."""
    there = next(path for path in (settings.run, *settings.run.parents) if path.exists())
    if there != settings.run and there.is_dir():
        return
    from pewm_jax.train import runs  # here: help and refusals are fast

    config = presets.load(settings.preset)
    where = dataclasses.replace(config.data, path=str(settings.data))
    train = dataclasses.replace(config.train, run=str(settings.run))
    runs.check(dataclasses.replace(config, data=where, train=train))


def _viewer() -> bool:
    """Tell whether what the viewer needs is installed."""
    try:
        importlib.metadata.version("viser")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
