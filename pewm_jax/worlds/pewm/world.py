"""The world of PEWM: a video diffusion model, clip after clip, with a memory.

Each clip is conditioned on the present frame, on the control, and on the part of the memory that
its cameras see. Imagined frames are inserted in the same way as observed ones, with
``observed=False``.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import ModelConfig, UserError, functions
from pewm_jax.memory import coverage as memory_coverage
from pewm_jax.memory import interface as memories
from pewm_jax.memory import rendering as memory_views
from pewm_jax.types import Array, Control, Frames, MemoryReadout, Params, WorldState
from pewm_jax.worlds import objective, world_model
from pewm_jax.worlds.control import control_of, cut_into_clips, join_clips, last_frames
from pewm_jax.worlds.pewm import candidates
from pewm_jax.worlds.pewm import gate as pewm_gate
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

init = world_model.init
sample = world_model.sample
imagine_many = candidates.imagine_many
to_compare = candidates.to_compare
views = candidates.views

STAGES = (
    Stage(
        name="stage1",
        number=1,
        rules=((r"(backbone|control)/.*", TRAIN), (r"(codec|encoder|image|text)/.*", FREEZE)),
        init=functools.partial(world_model.init, memory=False),
        loss=objective.without_memory,
        prepare=functools.partial(objective.prepare, memory=False),
    ),
    Stage(
        name="stage2",
        number=2,
        rules=((r"memory/.*", TRAIN), (r"(backbone|control|codec|encoder|image|text)/.*", FREEZE)),
        init=world_model.init,
        loss=objective.with_memory,
        memory=True,
        prepare=functools.partial(objective.prepare, memory=True),
    ),
    Stage(
        name="joint",
        number=3,
        rules=(
            (r"(backbone|control|memory)/.*", TRAIN),
            (r"(codec|encoder|image|text)/.*", FREEZE),
        ),
        init=world_model.init,
        loss=objective.with_memory,
        memory=True,
        prepare=functools.partial(objective.prepare, memory=True),
        optional=True,
    ),
    Stage(
        name="gate",
        number=4,
        rules=(
            (r"codec/gate/.*", TRAIN),
            (r"(backbone|control|memory|codec|encoder|image|text)/.*", FREEZE),
        ),
        init=world_model.init,
        loss=pewm_gate.loss,
        memory=True,
        prepare=pewm_gate.prepare,
        prepares_by=("backbone", "control", "memory", "codec", "encoder", "image", "text"),
        optional=True,
        extra_weights=pewm_gate.perceptual,
        require=pewm_gate.require_gate,
    ),
)
"""Stage 1 adapts the backbone to the domain, the control and RGB-D, without memory. Stage 2 adds
the memory reader, which has no effect at first, and trains only that. Stages ``joint``
and ``gate``, which are ours and are left out unless they have steps, then train both, and the
codec's gate on what the model imagines."""


def stages(model: ModelConfig) -> tuple[Stage, ...]:
    """Return the paper's two stages, and two optional ones.

    Where the control asks for another learning rate, its parameters get that.
    """
    if model.control.rate == 1:
        return STAGES
    rates = ((r"control/.*", model.control.rate),)
    return tuple(dataclasses.replace(stage, rates=rates) for stage in STAGES)


def sharding(model: ModelConfig) -> tuple[tuple[str, Any], ...]:
    """Return the sharding rules of all parts of the model."""
    memory = model.memory
    parts = (model.backbone, memory.reader, model.codec, memory.encoder, model.control)
    rules = [rule for part in parts for rule in functions(part).SHARDING]
    return (*rules, (r"text/(prompt|negative)_LC", P(None, "fsdp")))


def split_heads(model: ModelConfig, stage: Stage) -> dict[str, int]:
    """Return the head counts that ``train.mesh.tensor`` must divide."""
    heads = {"backbone.heads": model.backbone.split_heads}
    if stage.memory:
        heads["memory.reader.heads"] = model.memory.reader.split_heads
    return heads


