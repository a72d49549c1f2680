"""The world of EgoWM: a video model steered by actions, chunk after chunk (arXiv 2601.15284).

There is no map. A chunk is conditioned on the last frames, observed or imagined, in the form that
the backbone was trained with (``Backbone.observed``). Guidance (``noise.guidance``; 2 in the paper)
is on these frames, or on the text of a backbone that has one (``world_model.blind``); the actions
condition both predictions. A chunk is denoised as a whole: if the backbone's attention over time is
bidirectional, all its frames attend to all its actions, but not to those of later chunks.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import (
    AssembledModel,
    BatchSpec,
    Capabilities,
    Conditioner,
    Memory,
    StageConfig,
    TrainSettings,
    register,
)
from pewm_jax.config.assembled import WhereObserved
from pewm_jax.errors import UserError, require
from pewm_jax.registry import part
from pewm_jax.types import Array, Clip, Control, Frames, Params, WorldState
from pewm_jax.worlds import checks, gating, objective, world_model
from pewm_jax.worlds.control import control_of, cut_into_clips, join_clips, last_frames
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage


@dataclasses.dataclass(frozen=True)
class EgoWMTrainConfig(TrainSettings):
    """Training of a video model as a world model: the whole backbone, with actions."""

    ZERO: ClassVar[dict[str, str]] = {
        "hidden": "this world has no memory to hide",
        "memory_errors": "this world has no memory",
        "chained": "the clips of this world cannot be run backwards",
    }

    run: str = "runs/egowm"
    """Folder of this run: checkpoints, logs, images, report."""
    video: StageConfig = StageConfig(steps=0)
    """Trains a video model without actions, if there is no pre-trained one; skipped by default. A
    backbone with random weights learns to follow actions without it, too."""
    adapt: StageConfig = StageConfig()
    """The backbone is trained further, with actions; the control's learning rate is
    `model.control.rate` times this one's."""
    gate: StageConfig = StageConfig(steps=0)
    """The codec's gate is trained on imagined clips, if it blends them with the warped observed
    frame (`codec.gate`, `model.observed warped`); skipped by default."""
    gate_lpips: float = 0.0
    """Weight of LPIPS (AlexNet's, `pip install 'pewm-jax[metrics]'`) in the loss of stage `gate`; 0
    leaves it out."""
    blind: float = 0.1
    """Share of clips without the input of guidance (the observed image or the text); needed for
    `model.noise.guidance` above 1."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(0 <= self.blind < 1, f"train.blind is {self.blind}: use 0 up to, not with, 1.")
        require(self.gate_lpips >= 0, f"train.gate_lpips is {self.gate_lpips}: use 0 or more.")


def gated(model: AssembledModel) -> bool:
    """Tell whether the codec's gate blends imagined frames with the warped observed one."""
    return model.observed == "warped" and bool(getattr(model.codec, "gate", 0))


def require_gate(model: AssembledModel) -> None:
    """Refuse to train the gate of a model that has none, or nothing to blend with.

    Raises:
        UserError: it does not blend its frames with the observed one.
    """
    if not gated(model):
        raise UserError(
            "train.gate.steps is above 0, but this model has no gate that blends its frames with "
            "the observed one: give it a codec with a gate (codec.kind learned or pixel, "
            "codec.gate 48) and model.observed warped, or set train.gate.steps 0."
        )


