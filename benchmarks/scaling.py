"""The table of docs/scaling.md: both large presets, both stages, on 8, 64 and 256 devices.

    python benchmarks/scaling.py            # compiles 14 steps for 256 virtual devices, minutes
    python benchmarks/scaling.py --record   # and rewrites the table
    python benchmarks/scaling.py --quick    # the smallest preset on 8 devices, to see that it runs

No device but a CPU is needed. Every number is one that `python train.py PRESET --plan` prints.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from record import machine, record, table

from pewm_jax import presets as configs
from pewm_jax.config import ClipConfig, Config, MeshConfig
from pewm_jax.plan.measure import MeshSizes, virtual
from pewm_jax.plan.plan import StagePlan, arranged, flop, plan_stage, rate, size
from pewm_jax.train import chips, runs
from pewm_jax.train.log import duration

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
DEVICES = (8, 64, 256)
HEAD = (
    "model",
    "stage",
    "devices",
    "mesh",
    "memory of a device",
    "CPU program",
    "fits",
    "work of a device (CPU program)",
    "step",
    "MFU",
    "clips/s",
    "fastest mesh",
)


def long_clip() -> Config:
    """Return pewm_5b on 49 × 480 × 720, whose 17,550 video tokens four devices share."""
    config = configs.load("pewm_5b")
    mesh = MeshConfig(fsdp=16, context=4)
    stage = dataclasses.replace(config.train.stage2, batch=16)
    config = config.with_model(clip=ClipConfig(frames=49, height=480, width=720))
    train = dataclasses.replace(config.train, mesh=mesh, stage1=stage, stage2=stage)
    return dataclasses.replace(config, train=train)


def cases(quick: bool) -> Iterator[tuple[str, Config, int]]:
    """Yield what is planned: label, settings, devices."""
    if quick:
        tiny = configs.load("tiny")
        stage = dataclasses.replace(tiny.train.stage1, batch=8)
        train = dataclasses.replace(tiny.train, stage1=stage, stage2=stage)
        yield "tiny", dataclasses.replace(tiny, train=train), 8
        return
    for name in ("pewm_2b", "pewm_5b"):
        for devices in DEVICES:
            yield name, configs.load(name), devices
    yield "pewm_5b, 49 × 480 × 720, 16 clips", long_clip(), 64


def row(label: str, plan: StagePlan) -> list[str]:
    """Return a plan's line of the table."""
    choice, compiled, best = plan.choice, plan.compiled, plan.best[0]
    assert compiled is not None
    return [
        label,
        str(plan.stage.number),
        f"{choice.mesh.devices} × {plan.chip.name}",
        arranged(choice.mesh.sizes),
        size(choice.memory.peak),
        size(compiled.peak),
        "yes" if choice.fits else "**no**",
        f"{flop(choice.time.executed_flops)} ({flop(compiled.program.flops)})",
        duration(choice.time.step_s),
        f"{choice.time.mfu:.0%}",
        rate(choice.time.clips_per_s),
        f"{arranged(best.mesh.sizes)}: {duration(best.time.step_s)}",
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, and keep it if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the smallest preset alone")
    parser.add_argument("--record", action="store_true", help="rewrite docs/scaling.md")
    parser.add_argument("--chip", default="h200", help="kind of device")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to rewrite")
    options = parser.parse_args(argv)
    chip = chips.named(options.chip)
    found = list(cases(options.quick))
    virtual(max(count for *_, count in found))
    wanted = [(*case, stage) for case in found for stage in runs.planned(case[1])]
    rows: dict[int, list[str]] = {}
    # The largest first: what is written after each is then never without them.
    for index in sorted(range(len(wanted)), key=lambda k: "5b" not in wanted[k][0]):
        label, config, count, stage = wanted[index]
        print(f"{label}, stage {stage.number}, {count} × {chip.name}: compiling …", flush=True)
        sizes = MeshSizes(*config.train.mesh.shape(count))
        rows[index] = row(label, plan_stage(config, stage, sizes, chip))
        source = f"{chip.name}: {chip.source}. Compiled with {machine('jax')}."
        text = f"{table(HEAD, [rows[k] for k in sorted(rows)])}\n\n{source}"
        if options.record:
            record("scaling", text, options.page)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
