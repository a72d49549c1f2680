"""The results of an evaluation: the content of ``metrics.json`` and the scores of every clip.

``samples.npz`` stores the scores of every clip, so that any two runs can be compared clip by clip
later. It contains an array for each of ``clips``, ``frames`` and ``rollouts``, each method, mask
and metric, under a name such as ``clips/memory/seen/psnr``; NaN if a clip has no score. Its member
``about`` is JSON. ``docs/evaluation.md`` describes both.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import zipfile
import zlib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config, UserError, to_dict
from pewm_jax.eval import mirror, statistics
from pewm_jax.eval.long_rollouts import LongRollouts
from pewm_jax.eval.metrics import VideoDistance
from pewm_jax.eval.metrics.structure import Consistency
from pewm_jax.eval.mirror import Mirror
from pewm_jax.eval.scoring import TRUTH, Scored
from pewm_jax.eval.statistics import scores
from pewm_jax.io import atomic
from pewm_jax.report.labels import own_method

SCHEMA = 1
"""Version of the layout of ``metrics.json``, which ``docs/evaluation.md`` describes. Entries may be
added; increase it when one is removed or changes its meaning."""


def compute_metrics(
    config: Config,
    scored: Scored,
    long: LongRollouts,
    back: Mirror | None = None,
    i3d: VideoDistance | None = None,
    consistency: Consistency | None = None,
) -> dict[str, Any]:
    """Return the content of ``metrics.json``, except for hashes.

    Returns:
        ``schema``; ``protocol``; ``results[method][mask][metric] = {mean, stderr, n}``;
        ``margins[method][mask][metric]``, the model minus that method, paired by clip, and
        ``margin``, the one over ``empty`` (None for a model without a memory);
        ``per_frame[method][mask][metric]``; ``long`` with the same for long rollouts,
        ``drift[method]`` (see ``statistics.drift``) and ``growth``, the size of the map;
        ``houses``, means over houses with 95 % intervals (``statistics.house_table``),
        with the same for long rollouts in ``long``; ``videos``, FVD and KVD; ``mirror``, see
        ``mirror.facts``; ``scs``, see ``structure``; None for what was not measured.
    """
    return {
        "schema": SCHEMA,
        "protocol": protocol_of(config, scored, long),
        **_scores(scored),
        "long": {
            **_scores(long.scored),
            "drift": statistics.drift(long.scored.sums, long.scored.clusters),
            "growth": growth(config, long),
        },
        "videos": videos(config, scored, i3d) if i3d else None,
        "mirror": mirror.facts(back) if back else None,
        "scs": structure(config, scored, consistency) if consistency else None,
        "houses": {
            "how": statistics.interval_facts(),
            "house": scored.clustered_by,
            **statistics.house_table(scored.sums, scored.clusters),
            "long": statistics.house_table(long.scored.sums, long.scored.clusters),
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


def growth(config: Config, long: LongRollouts) -> dict[str, Any] | None:
    """Return the size of the map along long rollouts, or None without a map."""
    held = long.kept.get("memory", {}).get("occupied")
    if held is None:
        return None
    each = config.model.clip.frames - 1
    clusters = long.scored.clusters
    return {
        "frames": [each * clip for clip in range(long.chain + 1)],
        "occupied": statistics.entry(held, clusters),
        "per_frame": statistics.entry((held[:, -1] - held[:, 0]) / (each * long.chain), clusters),
        "capacity": config.model.facts.room or None,
    }


def structure(config: Config, scored: Scored, consistency: Consistency) -> dict[str, Any]:
    """Return SCS of every method and its ceiling, over houses; see ``docs/evaluation.md``."""
    entries = functools.partial(statistics.entries, houses_C=scored.clusters)
    values = {method: scs for method, scs in scored.structure.items() if method != TRUTH}
    truth, own = scored.structure[TRUTH], values[own_method(values)]
    return {
        "name": consistency.name,
        "seed": config.evaluate.seeds[0],
        "clips": int(np.isfinite(truth[:, 0]).sum()),
        "results": entries({method: scs[:, 0] for method, scs in values.items()}),
        "per_frame": entries({method: scs[:, 1:] for method, scs in values.items()}),
        **entries({"ceiling": truth[:, 0], "ceiling_per_frame": truth[:, 1:]}),
        "margins": entries(
            {method: own[:, 0] - scs[:, 0] for method, scs in values.items() if scs is not own}
        ),
    }


def videos(config: Config, scored: Scored, i3d: VideoDistance) -> dict[str, Any] | None:
    """Return FVD and KVD of every method with their floors; None for fewer than two clips.

    ``masks.MASK`` has those of composites, which show the truth outside a mask.
    """
    clips, frames = len(scored.choices), len(scored.choices[0].targets_N) + 1
    if clips < 2:
        return None
    kinds_of, truth = i3d.kinds(), scored.features[TRUTH]

    def table(features: Mapping[str, np.ndarray]) -> dict[str, Any]:
        return {
            method: {kind: metric.score(found, truth).facts() for kind, metric in kinds_of.items()}
            for method, found in features.items()
            if method != TRUTH
        }

    return {
        "frames": frames,
        "clips": clips,
        "seed": config.evaluate.seeds[0],
        "names": {kind: metric.name(frames, clips) for kind, metric in kinds_of.items()},
        "results": table(scored.features),
        "masks": {mask: table(found) for mask, found in scored.composites.items()},
    }


def protocol_of(config: Config, scored: Scored, long: LongRollouts) -> dict[str, Any]:
    """Describe the measurement completely enough to repeat it."""
    clip, choices, own = config.model.clip, scored.choices, own_method(scored.sums)
    remembers = own == "memory"
    scenes = sorted({choice.scene for choice in choices + long.scored.choices})
    try:
        version = metadata.version("pewm-jax")
    except metadata.PackageNotFoundError:
        version = "not installed"
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
        "noise": config.model.facts.noise or None,
        "sampler": config.model.facts.sampler or ("euler" if config.model.facts.noise else None),
        "sampling_steps": config.model.sample_steps,
        "guidance": config.model.facts.guidance,
        "resolution": f"{clip.width} × {clip.height} pixels",
        "method": own,
        **_memory_of(config, remembers=remembers),
        "dataset": config.data.path,
        "split": config.evaluate.split,
        "starts": "spread evenly over the way back of every episode; no randomness",
        "observed": "context frames spread evenly over the episode's past, the present one last; "
        + (
            "all are inserted into the map, and the model also sees the present one directly"
            if remembers
            else "the model has no memory and sees only the present one"
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
        "versions": {"pewm_jax": version, "jax": jax.__version__},
        "scene_names": scenes,
        "clip_list": [[choice.name, choice.start] for choice in choices],
        "config": to_dict(config),
    }


def _memory_of(config: Config, *, remembers: bool) -> dict[str, Any]:
    """Return the facts about the memory; nulls if the model has none."""
    facts = config.model.facts
    if not remembers:
        return {"memory": "none"} | dict.fromkeys(("encoder", "reader", "positions", "map"))
    return {
        "memory": facts.memory or "of its own kind",
        "encoder": facts.encoder or None,
        "reader": facts.reader or None,
        "positions": facts.positions,
        "map": facts.capacity or None,
    }


SAMPLES, SAMPLES_VERSION = "samples.npz", 1
PARTS = ("clips", "frames", "rollouts")
"""Parts of the scores: whole clips, (seeds, clips); their frames, (seeds, clips, horizon); and the
frames of long rollouts, (1, rollouts, long horizon)."""


@dataclasses.dataclass(frozen=True)
class Samples:
    """The content of ``samples.npz``: the scores by name, and what they are of.

    ``about`` has ``version``, ``protocol_sha256``, ``weights_sha256``, ``lpips_weights_sha256``,
    ``seeds``, ``clustered_by``, and ``clips`` and ``rollouts``: name, scene and start of each.
    """

    about: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray] = dataclasses.field(repr=False)

    @property
    def own(self) -> str:
        """Return the method of the model itself: ``memory``, or ``model`` if it has none."""
        return own_method(name.split("/")[1] for name in self.arrays)

    def table(self, part: str, method: str) -> dict[str, dict[str, np.ndarray]]:
        """Return ``[mask][metric]`` of one of ``PARTS``; empty if there is no such method."""
        found: dict[str, dict[str, np.ndarray]] = {}
        for name, array in self.arrays.items():
            where, whose, mask, metric = name.split("/")
            if (where, whose) == (part, method):
                found.setdefault(mask, {})[metric] = array
        return found

    def houses(self, part: str) -> list[str]:
        """Return the name of each clip's house: its scene, or its episode if there is one scene."""
        listed = self.about["rollouts" if part == "rollouts" else "clips"]
        return [entry[1 if self.about["clustered_by"] == "scene" else 0] for entry in listed]


