"""Plan a training run on absent hardware: ``pewm-jax plan PRESET``.

The real step is traced and compiled from shapes alone: no data is read, no weights are created, no
folder is written. ``--compiler target`` uses the chip's own compiler (``target_compiler``); with
``--fit`` it searches for settings (``fit``), with ``--inference`` it compiles what a trained model
runs (``inference``).
``--compiler cpu`` compiles for the requested number of virtual CPU devices: ``measure`` determines
the computation, memory and communication of the step, ``suggest`` predicts time and memory on the
chip. A network without scanned blocks gives a program so large that compiling it takes too long for
a plan; then temporary memory is unknown.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from pewm_jax import __version__
from pewm_jax.config import Config, Launch, UserError
from pewm_jax.io import atomic, tree
from pewm_jax.io.progress import duration
from pewm_jax.plan import fit, inference, measure, suggest, target_compiler, topology
from pewm_jax.plan.measure import Compiled, MeshSizes, virtual
from pewm_jax.plan.program import COLLECTIVES
from pewm_jax.plan.suggest import Arrangement
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train import chips, runs, sharding
from pewm_jax.train.chips import Chip
from pewm_jax.worlds.stages import Stage

MOST_ARRAYS = 1000
"""Number of trained parameter arrays above which `--compiled auto` does not compile. Each array has
its own operations in the forward pass, the backward pass and the optimizer: with Stable Video
Diffusion's 1,432 arrays, XLA handles 216,000 operations, and many of its passes take seconds
each."""
MEMORY = (
    ("trained weights, float32", "trained"),
    ("frozen weights", "frozen"),
    ("moving average", "average"),
    ("optimizer state", "moments"),
    ("batch", "batch"),
    ("gradients", "gradients"),
    ("activations and other temporary memory", "temporary"),
)
"""Label and ``Memory`` field of each line in the memory table."""
COMPILED_MEMORY = (
    ("state and batch", "argument_bytes"),
    ("temporary memory", "temporary_bytes"),
    ("results", "output_bytes"),
    ("of these in the memory of the state", "alias_bytes"),
    ("peak", "peak_bytes"),
)
"""Label and ``StageReport`` field of each line in the memory table of a chip's compiler."""
ESTIMATED = (
    "Estimated from formulas and a program for CPUs; mfu is that of the predicted step. The chip's "
    "own compiler may need a third less memory: --compiler target asks it."
)
"""What is uncertain about the numbers of a plan without the chip's compiler."""


@dataclasses.dataclass(frozen=True)
class StagePlan:
    """One stage on one kind of device.

    Attributes:
        config: the experiment.
        stage: the stage.
        chip: the kind of device.
        choice: the requested arrangement.
        compiled: the compiler's report; None if the step was not compiled.
        best: the best arrangements.
    """

    config: Config
    stage: Stage
    chip: Chip
    choice: Arrangement
    compiled: Compiled | None
    best: tuple[Arrangement, ...]


def show(
    config: Config, launch: Launch, log: Callable[[str], None] = print
) -> list[StagePlan | StageReport]:
    """Plan all stages that have steps, print the plans and write them to ``launch.json``, if set.

    Args:
        config: the experiment.
        launch: number and kind of devices, and the compiler.
        log: prints a line.

    Returns:
        A ``StageReport`` of each stage with the chip's compiler, otherwise a ``StagePlan``.

    Raises:
        ConfigError: the chip is unknown, or the mesh does not fit the devices or the batch.
        UserError: the file cannot be written; JAX already uses devices, but too few; or the chip's
            compiler is not installed, or fails.
    """
    file = Path(launch.json) if launch.json else None
    if file is not None:
        _require_writable(file)
    chip, on_target = chips.named(launch.chip), launch.compiler == "target"
    topology.require_slices(chip, launch.slices)
    if on_target:
        topology.require_compiler(chip)
    if launch.inference:
        found = _plan_inference(config, chip, launch.quantize, log)
    else:
        found = _plan_training(config, chip, launch, log)
    plans: list[StagePlan | StageReport] = []
    for plan, printed in found:
        plans.append(plan)
        for line in printed:
            log(line)
        if file is not None:
            _write(file, plans)
    return plans


