"""A plan as text for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from pewm_jax.plan import hlo, suggest
from pewm_jax.plan.stage import Plan
from pewm_jax.plan.suggest import Arrangement
from pewm_jax.train.log import duration

MEMORY = (
    ("weights that train, float32", "trained"),
    ("frozen weights", "frozen"),
    ("moving average", "average"),
    ("Adam's moments", "moments"),
    ("batch", "batch"),
    ("gradients", "gradients"),
    ("activations kept for the backward pass", "kept"),
    ("one block's backward pass", "block"),
    ("one block's weights, gathered", "gathered"),
    ("or before all that: VAE and DINOv2", "encoders"),
)
"""Label and ``Footprint`` field of each line in the table of memory."""


def lines(plan: Plan) -> Iterator[str]:
    """Yield the lines of a stage's plan."""
    config, choice, compiled = plan.config, plan.choice, plan.compiled
    chip, time = plan.chip, choice.time
    clips = plan.stage.settings(config).batch
    yield ""
    yield (
        f"{plan.stage.title.capitalize()} on {choice.mesh.devices} × {chip.name}: "
        f"{arranged(choice)}; {clips} clips a step, {clips / choice.mesh.batch:g} a device"
    )
    yield "  memory of a device"
    for label, name in MEMORY:
        yield f"    {label:<42}{size(getattr(choice.footprint, name)):>10}"
    yield f"    {'peak, by the formula':<42}{size(choice.footprint.peak):>10}"
    if compiled is not None:
        yield (
            f"    the compiled CPU program: {size(compiled.arguments)} of state and batch + "
            f"{size(compiled.temporary)} = {size(compiled.peak)}, where the formula for a CPU, "
            f"which widens 16 bits to 32, has {size(compiled.expected.peak)}"
        )
    yield from _verdict(plan)
    yield "  work of a step"
    yield f"    {'the mathematics needs, all devices':<42}{work(time.model_flops):>12}"
    done = f"    {'done by a device, with what is recomputed':<42}{work(time.hardware_flops):>12}"
    sent = "  sent by a device in a step, by the formula"
    if compiled is None:
        yield done
        yield sent
    else:
        yield f"{done} (compiled program: {work(compiled.program.flops)})"
        yield f"{sent} (compiled program, in 32 bits)"
    for kind in hlo.KINDS:
        formula = time.sent_of(kind)
        counted = 0.0 if compiled is None else compiled.program.sent(kind)
        if formula or counted:
            beside = "" if compiled is None else f" ({size(counted)})"
            yield f"    {kind:<42}{size(formula):>10}{beside}"
    yield "  predicted"
    yield (
        f"    a step {duration(time.step_s)}: products {duration(time.products_s)}, element-wise "
        f"{duration(time.streaming_s)}, waiting for other devices {duration(time.waiting_s)}"
    )
    yield (
        f"    MFU {time.mfu:.1%}, {rate(time.clips_per_s)} clips/s, {time.tokens_per_s:,.0f} video "
        "tokens/s"
    )
    yield "  arrangements that suit best, by the formula"
    for best in plan.best:
        fits = "fits" if best.fits else "does not fit"
        yield (
            f"    {duration(best.time.step_s)}/step, {size(best.footprint.peak)}, {fits}: "
            f"{best.flags}"
        )


def _verdict(plan: Plan) -> Iterator[str]:
    """Yield whether the step fits into memory, and how that was computed."""
    verdict, raised = "fits" if plan.fits else "does not fit", plan.raised
    yield (
        f"    {verdict}: {size(plan.peak)} of {size(plan.chip.memory)}, of which "
        f"{suggest.MARGIN:.0%} may be filled ({size(suggest.MARGIN * plan.chip.memory)})"
    )
    if plan.compiled is None:
        why = "which no compiled program confirms here"
    elif raised > 1:
        why = f"raised by the {raised - 1:.1%} that the CPU program needs above the formula for it"
    else:
        why = "not lowered, though the CPU program needs less than the formula for it"
    yield f"    that is the formula's {size(plan.choice.footprint.peak)}, {why}"


def arranged(choice: Arrangement) -> str:
    """Format an arrangement: ``data 8 × fsdp 8 × tensor 1 × context 1``."""
    return " × ".join(f"{name} {count}" for name, count in choice.mesh.sizes.items())


def size(count: float) -> str:
    """Format a number of bytes."""
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{_short(count / factor)} {unit}"
    return f"{count:.0f} B"


def work(flops: float) -> str:
    """Format a number of FLOPs."""
    for unit, factor in (("EFLOP", 1e18), ("PFLOP", 1e15), ("TFLOP", 1e12), ("GFLOP", 1e9)):
        if flops >= factor:
            return f"{_short(flops / factor)} {unit}"
    return f"{_short(flops / 1e6)} MFLOP"


def rate(count: float) -> str:
    """Format a rate with three digits and no exponent."""
    return f"{count:,.0f}" if count >= 1000 else f"{count:.3g}"


def _short(value: float) -> str:
    """Format a number with three digits, or with all digits before the point."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
