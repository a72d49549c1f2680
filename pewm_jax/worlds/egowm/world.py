"""The world of EgoWM: a video model steered by actions, chunk after chunk (arXiv 2601.15284).

There is no map: all that a chunk knows of the past are the last frames, observed or imagined, which
are shown to the backbone as it learned to be shown them (``backbones.observed``). Guidance is on
these frames alone, or on the text of a backbone that has one (``world_model.blind``): without them,
actions steer on (``noise.guidance``; 2 in the paper). A chunk is
denoised as a whole, so all its frames see all its actions, where the backbone's attention over time
looks both ways; earlier chunks never see the actions of later ones.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import EgoWMConfig, EgoWMTrainConfig, TrainSettings
from pewm_jax.types import Array, Clip, Control, Frames, Params, WorldState
from pewm_jax.worlds import objective, world_model
from pewm_jax.worlds.control import control_of, cut_into_clips, join_clips, last_frames
from pewm_jax.worlds.pewm import world as pewm
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

memory_points, point_colours = pewm.memory_points, pewm.point_colours
init = functools.partial(world_model.init, memory=False)
sharding = pewm.sharding
split_heads = pewm.split_heads


def loss(
    model: EgoWMConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the backbone's own loss, of clips with actions; see ``objective.loss``."""
    assert isinstance(train, EgoWMTrainConfig)
    return objective.loss(
        model, train, params, clip, key, memory=False, history=model.history, blind=train.blind
    )


VIDEO = Stage(
    name="video",
    number=1,
    rules=((r"backbone/.*", TRAIN), (r"(control|codec|image|text)/.*", FREEZE)),
    init=init,
    loss=loss,
    prepare=functools.partial(objective.prepare, memory=False),
    optional=True,
)
"""The backbone learns to be a video model: the control stands still, and it begins with zeros."""
ADAPT = dataclasses.replace(
    VIDEO,
    name="adapt",
    number=2,
    rules=((r"(backbone|control)/.*", TRAIN), (r"(codec|image|text)/.*", FREEZE)),
    optional=False,
)
"""The whole backbone learns on, with actions."""


def stages(model: EgoWMConfig) -> tuple[Stage, ...]:
    """Return the stages, of which the second has the control's learning rate."""
    return VIDEO, dataclasses.replace(ADAPT, rates=((r"control/.*", model.control.rate),))


def start(model: EgoWMConfig, params: Params, frames: Frames) -> WorldState:
    """Begin a world; see ``worlds.start``. Of fewer frames than ``history`` the first repeats."""
    del params
    pewm.require_frames(model, frames, "start")
    return _state(model, jax.tree.map(jnp.asarray, as_signal(frames)))


def observe(model: EgoWMConfig, params: Params, state: WorldState, frames: Frames) -> WorldState:
    """Take in real frames; see ``worlds.observe``."""
    del params
    pewm.require_frames(model, frames, "observe")
    return _state(model, _behind(state.map, state.frame, as_signal(frames)))


def imagine(
    model: EgoWMConfig,
    params: Params,
    state: WorldState,
    control: Any,
    key: Array,
    *,
    remember: bool = True,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Imagine chunk after chunk; see ``worlds.imagine``.

    There is no memory to ignore. Without ``remember`` the state keeps the frames before the present
    one that it had; with a ``history`` of 1 there are none, and the two are the same.
    """
    del memory
    asked = control_of(model, state.frame.camera, control)
    count = asked.camera.world_from_camera.shape[0]
    chunked, wanted = cut_into_clips(asked, model.clip.frames - model.history)
    keys = jax.random.split(key, chunked.camera.world_from_camera.shape[0])

    def step(past: Frames, inputs: tuple[Control, Array, Array | None]) -> tuple[Frames, Frames]:
        chunk, chunk_key, valid = inputs
        frames = imagine_chunk(model, params, past, chunk, chunk_key)
        seen = None if valid is None else valid.sum() + model.history
        return last_frames(_behind(past, frames), seen, model.history), frames

    past, frames = jax.lax.scan(step, _behind(state.map, state.frame), (chunked, keys, wanted))
    after = _state(model, past)
    if not remember:
        after = WorldState(after.frame, state.map)
    return after, join_clips(frames, count)


def imagine_chunk(
    model: EgoWMConfig, params: Params, past: Frames, control: Control, key: Array
) -> Frames:
    """Imagine one chunk.

    Args:
        model: the model.
        params: the world model's parameters.
        past: (history) frames before it, colours float in [−1, 1]; the last one is the present.
        control: (n) cameras of the frames to imagine, with n = clip.frames − history, and actions
            that lead to them.
        key: randomness of the noise.

    Returns:
        n frames; depth is 0 where the denoiser works without it (``clip.depth``).
    """
    before = model.history - 1
    actions = control.actions_TA
    if actions is not None:  # of those that led to the past frames the control makes nothing
        actions = jnp.pad(actions, ((before, 0), (0, 0)))
    camera = _behind(past.camera, control.camera)
    noise_key, key = jax.random.split(key)
    rgb = past.rgb_THWC
    if model.image_noise:
        rgb = rgb + model.image_noise * jax.random.normal(noise_key, rgb.shape)
    noisy = dataclasses.replace(past, rgb_THWC=rgb)
    observed, whole = jax.tree.map(
        lambda x: x[None], (noisy, Control(camera, actions, control.state_A))
    )
    given = world_model.condition(
        model,
        params,
        observed,
        whole,
        noise_B=jnp.full((1,), model.image_noise),
        clean_BTHWC=past.rgb_THWC[None],
    )
    blind = None
    if model.noise.guidance != 1:
        blind = world_model.blind(model, params, given, np.ones((1,), bool))
    latents = world_model.draw(model, params, given, None, key, blind=blind)
    rgb, depth = rgbd.decode_rgbd(model, params, latents)
    depth = depth if model.clip.depth else jnp.zeros_like(depth)
    return Frames(rgb[0, model.history :], depth[0, model.history :], control.camera)


def _state(model: EgoWMConfig, frames: Frames) -> WorldState:
    """Return the state whose last frames are these: the present one, and those before it."""
    count = frames.depth_THW.shape[0]
    kept = np.maximum(np.arange(count - model.history, count), 0)
    past = jax.tree.map(lambda x: x[kept], frames)
    return WorldState(jax.tree.map(lambda x: x[-1:], past), jax.tree.map(lambda x: x[:-1], past))


def _behind(*parts: Any) -> Any:
    """Join frames, or cameras, one after the other."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
