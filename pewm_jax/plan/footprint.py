"""The memory of a training step, computed by formulas (derived in ``docs/scaling.md``).

The size of the state (weights, moments, average) and of the batch follows from shapes alone. The
peak of a step's temporary memory is either in the encoders or in the backward pass of one block.
The number of live buffers there was counted in a compiled program. A compiler may need others, so
tests compare the formulas with ``memory_analysis``.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import numpy as np
from jax.sharding import Mesh

from pewm_jax import worlds
from pewm_jax.config import ArraySpec, Config, World
from pewm_jax.io import tree
from pewm_jax.nn.costs import FLOAT, Share
from pewm_jax.train.stages import Stage
from pewm_jax.types import Params
from pewm_jax.worlds import costs

ENCODERS = ("codec", "encoder", "image")
"""Frozen networks that run before the denoiser, as their parameters are named."""


@dataclasses.dataclass(frozen=True)
class MeshSizes:
    """The number of devices along each mesh axis."""

    data: int = 1
    fsdp: int = 1
    tensor: int = 1
    context: int = 1

    @classmethod
    def of(cls, mesh: Mesh) -> MeshSizes:
        """Return the sizes of a mesh."""
        return cls(**{name: mesh.shape[name] for name in ("data", "fsdp", "tensor", "context")})

    @property
    def sizes(self) -> dict[str, int]:
        """The number of devices along each axis."""
        return dataclasses.asdict(self)

    @property
    def devices(self) -> int:
        """The number of all devices."""
        return math.prod(self.sizes.values())

    @property
    def batch(self) -> int:
        """The number of parts that the batch is split into."""
        return self.data * self.fsdp


@dataclasses.dataclass(frozen=True)
class Weights:
    """Counts of parameters, grouped by the mesh axes that split them."""

    split: tuple[tuple[tuple[str, ...], int], ...]

    @classmethod
    def of(cls, model: World, params: Params) -> Weights:
        """Count parameters, which may be abstract, by the model's sharding rules."""
        specs = tree.flatten(tree.assign(worlds.sharding(model), params, "sharding rules"))
        found: dict[tuple[str, ...], int] = {}
        for path, leaf in tree.flatten(params).items():
            axes = tuple(axis for axis in specs[path] if axis)
            found[axes] = found.get(axes, 0) + leaf.size
        return cls(tuple(found.items()))

    @property
    def count(self) -> int:
        """The number of all parameters."""
        return sum(count for _, count in self.split)

    def on(self, mesh: MeshSizes) -> float:
        """Return the number of parameters on one device."""
        sizes = mesh.sizes
        return sum(count / math.prod(sizes[axis] for axis in axes) for axes, count in self.split)


@dataclasses.dataclass(frozen=True)
class Counts:
    """Numbers of parameters in a stage.

    Attributes:
        trained: trained parameters.
        frozen: frozen parameters, such as the backbone in stage 2, without the encoders.
        encoders: the frozen VAE, DINOv2 and what a backbone sees the image with.
        layer: parameters of one block and its memory block.
        trained_layer: those of them that are trained.
    """

    trained: Weights
    frozen: Weights
    encoders: Weights
    layer: int
    trained_layer: int


@functools.cache
def counts(config: Config, stage: Stage) -> Counts:
    """Count the parameters of a stage from shapes alone."""
    params = jax.eval_shape(functools.partial(stage.init, config.model), jax.random.key(0))
    trained, frozen = tree.split(params, stage.trained)
    encoders = {name: frozen.pop(name) for name in ENCODERS if name in frozen}
    count = functools.partial(Weights.of, config.model)
    return Counts(
        trained=count(trained),
        frozen=count(frozen),
        encoders=count(encoders),
        layer=_one_block(params),
        trained_layer=_one_block(trained),
    )


def _one_block(params: Params) -> int:
    """Count the parameters of one block per network, or of a whole network without ``blocks``."""
    total = 0
    for name, part in params.items():
        if name in (*ENCODERS, "text"):
            continue
        stacked = isinstance(part, dict) and "blocks" in part
        blocks = part["blocks"] if stacked else part
        layers = jax.tree.leaves(blocks)[0].shape[0] if stacked else 1
        total += _count(blocks) // layers
    return total