def _plan_training(config: Config, chip: Chip, launch: Launch, log: Any) -> Iterator[Any]:
    """Yield each stage's plan, and its lines."""
    sizes = MeshSizes(*config.train.mesh.shape(launch.devices))
    planned = runs.planned(config)
    if not launch.fit:
        for stage in planned:
            sharding.require_divisible(config, stage, sizes.abstract)
    if launch.compiler == "cpu":
        virtual(launch.devices)
    for stage in planned:
        if launch.fit:
            yield _fit_on_target(config, stage, chip, launch, log)
        elif launch.compiler == "target":
            yield _plan_on_target(config, stage, sizes, chip, launch, log)
        else:
            yield _plan_on_cpu(config, stage, sizes, chip, launch, log)


def _plan_inference(
    config: Config, chip: Chip, quantize: str, log: Any
) -> Iterator[tuple[StageReport, Iterator[str]]]:
    """Yield what a chip's compiler says about each program of inference, and its lines."""
    for name in inference.names(config):
        title = inference.title(config, name, quantize)
        log(f"{title}: compiling it for one {chip.name} …")
        report = target_compiler.compile_inference(config, name, chip, quantize)
        yield report, report_lines(report, title)


def _fit_on_target(
    config: Config, stage: Stage, chip: Chip, launch: Launch, log: Any
) -> tuple[StageReport, Iterator[str]]:
    """Return the best settings of a stage that fit, according to a chip's compiler."""
    found = fit.search(config, stage, chip, launch.devices, launch.tries, log, launch.slices)
    best = found.best.report
    assert best is not None
    best = dataclasses.replace(best, tries=[one.summary for one in found.tries])
    printed = report_lines(best, stage.title, stage.settings(config).batch)
    return best, itertools.chain(printed, fit.lines(found))


def _require_writable(file: Path) -> None:
    """Raise an error before hours of compilation if a file cannot be written."""
    try:
        if file.is_dir():
            raise UserError(f"--json {file} is a folder: choose the name of a file.")
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        raise UserError(
            f"--json {file} cannot be written ({error.strerror}): choose another file."
        ) from None


def _write(file: Path, plans: Sequence[StagePlan | StageReport]) -> None:
    """Write plans as JSON, atomically."""
    reports = (estimate(plan) if isinstance(plan, StagePlan) else plan for plan in plans)
    values = {"version": __version__, "stages": [dataclasses.asdict(one) for one in reports]}
    atomic.write_text(file, json.dumps(values, indent=2) + "\n")


def _plan_on_target(
    config: Config, stage: Stage, sizes: MeshSizes, chip: Chip, launch: Launch, log: Any
) -> tuple[StageReport, Iterator[str]]:
    """Return what a chip's compiler says about a stage, and its lines."""
    log(f"{stage.title}: compiling the real step for {sizes.devices} × {chip.name} …")
    if config.train.lora.rank:
        log(f"{stage.title}: {adapters(config, stage)}")
    report = target_compiler.compile_stage(config, stage.name, chip, launch.devices, launch.slices)
    return report, report_lines(report, stage.title, stage.settings(config).batch)


def _plan_on_cpu(
    config: Config, stage: Stage, sizes: MeshSizes, chip: Chip, launch: Launch, log: Any
) -> tuple[StagePlan, Iterator[str]]:
    """Return the plan of a stage from formulas and a program for CPUs, and its lines."""
    wanted = _should_compile(config, stage, launch)
    if wanted:
        log(f"{stage.title}: compiling the real step for {sizes.devices} devices …")
    plan = plan_stage(config, stage, sizes, chip, compiles=wanted)
    if plan.compiled is not None:
        log(f"{stage.title}: compiled in {plan.compiled.seconds:.0f} s")
    else:
        log(f"{stage.title}: not compiled, so temporary memory is unknown ({_why(launch)})")
    return plan, lines(plan)


