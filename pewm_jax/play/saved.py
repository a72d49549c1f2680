"""Files of the viewer: saved worlds and videos, in one folder, written atomically."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError, serialize
from pewm_jax.errors import require
from pewm_jax.io import tree, weights
from pewm_jax.io.video import Video
from pewm_jax.play.engine import Engine
from pewm_jax.types import WorldState

FORMAT, SUFFIX = "world 1", ".world.safetensors"
MOST_NAME = 60


def names(folder: Path) -> list[str]:
    """Return the names of the worlds in a folder, in order."""
    return sorted(path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}"))


def path_of(folder: Path, name: str) -> Path:
    """Return a world's file, or refuse a name that could point outside the folder."""
    plain = re.fullmatch(r"\w[\w \-]*", name) is not None and len(name) <= MOST_NAME
    require(
        plain, f"{name!r} is not a valid name of a world: use letters, digits, spaces and hyphens."
    )
    return folder / f"{name}{SUFFIX}"


def save(
    engine: Engine,
    world: WorldState,
    folder: Path,
    name: str,
    state_A: np.ndarray | None = None,
) -> Path:
    """Write a world: its present frame and its map; one of the same name is replaced.

    The settings of the model's clip and memory, and the state of the agent's body if it has one,
    are stored in the file.

    Raises:
        ConfigError: the name is not plain.
    """
    path = path_of(folder, name)
    host = {name: np.asarray(x) for name, x in tree.flatten(world).items()}
    facts = {"format": FORMAT, "of": _facts(engine)}
    if state_A is not None:
        facts["state"] = json.dumps(np.asarray(state_A).tolist())
    weights.save(path, tree.unflatten(host), facts)
    return path


def posture(folder: Path, name: str) -> np.ndarray | None:
    """Return the state of the agent's body in a saved world; None if it has none."""
    facts = weights.metadata(path_of(folder, name))
    return np.array(json.loads(facts["state"])) if "state" in facts else None


def load(engine: Engine, like: WorldState, folder: Path, name: str) -> WorldState:
    """Read a world written by ``save``, with the shapes of ``like``.

    Raises:
        UserError: it does not exist, is damaged, or belongs to a model with another memory.
    """
    path = path_of(folder, name)
    if not path.is_file():
        raise UserError(f"There is no world {name!r} in {folder}.")
    facts = weights.metadata(path)
    if facts.get("format") != FORMAT:
        raise UserError(f"{path} is not a world saved by the viewer.")
    if facts.get("of") != _facts(engine):
        raise UserError(
            f"The world {name!r} was made by a model whose images or memory differ from those of "
            f"{engine.name}: open it with the model that made it."
        )
    found = weights.load(path)
    tree.require_like(found, like, str(path))
    read = tree.flatten(found)
    leaves = [jnp.asarray(read[where]) for where in tree.flatten(like)]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _facts(engine: Engine) -> str:
    """Return the settings that two models must share to exchange worlds."""
    sections = (engine.model.clip, getattr(engine.model, "memory", engine.model))
    own = [engine.body] if engine.body else []
    return json.dumps([serialize.to_dict(section) for section in sections] + own, sort_keys=True)


FPS = 6
"""Steps per second of video."""


class DriveFilm:
    """A video that is being recorded; its name is the next free number."""

    def __init__(self, folder: Path, picture_HWC: np.ndarray):
        """Start a video in a folder with its first frame, uint8."""
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [path.stem.removeprefix("drive-") for path in folder.glob("drive-*.mp4")]
        number = 1 + max((int(text) for text in numbers if text.isdigit()), default=0)
        self._path = folder / f"drive-{number:03d}.mp4"
        self._partial = self._path.with_name(f"{self._path.name}.{os.getpid()}.partial")
        self._film = Video(self._partial, picture_HWC.shape[:2], FPS)
        self._film.add(picture_HWC)

    def add(self, picture_HWC: np.ndarray) -> None:
        """Add a frame."""
        self._film.add(picture_HWC)

    def close(self) -> Path:
        """End the video and return its file."""
        self._film.close()
        self._partial.replace(self._path)
        return self._path
