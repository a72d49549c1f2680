"""How a memory is best read: ``attend``, ``render`` and ``both``, at equal steps and at equal time.

``python benchmarks/readers.py`` trains the demo's stage 1 once and, from it, stage 2 with every
memory and reader, twice: for as many steps each, and for as much time as rendering surfels took.
What is scored is what ``evaluate.py`` scores. Runs that are done are found again, so the same
command goes on after a kill. ``--record`` writes the table into RESULTS.md, ``--smoke`` shows
quickly that it runs.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

from record import machine, record, table

from pewm_jax.cli import main as program

VOXELS = [
    *("--model.memory.kind", "voxel", "--model.memory.cell_m", "0.25", "0.25", "1.0"),
    *("--model.memory.capacity", "4096", "--model.memory.cells", "128", "128", "16"),
]
"""The paper's cells; the features are patches of colours, so the codec's gate stands aside."""
HEADS = ["--model.memory.reader.heads", "6", "--model.memory.reader.head_dim", "32"]
VARIANTS: dict[tuple[str, str], list[str]] = {
    ("surfels", "render"): [],
    ("surfels", "both"): ["--model.memory.reader.kind", "both", *HEADS],
    ("surfels", "attend"): ["--model.memory.reader.kind", "attend", *HEADS],
    ("voxel", "render"): VOXELS,
    ("voxel", "both"): [*VOXELS, "--model.memory.reader.kind", "both", *HEADS],
    ("voxel", "attend"): [*VOXELS, "--model.memory.reader.kind", "attend", *HEADS],
}
"""Memory and reader; the first is what the others are given as much time as."""
MASKS = ("seen", "unseen", "all")
Result = dict[str, Any]


def main() -> None:
    """Train, score, print."""
    options = parse()
    if program.main(["data", "collect", str(options.data), *options.collect]):
        raise SystemExit(f"{options.data} could not be collected.")
    before = options.out / "stage1"
    run_training(options, before, ["--train.stage1.steps", str(options.steps1)], 0)
    found: dict[tuple[str, str, str], Result] = {}
    for variant, flags in VARIANTS.items():
        if found and variant[0] not in options.memory:
            continue  # the first is what the others are given as much time as
        steps = options.steps2
        result = found["steps", *variant] = one(options, variant, flags, before, steps)
        allowed = found["steps", *next(iter(VARIANTS))]["seconds"]
        steps = max(1, round(steps * allowed / result["seconds"]))
        found["time", *variant] = one(options, variant, flags, before, steps)
    text = page(options, found)
    print(text)
    if options.record:
        record("readers", text)


def one(
    options: argparse.Namespace,
    variant: tuple[str, str],
    flags: list[str],
    before: Path,
    steps: int,
) -> Result:
    """Train stage 2 for so many steps and score it; returns PSNR by mask, steps and seconds."""
    run = options.out / f"{'-'.join(variant)}-{steps}"
    start = ["--train.start", str(before), "--train.stage1.steps", "0"]
    run_training(options, run, [*flags, *start], steps)
    clips = ["--clips", str(options.clips), "--videos", "1", "--video_clips", "1"]
    if program.execute(["evaluate", str(run), *clips, "--seeds", *map(str, range(options.seeds))]):
        raise SystemExit(f"{run} could not be scored.")
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    lines = (run / "metrics.jsonl").read_text().splitlines()
    seconds = statistics.median(json.loads(line)["step_seconds"] for line in lines)
    methods = ("memory", "empty", "reproject")
    return {"steps": steps, "seconds": seconds, "protocol": metrics["protocol"]} | {
        method: {mask: metrics["results"][method][mask]["psnr"]["mean"] for mask in MASKS}
        for method in methods
    }


def run_training(options: argparse.Namespace, run: Path, flags: list[str], stage2: int) -> None:
    """Train a run, or find it trained."""
    shared = [
        *("--data.path", str(options.data), "--data.prepared", str(options.prepared)),
        *("--data.prepared_path", str(options.out / "prepared")),
        *("--train.stage2.steps", str(stage2), "--train.log_every", str(options.log_every)),
    ]
    if program.execute(["train", options.preset, *shared, "--train.run", str(run), *flags]):
        raise SystemExit(f"{run} could not be trained.")


def page(options: argparse.Namespace, found: dict[tuple[str, str, str], Result]) -> str:
    """Return the table and how it was made, in Markdown."""
    first = next(iter(found.values()))
    header = ["equal", "memory", "reader", "steps", "s/step"]
    header += [f"{name}, dB" for name in ("seen before", "never seen", "all")]

    def numbers(scores: dict[str, float]) -> list[str]:
        return [f"{scores[mask]:.2f}" for mask in MASKS]

    rows = [
        [*key, str(result["steps"]), f"{result['seconds']:.2f}", *numbers(result["memory"])]
        for key, result in sorted(found.items(), key=lambda item: item[0][0])
    ]
    rows += [["", name, "", "", "", *numbers(first[name])] for name in ("empty", "reproject")]
    protocol = first["protocol"]
    return (
        "## Readers of the memory (readers.py)\n\n"
        f"Preset {options.preset}; {options.steps1} steps of stage 1, shared; then stage 2. "
        f"{protocol['clips']} clips of {protocol['scenes']} held-out houses, "
        f"{options.seeds} sampling seed(s), one training seed; PSNR of sampled frames. The empty "
        "map shows the shared stage 1. Surfels show colours, which the codec's gate mixes in "
        "whatever the reader is; voxels hold features, and nothing is mixed in.\n\n"
        f"{table(header, rows)}\n\n{machine('jax')}."
    )


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", default="demo")
    parser.add_argument("--data", type=Path, default=Path("data/demo"), help="collected if absent")
    parser.add_argument("--out", type=Path, default=None, help="default runs/readers")
    parser.add_argument("--steps1", type=int, default=200, help="steps without memory")
    parser.add_argument("--steps2", type=int, default=150, help="steps of each reader")
    parser.add_argument("--prepared", type=int, default=512, help="clips to learn from")
    parser.add_argument("--clips", type=int, default=24, help="held-out clips per run")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of the sampling noise")
    kinds = list(dict.fromkeys(memory for memory, _ in VARIANTS))
    parser.add_argument("--memory", nargs="+", choices=kinds, default=kinds, help="default both")
    parser.add_argument("--smoke", action="store_true", help="2 steps, 2 clips")
    parser.add_argument("--record", action="store_true", help="write into RESULTS.md")
    options = parser.parse_args()
    options.collect, options.log_every = ["--train", "144", "--frames", "80"], 10
    if options.smoke:
        vars(options).update(steps1=2, steps2=2, prepared=16, clips=2, log_every=1)
        options.data = Path("data/readers_smoke")
        options.collect = ["--train", "2", "--validation", "1", "--test", "1", "--frames", "60"]
    options.out = options.out or Path("runs/readers_smoke" if options.smoke else "runs/readers")
    return options


if __name__ == "__main__":
    main()
