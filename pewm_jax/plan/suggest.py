"""Memory and time of a stage on a mesh of one kind of device, and the best meshes.

State and weight communication follow from the shapes and the sharding rules. Temporary memory is
that of the program compiled for the requested mesh, scaled to other meshes. Time is a prediction
from the chip's data sheet, not a measurement: the fraction of the peak that each kind of work
reaches is assumed (``REACHED``), and communication that no computation waits for is assumed to
overlap with computation.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping

import jax

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.data import abstract
from pewm_jax.io import tree
from pewm_jax.plan.measure import Compiled, MeshSizes, StepWork, in_bfloat16
from pewm_jax.train import sharding
from pewm_jax.train.chips import Chip
from pewm_jax.train.step import TrainState, create
from pewm_jax.worlds.stages import Stage

MARGIN = 0.9
"""Fraction of the memory that a plan may use; the runtime and fragmentation need the rest."""
REACHED = {"linear": 0.65, "attention": 0.4, "convolution": 0.4}
"""Assumed fractions of peak FLOPs for large products, from published kernel benchmarks."""
STREAMED = 0.8
"""Assumed fraction of the memory bandwidth reached by reading and writing arrays."""
OPTIMIZER = 10
"""Number of times that clipping, Adam and the EMA read or write each trained parameter (4
bytes)."""
FLOAT = 4
"""Bytes of a float32."""
SPLIT = ("tensor", "context")
"""Mesh axes that split the work of a layer: their communication cannot overlap with its
computation."""


@dataclasses.dataclass(frozen=True)
class Memory:
    """Memory of one device in bytes.

    Attributes:
        trained: trained weights.
        frozen: frozen weights.
        average: moving average of the trained weights.
        moments: the optimizer's state.
        batch: the device's clips.
        gradients: gradients of the trained weights in float32.
        temporary: the other temporary memory of a step; None if it was not measured.
    """

    trained: float
    frozen: float
    average: float
    moments: float
    batch: float
    gradients: float
    temporary: float | None = None

    @property
    def state(self) -> float:
        """Return the memory of the training state and the batch."""
        return self.trained + self.frozen + self.average + self.moments + self.batch

    @property
    def peak(self) -> float:
        """Return the peak memory, without unmeasured parts."""
        return self.state + self.gradients + (self.temporary or 0.0)


@dataclasses.dataclass(frozen=True)
class Prediction:
    """The predicted time, traffic and throughput of a step.

    Attributes:
        products_s: seconds of matrix products and convolutions.
        streaming_s: seconds of reading and writing arrays.
        sent: bytes that a device sends, by (kind, axis of the mesh).
        waiting_s: seconds of communication that does not overlap with computation.
        step_s: seconds of a step.
        needed_flops: FLOPs that a step needs, over all devices.
        executed_flops: FLOPs that one device executes, including recomputation.
        mfu: model FLOPs utilization: needed FLOPs over the peak FLOPs of all devices in that time.
        clips_per_s: clips per second.
    """

    products_s: float
    streaming_s: float
    sent: dict[tuple[str, str], float]
    waiting_s: float
    step_s: float
    needed_flops: float
    executed_flops: float
    mfu: float
    clips_per_s: float

    def sent_of(self, kind: str) -> float:
        """Return the bytes sent in one kind of communication."""
        return sum(size for (sent_kind, _), size in self.sent.items() if sent_kind == kind)


@dataclasses.dataclass(frozen=True)
class Arrangement:
    """A device mesh, with the memory and time of a stage on it.

    ``fits`` says whether the memory suffices, as far as known.
    """

    mesh: MeshSizes
    memory: Memory
    time: Prediction
    fits: bool

    @property
    def flags(self) -> str:
        """Return the flags of ``train.py`` that select it."""
        return " ".join(f"--train.mesh.{name} {n}" for name, n in self.mesh.sizes.items())


@dataclasses.dataclass(frozen=True)
class Weights:
    """Parameter counts, grouped by the mesh axes that shard them."""

    split: tuple[tuple[tuple[str, ...], int], ...]

    @property
    def count(self) -> int:
        """Return the total number of parameters."""
        return sum(count for _, count in self.split)

    def on(self, mesh: MeshSizes) -> float:
        """Return the number of parameters on one device."""
        sizes = mesh.sizes
        return sum(count / math.prod(sizes[axis] for axis in axes) for axes, count in self.split)


@functools.cache
def abstract_state(config: Config, stage: Stage) -> TrainState:
    """Return the shapes of a stage's state."""
    return jax.eval_shape(functools.partial(create, config, stage), jax.random.key(0))


