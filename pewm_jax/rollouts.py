"""Chapter 6, the world model as a function: WorldState → WorldState.

    config, params = pewm_jax.load("runs/demo")
    state = start(config, params, frames)             # a few posed RGB-D frames
    state, clip = rollout(config, params, state, actions, jax.random.key(0))

``rollout`` is pure: jit it with ``static_argnums=0``, vmap it over states, actions and keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from pewm_jax import config as configs
from pewm_jax import weights
from pewm_jax.config import Config, UserError
from pewm_jax.diffusion import objective, sampler
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.memory import features as image_features
from pewm_jax.memory import memories
from pewm_jax.models import codec, world_model
from pewm_jax.types import Array, Camera, Frames, Params, WorldState


def load_finished(path: str | Path, *, lazily: bool = False) -> tuple[Config, Params]:
    """Load the weights of a finished training; ``training.loading.load`` also reads checkpoints.

    Args:
        path: a run folder made by ``train.py``, with ``config.json`` and ``weights.safetensors``.
        lazily: map the file into memory, so that what is not looked at is not read.

    Returns:
        ``(config, params)``; the averaged weights that inference uses, in the dtype of the file.

    Raises:
        UserError: something is absent or damaged, or the weights do not fit the configuration.
    """
    folder = Path(path)
    config = configs.load(folder / "config.json")
    params = (weights.lazy if lazily else weights.load)(folder / "weights.safetensors")
    expected = jax.eval_shape(
        lambda key: world_model.init(config, key, memory="memory" in params), jax.random.key(0)
    )
    weights.check(params, expected, str(folder / "weights.safetensors"))
    return config, params


def start(config: Config, params: Params, frames: Frames) -> WorldState:
    """Begin a world from a few posed RGB-D frames.

    Args:
        config: the experiment.
        params: the world model's parameters; those of the image encoder are used, if it has any.
        frames: S ≥ 1 frames (S, H, W, …), uint8 or float colours; all go into the map, the last
            one is the present.

    Returns:
        The state to roll out from.

    Raises:
        UserError: the frames' shapes do not agree with each other or with the configuration.
    """
    count = frames.depth_THW.shape[0] if frames.depth_THW.ndim else 0
    expected = (count, config.clip.height, config.clip.width)
    if count < 1 or frames.rgb_THWC.shape != (*expected, 3) or frames.depth_THW.shape != expected:
        raise UserError(
            f"start() got colours {frames.rgb_THWC.shape} and depth {frames.depth_THW.shape}; this "
            f"model needs (S, {expected[1]}, {expected[2]}, 3) and (S, {expected[1]}, "
            f"{expected[2]}) with S ≥ 1: resize the frames and scale their intrinsics."
        )
    poses, intrinsics = frames.camera.world_from_camera, frames.camera.intrinsics_4
    if poses.shape != (count, 4, 4) or intrinsics.shape != (count, 4):
        raise UserError(
            f"start() got {count} frames but poses {poses.shape} and intrinsics "
            f"{intrinsics.shape}; give ({count}, 4, 4) and ({count}, 4)."
        )
    frames = jax.tree.map(jnp.asarray, objective.as_signal(frames))
    remembered = objective.remember(config, params, frames, jnp.ones((count,), bool))
    return WorldState(jax.tree.map(lambda x: x[-1:], frames), remembered)


def imagine_clip(
    config: Config,
    params: Params,
    state: WorldState,
    actions_T3: Array,
    key: Array,
    *,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Generate one clip: the T − 1 frames after the present one.

    Args:
        config: the experiment.
        params: the world model's parameters.
        state: the world so far.
        actions_T3: (T − 1, 3) actions (dx, dy, dyaw).
        key: sampling noise.
        memory: False ignores the map (it is still updated).

    Returns:
        The next state and T − 1 frames, colours float in [−1, 1]. A denoiser that works without
        depth (``memory.depth``) imagines none: 0 everywhere, which no map keeps.
    """
    frame = state.frame
    poses = action_geometry.integrate(frame.camera.world_from_camera[0], actions_T3)
    intrinsics = jnp.broadcast_to(frame.camera.intrinsics_4, (poses.shape[0], 4))
    camera = Camera(intrinsics, poses)
    batched = jax.tree.map(lambda x: x[None], camera)
    conditioning = world_model.condition(config, params, frame.rgb_THWC, frame.depth_THW, batched)
    tokens = None
    if memory and "memory" in params:
        tokens = jax.tree.map(lambda x: x[None], memories.tokens(config, state.map, camera))
    shape = (1, *codec.latent_shape(config), codec.latent_channels(config))
    latents = sampler.sample(
        config,
        params,
        conditioning,
        tokens,
        jax.random.normal(key, shape),
        jax.random.fold_in(key, 1),
    )
    rgb, depth = codec.decode_rgbd(config, params, latents)
    depth = depth if config.memory.depth else jnp.zeros_like(depth)
    future = Camera(intrinsics[1:], poses[1:])
    frames = Frames(rgb[0, 1:], depth[0, 1:], future)
    features = image_features.encode(config.memory, params.get("encoder", {}), frames.rgb_THWC)
    remembered = memories.remember(config, state.map, frames, features)
    return WorldState(jax.tree.map(lambda x: x[-1:], frames), remembered), frames


