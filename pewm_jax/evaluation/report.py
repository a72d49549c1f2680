"""The report of a trained run: ``report/`` with metrics.json, index.html and strip.png."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from pewm_jax import atomic
from pewm_jax.config import Config, ModelConfig, UserError, kinds, to_dict
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.evaluation import statistics
from pewm_jax.evaluation.gallery import make_gallery
from pewm_jax.evaluation.imagine import Imagination, print_now
from pewm_jax.evaluation.page import render, verdict
from pewm_jax.evaluation.partial import Partials
from pewm_jax.evaluation.pictures import save_png
from pewm_jax.evaluation.protocol import choose, file_hash, fingerprint, needs_cameras
from pewm_jax.evaluation.scoring import (
    LongRollouts,
    Scored,
    long_choices,
    roll_long,
    score_table,
)
from pewm_jax.rollouts import load_finished

WEIGHTS = "weights.safetensors"
TRAINED_ON = "train"
"""The split that training reads."""
REPORT_VERSION = 2
"""Increase it whenever the same scores would give another report."""
PAGE, METRICS, STRIP = "index.html", "metrics.json", "strip.png"


def override(config: Config, **changes: Any) -> Config:
    """Return the configuration with some of the evaluation's settings changed.

    Args:
        config: the run's configuration.
        changes: fields of ``EvalConfig``, ``steps`` (of the sampler) and ``data`` (folder of the
            data set). None keeps a setting.

    Raises:
        ConfigError: a value cannot work.
    """
    changes = {key: value for key, value in changes.items() if value is not None}
    steps, data = changes.pop("steps", None), changes.pop("data", None)
    if steps is not None:
        config = config.with_model(
            noise=dataclasses.replace(config.model.noise, sample_steps=steps)
        )
    if data is not None:
        config = dataclasses.replace(config, data=dataclasses.replace(config.data, path=str(data)))
    return dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, **changes))


def evaluate(run: str | Path, *, say: Callable[[str], Any] = print_now, **changes: Any) -> Path:
    """Score a trained run and write its report.

    After an interruption, finished scores are reused. A report that is complete for these weights
    and this protocol is not written again.

    Args:
        run: a run folder made by ``train.py``.
        say: shows a progress line.
        changes: as for ``override``.

    Returns:
        The path of the page.

    Raises:
        UserError: the run, its weights or the data are absent, damaged, or do not fit together.
    """
    run = Path(run)
    if not run.is_dir():
        raise UserError(f"{run} does not exist; train a model first, e.g. `python train.py demo`.")
    config, params = load_finished(run)
    if not isinstance(config.model, ModelConfig):
        raise UserError(
            f"{run} holds a world of kind {kinds.of(config.model).name}, of which there is no "
            "report: of a codec, pewm_jax.evaluation.codec_score.score gives the numbers."
        )
    trained_on = Path(config.data.path) / TRAINED_ON
    if "memory" not in params:
        raise UserError(
            f"{run / WEIGHTS} has no memory blocks yet, only stage 1 is trained; finish training "
            "with `python train.py`, which goes on where it stopped."
        )
    config = override(config, **changes)
    split = Path(config.data.path) / config.evaluate.split
    episodes = EpisodeSource(split)
    weights_hash, data_hash = file_hash(run / WEIGHTS), file_hash(split / MANIFEST)
    name = fingerprint(config, weights_hash, data_hash)
    folder = run / "report"
    if is_complete(folder, config, name):
        say("the report is complete for these weights and this protocol; nothing to do")
        return folder / PAGE
    folder.mkdir(parents=True, exist_ok=True)
    partials = Partials(folder / "partial", weights_hash, name)
    clips = list(long_choices(config, episodes)[0])
    clips += choose(config, episodes, config.evaluate.clips, config.evaluate.chain)
    cameras = needs_cameras(episodes, clips)
    model = Imagination(
        config, params, config.evaluate.batch, config.data.context, say, cameras=cameras
    )
    scored = score_table(config, episodes, model, partials, say)
    long = roll_long(config, episodes, model, partials, say)
    say("drawing the report …")
    metrics = measure(config, scored, long)
    if cameras:
        metrics["protocol"]["motion"] = "the recorded cameras, in six degrees of freedom"
    metrics["protocol"] |= held_out(metrics["protocol"]["scene_names"], trained_on) | {
        "weights_sha256": weights_hash,
        "dataset_sha256": data_hash,
        "fingerprint": name,
        "report_version": REPORT_VERSION,
    }
    gallery = make_gallery(config, episodes, long)
    (folder / METRICS).unlink(missing_ok=True)
    save_png(folder / STRIP, gallery.strip)
    page = render(metrics, gallery)
    atomic.write_text(folder / PAGE, page)
    metrics["page_sha256"] = hashlib.sha256(page.encode()).hexdigest()
    atomic.write_text(folder / METRICS, json.dumps(metrics, indent=1, allow_nan=False) + "\n")
    say(verdict(metrics["margin"]["seen"]["psnr"], "seen before"))
    say(verdict(metrics["margin"]["unseen"]["psnr"], "never seen"))
    return folder / PAGE


def is_complete(folder: Path, config: Config, name: str) -> bool:
    """Tell whether a folder holds the complete report for a fingerprint, seeds and videos."""
    try:
        metrics = json.loads((folder / METRICS).read_text("utf-8"))
        protocol = metrics["protocol"]
        return (
            protocol["fingerprint"] == name
            and protocol["report_version"] == REPORT_VERSION
            and protocol["seeds"] == list(config.evaluate.seeds)
            and protocol["config"]["evaluate"]["videos"] == config.evaluate.videos
            and metrics["page_sha256"] == file_hash(folder / PAGE)
            and (folder / STRIP).is_file()
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False


def held_out(scenes: Sequence[str], trained_on: Path) -> dict[str, Any]:
    """Tell whether the model was trained in the scenes it is scored in; compares names.

    Args:
        scenes: names of the scenes scored.
        trained_on: folder of the split the run was trained on.

    Returns:
        ``held_out``: True if no scene is shared, False if some are, None if the training data is
        not available; ``trained_scenes``: the scored scenes that are shared.
    """
    try:
        source = EpisodeSource(trained_on)
        known = {source[index].scene for index in range(len(source))}
    except UserError:
        return {"held_out": None, "trained_scenes": []}
    shared = sorted(known & set(scenes))
    return {"held_out": not shared, "trained_scenes": shared}


def measure(config: Config, scored: Scored, long: LongRollouts) -> dict[str, Any]:
    """Turn errors into the content of ``metrics.json``, except for hashes.

    Returns:
        ``protocol``; ``results[method][mask][metric] = {mean, stderr, n}``;
        ``margin[mask][metric]``, memory minus empty; ``per_frame[method][mask][metric]``; ``long``
        with ``results``, ``margin`` and ``per_frame`` of long rollouts.
    """
    rollouts = long.scored
    return {
        "protocol": protocol_of(config, scored, long),
        "results": statistics.table(scored.sums, scored.clusters),
        "margin": statistics.margin(scored.sums["memory"], scored.sums["empty"], scored.clusters),
        "per_frame": statistics.per_frame(scored.sums, scored.clusters),
        "long": {
            "results": statistics.table(rollouts.sums, rollouts.clusters),
            "margin": statistics.margin(
                rollouts.sums["memory"], rollouts.sums["empty"], rollouts.clusters
            ),
            "per_frame": statistics.per_frame(rollouts.sums, rollouts.clusters),
        },
    }


def protocol_of(config: Config, scored: Scored, long: LongRollouts) -> dict[str, Any]:
    """Describe the measurement completely enough to repeat it."""
    clip, choices = config.model.clip, scored.choices
    scenes = sorted({choice.scene for choice in choices + long.scored.choices})
    return {
        "scenes": len(scenes),
        "episodes": len({choice.episode for choice in choices}),
        "clips": len(choices),
        "seeds": list(config.evaluate.seeds),
        "chain": config.evaluate.chain,
        "context": config.data.context,
        "frames": clip.frames,
        "imagined_frames": config.evaluate.chain * (clip.frames - 1),
        "stride": config.evaluate.stride,
        "noise": kinds.of(config.model.noise).name,
        "sampler": getattr(config.model.noise, "sampler", "euler"),
        "sampling_steps": config.model.noise.sample_steps,
        "guidance": config.model.noise.guidance,
        "resolution": f"{clip.width} × {clip.height} pixels",
        "memory": kinds.of(config.model.memory).name,
        "encoder": kinds.of(config.model.memory.encoder).name,
        "reader": kinds.of(config.model.memory.reader).name,
        "positions": getattr(config.model.memory.reader, "positions", ""),
        "map": f"{config.model.memory.capacity} cells of {config.model.memory.cell_m} m, "
        f"{config.model.memory.tokens} read per clip",
        "dataset": config.data.path,
        "split": config.evaluate.split,
        "starts": "spread evenly over the way back of every episode; no randomness",
        "observed": "context frames spread evenly over the episode's past, the present one last; "
        "all go into the map, and the model also sees the present one itself",
        "motion": "the recorded one; poses integrated from actions agree with the recorded poses",
        "seen": "a pixel whose true point projects into an observed frame where the true depth "
        "agrees (nearest pixel or interpolated, larger of 5 cm and 3 %)",
        "seen_share": round(statistics.seen_share(scored.sums["memory"]), 4),
        "psnr": "of colours in [0, 1], from the mean squared error of all masked pixels of a clip; "
        "equal images count as 100 dB",
        "ssim": "11 × 11 Gaussian window, σ 1.5, valid windows, averaged over masked pixels",
        "depth": "mean absolute error in metres, and relative to the true depth",
        "stderr": "over clips, seeds averaged within a clip, clustered by " + scored.clustered_by,
        "clustered_by": scored.clustered_by,
        "long_rollouts": {
            "rollouts": len(long.scored.choices),
            "clips_each": long.chain,
            "frames_each": long.chain * (clip.frames - 1),
            "seed": config.evaluate.seeds[0],
            "shown": long.shown,
        },
        "versions": {"pewm_jax": _version(), "jax": jax.__version__},
        "scene_names": scenes,
        "clip_list": [[choice.name, choice.start] for choice in choices],
        "config": to_dict(config),
    }


def _version() -> str:
    try:
        return metadata.version("pewm-jax")
    except metadata.PackageNotFoundError:
        return "not installed"