def plan_stage(
    config: Config, stage: Stage, sizes: MeshSizes, chip: Chip, *, compiles: bool = True
) -> StagePlan:
    """Plan one stage on the requested mesh.

    ``compiles``: whether to compile the step, for temporary memory and communication.
    """
    traced = measure.trace(config, stage, virtual(sizes.devices))
    compiled = measure.compile_traced(traced, sizes) if compiles else None
    work = measure.work_of(config, stage, traced, chip)
    job = suggest.Job(config, stage, chip, work, compiled)
    best = job.rank(sizes.devices, sizes.context)[:3]
    return StagePlan(config, stage, chip, job.assess(sizes), compiled, tuple(best))


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
        argument_bytes=memory.state,
        temporary_bytes=memory.peak - memory.state if known else None,
        peak_bytes=memory.peak if known else None,
        capacity_bytes=plan.chip.memory,
        fits=choice.fits,
        flops_needed=time.needed_flops / count,
        flops_executed=time.executed_flops,
        collectives=target_compiler.sent_by_axes(time.sent),
        mfu=time.mfu,
        compile_s=compiled.seconds if compiled else 0.0,
        notes=[ESTIMATED],
    )


def _should_compile(config: Config, stage: Stage, launch: Launch) -> bool:
    """Return whether to compile a stage's step."""
    if launch.compiled != "auto":
        return launch.compiled == "on"
    params = suggest.abstract_state(config, stage).params
    return len(jax.tree.leaves(tree.select(params, stage.trained))) <= MOST_ARRAYS


def _why(launch: Launch) -> str:
    """Return the reason why a step is not compiled."""
    if launch.compiled == "off":
        return "--compiled off"
    return (
        f"it trains more than {MOST_ARRAYS} arrays, so compilation is slow; --compiled on forces it"
    )


def lines(plan: StagePlan) -> Iterator[str]:
    """Yield the lines of a stage's plan, for the terminal."""
    choice, compiled, time = plan.choice, plan.compiled, plan.choice.time
    clips = plan.stage.settings(plan.config).batch
    yield ""
    yield (
        f"{plan.stage.title.capitalize()} on {choice.mesh.devices} × {plan.chip.name}: "
        f"{arranged(choice.mesh.sizes)}; {clips} clips per step, "
        f"{clips / choice.mesh.batch:g} per device"
    )
    if plan.config.train.lora.rank:
        yield f"  {adapters(plan.config, plan.stage)}"
    yield "  memory of a device"
    for label, name in MEMORY:
        value = getattr(choice.memory, name)
        yield f"    {label:<42}{'unknown' if value is None else size(value):>10}"
    peak = "peak" if compiled else "peak, without temporary memory"
    yield f"    {peak:<42}{size(choice.memory.peak):>10}"
    if compiled is not None:
        yield (
            f"    the program compiled for a CPU, which widens bfloat16 to float32: "
            f"{size(compiled.arguments)} of state and batch + {size(compiled.temporary)} = "
            f"{size(compiled.peak)}"
        )
    verdict = "fits" if choice.fits else "does not fit"
    yield (
        f"    {verdict}: {size(choice.memory.peak)} of {size(plan.chip.memory)}, of which "
        f"{suggest.MARGIN:.0%} may be filled ({size(suggest.MARGIN * plan.chip.memory)})"
    )
    yield "  work of a step"
    yield f"    {'needed, all devices':<42}{flop(time.needed_flops):>12}"
    done = f"    {'executed by a device, with recomputation':<42}{flop(time.executed_flops):>12}"
    yield done if compiled is None else f"{done} (compiled program: {flop(compiled.program.flops)})"
    sent = "  sent by a device in a step"
    yield sent if compiled is None else f"{sent} (compiled program, in 32 bits)"
    for kind in COLLECTIVES:
        expected = time.sent_of(kind)
        counted = 0.0 if compiled is None else compiled.program.sent(kind)
        if expected or counted:
            beside = "" if compiled is None else f" ({size(counted)})"
            yield f"    {kind:<42}{size(expected):>10}{beside}"
    yield "  predicted"
    yield (
        f"    a step {duration(time.step_s)}: products {duration(time.products_s)}, reading and "
        f"writing {duration(time.streaming_s)}, waiting for other devices "
        f"{duration(time.waiting_s)}"
    )
    yield f"    MFU {time.mfu:.1%}, {rate(time.clips_per_s)} clips/s"
    yield "  best arrangements"
    for best in plan.best:
        fits = "fits" if best.fits else "does not fit"
        yield (
            f"    {duration(best.time.step_s)}/step, {size(best.memory.peak)}, {fits}: {best.flags}"
        )
    yield f"  {ESTIMATED}"


