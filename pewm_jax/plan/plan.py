"""Plan a training run on absent hardware: ``python train.py PRESET --plan``.

The real step is traced and compiled for the requested number of virtual CPU devices, from shapes
alone: no data is read, no weights are created, no folder is written. ``measure`` determines the
computation, memory and communication of the step, ``suggest`` predicts time and memory on the chip.
A network without scanned blocks gives a program so large that compiling it takes too long for a
plan; then temporary memory is unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import jax

from pewm_jax.config import Config, Launch
from pewm_jax.io import tree
from pewm_jax.plan import hlo, measure, suggest
from pewm_jax.plan.measure import Compiled, MeshSizes, virtual
from pewm_jax.plan.suggest import Arrangement
from pewm_jax.train import chips, sharding, stages
from pewm_jax.train.chips import Chip
from pewm_jax.train.log import duration
from pewm_jax.train.stages import Stage

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


@dataclasses.dataclass(frozen=True)
class StagePlan:
    """One stage on one kind of device.

    Attributes:
        config: the experiment.
        stage: the stage.
        chip: the kind of device.
        choice: the requested arrangement, with its memory and time.
        compiled: the compiler's report; None if the step was not compiled.
        best: the best arrangements.
    """

    config: Config
    stage: Stage
    chip: Chip
    choice: Arrangement
    compiled: Compiled | None
    best: tuple[Arrangement, ...]


def show(config: Config, launch: Launch, log: Callable[[str], None] = print) -> list[StagePlan]:
    """Plan all stages that have steps, and print the plans.

    Args:
        config: the experiment.
        launch: number and kind of devices.
        log: prints a line.

    Raises:
        ConfigError: the chip is unknown, or the mesh does not fit the devices or the batch.
        UserError: JAX already uses devices, but too few.
    """
    chip = chips.named(launch.chip)
    sizes = MeshSizes(*config.train.mesh.shape(launch.devices))
    planned = stages.planned(config)
    for stage in planned:
        sharding.require_divisible(config, stage, sizes.abstract)
    virtual(launch.devices)
    plans = []
    for stage in planned:
        wanted = _should_compile(config, stage, launch)
        if wanted:
            log(f"{stage.title}: compiling the real step for {launch.devices} devices …")
        plan = plan_stage(config, stage, sizes, chip, compiles=wanted)
        if plan.compiled is not None:
            log(f"{stage.title}: compiled in {plan.compiled.seconds:.0f} s")
        else:
            log(f"{stage.title}: not compiled, so temporary memory is unknown ({_why(launch)})")
        plans.append(plan)
        for line in lines(plan):
            log(line)
    return plans


def plan_stage(
    config: Config, stage: Stage, sizes: MeshSizes, chip: Chip, *, compiles: bool = True
) -> StagePlan:
    """Plan one stage.

    Args:
        config: the experiment.
        stage: the stage.
        sizes: the requested mesh.
        chip: the kind of device.
        compiles: whether to compile the step, for temporary memory and communication.
    """
    traced = measure.trace(config, stage, virtual(sizes.devices))
    compiled = measure.compile_traced(traced, sizes) if compiles else None
    work = measure.work_of(config, stage, traced, chip)
    choice = suggest.assess(config, stage, sizes, chip, work, compiled)
    best = suggest.rank(config, stage, sizes, chip, work, compiled)[:3]
    return StagePlan(config, stage, chip, choice, compiled, tuple(best))


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
        f"{arranged(choice)}; {clips} clips per step, {clips / choice.mesh.batch:g} per device"
    )
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
    for kind in hlo.KINDS:
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


def arranged(choice: Arrangement) -> str:
    """Format an arrangement: ``data 8 × fsdp 8 × tensor 1 × context 1``."""
    return " × ".join(f"{name} {count}" for name, count in choice.mesh.sizes.items())


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
