"""Gate fine-tuning: blend imagined frames with the rendered memory.

The codec's gate is trained on true latents with noise. The errors of imagined frames differ: they
are sharp, plausible and displaced. After the other stages the model imagines each clip once, from
the clip's first frame and with the memory of its context, and only the gate is trained to choose
between the two at each pixel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal, rgbd_signal
from pewm_jax.config import AssembledModel, TrainConfig, TrainSettings, UserError
from pewm_jax.memory import interface as memories
from pewm_jax.types import Array, Clip, Control, Params
from pewm_jax.worlds import codec as codec_task
from pewm_jax.worlds import objective, world_model


def require_gate(model: AssembledModel) -> None:
    """Refuse a model whose codec has no gate, or whose memory shows no colours."""
    if not memories.gated(model):
        raise UserError(
            "train.gate.steps is above 0, but this model has no gate that mixes its memory's "
            "colours in: give it a codec with a gate (codec.kind learned, codec.gate) and a memory "
            "of colours, or set train.gate.steps 0."
        )


def prepare(model: AssembledModel, params: Params, clip: Clip) -> Clip:
    """Imagine a batch of clips with their memories; ``latents_thwC`` are those imagined.

    The noise depends on the clips alone.

    Raises:
        UserError: see ``require_gate``.
    """
    require_gate(model)
    readout = objective.clip_readout(model, params, clip, pictures=True)
    frames = as_signal(clip.frames)
    observed = jax.tree.map(lambda x: x[:, :1], frames)
    control = Control(frames.camera, clip.actions_TA, clip.extras.get("state_A"))
    conditioning = world_model.condition(model, params, observed, control)
    key = jax.random.fold_in(jax.random.key(0), clip.frames.rgb_THWC.astype(jnp.uint32).sum())
    shape = (len(frames.depth_THW), *model.latent_shape, model.codec.channels)
    noise = jax.random.normal(key, shape)
    latents = world_model.sample(
        model, params, conditioning, readout, noise, jax.random.fold_in(key, 1)
    )
    return clip.without_context().with_extras(
        context_features_ShwF=None, latents_thwC=latents, readout=readout
    )


def loss(
    model: AssembledModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of the gate on imagined frames; see ``codec_task.score``."""
    assert isinstance(train, TrainConfig)
    del key
    if "latents_thwC" not in clip.extras:
        clip = jax.lax.stop_gradient(prepare(model, params, clip))
    view = clip.extras["readout"].view
    assert view is not None
    rgb, depth = rgbd.decode_rgbd(model, params, clip.extras["latents_thwC"])
    shown = rgbd_signal(model.clip, view.features_THWF[..., :3], view.depth_THW)
    truth = jax.tree.map(lambda x: x[:, 1:], as_signal(clip.frames))
    return codec_task.score(
        model,
        params["codec"]["gate"],
        rgb[:, 1:],
        depth[:, 1:],
        shown[:, 1:],
        view.seen_THW[:, 1:],
        truth,
        (train.gate_lpips, params["lpips"]) if train.gate_lpips else None,
    )


def perceptual(model: AssembledModel, train: TrainSettings) -> Params | None:
    """Return the weights that ``loss`` needs, or None; see ``codec_task.lpips_weights``."""
    assert isinstance(train, TrainConfig)
    if not train.gate_lpips:
        return None
    return codec_task.lpips_weights(codec_task.LPIPS, model.clip)
