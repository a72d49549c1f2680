"""The main calls: load a trained world model from its folder, and imagine frames.

    config, params = pewm_jax.load("runs/demo")
    state = start(config, params, frames)             # a few posed RGB-D frames
    state, clip = rollout(config, params, state, actions, jax.random.key(0))

``pewm_jax.worlds`` documents all calls. To compare actions from one state use
``worlds.imagine_many``, whose candidates share one memory.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jax.typing import ArrayLike

from pewm_jax import config as configs
from pewm_jax import shipped, worlds
from pewm_jax.config import Config, World
from pewm_jax.io import tree, weights
from pewm_jax.types import Array, Camera, Control, Frames, Params, WorldState
from pewm_jax.worlds import lora


def load_finished(
    path: str | Path, *, lazily: bool = False, config: Config | None = None
) -> tuple[Config, Params]:
    """Load the weights of a finished training; ``train.loading.load`` reads checkpoints too.

    Args:
        path: a run folder made by ``train.py``, with ``config.json`` and ``weights.safetensors``,
            or the name of weights that come with the library. Adapters (``worlds.lora``) are added
            to the weights that they adapt.
        lazily: map the file into memory, so that unused weights are not read, except kernels in 8
            bits.
        config: the run's configuration, if it is read already.

    Raises:
        UserError: something is absent or damaged, or the weights do not fit the configuration.
    """
    folder = shipped.find(path)
    config = configs.load(folder / "config.json") if config is None else config
    file = folder / "weights.safetensors"
    params = (weights.lazy if lazily else weights.load)(file)
    if lora.ROOT in params:
        start = lora.find_base(folder, weights.metadata(file))
        base = load_finished(start, lazily=lazily)[1]
        params = lora.merge(base, params, config.train.lora, config.model.dtype)
    expected = _expected(config, params)
    weights.check(params, expected, str(file))
    return config, params


def _expected(config: Config, params: Params) -> Params:
    """Return the shapes of the parameters that weights of a finished stage have."""
    key = jax.random.key(0)
    made = [
        stage.published(jax.eval_shape(functools.partial(stage.init, config.model), key))
        for stage in worlds.stages(config.model)
    ]
    found = tree.flatten(params).keys()
    same = (shapes for shapes in made if tree.flatten(shapes).keys() == found)
    alike = (shapes for shapes in made if shapes.keys() == params.keys())
    return next(same, next(alike, made[-1]))


def rollout(
    config: Config | World,
    params: Params,
    state: WorldState,
    actions: ArrayLike | Sequence[Any] | Camera | Control,
    key: Array,
    *,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Imagine the frames that actions lead to, and remember them; see ``worlds.imagine``.

    Actions are n ≥ 1 discrete actions, (n, 3) continuous ones, or cameras, in an array or a list.
    With ``memory`` False the map is ignored (the empty-map baseline) but still updated.
    """
    return worlds.imagine(config, params, state, actions, key, memory=memory)