def adapters(config: Config, stage: Stage) -> str:
    """Return a sentence about the parameters that a stage with adapters trains."""
    c = suggest.counts(config, stage)
    total = sum(part.count for part in c.values())
    return (
        f"adapters of rank {config.train.lora.rank}: {c['trained'].count:,} of {total:,} "
        "parameters are trained and have an optimizer state"
    )


def report_lines(report: StageReport, title: str, clips: int = 0) -> Iterator[str]:
    """Yield the lines of a chip's compiler's report, for the terminal.

    ``clips`` is the number of clips of a training step, 0 for a program of inference.
    """
    yield ""
    on = f"{title[0].upper()}{title[1:]} on {report.devices} × {report.chip}"
    yield f"{on}: {arranged(report.mesh)}; {clips} clips a step" if clips else on
    compiler = report.compiler
    yield (
        f"  compiled by {compiler['name']} {compiler['version']} in {duration(report.compile_s)}, "
        f"after {duration(report.trace_s)} of tracing"
    )
    yield "  memory of a device"
    for label, name in COMPILED_MEMORY:
        value = getattr(report, name)
        yield f"    {label:<42}{'unknown' if value is None else gib(value):>12}"
    needed = gib(report.peak_bytes) if report.peak_bytes is not None else "more"
    verdict = "fits" if report.fits else "does not fit"
    yield f"    {verdict}: {needed} of {gib(report.capacity_bytes)}"
    if report.fits_gb:
        fit_text = (f"{card} GB {'yes' if ok else 'no'}" for card, ok in report.fits_gb.items())
        yield f"    fits a card of: {', '.join(fit_text)}"
    if report.refusal:
        yield f"    the compiler refused it: {report.refusal}"
    yield "  work of a device in a step" if clips else "  work"
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
        rates = f", {rate(clips / report.roofline_s)} clips/s" if clips else ""
        yield (
            f"  at best {duration(report.roofline_s)}{' a step' if clips else ''}, bound by "
            f"{report.bound}: MFU {report.mfu:.1%}{rates}"
        )
    for note in report.notes:
        yield f"  {note}"


def arranged(sizes: Mapping[str, int]) -> str:
    """Format the sizes of a mesh: ``data 8 × fsdp 8 × tensor 1 × context 1``."""
    return " × ".join(f"{name} {count}" for name, count in sizes.items())


def size(count: float) -> str:
    """Format a number of bytes."""
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{_short(count / factor)} {unit}"
    return f"{count:.0f} B"


def flop(count: float) -> str:
    """Format a number of FLOPs."""
    for unit, factor in (("EFLOP", 1e18), ("PFLOP", 1e15), ("TFLOP", 1e12), ("GFLOP", 1e9)):
        if count >= factor:
            return f"{_short(count / factor)} {unit}"
    return f"{_short(count / 1e6)} MFLOP"


def rate(count: float) -> str:
    """Format a rate with three digits and no exponent."""
    return f"{count:,.0f}" if count >= 1000 else f"{count:.3g}"


def _short(value: float) -> str:
    """Format a number with three digits, or with all digits before the point."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def gib(count: float) -> str:
    """Format a number of bytes in GiB or MiB."""
    if count >= 2**30:
        return f"{count / 2**30:.2f} GiB"
    return f"{count / 2**20:.2f} MiB"
