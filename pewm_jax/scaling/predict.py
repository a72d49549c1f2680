"""How long a step takes on a chip, from its data sheet: FLOPs, bytes of memory, bytes sent.

A prediction, not a measurement: what share of the peak each kind of work reaches is assumed
(``REACHED``), and communication is taken to run behind the computation where nothing waits for it.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pewm_jax.config import AXES, Config
from pewm_jax.models.costs import FLOAT, SPLIT, video_tokens
from pewm_jax.scaling.footprint import Arranged, counts, share_of
from pewm_jax.training.chips import Chip
from pewm_jax.training.stages import Stage
from pewm_jax.worlds import costs

REACHED = {"linear": 0.65, "attention": 0.4, "convolution": 0.4}
"""Shares of the peak that large products reach: assumed, from what is published of such kernels."""
STREAMED = 0.8
"""Share of the memory's bandwidth that element-wise work reaches; assumed."""
OPTIMIZER = 10
"""Times that each trained parameter's 4 bytes are read or written by clipping, Adam, average."""


@dataclasses.dataclass(frozen=True)
class Prediction:
    """What a step is expected to take.

    Attributes:
        products_s: seconds of matrix products and convolutions.
        streaming_s: seconds of element-wise work.
        sent: bytes that a device sends, by (kind, axis of the mesh).
        waiting_s: seconds of communication that nothing runs beside.
        step_s: seconds of a step.
        model_flops: FLOPs of a step on all devices that the mathematics needs.
        hardware_flops: FLOPs that one device does, with what is recomputed.
        mfu: model FLOPs over what the devices could do in that time.
        clips_per_s: clips per second.
        tokens_per_s: video tokens per second.
    """

    products_s: float
    streaming_s: float
    sent: dict[tuple[str, str], float]
    waiting_s: float
    step_s: float
    model_flops: float
    hardware_flops: float
    mfu: float
    clips_per_s: float
    tokens_per_s: float

    def sent_of(self, kind: str) -> float:
        """Return the bytes of one kind of communication."""
        return sum(size for (one, _), size in self.sent.items() if one == kind)


def predict(config: Config, stage: Stage, mesh: Arranged, chip: Chip) -> Prediction:
    """Predict a stage's step on a chip."""
    products = costs.products(config, stage)
    clips = stage.settings(config).batch
    work = {product: costs.flops_of_device(product, mesh.sizes, clips) for product in products}
    peak = chip.flops if config.model.dtype == "bfloat16" else chip.flops / 2
    products_s = sum(flops / (peak * REACHED[p.kind]) for p, flops in work.items())
    streaming_s = _streamed(config, stage, mesh) / (chip.bandwidth * STREAMED)
    sent = traffic(config, stage, mesh)
    seconds = {key: size / _rate(mesh, key[1], chip) for key, size in sent.items()}
    needed = sum(s for (_, axis), s in seconds.items() if axis in SPLIT)
    behind = sum(s for (_, axis), s in seconds.items() if axis not in SPLIT)
    busy = products_s + streaming_s
    waiting_s = needed + max(0.0, behind - busy)
    step_s = busy + waiting_s
    model = clips * costs.flops_per_clip(config, stage)
    return Prediction(
        products_s=products_s,
        streaming_s=streaming_s,
        sent=sent,
        waiting_s=waiting_s,
        step_s=step_s,
        model_flops=model,
        hardware_flops=sum(work.values()),
        mfu=model / (step_s * chip.flops * mesh.devices),
        clips_per_s=clips / step_s,
        tokens_per_s=clips * math.prod(video_tokens(config.model)) / step_s,
    )


def traffic(config: Config, stage: Stage, mesh: Arranged) -> dict[tuple[str, str], float]:
    """Return the bytes that a device sends in a step, by kind and axis of the mesh.

    Per step: a block's weights are gathered for the forward and again for the backward pass, once
    more where it repeats the forward pass (``backbone.remat``) in 16 bits, since XLA does not see then
    that both are the same (``fsdp``); gradients are added up and scattered; copies of the weights
    add up theirs (``data``). Per block and pass: what its two, with memory four, last products give
    is added up over ``tensor``; keys and values are gathered over ``context`` and their gradients
    scattered.
    """
    c, remat = counts(config, stage), bool(config.model.backbone.remat)
    wide = 2 if config.model.dtype == "bfloat16" else FLOAT
    parts = costs.of_stage(config, stage, share_of(config, stage, mesh, wide=wide))
    parameters = (c.trained.on(mesh) + c.frozen.on(mesh)) * mesh.fsdp * wide
    learnt = c.trained.on(mesh) * mesh.fsdp * wide
    gathered = 2 + (remat and wide < FLOAT)
    summed = sum(part.summed for part in parts.values())
    others = mesh.context - 1
    sent = {
        ("all-gather", "fsdp"): (gathered * parameters + c.encoders.count * wide)
        * _ring(mesh.fsdp),
        ("reduce-scatter", "fsdp"): learnt * _ring(mesh.fsdp),
        ("all-reduce", "data"): 2 * learnt / mesh.fsdp * _ring(mesh.data),
        ("all-reduce", "tensor"): 2 * summed * _ring(mesh.tensor),
        ("all-gather", "context"): others * sum(part.gathered for part in parts.values()),
        ("reduce-scatter", "context"): others * sum(part.scattered for part in parts.values()),
        ("all-reduce", "context"): 2 * learnt / mesh.fsdp * _ring(mesh.context),
    }
    return {key: size for key, size in sent.items() if size > 0}


def _ring(devices: int) -> float:
    return (devices - 1) / devices


def _rate(mesh: Arranged, axis: str, chip: Chip) -> float:
    """Return the bytes/s at which a device sends along an axis of the mesh."""
    places = np.arange(mesh.devices).reshape(tuple(mesh.sizes.values()))
    group = np.moveaxis(places, AXES.index(axis), -1).reshape(-1, mesh.sizes[axis])[0]
    return rate(tuple(group.tolist()), chip)


def rate(group: tuple[int, ...], chip: Chip) -> float:
    """Return the bytes/s at which each of a group of devices sends.

    Within an island that is the fast link's. Beyond, all of the group's devices in an island bring
    in together, each by its own way out, what each of them wants.
    """
    islands = {device // chip.island for device in group}
    if len(islands) <= 1:
        return chip.link
    return min(chip.link, chip.network * math.ceil(len(group) / len(islands)))


def _streamed(config: Config, stage: Stage, mesh: Arranged) -> float:
    """Return the bytes that element-wise work reads and writes on one device."""
    wide = 2 if config.model.dtype == "bfloat16" else FLOAT
    share = share_of(config, stage, mesh, wide=wide)
    total = sum(part.streamed for part in costs.of_stage(config, stage, share).values())
    return total + OPTIMIZER * FLOAT * counts(config, stage).trained.on(mesh)