def start(model: ModelConfig, params: Params, frames: Frames) -> WorldState:
    """Begin a world; see ``worlds.start``."""
    count = require_frames(model, frames, "start")
    frames = jax.tree.map(jnp.asarray, as_signal(frames))
    remembered = memories.from_context(model, params, frames, jnp.ones((count,), bool))
    return WorldState(jax.tree.map(lambda x: x[-1:], frames), remembered)


def observe(model: ModelConfig, params: Params, state: WorldState, frames: Frames) -> WorldState:
    """Take in real frames; see ``worlds.observe``."""
    require_frames(model, frames, "observe")
    frames = jax.tree.map(jnp.asarray, as_signal(frames))
    remembered = _remember(model, params, state.map, frames)
    return WorldState(jax.tree.map(lambda x: x[-1:], frames), remembered)


def imagine(
    model: ModelConfig,
    params: Params,
    state: WorldState,
    control: Any,
    key: Array,
    *,
    remember: bool = True,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Imagine clip after clip; see ``worlds.imagine``."""
    asked = control_of(model, state.frame.camera, control)
    count = asked.camera.world_from_camera.shape[0]
    chunked, wanted = cut_into_clips(asked, model.clip.frames - 1)
    clips = chunked.camera.world_from_camera.shape[0]

    def step(state: WorldState, inputs: tuple[Control, Array, Array | None]) -> Any:
        chunk, clip_key, valid = inputs
        return imagine_clip(
            model, params, state, chunk, clip_key, remember=remember, memory=memory, valid_T=valid
        )

    inputs = (chunked, jax.random.split(key, clips), wanted)
    state, frames = jax.lax.scan(step, state, inputs)
    return state, join_clips(frames, count)


def imagine_clip(
    model: ModelConfig,
    params: Params,
    state: WorldState,
    control: Control,
    key: Array,
    *,
    remember: bool = True,
    memory: bool = True,
    valid_T: Array | None = None,
) -> tuple[WorldState, Frames]:
    """Imagine one clip: the T − 1 frames after the present one.

    Args:
        model: the model.
        params: the world model's parameters.
        state: the world so far.
        control: (T − 1) cameras of the frames to imagine, and actions that lead to them.
        key: sampling noise.
        remember: see ``worlds.imagine``.
        memory: False ignores the memory.
        valid_T: (T − 1,) bool, True for the leading frames that were asked for; None if all were.

    Returns:
        The next state and T − 1 frames, colours float in [−1, 1]. If the denoiser works without
        depth (``clip.depth``), depth is 0 everywhere, and memories ignore these frames.
    """
    present, future = state.frame, control.camera
    camera = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), present.camera, future)
    whole = dataclasses.replace(control, camera=camera)
    whole = jax.tree.map(lambda x: x[None], whole)
    observed = jax.tree.map(lambda x: x[None], present)
    conditioning = world_model.condition(model, params, observed, whole)
    readout = None
    if memory and "memory" in params:
        gated = memories.gated(model)
        shown = memories.readout(model, state.map, camera, params=params, pictures=gated)
        readout = jax.tree.map(lambda x: x[None], shown)
    latents = world_model.draw(model, params, conditioning, readout, key)
    rgb, depth = rgbd.decode_rgbd(model, params, latents)
    if readout is not None and memories.gated(model):
        rgb, depth = rgbd.mix(model, params, rgb, depth, readout.view)
    depth = depth if model.clip.depth else jnp.zeros_like(depth)
    frames = Frames(rgb[0, 1:], depth[0, 1:], future)
    remembered = state.map
    if remember:
        new = new_surfaces(model, frames, readout)
        remembered = _remember(model, params, state.map, new, valid_T, observed=False)
    end = None if valid_T is None else valid_T.sum()
    return WorldState(last_frames(frames, end), remembered), frames


def memory_points(model: ModelConfig, memory: Any) -> tuple[Array, Array, Array, Array | None]:
    """Return the memory's points; see ``World.memory_points``."""
    return *model.memory.to_points(model, memory), getattr(memory, "observed_V", None)


def point_colours(model: ModelConfig, features_VF: Array) -> Array:
    """Return the colours in which points are drawn; see ``World.point_colours``."""
    return memories.colours(model, features_VF)


def erase(model: ModelConfig, params: Params, state: WorldState, box_23: Array) -> WorldState:
    """Forget what is in a box, in the memory and in the present frame; see ``World.erase``."""
    del params
    return _looked_at(model, state, model.memory.erase(model, state.map, box_23))


def move(
    model: ModelConfig,
    params: Params,
    state: WorldState,
    box_23: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> WorldState:
    """Move what is in a box, in the memory and in the present frame; see ``World.move``."""
    del params
    changed = model.memory.move(model, state.map, box_23, transform, leave=leave)
    return _looked_at(model, state, changed)


def _looked_at(model: ModelConfig, state: WorldState, changed: memories.Memory) -> WorldState:
    """Return a state with a changed memory, whose present frame shows the change.

    The next clip is imagined from the present frame, too: what was erased would be copied from it.
    So its pixels are taken from the memory where the memory looks different now; holes are filled
    with what is nearest to them. Memories that cannot be rendered in colours leave the frame as it
    is.
    """
    frame = state.frame
    if not memories.shows_colours(model):
        return WorldState(frame, changed)
    size = (model.clip.height, model.clip.width)
    before, after = (memories.render(model, m, frame.camera, *size) for m in (state.map, changed))
    apart = jnp.abs(before.features_THWF - after.features_THWF).max(-1) > 1e-3
    apart = apart | (before.seen_THW != after.seen_THW)
    apart = apart | (jnp.abs(before.depth_THW - after.depth_THW) > 1e-3)
    whole = memory_views.fill_nearest(after)
    rgb = jnp.where(apart[..., None], whole.features_THWF[..., :3], frame.rgb_THWC)
    depth = jnp.where(apart, whole.depth_THW, frame.depth_THW)
    return WorldState(Frames(rgb, depth, frame.camera), changed)


def coverage(
    model: ModelConfig, params: Params, state: WorldState, frames: Frames, seen_THW: Array
) -> dict[str, Array]:
    """Count the pixels that the memory covers; see ``memory.coverage``."""
    del params
    tokens = model.memory.read(model, state.map, frames.camera)
    return vars(memory_coverage.coverage(model, state.map, tokens, frames, seen_THW))


def new_surfaces(model: ModelConfig, frames: Frames, readout: MemoryReadout | None) -> Frames:
    """Return imagined frames with a depth of 0 where the memory showed something already."""
    again = getattr(model.memory, "imagined_again", True)
    if again or readout is None or readout.view is None:
        return frames
    return dataclasses.replace(
        frames, depth_THW=jnp.where(readout.view.seen_THW[0, 1:], 0, frames.depth_THW)
    )


def _remember(
    model: ModelConfig,
    params: Params,
    memory: Any,
    frames: Frames,
    valid_T: Array | None = None,
    *,
    observed: bool = True,
) -> Any:
    """Put frames into the memory."""
    features = model.memory.encoder.features(model, params, frames.rgb_THWC)
    return memories.insert(model, params, memory, frames, features, valid_T, observed=observed)


def require_frames(model: ModelConfig, frames: Frames, who: str) -> int:
    """Return the number of frames, or refuse frames whose shapes do not fit the model."""
    count = frames.depth_THW.shape[0] if frames.depth_THW.ndim else 0
    expected = (count, model.clip.height, model.clip.width)
    if count < 1 or frames.rgb_THWC.shape != (*expected, 3) or frames.depth_THW.shape != expected:
        raise UserError(
            f"{who}() got colours {frames.rgb_THWC.shape} and depth {frames.depth_THW.shape}; this "
            f"model needs (S, {expected[1]}, {expected[2]}, 3) and (S, {expected[1]}, "
            f"{expected[2]}) with S ≥ 1: resize the frames and scale their intrinsics."
        )
    poses, intrinsics = frames.camera.world_from_camera, frames.camera.intrinsics_4
    if poses.shape != (count, 4, 4) or intrinsics.shape != (count, 4):
        raise UserError(
            f"{who}() got {count} frames but poses {poses.shape} and intrinsics "
            f"{intrinsics.shape}; give ({count}, 4, 4) and ({count}, 4)."
        )
    return count
