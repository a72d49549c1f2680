"""Predicted time of a step on a chip, from its data sheet: FLOPs, memory traffic, communication.

This is a prediction, not a measurement. The share of the peak that each kind of work reaches is
assumed (``REACHED``), and communication that no computation waits for is assumed to overlap with
computation.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pewm_jax.config import AXES, Config
from pewm_jax.nn.costs import FLOAT, SPLIT, video_tokens
from pewm_jax.plan.footprint import MeshSizes, counts, share_of
from pewm_jax.train.chips import Chip
from pewm_jax.train.stages import Stage
from pewm_jax.worlds import costs

REACHED = {"linear": 0.65, "attention": 0.4, "convolution": 0.4}
"""Assumed shares of the peak FLOPs that large products reach, from published kernel benchmarks."""
STREAMED = 0.8
"""Assumed share of the memory bandwidth that element-wise work reaches."""
OPTIMIZER = 10
"""How often clipping, Adam and the average read or write each trained parameter (4 bytes)."""


@dataclasses.dataclass(frozen=True)
class Prediction:
    """The predicted time, traffic and throughput of a step.

    Attributes:
        products_s: seconds of matrix products and convolutions.
        streaming_s: seconds of element-wise work.
        sent: bytes that a device sends, by (kind, axis of the mesh).
        waiting_s: seconds of communication that does not overlap with computation.
        step_s: seconds of a step.
        model_flops: FLOPs of a step on all devices, without recomputation.
        hardware_flops: FLOPs of one device, with recomputation.
        mfu: model FLOPs utilisation: model FLOPs over peak FLOPs of all devices in that time.
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
        return sum(size for (sent_kind, _), size in self.sent.items() if sent_kind == kind)


def predict(config: Config, stage: Stage, mesh: MeshSizes, chip: Chip) -> Prediction:
    """Predict a stage's step on a chip."""
    products = costs.products(config, stage)
    clips = stage.settings(config).batch
    work = {product: costs.flops_of_device(product, mesh.sizes, clips) for product in products}
    peak = chip.flops if config.model.dtype == "bfloat16" else chip.flops / 2
    products_s = sum(flops / (peak * REACHED[p.kind]) for p, flops in work.items())
    streaming_s = _streamed(config, stage, mesh) / (chip.bandwidth * STREAMED)
    sent = traffic(config, stage, mesh)
    seconds = {key: size / _rate(mesh, key[1], chip) for key, size in sent.items()}
    blocking = sum(s for (_, axis), s in seconds.items() if axis in SPLIT)
    overlapping = sum(s for (_, axis), s in seconds.items() if axis not in SPLIT)
    busy = products_s + streaming_s
    waiting_s = blocking + max(0.0, overlapping - busy)
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
        tokens_per_s=clips * _tokens(config) / step_s,
    )


def _tokens(config: Config) -> int:
    """Return the video tokens of a clip; 0 of a model without a transformer."""
    return math.prod(video_tokens(config.model)) if hasattr(config.model, "backbone") else 0


def traffic(config: Config, stage: Stage, mesh: MeshSizes) -> dict[tuple[str, str], float]:
    """Return the bytes that a device sends in a step, by kind and axis of the mesh.

    Once per step: weights are gathered for the forward pass and for the backward pass (``fsdp``),
    and once more if the backward pass repeats the forward pass (``backbone.remat``) in 16 bits,
    because XLA then does not merge the two gathers. Gradients are reduce-scattered (``fsdp``) and
    summed over copies of the weights (``data``).

    Per block and pass: the outputs of its two (with memory, four) output projections are summed
    over ``tensor``. Keys and values are gathered over ``context``, and their gradients scattered.
    """
    c, remat = (
        counts(config, stage),
        bool(getattr(getattr(config.model, "backbone", None), "remat", False)),
    )
    activation_bytes = 2 if config.model.dtype == "bfloat16" else FLOAT
    parts = costs.of_stage(
        config, stage, share_of(config, stage, mesh, activation_bytes=activation_bytes)
    )
    parameters = (c.trained.on(mesh) + c.frozen.on(mesh)) * mesh.fsdp * activation_bytes
    gradients = c.trained.on(mesh) * mesh.fsdp * activation_bytes
    gathered = 2 + (remat and activation_bytes < FLOAT)
    summed = sum(part.summed for part in parts.values())
    peers = mesh.context - 1
    sent = {
        ("all-gather", "fsdp"): (gathered * parameters + c.encoders.count * activation_bytes)
        * _ring(mesh.fsdp),
        ("reduce-scatter", "fsdp"): gradients * _ring(mesh.fsdp),
        ("all-reduce", "data"): 2 * gradients / mesh.fsdp * _ring(mesh.data),
        ("all-reduce", "tensor"): 2 * summed * _ring(mesh.tensor),
        ("all-gather", "context"): peers * sum(part.gathered for part in parts.values()),
        ("reduce-scatter", "context"): peers * sum(part.scattered for part in parts.values()),
        ("all-reduce", "context"): 2 * gradients / mesh.fsdp * _ring(mesh.context),
    }
    return {key: size for key, size in sent.items() if size > 0}


def _ring(devices: int) -> float:
    return (devices - 1) / devices


def _rate(mesh: MeshSizes, axis: str, chip: Chip) -> float:
    """Return the bytes/s at which a device sends along an axis of the mesh."""
    places = np.arange(mesh.devices).reshape(tuple(mesh.sizes.values()))
    group = np.moveaxis(places, AXES.index(axis), -1).reshape(-1, mesh.sizes[axis])[0]
    return rate(tuple(group.tolist()), chip)


def rate(group: tuple[int, ...], chip: Chip) -> float:
    """Return the bytes/s at which each of a group of devices sends.

    Within an island (devices joined by the fast link) it is the link's bandwidth. Between islands,
    the group's devices in each island share their network connections.
    """
    islands = {device // chip.island for device in group}
    if len(islands) <= 1:
        return chip.link
    return min(chip.link, chip.network * math.ceil(len(group) / len(islands)))


def _streamed(config: Config, stage: Stage, mesh: MeshSizes) -> float:
    """Return the bytes that element-wise work reads and writes on one device."""
    activation_bytes = 2 if config.model.dtype == "bfloat16" else FLOAT
    share = share_of(config, stage, mesh, activation_bytes=activation_bytes)
    total = sum(part.streamed for part in costs.of_stage(config, stage, share).values())
    return total + OPTIMIZER * FLOAT * counts(config, stage).trained.on(mesh)