def gather_samples(scored: Scored, long: LongRollouts, **facts: Any) -> Samples:
    """Return the scores of every clip, frame and long rollout, with ``facts`` in ``about``."""
    arrays = {}
    for method, sums_SCT39 in scored.sums.items():
        arrays |= _score_arrays("clips", method, sums_SCT39.sum(2))
        arrays |= _score_arrays("frames", method, sums_SCT39)
    for method, sums_SCT39 in long.scored.sums.items():
        arrays |= _score_arrays("rollouts", method, sums_SCT39)
    clips, rollouts = (
        [[choice.name, choice.scene, choice.start] for choice in each.choices]
        for each in (scored, long.scored)
    )
    about = {"version": SAMPLES_VERSION, **facts, "clustered_by": scored.clustered_by}
    return Samples(about | {"clips": clips, "rollouts": rollouts}, arrays)


def _score_arrays(part: str, method: str, sums: np.ndarray) -> dict[str, np.ndarray]:
    return {
        f"{part}/{method}/{mask}/{metric}": values
        for mask, by_metric in scores(sums).items()
        for metric, values in by_metric.items()
    }


def save_samples(folder: Path, samples: Samples) -> None:
    """Write ``samples.npz`` into a report's folder."""
    about = np.array(json.dumps(samples.about))
    with atomic.replacing(folder / SAMPLES) as partial, partial.open("wb") as file:
        np.savez_compressed(file, about=about, **samples.arrays)  # pyright: ignore[reportArgumentType]


def load_samples(folder: Path) -> Samples:
    """Read ``samples.npz`` of a report's folder.

    Raises:
        UserError: it is missing, damaged, or of another version.
    """
    path = folder / SAMPLES
    again = "evaluate the run again with `pewm-jax evaluate`; finished scores are reused"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
            about = json.loads(str(arrays.pop("about")))
    except FileNotFoundError:
        raise UserError(f"{folder} has no {SAMPLES}, the scores clip by clip: {again}.") from None
    except (
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,  # an unknown compression method
        ValueError,
        EOFError,
        KeyError,
    ) as error:
        raise UserError(f"{path} is damaged ({error}): {again}.") from None
    if about.get("version") != SAMPLES_VERSION:
        raise UserError(
            f"{path} is of version {about.get('version')}, this library reads {SAMPLES_VERSION}: "
            f"{again}."
        )
    return Samples(about, arrays)
