"""The world of PEWM: a video diffusion model, clip after clip, with a memory.

Each clip is conditioned on the present frame, the control, and the memory's readout for its
cameras. Imagined frames are inserted as observed ones are, with ``observed=False``.

Stages ``gate`` and ``sharpen`` fine-tune the codec's gate, which blends imagined frames with the
rendered memory, on imagined clips (``worlds.gating``).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import AssembledModel, TrainConfig, TrainSettings, UserError, register
from pewm_jax.config.assembled import WhereObserved
from pewm_jax.config.parts import Draft
from pewm_jax.errors import require
from pewm_jax.memory import coverage as memory_coverage
from pewm_jax.memory import interface as memories
from pewm_jax.registry import part
from pewm_jax.types import Array, Camera, Control, Frames, MemoryReadout, Params, View, WorldState
from pewm_jax.worlds import checks, gating, objective, sharpen, world_model
from pewm_jax.worlds import draft as drafts
from pewm_jax.worlds.control import control_of, cut_into_clips, join_clips, last_frames
from pewm_jax.worlds.pewm import candidates
from pewm_jax.worlds.stages import ADVERSARY, FREEZE, TRAIN, Stage


def _require_no_draft(model: AssembledModel) -> None:
    """Refuse a model with a draft, which is made from the memory."""
    if model.draft.PREDICTS:
        raise UserError(
            "train.stage1.steps is above 0, and stage 1 has no memory, from which model.draft is "
            "made: set it to 0."
        )


def require_gate(model: AssembledModel) -> None:
    """Refuse a model whose codec has no gate, or whose memory shows no colours."""
    if not memories.gated(model):
        raise UserError(
            "train.gate.steps is above 0, but this model has no gate that mixes its memory's "
            "colours in: give it a codec with a gate (codec.kind learned or pixel, codec.gate 48), "
            "clip.depth true and a memory of colours, or set train.gate.steps 0."
        )


FROZEN = r"(codec|encoder|image|text|draft)/.*"
PREPARES_BY = ("codec", "encoder", "draft")
STAGE_1 = Stage(
    name="stage1",
    number=1,
    rules=((r"(backbone|control)/.*", TRAIN), (FROZEN, FREEZE)),
    init=functools.partial(world_model.init, memory=False),
    loss=objective.without_memory,
    prepare=functools.partial(objective.prepare, memory=False),
    prepares_by=PREPARES_BY,
    require=_require_no_draft,
)
STAGE_2 = Stage(
    name="stage2",
    number=2,
    rules=((r"memory/.*", TRAIN), (r"(backbone|control)/.*", FREEZE), (FROZEN, FREEZE)),
    init=world_model.init,
    loss=objective.with_memory,
    memory=True,
    prepare=functools.partial(objective.prepare, memory=True),
    prepares_by=PREPARES_BY,
)
JOINT = dataclasses.replace(
    STAGE_2,
    name="joint",
    number=3,
    rules=((r"(backbone|control|memory)/.*", TRAIN), (FROZEN, FREEZE)),
    loss=objective.joint,
    extra_weights=objective.perceptual_weights,
    optional=True,
)
GATE = Stage(
    name="gate",
    number=4,
    rules=(
        (r"codec/gate/.*", TRAIN),
        (r"(backbone|control|memory)/.*", FREEZE),
        (FROZEN, FREEZE),
    ),
    init=world_model.init,
    loss=gating.loss,
    memory=True,
    prepare=gating.prepare,
    prepares_by=("backbone", "control", "memory", "image", "text", *PREPARES_BY),
    optional=True,
    extra_weights=gating.perceptual_weights,
    require=require_gate,
)


def _with_discriminator(model: AssembledModel, key: Array) -> Params:
    """Return random parameters of all parts, and of the discriminator."""
    return {**world_model.init(model, key), **sharpen.init(key)}


def _require_sharpen(model: AssembledModel) -> None:
    """Refuse a model without a gate, or with frames that are too small."""
    require_gate(model)
    sharpen.require_size(model.clip.height, model.clip.width)


SHARPEN = dataclasses.replace(
    GATE,
    name="sharpen",
    number=5,
    rules=((sharpen.DISCRIMINATOR, ADVERSARY), *GATE.rules),
    init=_with_discriminator,
    loss=gating.sharpen_loss,
    extra_weights=functools.partial(gating.perceptual_weights, weight="sharpen_lpips"),
    require=_require_sharpen,
)
STAGES = (STAGE_1, STAGE_2, JOINT, GATE)
"""Stage 1 adapts the backbone to the domain, the control and RGB-D, without memory. Stage 2 adds
the memory reader, which has no effect at first, and trains only the reader. ``joint`` trains both,
and ``gate`` the codec's gate on imagined clips; these two are ours, and skipped without steps."""


