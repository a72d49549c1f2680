"""What a stage's step computes, needs and sends, measured without its devices.

The real step is traced and compiled ahead of time for virtual CPU devices, from shapes alone. The
jaxprs tell the FLOPs (``train.flops``). The compiled program tells memory and communication.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AbstractMesh, Mesh

from pewm_jax.config import AXES, Config, UserError
from pewm_jax.data import abstract
from pewm_jax.plan import hlo
from pewm_jax.train import flops, sharding, step
from pewm_jax.train.chips import Chip
from pewm_jax.train.flops import Work
from pewm_jax.train.stages import Stage

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Compiler options that save time. They affect only machine code, which is never run."""


@dataclasses.dataclass(frozen=True)
class MeshSizes:
    """The number of devices along each mesh axis."""

    data: int = 1
    fsdp: int = 1
    tensor: int = 1
    context: int = 1

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

    @property
    def abstract(self) -> AbstractMesh:
        """A mesh without devices."""
        return AbstractMesh(tuple(self.sizes.values()), tuple(self.sizes))


@dataclasses.dataclass(frozen=True)
class Compiled:
    """What the compiler reports about a step on virtual CPU devices; all bytes are of one device.

    Attributes:
        program: its products and communication.
        arguments: bytes of state and batch.
        temporary: bytes of temporary memory and new outputs.
        mesh: the devices that it was compiled for.
        seconds: time of compilation.
    """

    program: hlo.Program
    arguments: float
    temporary: float
    mesh: MeshSizes
    seconds: float

    @property
    def peak(self) -> float:
        """Peak memory in bytes."""
        return self.arguments + self.temporary

    def sent_along(self, axis: str) -> dict[str, float]:
        """Return kind → bytes that a device sends to devices that differ only along this axis."""
        places = np.arange(self.mesh.devices).reshape(tuple(self.mesh.sizes.values()))
        lines = np.moveaxis(places, AXES.index(axis), -1).reshape(-1, self.mesh.sizes[axis])
        groups = {tuple(sorted(line)) for line in lines.tolist()}
        sent: dict[str, float] = {}
        for item in self.program.collectives:
            if len(item.group) > 1 and tuple(sorted(item.group)) in groups:
                sent[item.kind] = sent.get(item.kind, 0.0) + item.sent
        return sent


@dataclasses.dataclass(frozen=True)
class StepWork:
    """The work of one step of a stage, of all devices together.

    Attributes:
        needed: what the mathematics needs; MFU is based on it.
        executed: what the step executes, with what it recomputes.
    """

    needed: Work
    executed: Work

    @property
    def recomputes(self) -> bool:
        """Whether the backward pass recomputes part of the forward pass."""
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
    """Return virtual CPU devices; call it before JAX uses any device.

    Raises:
        UserError: JAX already uses devices, and too few.
    """
    try:
        jax.config.update("jax_platforms", "cpu")
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        pass  # JAX already uses devices; they may suffice
    devices = jax.devices("cpu")
    if len(devices) < count:
        raise UserError(
            f"A plan for {count} devices needs a process of its own, in which JAX has not used its "
            f"{len(devices)} yet: run `python train.py … --plan`."
        )
    return devices[:count]


def work_of(config: Config, stage: Stage, traced: jax.stages.Traced, chip: Chip | None) -> StepWork:
    """Count the work of a stage's step.

    Args:
        config: the experiment.
        stage: the stage.
        traced: from ``trace``.
        chip: where it is to run; None for a CPU.
    """
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
    """Compile a traced step, and measure the program.

    Args:
        traced: from ``trace``.
        mesh: the sizes of the mesh that it was traced for.
    """
    began = time.monotonic()
    compiled = traced.lower().compile(compiler_options=QUICK)
    text = compiled.as_text()
    if text is None:
        raise UserError("This JAX does not return the text of a program; use 0.10 or newer.")
    arguments, temporary = device_memory(compiled)
    return Compiled(
        program=hlo.read(text),
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
        raise UserError("This JAX does not say what a compiled program needs; use 0.10 or newer.")
    outputs = memory.output_size_in_bytes - memory.alias_size_in_bytes
    return float(memory.argument_size_in_bytes), float(memory.temp_size_in_bytes + outputs)


def as_on_chips(config: Config) -> Config:
    """Choose the form of the VAE's convolutions that accelerators use."""
    codec: Any = getattr(config.model, "codec", None)  # a policy has none
    if getattr(codec, "convolution", "") != "auto":
        return config
    return config.with_model(codec=dataclasses.replace(codec, convolution="volume"))


def in_bfloat16(config: Config, values: Mapping[str, float]) -> dict[str, float]:
    """Return what a chip sends where a CPU, which widens bfloat16 to float32, sends ``values``."""
    factor = 0.5 if config.model.dtype == "bfloat16" else 1.0
    return {kind: factor * value for kind, value in values.items()}
