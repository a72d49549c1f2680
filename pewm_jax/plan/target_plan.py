"""Plan a training with the chip's own compiler: ``pewm-jax plan PRESET --compiler target``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from pewm_jax import __version__
from pewm_jax.config import Config, Launch
from pewm_jax.io import atomic
from pewm_jax.plan import target_compiler, topology
from pewm_jax.plan.measure import MeshSizes
from pewm_jax.plan.plan import StagePlan, flop, rate, size
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train import chips, sharding, stages
from pewm_jax.train.log import duration

MEMORY = (
    ("state and batch", "argument_bytes"),
    ("temporary memory", "temporary_bytes"),
    ("results", "output_bytes"),
    ("of these in the memory of the state", "alias_bytes"),
    ("peak", "peak_bytes"),
)
"""Label and ``StageReport`` field of each line in the table of memory."""
ESTIMATED = "Estimated from formulas and a program for CPUs; mfu is that of the predicted step."
"""What is uncertain about the numbers of a plan without the chip's compiler."""


def show(config: Config, launch: Launch, log: Callable[[str], None] = print) -> list[StageReport]:
    """Compile all stages that have steps for a chip, and print what its compiler decided.

    Args:
        config: the experiment.
        launch: number and kind of devices; ``json`` names a file for the numbers.
        log: prints a line.

    Raises:
        ConfigError: the chip is not known, or the devices cannot form the mesh or share the batch.
        UserError: the chip's compiler is not installed, or fails.
    """
    chip = chips.named(launch.chip)
    topology.require_compiler(chip)
    sizes = MeshSizes(*config.train.mesh.shape(launch.devices))
    planned = stages.planned(config)
    for stage in planned:
        sharding.require_divisible(config, stage, sizes.abstract)
    reports = []
    for stage in planned:
        log(f"{stage.title}: compiling the real step for {launch.devices} × {chip.name} …")
        report = target_compiler.compile_stage(config, stage.name, chip, launch.devices)
        reports.append(report)
        for line in lines(report, stage.title, stage.settings(config).batch):
            log(line)
        if launch.json:
            write(Path(launch.json), reports)
    return reports


def write(path: Path, reports: list[StageReport]) -> None:
    """Write reports as JSON, atomically."""
    values: dict[str, Any] = {
        "version": __version__,
        "stages": [dataclasses.asdict(report) for report in reports],
    }
    atomic.write_text(path, json.dumps(values, indent=2) + "\n")


def estimate(plan: StagePlan) -> StageReport:
    """Return the numbers of a stage that was not compiled for its chip, as a report."""
    choice, compiled = plan.choice, plan.compiled
    memory, time, count = choice.memory, choice.time, choice.mesh.devices
    known = memory.temporary is not None
    return StageReport(
        name=plan.stage.name,
        chip=plan.chip.name,
        devices=count,
        mesh=choice.mesh.sizes,
        compiler={"name": "XLA for CPUs", "version": jax.__version__},
        options={},
        argument_bytes=memory.state,
        temporary_bytes=memory.peak - memory.state if known else None,
        output_bytes=None,
        alias_bytes=None,
        peak_bytes=memory.peak if known else None,
        capacity_bytes=plan.chip.memory,
        fits=choice.fits,
        refusal="",
        flops_needed=time.needed_flops / count,
        flops_executed=time.executed_flops,
        bytes=None,
        kernels={},
        collectives=[
            {"kind": kind, "axis": axis, "bytes": sent} for (kind, axis), sent in time.sent.items()
        ],
        roofline_s=None,
        bound="",
        mfu=time.mfu,
        trace_s=0.0,
        compile_s=compiled.seconds if compiled else 0.0,
        notes=[ESTIMATED],
    )


def lines(report: StageReport, title: str, clips: int) -> Iterator[str]:
    """Yield the lines of a stage's report, for the terminal."""
    mesh = " × ".join(f"{name} {count}" for name, count in report.mesh.items())
    yield ""
    yield f"{title.capitalize()} on {report.devices} × {report.chip}: {mesh}; {clips} clips a step"
    compiler = report.compiler
    yield (
        f"  compiled by {compiler['name']} {compiler['version']} in {duration(report.compile_s)}, "
        f"after {duration(report.trace_s)} of tracing"
    )
    yield "  memory of a device"
    for label, name in MEMORY:
        value = getattr(report, name)
        yield f"    {label:<42}{'unknown' if value is None else gib(value):>12}"
    needed = gib(report.peak_bytes) if report.peak_bytes is not None else "more"
    verdict = "fits" if report.fits else "does not fit"
    yield f"    {verdict}: {needed} of {gib(report.capacity_bytes)}"
    if report.refusal:
        yield f"    the compiler refused it: {report.refusal}"
    yield "  work of a device in a step"
    yield f"    {'needed':<42}{flop(report.flops_needed):>12}"
    yield f"    {'executed, with recomputation and padding':<42}{flop(report.flops_executed):>12}"
    if report.bytes is not None:
        yield f"    {'read from and written to memory':<42}{size(report.bytes):>12}"
    for kind, kernels in report.kernels.items():
        named = ", ".join(f"{name} × {count:,}" for name, count in kernels.items())
        yield f"    {kind} kernels: {named}"
    for item in report.collectives:
        label = f"{item['kind']} along {item['axis']}, sent"
        yield f"    {label:<42}{size(item['bytes']):>12}"
    if report.roofline_s is not None and report.mfu is not None:
        yield (
            f"  at best {duration(report.roofline_s)} a step, bound by {report.bound}: MFU "
            f"{report.mfu:.1%}, {rate(clips / report.roofline_s)} clips/s"
        )
    for note in report.notes:
        yield f"  {note}"


def gib(count: float) -> str:
    """Format a number of bytes in GiB or MiB."""
    if count >= 2**30:
        return f"{count / 2**30:.2f} GiB"
    return f"{count / 2**20:.2f} MiB"
