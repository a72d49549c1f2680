"""The costs of PEWM's training stages, collected from the parts of the model."""

from __future__ import annotations

import dataclasses
import re

from pewm_jax.codecs import gates
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import Config, ModelConfig, TrainConfig, functions
from pewm_jax.models.lpips import model as lpips
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.worlds import codec_gate
from pewm_jax.worlds.stages import Stage


def costs(config: Config, stage: Stage, share: Share) -> dict[str, Costs]:
    """Return the costs of one device by part, named as the parameters are.

    Of stage ``gate`` they are those of decoding and of the gate: what the model imagines for it is
    imagined once, where clips are prepared.

    Args:
        config: the experiment.
        stage: the stage.
        share: one device's share of the step.
    """
    model = config.model
    assert isinstance(model, ModelConfig)
    if stage.name == "gate":
        assert isinstance(config.train, TrainConfig)
        return {"codec": _gate(model, config.train.gate_lpips > 0)}
    trained = any(re.fullmatch(pattern, "backbone/any") for pattern in stage.trained)
    found = {
        "backbone": model.backbone.costs(model, share, trained=trained),
        "control": model.control.costs(model, share, trained=trained),
        "codec": model.codec.costs(model, share),
    }
    if stage.memory:
        found["memory"] = functions(model.memory.reader).costs(model, share)
        if encodes(config):
            found["encoder"] = model.memory.encoder.costs(model, share, config.data.context)
    if config.train.chained:
        for part in found.keys() & {"backbone", "control", "memory"}:
            found[part] = _once_more(found[part], config.train.chained)
    return found


def _once_more(part: Costs, clips: float) -> Costs:
    """Add a forward pass of a share of the clips, without gradient (``worlds.chained``)."""
    forward = (
        dataclasses.replace(product, macs=clips * product.macs, backward=0.0, again=0.0)
        for product in part.products
    )
    return dataclasses.replace(part, products=(*part.products, *forward))


def _gate(model: ModelConfig, perceptual: bool) -> Costs:
    """Return the costs of decoding a clip's colour and depth, and of the gate, which is trained.

    With ``perceptual`` also of LPIPS: of colours imagined, which have a gradient, and true ones.
    """
    codec, clip = model.codec, model.clip
    if not isinstance(codec, LearnedCodecConfig):
        return codec.costs(model, Share())
    decoder = 2 * clip.frames * codec.macs("decoder", clip.height, clip.width)
    gate = (clip.frames - 1) * gates.macs(codec.gate, clip.height, clip.width)
    products = [Product("codec", "convolution", decoder)]
    products.append(Product("codec", "convolution", gate, 2.0))
    if perceptual:
        work = 2 * (clip.frames - 1) * lpips.macs(codec_gate.LPIPS, clip.height, clip.width)
        products.append(Product("lpips", "convolution", work, 0.5))
    return Costs(tuple(products))


def encodes(config: Config) -> bool:
    """Tell whether a stage with memory runs the image encoder: features are used, not cached."""
    assert isinstance(config.model, ModelConfig)
    return config.model.memory.KEEPS_FEATURES and not config.data.features
