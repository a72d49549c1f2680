"""What a training step holds in memory, by the sum on paper (derived in ``docs/scaling.md``).

What lasts (weights, moments, average, batch) follows from shapes alone. What a step needs besides
is, at its peak, either the encoders' work or the backward pass of one block. The buffers alive
there were counted in the compiled program; the compiler may do with other ones, which is what the
comparison with ``memory_analysis`` in the tests is for.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
from jax.sharding import Mesh

from pewm_jax import tree, worlds
from pewm_jax.config import Config, WorldSettings
from pewm_jax.models.costs import FLOAT, Share
from pewm_jax.training.stages import Stage
from pewm_jax.types import Params
from pewm_jax.worlds import costs


@dataclasses.dataclass(frozen=True)
class Arranged:
    """How many devices lie along each axis of the mesh."""

    data: int = 1
    fsdp: int = 1
    tensor: int = 1
    context: int = 1

    @classmethod
    def of(cls, mesh: Mesh) -> Arranged:
        """Return the sizes of a mesh."""
        return cls(**{name: mesh.shape[name] for name in ("data", "fsdp", "tensor", "context")})

    @property
    def sizes(self) -> dict[str, int]:
        """The number of devices along each axis."""
        return dataclasses.asdict(self)

    @property
    def devices(self) -> int:
        """All devices."""
        return math.prod(self.sizes.values())

    @property
    def batch(self) -> int:
        """Parts that the batch is split into."""
        return self.data * self.fsdp


@dataclasses.dataclass(frozen=True)
class Weights:
    """Some parameters: how many, by the axes of the mesh that split them."""

    split: tuple[tuple[tuple[str, ...], int], ...]

    @classmethod
    def of(cls, model: WorldSettings, params: Params) -> Weights:
        """Count parameters, abstract ones too, by the networks' sharding rules."""
        specs = tree.flatten(tree.assign(worlds.sharding(model), params, "sharding rules"))
        found: dict[tuple[str, ...], int] = {}
        for path, leaf in tree.flatten(params).items():
            axes = tuple(axis for axis in specs[path] if axis)
            found[axes] = found.get(axes, 0) + leaf.size
        return cls(tuple(found.items()))

    @property
    def count(self) -> int:
        """All of them."""
        return sum(count for _, count in self.split)

    def on(self, mesh: Arranged) -> float:
        """How many a device has."""
        sizes_ = mesh.sizes
        return sum(count / math.prod(sizes_[axis] for axis in axes) for axes, count in self.split)


@dataclasses.dataclass(frozen=True)
class Counts:
    """The parameters of a stage.

    Attributes:
        trained: what the stage trains.
        frozen: backbone (in stage 2), text and whatever else stands still.
        encoders: the frozen VAE and DINOv2.
        layer: number in one block, with its memory block.
        trained_layer: number of what of it is trained.
    """

    trained: Weights
    frozen: Weights
    encoders: Weights
    layer: int
    trained_layer: int


@functools.cache
def counts(config: Config, stage: Stage) -> Counts:
    """Count the parameters of a stage, without making them."""
    params = jax.eval_shape(functools.partial(stage.init, config.model), jax.random.key(0))
    trained, frozen = tree.split(params, stage.trained)
    encoders = {name: frozen.pop(name) for name in ("codec", "encoder") if name in frozen}
    weigh = functools.partial(Weights.of, config.model)
    return Counts(
        trained=weigh(trained),
        frozen=weigh(frozen),
        encoders=weigh(encoders),
        layer=_one_block(params),
        trained_layer=_one_block(trained),
    )


def _one_block(params: Params) -> int:
    """Count the parameters of one block: what is stacked under ``blocks``, else a whole network."""
    total = 0
    for name, part in params.items():
        if name in ("codec", "encoder", "text"):
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
    """Bytes on one device.

    Attributes:
        trained: master weights in float32.
        frozen: frozen weights, of the encoders too.
        average: the moving average of what trains.
        moments: Adam's.
        batch: the clips of this device.
        gradients: of what trains, in float32.
        kept: activations kept from the forward pass for the backward pass.
        block: what the backward pass of one block needs besides.
        gathered: one block's weights, whole, as they compute, or its gradients not yet shared; on
            a CPU also all frozen ones, widened.
        encoders: what VAE and DINOv2 need while they run, before anything else is there.
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
        """What lasts from step to step, and the batch."""
        return self.trained + self.frozen + self.average + self.moments + self.batch

    @property
    def step(self) -> float:
        """What a step needs besides, at its peak."""
        return max(self.gradients + self.kept + self.block + self.gathered, self.encoders)

    @property
    def peak(self) -> float:
        """All together."""
        return self.state + self.step


def footprint(config: Config, stage: Stage, mesh: Arranged, *, wide: int, flash: bool) -> Footprint:
    """Sum up what one device holds.

    Args:
        config: the experiment.
        stage: the stage.
        mesh: how devices are arranged.
        wide: bytes of an activation: 2 for bfloat16, and 4 on a CPU, which widens it.
        flash: whether attention's logits stay in a kernel (cuDNN's) and are not held.
    """
    c = counts(config, stage)
    clips = stage.settings(config).batch / mesh.batch
    frozen_wide = 2 if config.model.dtype == "bfloat16" else FLOAT
    trained = FLOAT * c.trained.on(mesh)
    widened = FLOAT * c.frozen.on(mesh) if wide > frozen_wide else 0.0
    share = share_of(config, stage, mesh, wide=wide, flash=flash)
    parts = costs.of_stage(config, stage, share)
    # Encoders work clip by clip, their weights gathered; what comes of it is kept for all clips.
    pixels = clips * config.model.clip.frames * config.model.clip.height * config.model.clip.width
    held = max(part.held for part in parts.values()) + 2 * pixels * 3 * FLOAT
    return Footprint(
        trained=trained,
        frozen=frozen_wide * (c.frozen.on(mesh) + c.encoders.on(mesh)),
        average=trained,
        moments=2 * trained,
        batch=clips * clip_bytes(config, stage),
        gradients=trained,
        kept=sum(part.kept for part in parts.values()),
        block=sum(part.block for part in parts.values()),
        gathered=max(c.layer * wide, c.trained_layer * FLOAT) / mesh.tensor + widened,
        encoders=held + (c.encoders.count * wide if mesh.fsdp > 1 else 0),
    )


def share_of(
    config: Config, stage: Stage, mesh: Arranged, *, wide: int, flash: bool = False
) -> Share:
    """Return what one device has of a step; arguments as for ``footprint``."""
    clips = stage.settings(config).batch / mesh.batch
    return Share(clips, mesh.tensor, mesh.context, wide, flash)


def clip_bytes(config: Config, stage: Stage) -> float:
    """Return the bytes of one clip of a batch: colours in 8 bits, depth in 32, kept features."""
    clip, context = config.model.clip, config.data.context
    pixels = (clip.frames + context) * clip.height * clip.width * (3 + FLOAT)
    if not (config.data.features and stage.memory):
        return pixels
    encoder = config.model.memory.encoder
    return pixels + 2 * context * math.prod(encoder.grid(clip)) * encoder.channels