def rollout(
    config: Config,
    params: Params,
    state: WorldState,
    actions: ArrayLike | Sequence[Any],
    key: Array,
    *,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Imagine what the agent will see.

    Args:
        config: the experiment (static under jit).
        params: the world model's parameters.
        state: from ``start`` or from an earlier rollout.
        actions: (n·(T − 1),) discrete actions (0 forward, 1 turn left, 2 turn right) or
            (n·(T − 1), 3) continuous ones (dx, dy, dyaw: metres forward, metres left, radians
            counter-clockwise); T is ``config.clip.frames``. A list or a NumPy array will do.
        key: randomness of the sampling noise.
        memory: False ignores the map (the empty-map baseline); it is still updated.

    Returns:
        ``(state, frames)``: the world after the last clip, and the n·(T − 1) imagined frames,
        colours float32 in [−1, 1], depth in metres.

    Raises:
        UserError: the number of actions is not a positive multiple of T − 1, or a discrete action
            is not 0, 1 or 2 (under jit, vmap and grad values are unknown and not checked).
    """
    actions = jnp.asarray(actions)
    length = config.clip.frames - 1
    count = actions.shape[0] if actions.ndim else 0
    if count == 0 or count % length:
        raise UserError(
            f"rollout() got {count} actions; a clip takes {length}, so give a positive multiple "
            f"of {length}."
        )
    _require_known(actions)
    moves = action_geometry.continuous(config.actions, actions)
    if moves.ndim != 2 or moves.shape[1] != 3:
        raise UserError(
            f"rollout() got actions of shape {actions.shape}; give ({count},) integers or "
            f"({count}, 3) floats (dx, dy, dyaw)."
        )
    clips = count // length

    def step(state, inputs):
        chunk, clip_key = inputs
        return imagine_clip(config, params, state, chunk, clip_key, memory=memory)

    inputs = (moves.reshape(clips, length, 3), jax.random.split(key, clips))
    state, frames = jax.lax.scan(step, state, inputs)
    return state, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), frames)


def _require_known(actions: Array) -> None:
    """Refuse discrete actions outside the table, which a lookup would clamp to the last row."""
    if isinstance(actions, Tracer) or not jnp.issubdtype(actions.dtype, jnp.integer):
        return
    wrong = sorted({int(a) for a in np.ravel(actions)} - set(range(len(action_geometry.NAMES))))
    if wrong:
        known = ", ".join(f"{a} {name}" for a, name in enumerate(action_geometry.NAMES))
        raise UserError(
            f"rollout() got the discrete actions {wrong}; there is {known} (continuous actions are "
            "floats of shape (n, 3))."
        )
