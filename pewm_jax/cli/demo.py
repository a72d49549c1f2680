"""Run ``pewm-jax demo``: data, training and report by one command."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import shlex
from pathlib import Path

from pewm_jax import presets, registry
from pewm_jax.cli import main, parser
from pewm_jax.errors import ConfigError

SIZE = 64
"""Default width and height of the images of `data collect`, pixels."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Collect walks through generated houses, train a world model on them and evaluate it.

    It is evaluated on imagined walks through held-out houses. If interrupted, run it again: it
    resumes.
    """

    preset: str = "demo"
    """Preset to train; `pewm-jax train --help` lists them."""
    data: Path = Path("data/demo")
    """Folder of the walks."""
    run: Path = Path("runs/demo")
    """Folder of the training and of the report."""
    houses: int = 144
    """Number of training houses; held-out ones are generated in addition."""
    frames: int = 80
    """Frames per walk."""

    def __post_init__(self):
        """Validate."""
        parser.choose(self.preset, presets.names(), "preset")
        for name in ("houses", "frames"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name} is {getattr(self, name)}: give at least 1.")
        _ = self.size

    @property
    def size(self) -> int:
        """Return width and height of the preset's images, pixels.

        Raises:
            ConfigError: they are not square, or the preset is not of a world with a map.
        """
        model = presets.load(self.preset).model
        maps = registry.of(model).name == "pewm"  # other worlds need other data
        if not maps or model.clip.width != model.clip.height:
            raise ConfigError(
                f"--preset {self.preset} does not fit the demo, which trains a world with a map on "
                "square images: use demo, or run the steps one by one."
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
    """Return the description and the command line of each step."""
    walks, folder = str(settings.data), str(settings.run)
    collect = ["collect", walks, "--train", str(settings.houses), "--frames", str(settings.frames)]
    if settings.size != SIZE:
        collect += ["--size", str(settings.size)]
    learn = [settings.preset, "--data.path", walks, "--train.run", folder]
    return [
        ("Walking through generated houses", ["data", *collect]),
        ("Training a world model", ["train", *learn]),
        ("Imagining walks and evaluating them", ["evaluate", folder]),
    ]


def ending(run: Path, viewer: bool) -> str:
    """Return the sentences that say which files to open after training in a folder.

    ``viewer``: whether the viewer's dependencies are installed.
    """
    install = "" if viewer else "pip install 'pewm-jax[play]' && "
    return (
        f"Done. Open {run / 'report' / 'index.html'} in a browser: images, videos and scores of "
        f"the imagined walks. {run / 'config.json'} contains the settings. Drive in it: "
        f"{install}pewm-jax play {shlex.quote(str(run))}"
    )


def _require_folder(settings: Settings) -> None:
    """Raise an error before collecting if training would reject the folder; create none."""
    there = next(path for path in (settings.run, *settings.run.parents) if path.exists())
    if there != settings.run and there.is_dir():
        return
    from pewm_jax.train import runs  # imported lazily, for fast help and errors

    config = presets.load(settings.preset)
    where = dataclasses.replace(config.data, path=str(settings.data))
    train = dataclasses.replace(config.train, run=str(settings.run))
    runs.check(dataclasses.replace(config, data=where, train=train))


def _viewer() -> bool:
    """Return whether the viewer's dependencies are installed."""
    try:
        importlib.metadata.version("viser")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
