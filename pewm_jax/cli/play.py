"""Run ``pewm-jax play``: drive through an imagined world in the browser."""

from __future__ import annotations

import dataclasses
import functools
import os
import threading
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pewm_jax import shipped
from pewm_jax.errors import ConfigError
from pewm_jax.io import runtime
from pewm_jax.play.settings import Serve, Start


@dataclasses.dataclass(frozen=True)
class Settings(Start, Serve):
    """Drive through a world that a model imagines, in the browser.

    W, A, S, D or the arrow keys drive; the page shows the map in 3D, with boxes to erase and move.
    A model that is steered by the joints of a body has a slider for each of them. The drive starts
    in a generated house, unless a mesh, an episode or a recording is given. Ctrl-C ends it.
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")] = dataclasses.field(
        kw_only=True
    )
    """A run's folder, an export, or the name of a model that ships with the library."""
    quantize: Literal["", "int8", "fp8"] = ""
    """Keep the weights of the denoiser in 8 bits; if empty, they stay as they are."""

    def __post_init__(self):
        """Validate."""
        Start.__post_init__(self)
        Serve.__post_init__(self)


def run(settings: Settings) -> None:
    """Serve the page until Ctrl-C."""
    model = settings.model
    if not (shipped.find(model) / "config.json").is_file():
        raise ConfigError(
            f"{model} is not a run: give the folder of a run, such as runs/demo, or one of "
            f"{', '.join(shipped.names())}."
        )
    # Imported lazily: help and errors are fast, and malloc is set up first.
    runtime.keep_small()
    print("Starting …", flush=True)
    from pewm_jax.play import page as pages
    from pewm_jax.play import serving

    home = shipped.home(model)
    _require_usable(settings)
    folder = settings.worlds or home / "worlds"
    name, say = Path(model).name, functools.partial(print, flush=True)
    page = pages.Page(
        lambda: _load(model, home, settings.quantize), settings, settings, folder, name, say
    )
    try:
        if settings.open:
            serving.open_in_browser(page.url)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("\nEnding …", flush=True)
    finally:
        page.close()


def _require_usable(settings: Settings) -> None:
    """Raise errors before the page opens: missing model, unusable start, unwritable folder.

    Weights are memory-mapped; of them, only kernels in 8 bits are read.
    """
    from pewm_jax import config as configuration
    from pewm_jax.config import World
    from pewm_jax.play import places
    from pewm_jax.worlds.rollouts import load_finished

    run, worlds = shipped.find(settings.model), settings.worlds
    model: Any = configuration.load(run / "config.json").model
    if (run / "weights.safetensors").is_file():
        load_finished(settings.model, lazily=True)
    if settings.scene or settings.episode or settings.recording:
        body = model.capabilities.body if isinstance(model, World) else ""
        places.open_place(settings, model.clip.height, model.clip.width, body=body)
    if worlds is not None:
        there = next(path for path in (worlds, *worlds.absolute().parents) if path.exists())
        if not there.is_dir() or not os.access(there, os.W_OK):
            raise ConfigError(
                f"--worlds is {worlds}, but {there} is not a writable folder: choose another one."
            )


def _load(name: str, home: Path, quantize: str = ""):
    """Load the model, and enable the compilation cache."""
    from pewm_jax.play.engine import open_engine
    from pewm_jax.train.loading import load

    runtime.cache_compilation(home.parent)
    return open_engine(Path(name).name, *load(name, quantize=quantize))
