"""Measure the computation, memory and communication of a stage's step without its devices.

The real step is traced and compiled ahead of time for virtual CPU devices, from shapes alone. The
jaxprs give the FLOPs (``train.flops``). The compiled program gives memory and communication.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AbstractMesh, Mesh

from pewm_jax.config import AXES, Config, UserError
from pewm_jax.data import abstract
from pewm_jax.plan import program
from pewm_jax.plan.program import Collective, Program
from pewm_jax.train import flops, sharding, step
from pewm_jax.train.chips import Chip
from pewm_jax.train.flops import Work
from pewm_jax.worlds.stages import Stage

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Compiler options that save time. They affect only the generated machine code, which is never
executed."""


@dataclasses.dataclass(frozen=True)
class MeshSizes:
    """The number of devices along each mesh axis."""

    data: int = 1
    fsdp: int = 1
    tensor: int = 1
    context: int = 1

    @property
    def sizes(self) -> dict[str, int]:
        """Return the number of devices along each axis."""
        return dataclasses.asdict(self)

    @property
    def devices(self) -> int:
        """Return the total number of devices."""
        return math.prod(self.sizes.values())

    @property
    def batch(self) -> int:
        """Return the number of shards of the batch."""
        return self.data * self.fsdp

    @property
    def abstract(self) -> AbstractMesh:
        """Return a mesh without devices."""
        return AbstractMesh(tuple(self.sizes.values()), tuple(self.sizes))

    @functools.cached_property
    def groups(self) -> dict[tuple[int, ...], str]:
        """Return the axes along which each group of devices lies, joined by ``+``."""
        split = [name for name, size in self.sizes.items() if size > 1]
        places = np.arange(self.devices).reshape(tuple(self.sizes.values()))
        found: dict[tuple[int, ...], str] = {}
        for count in range(1, len(split) + 1):
            for axes in itertools.combinations(split, count):
                moved = np.moveaxis(places, [AXES.index(axis) for axis in axes], range(-count, 0))
                rows = moved.reshape(-1, math.prod(self.sizes[axis] for axis in axes))
                for group in np.sort(rows).tolist():
                    found.setdefault(tuple(group), "+".join(axes))
        return found

    def axes_of(self, group: tuple[int, ...]) -> str:
        """Return the axes along which devices communicate: all along them, or some of these."""
        exact = self.groups.get(tuple(sorted(group)))
        around = [axes for whole, axes in self.groups.items() if set(group) <= set(whole)]
        if exact or not around:
            return exact or "other"
        return min(around, key=lambda axes: axes.count("+"))

    def sent(self, collectives: Iterable[Collective]) -> dict[tuple[str, str], float]:
        """Return the bytes that a device sends, by (kind, axes of the mesh)."""
        sent = defaultdict[tuple[str, str], float](float)
        for item in collectives:
            sent[item.kind, self.axes_of(item.group)] += item.sent
        return {key: size for key, size in sorted(sent.items()) if size}


@dataclasses.dataclass(frozen=True)
class Compiled:
    """What the compiler reports about a step on virtual CPU devices; bytes are per device.

    Attributes:
        program: its work.
        arguments: bytes of state and batch.
        temporary: bytes of temporary memory and new outputs.
        mesh: the mesh for which it was compiled.
        seconds: time of compilation.
    """

    program: Program
    arguments: float
    temporary: float
    mesh: MeshSizes
    seconds: float

    @property
    def peak(self) -> float:
        """Return the peak memory in bytes."""
        return self.arguments + self.temporary

    def sent_along(self, axis: str) -> dict[str, float]:
        """Return kind → bytes that a device sends to devices that differ only along this axis."""
        sent = defaultdict[str, float](float)
        for item in self.program.collectives:
            if self.mesh.groups.get(tuple(sorted(item.group))) == axis:
                sent[item.kind] += item.sent
        return dict(sent)


