"""Worlds in files: a folder of them by plain names, each written whole or not at all."""

from __future__ import annotations

import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError, serialize
from pewm_jax.errors import require
from pewm_jax.io import tree, weights
from pewm_jax.play.engine import Engine
from pewm_jax.types import WorldState

FORMAT, SUFFIX = "world 1", ".world.safetensors"
MOST_NAME = 60


def names(folder: Path) -> list[str]:
    """Return the names of the worlds in a folder, in order."""
    return sorted(path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}"))


def path_of(folder: Path, name: str) -> Path:
    """Return a world's file.

    Raises:
        ConfigError: the name is not plain: it could lead out of the folder.
    """
    plain = re.fullmatch(r"\w[\w \-]*", name) is not None and len(name) <= MOST_NAME
    require(plain, f"{name!r} is no name for a world: use letters, digits, spaces and hyphens.")
    return folder / f"{name}{SUFFIX}"


def save(engine: Engine, world: WorldState, folder: Path, name: str) -> Path:
    """Write a world: its present frame and its map.

    Args:
        engine: the model it belongs to; its clip and memory are noted in the file.
        world: the world.
        folder: where; it is made.
        name: a plain name. A world of that name is replaced.

    Raises:
        ConfigError: the name is not plain.
    """
    path = path_of(folder, name)
    host = {name: np.asarray(x) for name, x in tree.flatten(world).items()}
    weights.save(path, tree.unflatten(host), {"format": FORMAT, "of": _facts(engine)})
    return path


def load(engine: Engine, like: WorldState, folder: Path, name: str) -> WorldState:
    """Read a world written by ``save``.

    Args:
        engine: the model to drive it with.
        like: a world of that model, for its shapes.
        folder: where.
        name: its name.

    Raises:
        UserError: it does not exist, is damaged, or belongs to a model with another memory.
    """
    path = path_of(folder, name)
    if not path.is_file():
        raise UserError(f"There is no world {name!r} in {folder}.")
    facts = weights.metadata(path)
    if facts.get("format") != FORMAT:
        raise UserError(f"{path} is no world that the viewer has saved.")
    if facts.get("of") != _facts(engine):
        raise UserError(
            f"The world {name!r} was made by a model with other images or another memory than "
            f"{engine.name}: open it with the model that made it."
        )
    found = weights.load(path)
    tree.require_like(found, like, str(path))
    read = tree.flatten(found)
    leaves = [jnp.asarray(read[where]) for where in tree.flatten(like)]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _facts(engine: Engine) -> str:
    """Return what two models must share to share worlds."""
    sections = (engine.model.clip, getattr(engine.model, "memory", engine.model))
    return json.dumps([serialize.to_dict(section) for section in sections], sort_keys=True)
