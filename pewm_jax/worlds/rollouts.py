"""The friendly calls: a trained world model from its folder, and what it imagines.

    config, params = pewm_jax.load("runs/demo")
    state = start(config, params, frames)             # a few posed RGB-D frames
    state, clip = rollout(config, params, state, actions, jax.random.key(0))

``pewm_jax.worlds`` says it all.

``rollout`` is pure, and compiled once for each model and set of shapes. Under a jit of the
caller's the model is static. Each rollout remembers what it imagines, so ``jax.vmap`` makes a map
for each; to compare actions from one state use ``worlds.imagine_many``, which shares its map.
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


def load_finished(
    path: str | Path, *, lazily: bool = False, config: Config | None = None
) -> tuple[Config, Params]:
    """Load the weights of a finished training; ``train.loading.load`` also reads checkpoints.

    Args:
        path: a run folder made by ``train.py``, with ``config.json`` and ``weights.safetensors``,
            or the name of weights that come with the library.
        lazily: map the file into memory, so that what is not looked at is not read.
        config: the run's configuration, if it is read already.

    Returns:
        ``(config, params)``; the averaged weights that inference uses, in the dtype of the file.

    Raises:
        UserError: something is absent or damaged, or the weights do not fit the configuration.
    """
    folder = shipped.find(path)
    config = configs.load(folder / "config.json") if config is None else config
    params = (weights.lazy if lazily else weights.load)(folder / "weights.safetensors")
    expected = _expected(config, params)
    weights.check(params, expected, str(folder / "weights.safetensors"))
    return config, params


def _expected(config: Config, params: Params) -> Params:
    """Return the shapes of the parameters that weights of a finished stage have."""
    key = jax.random.key(0)
    made = [
        jax.eval_shape(functools.partial(stage.init, config.model), key)
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
    """Imagine what the agent will see, and remember it.

    Args:
        config: the experiment, or its model (static under jit).
        params: the world model's parameters.
        state: from ``start`` or from an earlier rollout.
        actions: n ≥ 1 discrete actions (0 forward, 1 turn left, 2 turn right), (n, 3) continuous
            ones (dx, dy, dyaw: metres forward, metres left, radians counter-clockwise), or cameras;
            see ``worlds.imagine``. A list or a NumPy array will do.
        key: randomness of the sampling noise.
        memory: False ignores the map (the empty-map baseline); it is still updated.

    Returns:
        ``(state, frames)``: the world after the last frame, and the n imagined frames, colours
        float32 in [−1, 1], depth in metres. Under jit, vmap and grad an unknown or non-finite
        action gives NaN frames and leaves the map as it was; see ``worlds.imagine``.

    Raises:
        UserError: there are no actions, or they have another form; or, outside of jit, vmap and
            grad, they are unknown or not finite.
    """
    return worlds.imagine(config, params, state, actions, key, memory=memory)
