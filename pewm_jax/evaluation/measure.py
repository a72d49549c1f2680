"""The content of ``metrics.json``: scores, margins, and the protocol that they were made by."""

from __future__ import annotations

from importlib import metadata
from typing import Any

import jax

from pewm_jax.config import Config, kinds, to_dict
from pewm_jax.evaluation import intervals, statistics
from pewm_jax.evaluation.scoring import LongRollouts, Scored

SCHEMA = 1
"""Version of the layout of ``metrics.json``, which ``docs/evaluation.md`` describes. Entries may be
added; increase it when one goes or comes to mean something else."""


def measure(config: Config, scored: Scored, long: LongRollouts) -> dict[str, Any]:
    """Turn errors into the content of ``metrics.json``, except for hashes.

    Returns:
        ``schema``; ``protocol``; ``results[method][mask][metric] = {mean, stderr, n}``;
        ``margins[method][mask][metric]``, the model minus that method, clip by clip, and
        ``margin``, the one over ``empty`` (None of a model without a memory); ``per_frame[method][mask][metric]``; ``long`` with the same of long
        rollouts and ``drift[method]`` (see ``statistics.drift``); ``houses``, means over houses
        with 95 % intervals (see ``intervals.table``), with the same of long rollouts in ``long``.
    """
    return {
        "schema": SCHEMA,
        "protocol": protocol_of(config, scored, long),
        **_scores(scored),
        "long": {
            **_scores(long.scored),
            "drift": statistics.drift(long.scored.sums, long.scored.clusters),
        },
        "houses": {
            "how": intervals.how(),
            "house": scored.clustered_by,
            **intervals.table(scored.sums, scored.clusters),
            "long": intervals.table(long.scored.sums, long.scored.clusters),
        },
    }


def _scores(scored: Scored) -> dict[str, Any]:
    margins = statistics.margins(scored.sums, scored.clusters)
    return {
        "results": statistics.table(scored.sums, scored.clusters),
        "margin": margins.get("empty"),
        "margins": margins,
        "per_frame": statistics.per_frame(scored.sums, scored.clusters),
    }


def protocol_of(config: Config, scored: Scored, long: LongRollouts) -> dict[str, Any]:
    """Describe the measurement completely enough to repeat it."""
    clip, choices, own = config.model.clip, scored.choices, statistics.ours(scored.sums)
    remembers = own == "memory"
    scenes = sorted({choice.scene for choice in choices + long.scored.choices})
    return {
        "scenes": len(scenes),
        "episodes": len({choice.episode for choice in choices}),
        "clips": len(choices),
        "training_seed": getattr(config.train, "seed", None),
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
        "method": own,
        **_memory_of(config, remembers=remembers),
        "dataset": config.data.path,
        "split": config.evaluate.split,
        "starts": "spread evenly over the way back of every episode; no randomness",
        "observed": "context frames spread evenly over the episode's past, the present one last; "
        + (
            "all go into the map, and the model also sees the present one itself"
            if remembers
            else "the model has no memory and sees the present one alone"
        ),
        "motion": "the recorded one; poses integrated from actions agree with the recorded poses",
        "seen": "a pixel whose true point projects into an observed frame where the true depth "
        "agrees (nearest pixel or interpolated, larger of 5 cm and 3 %)",
        "seen_share": round(statistics.seen_share(scored.sums[own]), 4),
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


def _memory_of(config: Config, *, remembers: bool) -> dict[str, Any]:
    """Return what is said of the memory; nulls where the model has none."""
    memory = config.model.memory
    if not remembers:
        return {"memory": "none"} | dict.fromkeys(("encoder", "reader", "positions", "map"))
    return {
        "memory": kinds.of(memory).name,
        "encoder": kinds.of(memory.encoder).name,
        "reader": kinds.of(memory.reader).name,
        "positions": getattr(memory.reader, "positions", ""),
        "map": f"{memory.capacity} cells of {memory.cell_m} m, {memory.tokens} read per clip",
    }


def _version() -> str:
    try:
        return metadata.version("pewm-jax")
    except metadata.PackageNotFoundError:
        return "not installed"
