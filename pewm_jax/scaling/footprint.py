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

from pewm_jax import tree
from pewm_jax.config import Config
from pewm_jax.models import blocked_attention, vae, world_model
from pewm_jax.training import sharding
from pewm_jax.training.costs import encodes, sizes
from pewm_jax.training.stages import Stage
from pewm_jax.types import Params

FLOAT = 4
"""Bytes of a float32: what trains, its moments, average and gradients, and logits."""


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
    def of(cls, params: Params) -> Weights:
        """Count parameters, abstract ones too, by the table of ``sharding``."""
        specs = tree.flatten(tree.assign(sharding.PARAMETERS, params, "sharding rules"))
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
    make = functools.partial(world_model.init, config, memory=stage.memory)
    params = jax.eval_shape(make, jax.random.key(0))
    trained, frozen = tree.split(params, stage.trained)
    encoders = {name: frozen.pop(name) for name in ("codec", "encoder") if name in frozen}
    blocks = {
        name: {"blocks": params[name]["blocks"]}
        for name in ("backbone", "memory")
        if name in params
    }
    learning = blocks["memory" if stage.memory else "backbone"]
    return Counts(
        trained=Weights.of(trained),
        frozen=Weights.of(frozen),
        encoders=Weights.of(encoders),
        layer=_count(blocks) // config.dit.layers,
        trained_layer=_count(learning) // config.dit.layers,
    )


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
    frozen_wide = 2 if config.train.dtype == "bfloat16" else FLOAT
    trained = FLOAT * c.trained.on(mesh)
    widened = FLOAT * c.frozen.on(mesh) if wide > frozen_wide else 0.0
    kept, block = _activations(config, stage, mesh, clips, wide, flash=flash)
    return Footprint(
        trained=trained,
        frozen=frozen_wide * (c.frozen.on(mesh) + c.encoders.on(mesh)),
        average=trained,
        moments=2 * trained,
        batch=clips * clip_bytes(config, stage),
        gradients=trained,
        kept=kept,
        block=block,
        gathered=max(c.layer * wide, c.trained_layer * FLOAT) / mesh.tensor + widened,
        encoders=_encoders(config, stage, clips, wide, mesh),
    )


def clip_bytes(config: Config, stage: Stage) -> float:
    """Return the bytes of one clip of a batch: colours in 8 bits, depth in 32, kept features."""
    clip, context = config.clip, config.data.context
    pixels = (clip.frames + context) * clip.height * clip.width * (3 + FLOAT)
    if not (config.data.features and stage.memory):
        return pixels
    memory = config.memory
    if memory.encoder == "dinov2":
        places = (memory.encoder_size // memory.dinov2.patch) ** 2
    else:
        places = (clip.height // memory.encoder_patch) * (clip.width // memory.encoder_patch)
    return pixels + 2 * context * places * world_model.feature_channels(config)


def _activations(
    config: Config, stage: Stage, mesh: Arranged, clips: float, wide: int, *, flash: bool
) -> tuple[float, float]:
    """Return what the forward pass keeps for all blocks, and what one block's backward pass needs.

    In units of a block's tokens (``whole``: B·S·D values, split by ``context``), of what ``tensor``
    splits too (``part``), of hidden channels, and of tables of logits.
    """
    dit, memory, s = config.dit, config.memory, sizes(config)
    whole = clips * s.joint * s.width * wide / mesh.context
    part, hidden = whole / mesh.tensor, whole / mesh.tensor * dit.mlp_ratio
    each = clips * s.video / mesh.context / mesh.tensor
    video, inner = each * s.width * wide, each * s.inner * wide
    wider, table = video * memory.mlp_ratio, each * s.seen * memory.heads * FLOAT
    cells = dit.patch**2 * dit.patch_t
    patches = clips * s.video * cells * world_model.in_channels(config) * wide
    logits = clips * dit.heads / mesh.tensor * s.joint**2 / mesh.context
    if flash:
        logits = 0.0
    elif wide == FLOAT and logits > blocked_attention.LOGITS:  # a CPU: in pieces of a head
        logits = min(clips * s.joint**2 / mesh.context, blocked_attention.LOGITS)
    shared = 2 * part * (mesh.context - 1)  # keys and values of all tokens, or their gradients
    common = 4 * FLOAT * logits + shared

    kept = dit.layers * whole
    if stage.memory and dit.remat:
        block = 18 * whole + 13 * part + 2 * hidden + 5 * wider + 4 * inner + 3.3 * table
    elif stage.memory:
        block = 17 * whole + 13 * part
        kept = dit.layers * (3 * whole + 7 * part + hidden)
        kept += dit.layers * (10 * video + 6 * wider + 4.5 * inner + 3.3 * table)
    elif dit.remat:
        block = 12 * whole + 13 * part + 5 * hidden + 0.8 * patches
    else:
        block = 11 * whole + 13 * part + hidden + 0.8 * patches
        kept = dit.layers * (3 * whole + 7 * part + hidden)
    return kept, block + common


def _encoders(config: Config, stage: Stage, clips: float, wide: int, mesh: Arranged) -> float:
    """Return what VAE and DINOv2 hold while they run, clip by clip, their weights gathered."""
    clip, memory, held = config.clip, config.memory, 0.0
    pixels = clip.frames * clip.height * clip.width
    if config.codec.kind == "vae":
        at_once = vae.ENCODE_FRAMES + clip.frames % vae.ENCODE_FRAMES  # the first chunk's
        chunk = pixels * min(at_once / clip.frames, 1)
        widest = 2 * chunk * config.codec.vae.widths[0] * wide  # colour and depth
        held = 4.4 * widest
    if stage.memory and encodes(config):
        s = sizes(config)
        logits = s.context * memory.dinov2.heads * s.image**2
        values = s.context * s.image * memory.dinov2.width
        held = max(held, FLOAT * (2 * logits + 12 * values))
    signal = 2 * clips * pixels * 3 * FLOAT
    return held + signal + (counts(config, stage).encoders.count * wide if mesh.fsdp > 1 else 0)