@register("world", "egowm")
@dataclasses.dataclass(frozen=True)
class EgoWM(AssembledModel):
    """A video diffusion model steered by actions (EgoWM, arXiv 2601.15284)."""

    TRAIN: ClassVar[type[TrainSettings]] = EgoWMTrainConfig

    control: Conditioner = part("control", "actions")
    """Control: what steers a clip."""
    memory: Memory = part("memory", "none", reader=part("reader", "render"))
    """No memory: leave it at `none`."""
    history: int = 1
    """Frames at the beginning of every clip that are observed, or were imagined before: 1 in Stable
    Video Diffusion and CogVideoX; more if the backbone is trained with more. They fill latent
    frames: with `codec.temporal` 4, use 4k + 1."""
    own_m: float = 0.0
    """Observed pixels nearer than this are not warped, metres: they show the agent's own body,
    which moves with it."""
    observed: WhereObserved = "first"
    """Where the observed frames condition a chunk. `first`: at their latent frames. `every`: the
    last one's latents at every latent frame. `warped`: their colour and depth, rendered from each
    frame's camera and encoded; holes are marked by a mask; it needs `clip.depth`. The last two add
    input channels to the backbone."""
    image_noise: float = 0.0
    """Deviation of the noise on these frames in rollouts; the paper's is 0.1, with Stable Video
    Diffusion. The settings of `train` determine it in training."""

    @property
    def batch_spec(self) -> BatchSpec:
        """The clip's frames and actions; poses where the control needs them, and to warp by."""
        poses = self.observed == "warped" or self.control.sees_cameras
        spec = super().batch_spec
        return dataclasses.replace(spec, context=False, features=None, poses=poses)

    @property
    def capabilities(self) -> Capabilities:
        """The capabilities of a world without a memory."""
        return dataclasses.replace(super().capabilities, memory_parameters="")

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            not self.memory.REMEMBERS,
            "model.memory is of a kind that remembers, and the world egowm has no map: use "
            "memory.kind none, or the world pewm with control.kind actions.",
        )
        q = self.codec.temporal
        require(
            1 <= self.history < self.clip.frames and (self.history - 1) % q == 0,
            f"model.history is {self.history}: use {q}k + 1 frames (they fill latent frames), and "
            f"fewer than clip.frames ({self.clip.frames}).",
        )
        require(
            self.noise.guidance == 1
            or not self.backbone.GUIDED_BY_TEXT
            or self.backbone.stores_prompt,
            f"noise.guidance is {self.noise.guidance}, which guides this backbone by text, and no "
            "text is stored: use backbone.prompt stored and weights that were imported with a text "
            "encoder, or noise.guidance 1.",
        )
        require(self.image_noise >= 0, f"model.image_noise is {self.image_noise}: use 0 or more.")

    def init(self, key: Array) -> Params:
        """Return random parameters of all parts; there is no reader."""
        return world_model.init(self, key, memory=False)

    def loss(
        self,
        train: TrainSettings,
        params: Params,
        clip: Clip,
        key: Array,
        *,
        perceptual: bool = False,
    ) -> tuple[Array, dict[str, Array]]:
        """Return the backbone's own loss, of clips with actions; see ``objective.loss``."""
        assert isinstance(train, EgoWMTrainConfig)
        return objective.loss(
            self,
            train,
            params,
            clip,
            key,
            memory=False,
            history=self.history,
            blind=train.blind,
            perceptual=perceptual,
        )

    def prepare(self, params: Params, clip: Clip) -> Clip:
        """Encode a batch's frames; see ``objective.prepare``."""
        return objective.prepare(self, params, clip, memory=False, history=self.history)

    def stages(self) -> tuple[Stage, ...]:
        """Return the two stages, and a third for the gate.

        ``video`` trains the backbone as a video model; the control is frozen, and embeds nothing at
        first. ``adapt`` trains backbone and control, with actions. ``gate`` trains the codec's gate
        on imagined clips; it is skipped without steps.
        """
        video = Stage(
            name="video",
            number=1,
            rules=((r"backbone/.*", TRAIN), (r"(control|codec|image|text)/.*", FREEZE)),
            init=EgoWM.init,
            loss=EgoWM.loss,
            prepare=EgoWM.prepare,
            optional=True,
        )
        adapt = dataclasses.replace(
            video,
            name="adapt",
            number=2,
            rules=((r"(backbone|control)/.*", TRAIN), (r"(codec|image|text)/.*", FREEZE)),
            loss=functools.partial(EgoWM.loss, perceptual=True),
            extra_weights=objective.perceptual_weights,
            optional=False,
            rates=((r"control/.*", self.control.rate),),
        )
        given = {"memory": False, "history": self.history}
        gate = Stage(
            name="gate",
            number=3,
            rules=(
                (r"codec/gate/.*", TRAIN),
                (r"(backbone|control|codec|image|text)/.*", FREEZE),
            ),
            init=EgoWM.init,
            loss=functools.partial(gating.loss, **given),
            prepare=functools.partial(gating.prepare, **given),
            prepares_by=("backbone", "control", "codec", "image", "text"),
            optional=True,
            extra_weights=gating.perceptual_weights,
            require=require_gate,
        )
        return video, adapt, gate

    def start(self, params: Params, frames: Frames) -> WorldState:
        """Begin a world; if there are fewer frames than ``history``, the first is repeated."""
        del params
        checks.require_frames(self, frames, "start")
        return self._state(jax.tree.map(jnp.asarray, as_signal(frames)))

    def observe(self, params: Params, state: WorldState, frames: Frames) -> WorldState:
        """Observe real frames."""
        del params
        checks.require_frames(self, frames, "observe")
        return self._state(_joined(state.map, state.frame, as_signal(frames)))

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
        """Imagine chunk after chunk; there is no memory to ignore.

        Without ``remember`` the state keeps its frames before the present one; with a ``history``
        of 1 there are none, and the results are the same.
        """
        del memory
        asked = control_of(self, state.frame.camera, control)
        count = asked.camera.world_from_camera.shape[0]
        length = self.clip.frames - self.history
        chunked, wanted = cut_into_clips(asked, length, self.control.still)
        keys = jax.random.split(key, chunked.camera.world_from_camera.shape[0])

        def step(
            past: Frames, inputs: tuple[Control, Array, Array | None]
        ) -> tuple[Frames, Frames]:
            chunk, chunk_key, valid = inputs
            frames = self.imagine_chunk(params, past, chunk, chunk_key)
            seen = None if valid is None else valid.sum() + self.history
            return last_frames(_joined(past, frames), seen, self.history), frames

        past, frames = jax.lax.scan(step, _joined(state.map, state.frame), (chunked, keys, wanted))
        after = self._state(past)
        if not remember:
            after = WorldState(after.frame, state.map)
        return after, join_clips(frames, count)

    def imagine_chunk(self, params: Params, past: Frames, control: Control, key: Array) -> Frames:
        """Imagine one chunk of n = clip.frames − history frames.

        ``past`` has the (history) frames before it, of which the last is the present; ``control``
        has (n) cameras, and actions that lead to them. Depth is 0 where the denoiser works without
        it.
        """
        before = self.history - 1
        actions = control.actions_TA
        if actions is not None:  # the control ignores actions before the present frame
            actions = jnp.pad(actions, ((before, 0), (0, 0)))
        camera = _joined(past.camera, control.camera)
        noise_key, key = jax.random.split(key)
        rgb = past.rgb_THWC
        if self.image_noise:
            rgb = rgb + self.image_noise * jax.random.normal(noise_key, rgb.shape)
        noisy = dataclasses.replace(past, rgb_THWC=rgb)
        observed, whole = jax.tree.map(
            lambda x: x[None], (noisy, Control(camera, actions, control.state_A))
        )
        given = world_model.condition(
            self,
            params,
            observed,
            whole,
            noise_B=jnp.full((1,), self.image_noise),
            clean_BTHWC=past.rgb_THWC[None],
        )
        blind = None
        if self.noise.guidance != 1:
            blind = world_model.blind(self, params, given, np.ones((1,), bool))
        latents = world_model.draw(self, params, given, None, key, blind=blind)
        rgb, depth = rgbd.decode_rgbd(self, params, latents)
        if gated(self):
            view = world_model.splatted(self, jax.tree.map(lambda x: x[None], past), whole.camera)
            rgb, depth = rgbd.mix(self, params, rgb, depth, view)
        depth = depth if self.clip.depth else jnp.zeros_like(depth)
        return Frames(rgb[0, self.history :], depth[0, self.history :], control.camera)

    def _state(self, frames: Frames) -> WorldState:
        """Return the state whose last frames are these: the present one, and those before it."""
        count = frames.depth_THW.shape[0]
        kept = np.maximum(np.arange(count - self.history, count), 0)
        past = jax.tree.map(lambda x: x[kept], frames)
        return WorldState(
            jax.tree.map(lambda x: x[-1:], past), jax.tree.map(lambda x: x[:-1], past)
        )


def _joined(*parts: Any) -> Any:
    """Join frames, or cameras, one after the other."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