def _count(params: Params) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(params))


@dataclasses.dataclass(frozen=True)
class Footprint:
    """Memory of one device in bytes.

    Attributes:
        trained: trained weights in float32.
        frozen: frozen weights, including the encoders'.
        average: moving average of the trained weights.
        moments: Adam's moments.
        batch: the device's clips.
        gradients: gradients of the trained weights in float32.
        kept: activations stored by the forward pass for the backward pass.
        block: further memory of the backward pass of one block.
        gathered: one block's gathered weights in compute precision, or its gradients before they
            are scattered; on a CPU also all frozen weights, converted to float32.
        encoders: memory of VAE and DINOv2 while they run, before the denoiser starts.
    """

    trained: float
    frozen: float
    average: float
    moments: float
    batch: float
    gradients: float
    kept: float
    block: float
    gathered: float
    encoders: float

    @property
    def state(self) -> float:
        """Memory of the training state and the batch."""
        return self.trained + self.frozen + self.average + self.moments + self.batch

    @property
    def step(self) -> float:
        """Peak of the temporary memory of a step."""
        return max(self.gradients + self.kept + self.block + self.gathered, self.encoders)

    @property
    def peak(self) -> float:
        """Peak memory: state, batch and temporary memory."""
        return self.state + self.step


def footprint(
    config: Config, stage: Stage, mesh: MeshSizes, *, activation_bytes: int, flash: bool
) -> Footprint:
    """Return the memory of one device.

    Args:
        config: the experiment.
        stage: the stage.
        mesh: the device mesh.
        activation_bytes: bytes of one activation value: 2 in bfloat16, but 4 on a CPU, where XLA
            computes in float32.
        flash: whether a fused kernel (cuDNN's) computes attention, so that no logits are stored.
    """
    c = counts(config, stage)
    clips = stage.settings(config).batch / mesh.batch
    frozen_bytes = 2 if config.model.dtype == "bfloat16" else FLOAT
    trained = FLOAT * c.trained.on(mesh)
    widened = FLOAT * c.frozen.on(mesh) if activation_bytes > frozen_bytes else 0.0
    share = share_of(config, stage, mesh, activation_bytes=activation_bytes, flash=flash)
    parts = costs.of_stage(config, stage, share)
    # Encoders run clip by clip with gathered weights; their outputs are stored for all clips.
    pixels = clips * config.model.clip.frames * config.model.clip.height * config.model.clip.width
    held = max((part.held for part in parts.values()), default=0.0) + 2 * pixels * 3 * FLOAT
    return Footprint(
        trained=trained,
        frozen=frozen_bytes * (c.frozen.on(mesh) + c.encoders.on(mesh)),
        average=trained,
        moments=2 * trained,
        batch=clips * clip_bytes(config, stage),
        gradients=trained,
        kept=sum(part.kept for part in parts.values()),
        block=sum(part.block for part in parts.values()),
        gathered=max(c.layer * activation_bytes, c.trained_layer * FLOAT) / mesh.tensor + widened,
        encoders=held + (c.encoders.count * activation_bytes if mesh.fsdp > 1 else 0),
    )


def share_of(
    config: Config, stage: Stage, mesh: MeshSizes, *, activation_bytes: int, flash: bool = False
) -> Share:
    """Return one device's share of a step; arguments are as for ``footprint``."""
    clips = stage.settings(config).batch / mesh.batch
    return Share(clips, mesh.tensor, mesh.context, activation_bytes, flash)


def clip_bytes(config: Config, stage: Stage) -> float:
    """Return the bytes of one clip of a batch.

    That is 8-bit colours, 32-bit depth, cached features, 16-bit class ids of recorded grids.
    """
    clip, context = config.model.clip, config.data.context
    asked = config.model.batch_spec
    context = context if asked.context else 0
    total = (clip.frames + context) * clip.height * clip.width * (3 + FLOAT)
    total += sum(_bytes(one) for _, one in asked.extras)
    if asked.features is None or not (config.data.features and stage.memory):
        return total
    return total + context * _bytes(asked.features)


def _bytes(array: ArraySpec) -> int:
    return math.prod(array.shape) * np.dtype(array.dtype).itemsize