@dataclasses.dataclass(frozen=True)
class StepWork:
    """The work of one step of a stage, of all devices together.

    Attributes:
        needed: the work that the mathematics requires; MFU is based on it.
        executed: the work that the step executes, including recomputation.
    """

    needed: Work
    executed: Work

    @property
    def recomputes(self) -> bool:
        """Return whether the backward pass recomputes part of the forward pass."""
        return self.executed.total > 1.01 * self.needed.total

    def on_device(self, mesh: MeshSizes) -> dict[str, float]:
        """Return kind of product → FLOPs that one device executes, by the shardings of weights."""
        done: dict[str, float] = {}
        for kind, total in self.executed.flops.items():
            repeated = self.needed.repeated.get(kind, 0.0)
            unsplit = self.needed.unsplit.get(kind, 0.0)
            split = max(total - repeated - unsplit, 0.0)
            done[kind] = (repeated + (unsplit + split / mesh.tensor) / mesh.context) / mesh.batch
        return done

    def traffic_on_device(self, mesh: MeshSizes) -> float:
        """Return the bytes that products of one device read and write."""
        done = sum(self.on_device(mesh).values())
        return self.needed.traffic * done / max(self.needed.total, 1.0)


def virtual(count: int) -> Sequence[Any]:
    """Return virtual CPU devices; call it before JAX uses any device, or UserError is raised."""
    try:
        jax.config.update("jax_platforms", "cpu")
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        pass  # JAX already uses devices; they may suffice
    devices = jax.devices("cpu")
    if len(devices) < count:
        raise UserError(
            f"A plan for {count} devices needs a process in which JAX has not been used, but here "
            f"it uses {len(devices)} already: run `python train.py … --plan`."
        )
    return devices[:count]


def work_of(config: Config, stage: Stage, traced: jax.stages.Traced, chip: Chip | None) -> StepWork:
    """Count the work of a stage's step, traced by ``trace``, on a chip (None: a CPU)."""
    config = as_on_chips(config)
    clip = abstract.clip(config, stage.settings(config).batch, features=stage.memory)
    given = stage.extra_weights(config.model, config.train) if stage.extra_weights else None
    return StepWork(
        needed=flops.of_stage(config, stage, clip, given),
        executed=flops.executed(traced.jaxpr, chip.platform if chip else "cpu"),
    )


def trace(config: Config, stage: Stage, devices: Sequence[Any]) -> jax.stages.Traced:
    """Trace a stage's real step from shapes alone."""
    config, mesh = as_on_chips(config), sharding.make_mesh(devices, config.train.mesh)
    clip = abstract.clip(config, stage.settings(config).batch, features=stage.memory)
    return step.trace_step(config, stage, mesh, clip, step.load_extra_weights(config, stage, mesh))


def compile_traced(traced: jax.stages.Traced, mesh: Mesh | MeshSizes) -> Compiled:
    """Compile a step that ``trace`` traced for a mesh, or its sizes, and measure the program."""
    began = time.monotonic()
    compiled = traced.lower().compile(compiler_options=QUICK)
    text = compiled.as_text()
    if text is None:
        raise UserError("This JAX does not return the text of a program; use 0.10 or newer.")
    arguments, temporary = device_memory(compiled)
    return Compiled(
        program=program.read(text),
        arguments=arguments,
        temporary=temporary,
        mesh=MeshSizes(**{name: mesh.shape[name] for name in AXES})
        if isinstance(mesh, Mesh)
        else mesh,
        seconds=time.monotonic() - began,
    )


def device_memory(compiled: Any) -> tuple[float, float]:
    """Return the bytes that a compiled program needs on one device: arguments, temporary memory."""
    memory = compiled.memory_analysis()
    if memory is None:
        raise UserError("This JAX does not report a program's memory; use 0.10 or newer.")
    outputs = memory.output_size_in_bytes - memory.alias_size_in_bytes
    return float(memory.argument_size_in_bytes), float(memory.temp_size_in_bytes + outputs)


def as_on_chips(config: Config) -> Config:
    """Select the VAE's convolution implementation that accelerators use."""
    codec: Any = getattr(config.model, "codec", None)  # a policy has none
    if getattr(codec, "convolution", "") != "auto":
        return config
    return config.with_model(codec=dataclasses.replace(codec, convolution="volume"))


def in_bfloat16(config: Config, values: Mapping[str, float]) -> dict[str, float]:
    """Return the bytes a chip sends, given a CPU's, which widens bfloat16 to float32."""
    factor = 0.5 if config.model.dtype == "bfloat16" else 1.0
    return {kind: factor * value for kind, value in values.items()}
