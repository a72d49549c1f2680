"""A draft of a clip: what a finished network, which is not trained any further, predicts of it.

A denoiser that has to find layout and details at once needs long training. Predict-and-refine
(Whang et al. 2022, "Deblurring via stochastic refinement", arXiv 2112.02475) divides the work: a
first network predicts the mean of the possible frames, which is blurred where nothing was observed,
and a diffusion model, conditioned on it, draws sharp ones. Here the first network is a world model
of its own kind, with its codec, backbone, reader and noise; clip, control and memory are those of
the model that refines. Its frames are that model's input at every latent frame
(``model.observed drafted``), the start of its sampler, and what its gate blends in where the memory
shows something.

A draft is deterministic: its sampler starts from the same noise in every clip. It always has a
memory. Where the world is asked for frames without one, that is a memory of the present frame
alone. Errors that training plants into the rendered memory (``train.memory_errors``,
``train.hidden``) do not change the draft.

Parameters, under ``draft``: those of the first network (``backbone``, ``memory``, ``codec`` …).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.config import AssembledModel, register
from pewm_jax.config.parts import Backbone, Codec, Draft, Noise, Reader
from pewm_jax.errors import require
from pewm_jax.memory import interface as memories
from pewm_jax.registry import part
from pewm_jax.types import Array, Clip, Control, Frames, MemoryReadout, Params, View
from pewm_jax.worlds import world_model

NOISE_KEY = 0
"""Key of the noise that every draft starts from."""


@register("draft", "network")
@dataclasses.dataclass(frozen=True)
class NetworkDraft(Draft):
    """The frames that a finished network predicts."""

    PREDICTS: ClassVar[bool] = True

    codec: Codec = part("codec", "learned")
    """Its codec; a gate of it blends the rendered memory in."""
    backbone: Backbone = part("backbone", "dit")
    """Its denoiser."""
    reader: Reader = part("reader", "render")
    """Its reader of the memory, which must take the rendered memory alone."""
    noise: Noise = part("noise", "ddpm")
    """Its noise and sampler; few steps give the mean of the possible frames."""
    alone: float = 0.15
    """Share of the clips in training whose memory holds the present frame alone."""

    def __post_init__(self):
        """Validate."""
        require(
            0 <= self.alone <= 1,
            f"model.draft.alone is {self.alone}: use a share from 0 to 1.",
        )

    def check(self, model: Any) -> None:
        """Refuse what the parts refuse in this model, and readers that take points."""
        require(
            not self.reader.READS_TOKENS,
            "model.draft.reader takes points of the memory, and a draft is made from its "
            "rendering: use model.draft.reader.kind render.",
        )
        require(
            model.noise.STARTS,
            "model.draft is a network, and this noise cannot start from its frames: use "
            "noise.kind edm, or model.draft.kind none.",
        )
        self.of(model)

    def of(self, model: Any) -> Any:
        """Return the settings of the first network as a model."""
        return dataclasses.replace(
            model,
            codec=self.codec,
            backbone=self.backbone,
            memory=dataclasses.replace(model.memory, reader=self.reader),
            noise=self.noise,
            observed="first",
            draft=Draft(),
            asked_alone=False,
        )

    def init(self, model: Any, key: Array) -> Params:
        """Return random parameters."""
        return world_model.init(self.of(model), key)


def predict(
    model: Any, params: Params, observed: Frames, control: Control, readout: MemoryReadout
) -> Array:
    """Return a batch's drafts: their latents, and the share of each cell that the memory shows.

    Args:
        model: a model with a draft.
        params: the world model's parameters.
        observed: (B, 1) the present frames, colours in [−1, 1], depth in metres.
        control: what leads to the (B, T) frames, with their cameras.
        readout: the memory's readout, leading axis B, with its view.

    Returns:
        (B, t, h, w, C + 1), as ``world_model.everywhere`` returns the warped observed frame.
    """
    own, weights = model.draft.of(model), params["draft"]
    conditioning = world_model.condition(own, weights, observed, control)
    view = readout.view
    assert view is not None
    encoded = None
    if own.memory.reader.READS_LATENTS:
        encoded = jax.lax.map(lambda one: memories.encode(own, weights, one), view)
    shape = (*own.latent_shape, own.codec.channels)
    noise = jax.random.normal(jax.random.key(NOISE_KEY), shape)
    noise = jnp.broadcast_to(noise, (len(view.seen_THW), *shape))
    again = jax.random.key(NOISE_KEY + 1)
    given = MemoryReadout(view=view, encoded=encoded)
    latents = world_model.sample(own, weights, conditioning, given, noise, again)
    rgb, depth = rgbd.decode_rgbd(own, weights, latents)
    if memories.gated(own):
        rgb, depth = rgbd.mix(own, weights, rgb, depth, view)
    made = rgbd.encode_rgbd(model, params, rgb, depth)
    return jnp.concatenate([made, world_model.share(model, view.seen_THW)], -1)


def pad_readout(readout: MemoryReadout | None, frames: int) -> MemoryReadout:
    """Return the readout of a clip whose agent stands still after the frames that were read."""
    assert readout is not None

    def longer(x: Array) -> Array:
        return jnp.concatenate([x, jnp.repeat(x[:, -1:], frames - x.shape[1], 1)], 1)

    return dataclasses.replace(readout, view=jax.tree.map(longer, readout.view))


def gate_input(
    model: AssembledModel, params: Params, drafted_BthwC: Array, view: View | None
) -> View:
    """Return what the gate blends in: the draft, where the memory shows something."""
    assert view is not None
    rgb, depth = rgbd.decode_rgbd(model, params, drafted_BthwC[..., :-1])
    return View(rgb, depth, view.seen_THW)


def present_alone(model: AssembledModel, params: Params, frame: Frames) -> Any:
    """Return the memory of the (1,) present frame alone."""
    return memories.from_context(model, params, frame, jnp.ones((1,), bool))


def drop_context(model: Any, clip: Clip) -> Clip:
    """Return a batch of which the share ``draft.alone`` keeps only its last context frame.

    The choice depends on the clips alone.
    """
    valid = clip.context_valid_S
    slots = valid.shape[-1]
    last = jnp.argmax(jnp.where(valid, jnp.arange(slots), -1), -1, keepdims=True)
    sums = clip.frames.rgb_THWC.astype(jnp.uint32).sum((1, 2, 3, 4))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(NOISE_KEY), sums)
    alone = jax.vmap(jax.random.uniform)(keys) < model.draft.alone
    kept = valid & (~alone[:, None] | (jnp.arange(slots) == last))
    return dataclasses.replace(clip, context_valid_S=kept)
