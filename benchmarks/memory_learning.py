"""Which memory learns best: five memories and both position schemes, at equal cost.

Run with ``python benchmarks/memory_learning.py``; add ``--record`` to write the table into
RESULTS.md, ``--smoke`` to see quickly that it runs. Every seed trains one backbone without memory
(stage 1) and then, from it, each memory's blocks (stage 2): the same number of parameters, steps,
batches and noise. What is compared is the PSNR of sampled frames of held-out houses over the
pixels that the context had shown before. A finished run is kept as one file and not done again,
so the same command goes on after a kill.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import itertools
import json
import math
import shutil
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw
from record import machine, record, table

from pewm_jax import atomic, cli, weights
from pewm_jax import presets as configs
from pewm_jax.config import (
    Config,
    DataConfig,
    ImagesConfig,
    Map2DConfig,
    MemorySettings,
    NoMemoryConfig,
    PointsConfig,
    StageConfig,
    VoxelConfig,
    to_dict,
)
from pewm_jax.data import loader
from pewm_jax.data.__main__ import main as data_command
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.progress import Meter
from pewm_jax.evaluation import pictures, protocol
from pewm_jax.evaluation.images import MASKS, error_sums_batch
from pewm_jax.evaluation.imagine import Imagination
from pewm_jax.evaluation.seen import seen_masks_batch
from pewm_jax.evaluation.statistics import scores
from pewm_jax.training import sharding
from pewm_jax.training.feed import Feed
from pewm_jax.training.stages import Stage
from pewm_jax.training.state import inference_params
from pewm_jax.training.step import compile_step, initial_state, stage_key
from pewm_jax.types import Frames, Params
from pewm_jax.worlds.pewm import STAGES

MEMORIES: dict[str, type[MemorySettings]] = {
    "voxel": VoxelConfig,
    "images": ImagesConfig,
    "map2d": Map2DConfig,
    "points": PointsConfig,
    "none": NoMemoryConfig,
}
KINDS = tuple(kind for kind in MEMORIES if kind != "none")
POSITIONS = ("projective", "sinusoid")
VARIANTS = (*itertools.product(KINDS, POSITIONS), ("none", "projective"))
"""Memory and position scheme; without a memory nothing has a position."""
BEFORE = ("stage 1", "")
"""The backbone that all variants of a seed start from."""
BACKBONE = {"layers": 3, "heads": 4, "time_dim": 128}
READER = {"heads": 8, "head_dim": 16, "looks": 64}
TOKENS, SNAPSHOTS = 256, 7
"""What is smaller than in the demo; seven snapshots of 6 × 6 patches are 252 tokens."""
SMOKE = (("voxel", "projective"), ("images", "sinusoid"), ("none", "projective"))
NAME = "memory_learning"
Variant = tuple[str, str]
Result = dict[str, Any]


def settings(options: argparse.Namespace, variant: Variant, seed: int) -> Config:
    """Return the settings of the preset `pixels`, smaller, with another memory."""
    config = configs.load("pixels")
    kind, positions = variant if variant != BEFORE else ("none", "projective")
    model = config.model
    reader = dataclasses.replace(model.memory.reader, positions=positions, **READER)
    shared = {f.name: getattr(model.memory, f.name) for f in dataclasses.fields(MemorySettings)}
    shared |= {"tokens": TOKENS, "reader": reader}
    shared |= {"snapshots": SNAPSHOTS} if kind == "images" else {}
    stage = StageConfig(batch=options.batch, learning_rate=1e-3, warmup=20, steps=options.steps1)
    second = dataclasses.replace(stage, learning_rate=2e-3, steps=options.steps2)
    train = {"stage1": stage, "stage2": second, "seed": seed, "ema": 0.95}
    evaluate = {"clips": options.clips, "batch": min(options.clips, 16)}
    config = config.with_model(
        clip=dataclasses.replace(model.clip, frames=options.frames),
        backbone=dataclasses.replace(model.backbone, **BACKBONE),
        memory=MEMORIES[kind](**shared),
    )
    return dataclasses.replace(
        config,
        data=DataConfig(path=str(options.data), context=options.context),
        train=dataclasses.replace(config.train, **train),
        evaluate=dataclasses.replace(config.evaluate, **evaluate),
    )


def train(config: Config, stage: Stage, start: Params | None, label: str) -> tuple[Params, int]:
    """Train one stage; returns its inference weights and how many of them it trained."""
    mesh, chosen = sharding.make_mesh(jax.devices()[:1]), stage.settings(config)
    batches = loader.clips(config, "train", seed=stage.data_seed(config), batch=chosen.batch)
    key = jax.device_put(stage_key(config, stage), sharding.replicated(mesh))
    with Feed(iter(batches), sharding.of_batch(mesh)) as feed:
        clip = next(feed)
        print(f"{label}: compiling …", flush=True)
        began = time.monotonic()
        state = initial_state(config, stage, mesh, start)
        step = compile_step(config, stage, mesh, clip)
        print(f"{label}: compiled in {time.monotonic() - began:.0f} s", flush=True)
        with Meter(label, chosen.steps, "steps") as meter:
            for number in range(chosen.steps):
                clip = clip if number == 0 else next(feed)
                state, metrics = step(state, clip, key)
                loss = float(metrics["loss"])
                if not math.isfinite(loss):
                    raise SystemExit(f"{label}: the loss is {loss} at step {number + 1}.")
                meter.advance(1)
    print(f"{meter.summary()}, last loss {loss:.3f}", flush=True)
    count = sum(leaf.size for leaf in jax.tree.leaves(state.ema))
    return jax.device_get(inference_params(stage, state)), count


@dataclasses.dataclass(frozen=True)
class Batch:
    """Clips to imagine, and what of them was seen before."""

    context: Frames
    targets: Frames
    actions_BN3: np.ndarray
    numbers_B: np.ndarray
    seen: Any
    unseen: Any
    real: int


def held_out(config: Config) -> list[Batch]:
    """Read the clips that every run is scored on."""
    episodes = EpisodeSource(Path(config.data.path) / config.evaluate.split)
    choices = protocol.choose(config, episodes, config.evaluate.clips, 1)
    size, batches = config.evaluate.batch, []
    for first in range(0, len(choices), size):
        some = choices[first : first + size]
        parts = [protocol.load_clip(config, episodes, choice) for choice in some]
        context, targets, actions = (
            protocol.stack([part[index] for part in parts], size) for index in range(3)
        )
        seen, unseen = seen_masks_batch(targets, context)
        numbers = first + np.arange(size)
        batches.append(Batch(context, targets, actions, numbers, seen, unseen, len(some)))
    return batches


def score(config: Config, params: Params, batches: Sequence[Batch], *, memory: bool) -> Result:
    """Imagine all clips; returns PSNR per mask in dB, the mean over clips, and how many."""
    model = Imagination(config, params, config.evaluate.batch, config.data.context)
    sums = []
    for batch in batches:
        seeds = np.stack([np.full_like(batch.numbers_B, config.train.seed), batch.numbers_B], -1)
        _, _, frames = model.run(batch.context, batch.actions_BN3, seeds, memory=memory)
        found = error_sums_batch(frames, batch.targets, batch.seen, batch.unseen)
        sums.append(np.asarray(found)[: batch.real].sum(1))
    by_mask = scores(np.concatenate(sums))
    psnr = {mask: float(np.nanmean(by_mask[mask]["psnr"])) for mask in MASKS}
    return {"psnr": psnr, "clips": sum(batch.real for batch in batches)}


def fingerprint(config: Config) -> str:
    """Name what a run's result depends on, the data by the settings it was collected with."""
    values = to_dict(config)
    manifest = Path(config.data.path) / "train" / "dataset.json"
    text = json.dumps([values, json.loads(manifest.read_text())["settings"]], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def file_of(out: Path, variant: Variant, seed: int) -> Path:
    name = "-".join(part.replace(" ", "") for part in variant if part)
    return out / f"{name}-seed{seed}.json"


def keep(path: Path, result: Result) -> Result:
    """Write a result aside, then rename it."""
    atomic.write_text(path, json.dumps(result, indent=1) + "\n")
    return result


def kept(path: Path, name: str) -> Result | None:
    """Return a finished result of the same settings, or None."""
    try:
        result = json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return None
    return result if result.get("fingerprint") == name else None


def runs(options: argparse.Namespace) -> Iterator[tuple[Variant, int, Result]]:
    """Do, or find done, every run; the backbone of a seed first."""
    batches: list[Batch] | None = None
    for seed in range(options.seeds):
        backbone = options.out / f"stage1-seed{seed}.safetensors"
        for variant in (BEFORE, *options.variants):
            config = settings(options, variant, seed)
            label = f"seed {seed}, {' '.join(variant).strip()}"
            path, name = file_of(options.out, variant, seed), fingerprint(config)
            result = kept(path, name)
            if result is not None and (variant != BEFORE or backbone.exists()):
                print(f"{label}: {result['psnr']['seen']:.2f} dB, kept", flush=True)
                yield variant, seed, result
                continue
            began = time.process_time()
            batches = batches or held_out(config)
            first = variant == BEFORE
            start = None if first else weights.load(backbone)
            params, count = train(config, STAGES[0 if first else 1], start, label)
            if first:
                weights.save(backbone, params)
            found = score(config, params, batches, memory=not first)
            seconds = round(time.process_time() - began, 1)
            found |= {"fingerprint": name, "parameters": count, "seconds": seconds}
            took = f"{seconds:.0f} s of processor time"
            print(f"{label}: {found['psnr']['seen']:.2f} dB in {took}", flush=True)
            yield variant, seed, keep(path, found)


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean over seeds and its standard error (0 for one seed)."""
    spread = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else 0.0
    return statistics.fmean(values), spread


def summary(results: dict[Variant, list[Result]]) -> list[dict[str, Any]]:
    """Turn runs into rows: the best memory first, then the backbone alone."""
    none = [run["psnr"]["seen"] for run in results["none", "projective"]]
    rows = []
    for variant, found in results.items():
        seen = [run["psnr"]["seen"] for run in found]
        rows.append(
            {
                "memory": variant[0],
                "positions": variant[1] if variant[0] in KINDS else "–",
                "seen": mean_and_error(seen),
                "unseen": mean_and_error([run["psnr"]["unseen"] for run in found]),
                "gain": mean_and_error([a - b for a, b in zip(seen, none, strict=True)]),
                "parameters": found[0]["parameters"],
            }
        )
    rows.sort(key=lambda row: (row["memory"] == BEFORE[0], -row["seen"][0]))
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table."""

    def show(pair: tuple[float, float]) -> str:
        return f"{pair[0]:.2f} ± {pair[1]:.2f}"

    header = ["memory", "positions", "PSNR seen before, dB", "minus none, dB", "never seen, dB"]
    lines = [
        [
            row["memory"],
            row["positions"],
            *(show(row[key]) for key in ("seen", "gain", "unseen")),
            f"{row['parameters'] / 1e6:.3f} M",
        ]
        for row in rows
    ]
    return table([*header, "trained"], lines)


def plot(rows: list[dict[str, Any]], caption: str) -> np.ndarray:
    """Draw the rows as bars with standard errors; returns a (H, W, 3) uint8 picture."""
    wide, tall, left, top = 900, 34, 220, 64
    canvas = Image.new("RGB", (wide, top + tall * len(rows) + 24), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)
    low = math.floor(min(row["seen"][0] - row["seen"][1] for row in rows) - 0.5)
    high = math.ceil(max(row["seen"][0] + row["seen"][1] for row in rows) + 0.2)
    colours = {"projective": (44, 110, 170), "sinusoid": (214, 132, 52), "–": (130, 130, 130)}

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (wide - left - 140)

    pictures.write(draw, (16, 20), "PSNR over pixels seen before, dB (± standard error)", size=17)
    pictures.write(draw, (16, 44), caption, size=12)
    for tick in range(low, high + 1):
        draw.line([(x(tick), top), (x(tick), top + tall * len(rows))], fill=(225, 225, 225))
        pictures.write(draw, (x(tick), top + tall * len(rows) + 12), str(tick), anchor="mm")
    for index, row in enumerate(rows):
        y = top + tall * index + tall / 2
        value, error = row["seen"]
        words = row["memory"] if row["positions"] == "–" else f"{row['memory']}, {row['positions']}"
        pictures.write(draw, (left - 10, y), words, anchor="rm")
        draw.rectangle([left, y - 11, x(value), y + 11], fill=colours[row["positions"]])
        draw.line([(x(value - error), y), (x(value + error), y)], fill=(0, 0, 0), width=2)
        for end in (value - error, value + error):
            draw.line([(x(end), y - 5), (x(end), y + 5)], fill=(0, 0, 0), width=2)
        pictures.write(draw, (x(value + error) + 10, y), f"{value:.2f} ± {error:.2f}")
    return np.asarray(canvas)


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data/demo"), help="collected if absent")
    parser.add_argument("--out", type=Path, default=None, help=f"default runs/{NAME}")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps1", type=int, default=300, help="steps without memory, per seed")
    parser.add_argument("--steps2", type=int, default=150, help="steps of each memory's blocks")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--frames", type=int, default=5, help="frames of a clip, 4k + 1")
    parser.add_argument("--context", type=int, default=20, help="frames remembered")
    parser.add_argument("--clips", type=int, default=32, help="held-out clips per run")
    parser.add_argument("--smoke", action="store_true", help="2 steps, 2 clips, 2 seeds")
    parser.add_argument("--record", action="store_true", help="write into RESULTS.md")
    options = parser.parse_args()
    if options.smoke:
        small = {"steps1": 2, "steps2": 2, "batch": 2, "clips": 2, "seeds": 2, "context": 4}
        vars(options).update(small)
        options.out = options.out or Path(f"runs/{NAME}_smoke")
    options.out = options.out or Path(f"runs/{NAME}")
    options.variants = SMOKE if options.smoke else VARIANTS
    return options


def main() -> None:
    """Train, score, print, draw."""
    options = parse()
    options.out.mkdir(parents=True, exist_ok=True)
    cli.cache_compilation(options.out)
    if data_command(["collect", str(options.data), "--size", "48"]):
        raise SystemExit(f"{options.data} could not be collected.")
    results: dict[Variant, list[Result]] = {variant: [] for variant in (BEFORE, *options.variants)}
    for variant, _, result in runs(options):
        results[variant].append(result)
    rows = summary(results)
    minutes = sum(run["seconds"] for found in results.values() for run in found) / 60
    caption = (
        f"{options.seeds} seeds, {results[BEFORE][0]['clips']} clips of held-out houses, "
        f"{options.steps1} + {options.steps2} steps of {options.batch} clips of {options.frames} "
        f"frames, {options.context} remembered; {minutes:.0f} min of processor time"
    )
    picture = pictures.save_png(options.out / f"{NAME}.png", plot(rows, caption))
    keep(options.out / f"{NAME}.json", {"rows": rows, "caption": caption})
    text = f"{caption}\n{machine('jax')}\n\n{markdown(rows)}"
    print(f"{text}\n\nplot: {picture}")
    if options.record:
        shutil.copy(picture, Path(__file__).with_suffix(".png"))
        title = "## Which memory learns best (memory_learning.py)"
        record(NAME, f"{title}\n\n{text}\n\n![bars with standard errors]({NAME}.png)")


if __name__ == "__main__":
    main()