@functools.cache
def counts(config: Config, stage: Stage) -> dict[str, Weights]:
    """Count the parameters of a stage: trained ones, frozen ones, and frozen encoders.

    The encoders prepare clips (``Stage.prepares_by``): no gradient passes through them.
    """
    params = abstract_state(config, stage).params
    specs = tree.flatten(tree.assign(worlds.sharding(config.model), params, "sharding rules"))
    trained = tree.flatten(tree.split(params, stage.trained)[0])
    found: dict[str, dict[tuple[str, ...], int]] = {"trained": {}, "frozen": {}, "encoders": {}}
    for path, leaf in tree.flatten(params).items():
        part = "encoders" if path.split("/")[0] in stage.prepares_by else "frozen"
        group = found["trained" if path in trained else part]
        axes = tuple(axis for axis in specs[path] if axis)
        group[axes] = group.get(axes, 0) + leaf.size
    return {name: Weights(tuple(split.items())) for name, split in found.items()}


def memory_of(
    config: Config, stage: Stage, mesh: MeshSizes, compiled: Compiled | None = None
) -> Memory:
    """Return the memory of one device.

    Temporary memory beyond the gradients is that of the program compiled for a mesh, which may be
    another one, scaled to a device's share of the batch, heads and tokens. In bfloat16 it is half
    of the CPU's, which computes in float32.
    """
    shapes = abstract_state(config, stage)
    placed = sharding.of_state(config.model, mesh.abstract, shapes)

    def size(part: object, where: object) -> float:
        leaves = zip(jax.tree.leaves(part), jax.tree.leaves(where), strict=True)
        return math.fsum(_on_device(leaf, sharded, mesh) for leaf, sharded in leaves)

    trained, frozen = (
        size(one, where)
        for one, where in zip(
            tree.split(shapes.params, stage.trained),
            tree.split(placed.params, stage.trained),
            strict=True,
        )
    )
    clip = abstract.clip(config, stage.settings(config).batch, features=stage.memory)
    read = clip if stage.memory else (clip.frames, clip.actions_TA, clip.extras)
    batch = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(read))
    gradients = FLOAT * counts(config, stage)["trained"].on(mesh)
    rest = None
    if compiled is not None:
        measured = compiled.temporary - FLOAT * counts(config, stage)["trained"].on(compiled.mesh)
        share = compiled.mesh.batch * compiled.mesh.tensor * compiled.mesh.context
        share /= mesh.batch * mesh.tensor * mesh.context
        rest = in_bfloat16(config, {"": max(measured, 0.0) * share})[""]
    return Memory(
        trained=trained,
        frozen=frozen,
        average=size(shapes.ema, placed.ema),
        moments=size(shapes.opt_state, placed.opt_state),
        batch=batch / mesh.batch,
        gradients=gradients,
        temporary=rest,
    )


def _on_device(leaf: jax.ShapeDtypeStruct, where: jax.sharding.NamedSharding, mesh: MeshSizes):
    ways = math.prod(mesh.sizes[axis] for axis in where.spec if axis)
    return leaf.size * leaf.dtype.itemsize / ways


