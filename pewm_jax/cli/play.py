"""``pewm-jax play``: drive through an imagined world in the browser."""

from __future__ import annotations

import dataclasses
import functools
import os
import threading
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import shipped
from pewm_jax.cli import plugins as imports
from pewm_jax.config import command_line as cli
from pewm_jax.io import heap
from pewm_jax.play.settings import Serve, Start

ABOUT = (
    "Drive through a world that a model imagines, in the browser: W, A, S, D or the arrows, the "
    "map in 3D, boxes to erase and move in it. It begins in a generated house, unless a mesh, an "
    "episode or a recording is named. Ctrl-C ends it."
)


@dataclasses.dataclass(frozen=True)
class Settings(Start, Serve):
    """Where the drive begins, and how the page is served."""

    def __post_init__(self):
        """Validate."""
        Start.__post_init__(self)
        Serve.__post_init__(self)


def main(argv: Sequence[str], prog: str = "pewm-jax play") -> int:
    """Serve the page until Ctrl-C.

    Args:
        argv: the arguments: a run, an export, or the name of weights that come along; and settings.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    asks = any(word in ("-h", "--help") for word in argv)
    if not asks and (not argv or argv[0].startswith("-")):
        raise cli.ConfigError(f"Name a model first: {prog} small.")
    flags = ["--help"] if asks else argv[1:]
    named = f"{prog} {'RUN' if asks else argv[0]}"
    about = f"{ABOUT} Beside these settings:\n{imports.HELP}"
    settings = cli.parse(Settings, flags, default=Settings(), prog=named, description=about)
    if not (shipped.find(argv[0]) / "config.json").is_file():
        raise cli.ConfigError(
            f"{argv[0]} is no run: name its folder, such as runs/demo, or one of "
            f"{', '.join(shipped.names())}."
        )
    # Imported here and not above: help and refusals come at once, and memory is set up before.
    heap.keep_small()
    print("Starting …", flush=True)
    from pewm_jax.play import page as pages
    from pewm_jax.play import serving

    serve, start = _part(Serve, settings), _part(Start, settings)
    home = shipped.home(argv[0])
    _require_usable(argv[0], start, settings.worlds)
    folder = settings.worlds or home / "worlds"
    name, say = Path(argv[0]).name, functools.partial(print, flush=True)
    page = pages.Page(lambda: _load(argv[0], home), start, serve, folder, name, say)
    try:
        if settings.open:
            serving.open_in_browser(page.url)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("\nEnding …", flush=True)
    finally:
        page.close()
    return 0


def _require_usable(name: str, start: Start, worlds: Path | None) -> None:
    """Refuse, before the page opens, what cannot be loaded, begun with or written.

    Weights are mapped and not read.
    """
    from pewm_jax import config as configuration
    from pewm_jax.play import places
    from pewm_jax.worlds.rollouts import load_finished

    run = shipped.find(name)
    clip = configuration.load(run / "config.json").model.clip
    if (run / "weights.safetensors").is_file():
        load_finished(name, lazily=True)
    if start.scene or start.episode or start.recording:
        places.open_place(start, clip.height, clip.width)
    if worlds is not None:
        there = next(path for path in (worlds, *worlds.absolute().parents) if path.exists())
        if not there.is_dir() or not os.access(there, os.W_OK):
            raise cli.ConfigError(
                f"--worlds is {worlds}, and {there} is no folder that can be written: choose "
                "another one."
            )


def _load(name: str, home: Path):
    """Load the model, and keep what is compiled for it."""
    from pewm_jax.play.engine import open_engine
    from pewm_jax.train.loading import load

    cli.cache_compilation(home.parent)
    return open_engine(Path(name).name, *load(name))


def _part(kind: type, settings: Settings):
    """Return the settings of one part."""
    return kind(**{field.name: getattr(settings, field.name) for field in dataclasses.fields(kind)})