def _joined(first: Camera, later: Camera) -> Camera:
    """Return cameras one after the other."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, later)


@register("world", "pewm")
@dataclasses.dataclass(frozen=True)
class PEWM(memories.MemoryEdits, AssembledModel):
    """A video diffusion model with a memory (PEWM)."""

    TRAIN: ClassVar[type[TrainSettings]] = TrainConfig

    observed: WhereObserved = "first"
    """Where the observed frame conditions a clip. `first`: at its own latent frame. `every`: its
    latents at every latent frame. `warped`: its colour and depth, rendered from each frame's camera
    and encoded; holes are marked by a mask. `drafted`: the frames of `model.draft`, and a mask of
    what the memory shows. All but `first` add input channels to the backbone."""

    draft: Draft = part("draft", "none")
    """A finished network whose frames the model refines."""

    asked_alone: bool = False
    """Imagine only the frames that are asked for: of a clip that is asked for in part, as for one
    step in the viewer, its first ones, and of candidates of which only the last frame is asked for,
    as in planning, the last frame of each clip. For models that were trained on frames drawn from
    clips (`train.joint.frames`)."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            not self.asked_alone or (self.codec.temporal == 1 and not self.control.actions),
            "model.asked_alone is true, which needs cameras as control and a codec of single "
            "frames: set it to false.",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters of all parts."""
        return world_model.init(self, key)

    def stages(self) -> tuple[Stage, ...]:
        """Return the paper's two stages and optional ones, with the control's learning rate.

        A model with a gate has one more, which sharpens it.
        """
        stages = (*STAGES, SHARPEN) if memories.gated(self) else STAGES
        if self.control.rate == 1:
            return stages
        rates = ((r"control/.*", self.control.rate),)
        return tuple(dataclasses.replace(stage, rates=rates) for stage in stages)

    def sharding(self) -> tuple[tuple[str, Any], ...]:
        """Return the rules of all parts, and of the discriminator."""
        rules = (*super().sharding(), *sharpen.SHARDING)
        if not self.draft.PREDICTS:
            return rules
        own = self.draft.of(self).sharding()
        return (*rules, *((f"draft/{pattern}", spec) for pattern, spec in own))

    def start(self, params: Params, frames: Frames) -> WorldState:
        """Begin a world; see ``worlds.start``."""
        count = checks.require_frames(self, frames, "start")
        frames = jax.tree.map(jnp.asarray, as_signal(frames))
        remembered = memories.from_context(self, params, frames, jnp.ones((count,), bool))
        return WorldState(jax.tree.map(lambda x: x[-1:], frames), remembered)

    def observe(self, params: Params, state: WorldState, frames: Frames) -> WorldState:
        """Observe real frames; see ``worlds.observe``."""
        checks.require_frames(self, frames, "observe")
        frames = jax.tree.map(jnp.asarray, as_signal(frames))
        remembered = self._remember(params, state.map, frames)
        return WorldState(jax.tree.map(lambda x: x[-1:], frames), remembered)

    def imagine(
        self,
        params: Params,
        state: WorldState,
        control: Any,
        key: Array,
        *,
        remember: bool = True,
        memory: bool = True,
    ) -> tuple[WorldState, Frames]:
        """Imagine clip after clip; see ``worlds.imagine``."""
        asked = control_of(self, state.frame.camera, control)
        count = asked.camera.world_from_camera.shape[0]
        length = self.clip.frames - 1
        chunked, wanted = cut_into_clips(asked, length, self.control.still)
        clips = chunked.camera.world_from_camera.shape[0]
        rest = count % length if self.asked_alone else 0

        def step(state: WorldState, inputs: tuple[Control, Array, Array | None]) -> Any:
            chunk, clip_key, valid = inputs
            return self.imagine_clip(
                params, state, chunk, clip_key, remember=remember, memory=memory, valid_T=valid
            )

        inputs = (chunked, jax.random.split(key, clips), wanted)
        if not rest:
            state, frames = jax.lax.scan(step, state, inputs)
            return state, join_clips(frames, count)
        made = []
        if clips > 1:
            whole = (*(jax.tree.map(lambda x: x[:-1], part) for part in inputs[:2]), None)
            state, frames = jax.lax.scan(step, state, whole)
            made = [join_clips(frames, count - rest)]
        chunk, clip_key = jax.tree.map(lambda x: x[-1], inputs[:2])
        state, frames = self.imagine_clip(
            params, state, chunk, clip_key, remember=remember, memory=memory, asked=rest
        )
        return state, jax.tree.map(lambda *x: jnp.concatenate(x), *made, frames)

    def imagine_clip(
        self,
        params: Params,
        state: WorldState,
        control: Control,
        key: Array,
        *,
        remember: bool = True,
        memory: bool = True,
        valid_T: Array | None = None,
        asked: int = 0,
    ) -> tuple[WorldState, Frames]:
        """Imagine one clip: the T − 1 frames after the present one.

        ``valid_T`` is True for the leading frames that were asked for; None if all were. With
        ``asked`` only so many leading frames are imagined; a draft is still made of the whole clip.
        If the denoiser works without depth (``clip.depth``), depth is 0 everywhere, and memories
        ignore these frames.
        """
        present, count = state.frame, asked or self.clip.frames - 1
        whole = dataclasses.replace(control, camera=_joined(present.camera, control.camera))
        camera = jax.tree.map(lambda x: x[: 1 + count], whole.camera)
        future = jax.tree.map(lambda x: x[1:], camera)
        whole = jax.tree.map(lambda x: x[None], whole)
        observed = jax.tree.map(lambda x: x[None], present)
        readout, drafted = None, None
        remembered = state.map
        if self.draft.PREDICTS and not memory:
            memory, remembered = True, drafts.present_alone(self, params, present)
        if memory and ("memory" in params or self.draft.PREDICTS):
            gated = memories.gated(self) or self.draft.PREDICTS
            shown = memories.readout(self, remembered, camera, params=params, pictures=gated)
            readout = jax.tree.map(lambda x: x[None], shown)
        if self.draft.PREDICTS:
            shown = drafts.pad_readout(readout, self.clip.frames)
            drafted = drafts.predict(self, params, observed, whole, shown)[:, : 1 + count]
        model = self
        if asked:
            model = dataclasses.replace(self, clip=dataclasses.replace(self.clip, frames=1 + asked))
            whole = Control(jax.tree.map(lambda x: x[None], camera))
        conditioning = world_model.condition(
            model, params, observed, whole, everywhere_BthwC=drafted
        )
        latents = world_model.draw(model, params, conditioning, readout, key)
        rgb, depth = rgbd.decode_rgbd(model, params, latents)
        if readout is not None and memories.gated(model):
            view = readout.view
            if drafted is not None:
                view = drafts.gate_input(model, params, drafted, view)
            rgb, depth = rgbd.mix(model, params, rgb, depth, view)
        depth = depth if self.clip.depth else jnp.zeros_like(depth)
        frames = Frames(rgb[0, 1:], depth[0, 1:], future)
        remembered = state.map
        if remember:
            new = self.new_surfaces(frames, readout)
            remembered = self._remember(params, state.map, new, valid_T, observed=False)
        end = None if valid_T is None else valid_T.sum()
        return WorldState(last_frames(frames, end), remembered), frames

    def new_surfaces(self, frames: Frames, readout: MemoryReadout | None) -> Frames:
        """Return imagined frames with a depth of 0 where the memory showed something already."""
        again = getattr(self.memory, "imagined_again", True)
        if again or readout is None or readout.view is None:
            return frames
        return dataclasses.replace(
            frames, depth_THW=jnp.where(readout.view.seen_THW[0, 1:], 0, frames.depth_THW)
        )

    def _remember(
        self,
        params: Params,
        memory: Any,
        frames: Frames,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> Any:
        """Insert frames into the memory."""
        features = self.memory.encoder.features(self, params, frames.rgb_THWC)
        return memories.insert(self, params, memory, frames, features, valid_T, observed=observed)

    def imagine_many(
        self,
        params: Params,
        state: WorldState,
        controls: Any,
        keys: Array,
        *,
        memory: bool = True,
        last: bool = False,
        views: View | None = None,
    ) -> tuple[WorldState, Frames]:
        """Imagine K candidates; ``views`` is the result of ``candidates.Views``.

        The computation is that of ``imagine`` without ``remember``, but shared parts are computed
        once; see ``worlds.pewm.candidates``. With ``last`` and ``asked_alone``, a clip is its last
        frame alone.
        """
        asked = jax.vmap(lambda control: control_of(self, state.frame.camera, control))(controls)
        length = self.clip.frames - 1
        count = asked.camera.world_from_camera.shape[1]
        clips = -(-count // length)
        keys_KC = jax.vmap(lambda key: jax.random.split(key, clips))(keys)
        present, shared, made = state.frame, True, []
        for number in range(clips):
            here = slice(number * length, min((number + 1) * length, count))
            size = here.stop - here.start
            view = None if views is None else jax.tree.map(lambda x, n=number: x[:, n], views)
            frames = candidates.imagine_clip(
                self,
                params,
                (present, shared),
                state.map,
                candidates.clip_control(asked, here, length, self.control.still),
                keys_KC[:, number],
                shown=slice(size - 1 if last else 0, size),
                alone=last and self.asked_alone,
                memory=memory,
                view=view,
            )
            made.append(frames)
            present, shared = jax.tree.map(lambda x: x[:, -1:], frames), False
        made = made[-1:] if last else made
        frames = jax.tree.map(lambda *x: jnp.concatenate(x, 1), *made)
        return WorldState(present, state.map), frames

    def to_compare(self, state: WorldState) -> WorldState:
        """Return a state whose memory has no more room than it needs; see ``worlds.to_compare``."""
        return WorldState(state.frame, self.memory.trimmed(state.map))

    def views(self, params: Params, state: WorldState) -> candidates.Views | None:
        """Return what renders the memory for candidates; None if the model reads no rendering."""
        pictures = memories.gated(self) or self.memory.reader.READS_VIEW
        return candidates.Views(self, state) if pictures and "memory" in params else None

    def coverage(
        self, params: Params, state: WorldState, frames: Frames, seen_THW: Array
    ) -> dict[str, Array]:
        """Count the pixels that the memory covers; see ``memory.coverage``."""
        del params
        tokens = self.memory.read(self, state.map, frames.camera)
        return memory_coverage.coverage(self, state.map, tokens, frames, seen_THW)