@dataclasses.dataclass(frozen=True)
class Job:
    """A stage on one kind of device, to be estimated on meshes of them.

    Attributes:
        config: the experiment.
        stage: the stage.
        chip: the kind of device.
        work: the work of a step.
        compiled: the program compiled for the requested mesh; without it, temporary memory is
            unknown.
    """

    config: Config
    stage: Stage
    chip: Chip
    work: StepWork
    compiled: Compiled | None = None

    def predict(self, mesh: MeshSizes) -> Prediction:
        """Predict the time of a step."""
        clips, done = self.stage.settings(self.config).batch, self.work.on_device(mesh)
        peak = self.chip.flops if self.config.model.dtype == "bfloat16" else self.chip.flops / 2
        products_s = sum(flops / (peak * REACHED[kind]) for kind, flops in done.items())
        streamed = self.work.traffic_on_device(mesh)
        streamed += OPTIMIZER * FLOAT * counts(self.config, self.stage)["trained"].on(mesh)
        streamed += self._streamed_again(mesh)
        streaming_s = streamed / (self.chip.bandwidth * STREAMED)
        sent = self.traffic(mesh)
        seconds = {key: size / self._rate(mesh, key[1]) for key, size in sent.items()}
        blocking = sum(s for (_, axis), s in seconds.items() if axis in SPLIT)
        overlapping = sum(s for (_, axis), s in seconds.items() if axis not in SPLIT)
        busy = products_s + streaming_s
        waiting_s = blocking + max(0.0, overlapping - busy)
        step_s = busy + waiting_s
        return Prediction(
            products_s=products_s,
            streaming_s=streaming_s,
            sent=sent,
            waiting_s=waiting_s,
            step_s=step_s,
            needed_flops=self.work.needed.total,
            executed_flops=sum(done.values()),
            mfu=self.work.needed.total / (step_s * self.chip.flops * mesh.devices),
            clips_per_s=clips / step_s,
        )

    def _streamed_again(self, mesh: MeshSizes) -> float:
        """Return the bytes of weights and sums of gradients that further micro-batches stream."""
        c = counts(self.config, self.stage)
        parts = self.stage.settings(self.config).micro_batches
        wide = 2 if self.config.model.dtype == "bfloat16" else FLOAT
        weights = (c["trained"].on(mesh) + c["frozen"].on(mesh)) * mesh.fsdp * wide
        passes = 2 + self.work.recomputes
        return (parts - 1) * (passes * weights + 3 * FLOAT * c["trained"].on(mesh))

    def traffic(self, mesh: MeshSizes) -> dict[tuple[str, str], float]:
        """Return the bytes that a device sends in a step, by kind and axis of the mesh.

        Once per micro-batch, weights are gathered for the forward pass and for the backward pass
        (``fsdp``), and once more if the backward pass recomputes the forward pass in 16 bits,
        because XLA then does not merge the two gathers. Gradients are reduce-scattered (``fsdp``)
        and summed over copies of the weights (``data``, ``context``). In every pass the results of
        products whose contracted dimension is sharded are summed over ``tensor``. Communication of
        layers along ``context`` is that of the compiled program, scaled to a device's clips; 0
        without such a program.
        """
        c = counts(self.config, self.stage)
        wide = 2 if self.config.model.dtype == "bfloat16" else FLOAT
        parts = self.stage.settings(self.config).micro_batches
        parameters = parts * (c["trained"].on(mesh) + c["frozen"].on(mesh)) * mesh.fsdp * wide
        gradients = parts * c["trained"].on(mesh) * mesh.fsdp * wide
        gathered = 2 + (self.work.recomputes and wide < FLOAT)
        summed = (2 + self.work.recomputes) * self.work.needed.summed / (mesh.batch * mesh.context)
        sent = {
            ("all-gather", "fsdp"): (gathered * parameters + parts * c["encoders"].count * wide)
            * _ring(mesh.fsdp),
            ("reduce-scatter", "fsdp"): gradients * _ring(mesh.fsdp),
            ("all-reduce", "data"): 2 * gradients / mesh.fsdp * _ring(mesh.data),
            ("all-reduce", "tensor"): 2 * summed * _ring(mesh.tensor),
            ("all-reduce", "context"): 2 * gradients / mesh.fsdp * _ring(mesh.context),
        }
        if self.compiled is not None and mesh.context > 1:
            there = self.compiled.mesh
            share = there.batch * there.tensor / (mesh.batch * mesh.tensor)
            along = in_bfloat16(self.config, self.compiled.sent_along("context"))
            for kind, size in along.items():
                sent[kind, "context"] = max(sent.get((kind, "context"), 0.0), share * size)
        return {key: size for key, size in sent.items() if size > 0}

    def _rate(self, mesh: MeshSizes, axis: str) -> float:
        """Return the bytes/s at which a device sends along an axis of the mesh."""
        return rate(next(group for group, axes in mesh.groups.items() if axes == axis), self.chip)

    def assess(self, mesh: MeshSizes) -> Arrangement:
        """Compute the memory and the time of a step."""
        memory = memory_of(self.config, self.stage, mesh, self.compiled)
        fits = memory.peak <= MARGIN * self.chip.memory
        return Arrangement(mesh, memory, self.predict(mesh), fits)

    def rank(self, devices: int, context: int = 1) -> list[Arrangement]:
        """Return all meshes of a number of devices: those that fit, fastest first, then the others.

        If two times agree to two digits, the mesh that needs less memory comes first. Of those that
        do not fit, the smallest comes first. ``context`` is fixed.
        """
        meshes = arrangements(self.config, self.stage, devices, context)
        return sorted(map(self.assess, meshes), key=_order)


def _ring(devices: int) -> float:
    return (devices - 1) / devices


def rate(group: tuple[int, ...], chip: Chip) -> float:
    """Return the bytes/s at which each of a group of devices sends.

    Within an island (devices joined by the fast link) it is the link's bandwidth. Between islands,
    the group's devices in each island share their network connections.
    """
    islands = {device // chip.island for device in group}
    if len(islands) <= 1:
        return chip.link
    return min(chip.link, chip.network * math.ceil(len(group) / len(islands)))


def arrangements(
    config: Config, stage: Stage, devices: int, context: int = 1
) -> Iterator[MeshSizes]:
    """Yield all meshes of this many devices that can share the stage's batch and heads.

    ``tensor`` divides the numbers of heads; ``context`` is fixed.
    """
    settings = stage.settings(config)
    batch = settings.batch // settings.micro_batches
    heads: Mapping[str, int] = worlds.split_heads(config.model, stage)
    for tensor in _divisors(devices // context):
        rest = devices // tensor // context
        if any(count % tensor for count in heads.values()) or batch % rest:
            continue
        for fsdp in _divisors(rest):
            yield MeshSizes(rest // fsdp, fsdp, tensor, context)


def _order(choice: Arrangement) -> tuple[bool, float, float]:
    seconds = float(f"{choice.time.step_s:.2g}") if choice.fits else choice.memory.peak
    return not choice.fits, seconds, choice.memory.peak


def _divisors(number: int) -> list[int]:
    return [n for n in range(1, number + 1) if number % n == 0]
