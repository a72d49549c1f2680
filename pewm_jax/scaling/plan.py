"""What a training would take on hardware that is not here: ``python train.py PRESET --plan``.

The real step is compiled ahead of time for as many virtual CPU devices as are asked for, from
shapes alone: no data is read, no weight is made, no folder written. The compiled program says what
is done and sent; the sums on paper (``costs``, ``footprint``, ``predict``), which it confirms, say
what that is on the chip.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax

from pewm_jax.config import Config, Launch, ModelConfig, UserError, VAEConfig, kinds
from pewm_jax.data import abstract
from pewm_jax.scaling import hlo, plan_text, suggest
from pewm_jax.scaling.footprint import Arranged, footprint
from pewm_jax.scaling.stage_plan import Compiled, Plan
from pewm_jax.training import chips, sharding, stages, step
from pewm_jax.training.stages import Stage

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""What is never run need not be fast: only the machine code differs, not what is planned."""


def show(config: Config, launch: Launch, say: Callable[[str], None] = print) -> list[Plan]:
    """Plan all stages that have steps, and print the plans.

    Args:
        config: the experiment.
        launch: how many devices, and of what kind.
        say: prints a line.

    Raises:
        ConfigError: the chip is not known, or the devices cannot be arranged or share a batch so.
        UserError: devices were in use before and are too few, or the world is not PEWM's.
    """
    if not isinstance(config.model, ModelConfig):
        raise UserError(
            f"A plan is made of worlds of kind pewm, and this is of kind "
            f"{kinds.of(config.model).name}: train it where it is to be trained."
        )
    chip = chips.named(launch.chip)
    arranged = Arranged(*config.train.mesh.shape(launch.devices))
    planned = stages.planned(config)
    for stage in planned:
        sharding.require_divisible(config, stage, _abstract(arranged))
    devices = virtual(launch.devices)
    plans = []
    for stage in planned:
        say(f"{stage.title}: compiling the real step for {launch.devices} devices …")
        compiled = compile_stage(config, stage, devices)
        say(f"{stage.title}: compiled in {compiled.seconds:.0f} s")
        best = suggest.rank(config, stage, launch.devices, chip)[:3]
        choice = suggest.weigh(config, stage, arranged, chip)
        plans.append(Plan(config, stage, chip, choice, compiled, tuple(best)))
        for line in plan_text.lines(plans[-1]):
            say(line)
    return plans


def virtual(count: int) -> Sequence[Any]:
    """Return so many CPU devices that there are not; before any device is used.

    Raises:
        UserError: devices are in use already, and too few.
    """
    try:
        jax.config.update("jax_platforms", "cpu")
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        pass  # in use already: they may be enough
    devices = jax.devices("cpu")
    if len(devices) < count:
        raise UserError(
            f"A plan for {count} devices needs a process of its own, in which JAX has not used its "
            f"{len(devices)} yet: run `python train.py … --plan`."
        )
    return devices[:count]


def compile_stage(config: Config, stage: Stage, devices: Sequence[Any]) -> Compiled:
    """Compile a stage's real step from shapes alone, and read what it does."""
    began = time.monotonic()
    mesh = sharding.make_mesh(devices, config.train.mesh)
    as_there = _as_on_chips(config)
    lowered = step.lower_step(
        as_there,
        stage,
        mesh,
        abstract.clip(config, stage.settings(config).batch, features=stage.memory),
    )
    compiled = lowered.compile(compiler_options=QUICK)
    memory, text = compiled.memory_analysis(), compiled.as_text()
    if memory is None or text is None:
        raise UserError("This JAX does not say what a compiled program needs; use 0.10 or newer.")
    kept = memory.output_size_in_bytes - memory.alias_size_in_bytes
    return Compiled(
        program=hlo.read(text),
        arguments=float(memory.argument_size_in_bytes),
        temporary=float(memory.temp_size_in_bytes + kept),
        expected=footprint(config, stage, Arranged.of(mesh), wide=4, flash=False),
        seconds=time.monotonic() - began,
    )


def _as_on_chips(config: Config) -> Config:
    """Have the VAE's convolutions as accelerators run them, not in a CPU's form."""
    codec = config.model.codec
    if not isinstance(codec, VAEConfig) or codec.convolution != "auto":
        return config
    return config.with_model(codec=dataclasses.replace(codec, convolution="volume"))


def _abstract(arranged: Arranged) -> Any:
    """Return a mesh without devices."""
    return jax.sharding.AbstractMesh(tuple(arranged.sizes.values()), tuple(arranged.sizes))
