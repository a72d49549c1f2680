"""Plan a training for hardware that is not present: ``python train.py PRESET --plan``.

The real step is compiled ahead of time for the requested number of virtual CPU devices, from shapes
alone: no data is read, no weights are created, no folder is written. The compiled program tells how
much is computed and communicated. The formulas (``costs``, ``footprint``, ``predict``), which it
confirms, tell what this means on the chip. A network without scanned blocks makes so long a program
that compiling it takes far longer than a plan is worth; then the formulas stand alone.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax

from pewm_jax.config import Config, Launch, UserError
from pewm_jax.data import abstract
from pewm_jax.io import tree
from pewm_jax.models.cogvideox.vae_codec import VAECodec
from pewm_jax.models.wan.codec import WanVAECodec
from pewm_jax.plan import hlo, suggest
from pewm_jax.plan import text as plan_text
from pewm_jax.plan.footprint import MeshSizes, footprint
from pewm_jax.plan.stage import Compiled, Plan
from pewm_jax.train import chips, sharding, stages, step
from pewm_jax.train.stages import Stage

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Compiler options that save time. They affect only machine code, which is never run."""

MOST_ARRAYS = 1000
"""Trained arrays of parameters above which `--compiled auto` does not compile. Each has operations
of its own, forward, backward and in the optimizer: with Stable Video Diffusion's 1,432, XLA holds
216,000 of them, and many of its passes take seconds each."""


def show(config: Config, launch: Launch, say: Callable[[str], None] = print) -> list[Plan]:
    """Plan all stages that have steps, and print the plans.

    Args:
        config: the experiment.
        launch: number and kind of devices.
        say: prints a line.

    Raises:
        ConfigError: the chip is not known, or the devices cannot form the mesh or share the batch.
        UserError: JAX already uses devices, and too few.
    """
    chip = chips.named(launch.chip)
    sizes = MeshSizes(*config.train.mesh.shape(launch.devices))
    planned = stages.planned(config)
    for stage in planned:
        sharding.require_divisible(config, stage, _abstract_mesh(sizes))
    devices = virtual(launch.devices)
    plans = []
    for stage in planned:
        compiled = None
        if _wanted(config, stage, launch):
            say(f"{stage.title}: compiling the real step for {launch.devices} devices …")
            compiled = compile_stage(config, stage, devices)
            say(f"{stage.title}: compiled in {compiled.seconds:.0f} s")
        else:
            say(f"{stage.title}: not compiled, all numbers are the formulas' ({_why(launch)})")
        best = suggest.rank(config, stage, launch.devices, chip)[:3]
        choice = suggest.assess(config, stage, sizes, chip)
        plans.append(Plan(config, stage, chip, choice, compiled, tuple(best)))
        for line in plan_text.lines(plans[-1]):
            say(line)
    return plans


def _wanted(config: Config, stage: Stage, launch: Launch) -> bool:
    """Tell whether a stage's step is to be compiled."""
    if launch.compiled != "auto":
        return launch.compiled == "on"
    params = jax.eval_shape(functools.partial(stage.init, config.model), jax.random.key(0))
    return len(jax.tree.leaves(tree.select(params, stage.trained))) <= MOST_ARRAYS


def _why(launch: Launch) -> str:
    """Say why a step is not compiled."""
    if launch.compiled == "off":
        return "--compiled off"
    return (
        f"it trains more than {MOST_ARRAYS} arrays, so that takes very long; --compiled on does it"
    )


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


def compile_stage(config: Config, stage: Stage, devices: Sequence[Any]) -> Compiled:
    """Compile a stage's real step from shapes alone, and count what it does."""
    began = time.monotonic()
    mesh = sharding.make_mesh(devices, config.train.mesh)
    on_chip = _as_on_chips(config)
    lowered = step.lower_step(
        on_chip,
        stage,
        mesh,
        abstract.clip(config, stage.settings(config).batch, features=stage.memory),
    )
    compiled = lowered.compile(compiler_options=QUICK)
    memory, text = compiled.memory_analysis(), compiled.as_text()
    if memory is None or text is None:
        raise UserError("This JAX does not say what a compiled program needs; use 0.10 or newer.")
    outputs = memory.output_size_in_bytes - memory.alias_size_in_bytes
    return Compiled(
        program=hlo.read(text),
        arguments=float(memory.argument_size_in_bytes),
        temporary=float(memory.temp_size_in_bytes + outputs),
        expected=footprint(config, stage, MeshSizes.of(mesh), activation_bytes=4, flash=False),
        seconds=time.monotonic() - began,
    )


def _as_on_chips(config: Config) -> Config:
    """Choose the form of the VAE's convolutions that accelerators use."""
    codec = getattr(config.model, "codec", None)  # a policy has none
    if not isinstance(codec, VAECodec | WanVAECodec) or codec.convolution != "auto":
        return config
    return config.with_model(codec=dataclasses.replace(codec, convolution="volume"))


def _abstract_mesh(mesh: MeshSizes) -> Any:
    """Return a mesh without devices."""
    return jax.sharding.AbstractMesh(tuple(mesh.sizes.values()), tuple(mesh.sizes))
