"""Compare two evaluated runs: paired differences per clip, under one protocol."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax import config as configuration
from pewm_jax import shipped
from pewm_jax.config import Config, UserError
from pewm_jax.eval import protocol as protocols
from pewm_jax.eval import results, statistics
from pewm_jax.eval.evaluate import METRICS, PAGE, PROTOCOL, make_folder
from pewm_jax.eval.loaded_run import OWN
from pewm_jax.eval.metrics.images import MASKS
from pewm_jax.eval.protocol import Protocol, difference
from pewm_jax.eval.results import SCHEMA as REPORT_SCHEMA
from pewm_jax.eval.statistics import map_scores
from pewm_jax.io import atomic
from pewm_jax.report import compare_page
from pewm_jax.train import runs

SCHEMA = 1
"""Version of the layout of ``comparison.json``, which ``docs/evaluation.md`` describes."""
COMPARISON = "comparison.json"
SEED, DATA = "train.seed", "data.path"
"""Settings in which seeds of one training may differ; the path in a report is that of the scored
data, whose location does not matter."""


@dataclasses.dataclass(frozen=True)
class Report:
    """A report read from its folder; ``name`` is the run's, as passed by the caller."""

    name: str
    folder: Path
    metrics: Mapping[str, Any]
    samples: results.Samples
    protocol: Protocol

    @property
    def again(self) -> str:
        """The run and the data that it is of, as `pewm-jax evaluate` takes them."""
        if Path(self.name) != self.folder:
            return self.name
        home, data = self.folder.parent, self.metrics["protocol"]["config"]["data"]["path"]
        run = home if (home / "config.json").is_file() else home.name
        return f"{run} --data {data}"

    @property
    def facts(self) -> dict[str, Any]:
        """Return the entry for ``comparison.json``."""
        said = self.metrics["protocol"]
        return {
            "run": self.name,
            "report": str(self.folder),
            "method": self.samples.own,
            "weights_sha256": said["weights_sha256"],
            "training_seed": said["training_seed"],
            "sampler": said["sampler"],
            "sampling_steps": said["sampling_steps"],
        }


def compare(
    one: str | Path,
    two: str | Path,
    *,
    also_one: Sequence[str | Path] = (),
    also_two: Sequence[str | Path] = (),
    out: str | Path | None = None,
    log: Callable[[str], Any] = print,
) -> Path:
    """Write a page and ``comparison.json`` for two runs scored by one protocol.

    Args:
        one: an evaluated run, or the folder of one of its reports.
        two: likewise.
        also_one: runs that differ from ``one`` only in the training seed.
        also_two: likewise for ``two``.
        out: the output folder; by default ``compare-TWO`` beside the first one's report.
        log: prints a line.

    Raises:
        UserError: a run has no report, or one of another version; the protocols differ; or runs
            that should differ only in the training seed differ otherwise.
    """
    groups = [[read(name) for name in names] for names in ([one, *also_one], [two, *also_two])]
    first = groups[0][0]
    for other in (*groups[0][1:], *groups[1]):
        if first.protocol.sha256 != other.protocol.sha256:
            raise UserError(
                f"{first.name} and {other.name} were scored by different protocols "
                f"({first.protocol.sha256[:12]} and {other.protocol.sha256[:12]}: "
                f"{difference(first.protocol, other.protocol)}), so their clips cannot be paired; "
                f"evaluate one with the other's: `pewm-jax evaluate {other.again} --protocol "
                f"{first.folder / PROTOCOL}`."
            )
    for group in groups:
        _require_seeds(group)
    content = content_of(*groups)
    folder = Path(out) if out else first.folder.parent / f"compare-{_short(groups[1][0])}"
    make_folder(folder)
    pictures = compare_page.side_by_side(
        first.protocol.long_horizon, first.folder, groups[1][0].folder
    )
    atomic.write_text(folder / PAGE, compare_page.comparison_page(content, pictures))
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    atomic.write_text(folder / COMPARISON, text + "\n")
    for line in compare_page.sentences(content):
        log(line)
    return folder / PAGE


def read(name: str | Path) -> Report:
    """Read the report of a run, given by its folder, its name, or the folder of the report itself.

    Raises:
        UserError: there is no report, it is of another version, or its files are inconsistent.
    """
    folder = Path(name)
    if not (folder / METRICS).is_file():
        folder = shipped.home(name) / OWN
    again = f"evaluate it with `pewm-jax evaluate {name}`; finished scores are reused"
    try:
        metrics = json.loads((folder / METRICS).read_text("utf-8"))
    except OSError:
        raise UserError(f"{name} has no report in {folder}: {again}.") from None
    except ValueError as error:
        raise UserError(f"{folder / METRICS} is not JSON ({error}): {again}.") from None
    if isinstance(metrics, dict) and "protocol_sha256" not in (metrics.get("protocol") or {}):
        raise UserError(
            f"the report in {folder} contains no protocol: it is of a codec, which cannot be "
            f"compared, or of an earlier version of the library; in that case {again}."
        )
    if not isinstance(metrics, dict) or metrics.get("schema") != REPORT_SCHEMA:
        raise UserError(f"the report in {folder} is of another version of the library: {again}.")
    report = Report(
        str(name),
        folder,
        metrics,
        results.load_samples(folder),
        protocols.load_protocol(folder / PROTOCOL),
    )
    said, about = metrics["protocol"], report.samples.about
    hashes = {said["protocol_sha256"], about["protocol_sha256"], report.protocol.sha256}
    if len(hashes) > 1 or said["weights_sha256"] != about["weights_sha256"]:
        raise UserError(f"the files of {folder} are not of one evaluation: {again}.")
    return report


def _require_seeds(group: Sequence[Report]) -> None:
    """Raise an error unless runs differ only in their training seeds, which must be distinct."""
    if len(group) == 1:
        return
    settings = [
        runs.identity(configuration.from_dict(Config, dict(report.metrics["protocol"]["config"])))
        for report in group
    ]
    for report, there in zip(group[1:], settings[1:], strict=True):
        here = settings[0] | {name: there.get(name) for name in (SEED, DATA)}
        wrong = runs.differences(here, there)
        if wrong:
            raise UserError(
                f"{report.name} and {group[0].name} are not two seeds of one training: "
                f"{'; '.join(wrong)}; compare them with each other instead."
            )
    seeds = [found.get(SEED) for found in settings]
    if len(set(seeds)) < len(seeds):
        raise UserError(
            f"of {', '.join(report.name for report in group)} two were trained with the same seed "
            f"({', '.join(map(str, seeds))}); train each with another --train.seed."
        )


def content_of(one: Sequence[Report], two: Sequence[Report]) -> dict[str, Any]:
    """Return the content of ``comparison.json``, which ``docs/evaluation.md`` describes.

    Differences are first − second. Each argument has the reports of one model's training seeds, all
    of one protocol.
    """
    reports = [*one, *two]
    protocols = [report.metrics["protocol"] for report in reports]
    nets = {each.get("lpips_name") or each["lpips_weights_sha256"] for each in protocols} - {None}
    skip = {"lpips"} if len(nets) > 1 else set()
    clips = [_values(group, "clips", skip) for group in (one, two)]
    measured = [set(table[MASKS[-1]]) for table in clips]
    masked = [set(table["seen"]) | set(table["unseen"]) for table in clips]
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "protocol_sha256": one[0].protocol.sha256,
        "protocol": _facts(one[0]),
        "how": statistics.interval_facts(),
        "lpips_name": one[0].metrics["protocol"].get("lpips_name"),
        "left_out": sorted(skip),
        "measured_by_one": sorted(measured[0] ^ measured[1]),
        "masked_by_one": sorted(masked[0] ^ masked[1]),
        "videos": _videos(one, two),
    }
    sides = {"a": one, "b": two}
    for side, group in sides.items():
        content[side] = {"name": group[0].name, "runs": [report.facts for report in group]}
    content["differences"] = {}
    for part in results.PARTS:
        houses_C = np.unique(one[0].samples.houses(part), return_inverse=True)[1]
        values = {side: _values(group, part, skip) for side, group in sides.items()}
        averaged = {side: map_scores(lambda x: x.mean(0), found) for side, found in values.items()}
        averaged["differences"] = map_scores(np.subtract, averaged["a"], averaged["b"])
        for side, found in averaged.items():
            content[side][part] = map_scores(lambda x, h=houses_C: statistics.entry(x, h), found)
        if part == "clips":
            content["training_seeds"] = _over_seeds(values, houses_C)
            content["by_house"] = _by_house(one[0], averaged, houses_C)
    return content


def _videos(one: Sequence[Report], two: Sequence[Report]) -> dict[str, Any] | None:
    """Return FVD and KVD of both models, means over training seeds; None if one has none.

    They are numbers of a whole set of clips, so they are not paired and have no interval. They are
    compared only if they have equal names: the same network, frames and number of clips.
    """
    everywhere = [report.metrics.get("videos") or {} for report in (*one, *two)]
    names = everywhere[0].get("names")
    if not names or any(videos.get("names") != names for videos in everywhere):
        return None

    def tables(report: Report) -> dict[str, Any]:
        videos = report.metrics["videos"]
        masks = {**videos.get("masks", {}), MASKS[-1]: videos["results"]}
        return {mask: table[report.samples.own] for mask, table in masks.items()}

    sides = [[tables(report) for report in group] for group in (one, two)]
    shared = [mask for mask in MASKS if all(mask in table for group in sides for table in group)]

    def mean(group: Sequence[Mapping[str, Any]], mask: str, kind: str) -> float:
        return float(np.mean([table[mask][kind]["value"] for table in group]))

    values = [{m: {k: mean(group, m, k) for k in names} for m in shared} for group in sides]
    return {"names": names, "a": values[0], "b": values[1]}


def _facts(report: Report) -> dict[str, Any]:
    """Return the facts about the protocol for the page."""
    chosen = report.protocol
    return {
        "episodes": len(chosen.episodes),
        "houses": len(set(report.samples.houses("clips"))),
        "house": report.samples.about["clustered_by"],
        "clips": len(chosen.clips),
        "rollouts": len(chosen.rollouts),
        "sampling_seeds": list(chosen.seeds),
        **{
            name: getattr(chosen, name)
            for name in ("split", "context", "stride", "horizon", "long_horizon", "control")
        },
    }


def _values(group: Sequence[Report], part: str, skip: set[str]) -> dict[str, dict[str, Any]]:
    """Return ``[mask][metric]`` as (K, C, …): training seeds, clips; mean over sampling seeds."""
    tables = [report.samples.table(part, report.samples.own) for report in group]
    found = map_scores(lambda *each: np.stack([x.mean(0) for x in each]), *tables)
    return {m: {k: x for k, x in by.items() if k not in skip} for m, by in found.items()}


def _over_seeds(values: Mapping[str, Any], houses_C: np.ndarray) -> dict[str, Any]:
    """Return each training seed's mean over houses, and intervals over training seeds."""

    def means(values_KC: np.ndarray) -> list[float]:
        return [float(statistics.over_houses(values_C, houses_C)["mean"]) for values_C in values_KC]

    def entry(*groups: list[float]) -> dict[str, Any]:
        if not np.isfinite(np.concatenate(groups)).all():
            return {"mean": None, "low": None, "high": None}
        return statistics.over_seeds(*groups)

    per_seed = {side: map_scores(means, found) for side, found in values.items()}
    found = {side: map_scores(entry, table) for side, table in per_seed.items()}
    for side, table in found.items():
        for mask, by_metric in table.items():
            for metric, numbers in by_metric.items():
                plain = per_seed[side][mask][metric]
                numbers["per_seed"] = [value if np.isfinite(value) else None for value in plain]
    return {**found, "differences": map_scores(entry, per_seed["a"], per_seed["b"])}


def _by_house(
    report: Report, averaged: Mapping[str, Any], houses_C: np.ndarray
) -> list[dict[str, Any]]:
    """Return, per house, its clips and the difference of PSNR under each mask."""
    names, counts = np.unique(report.samples.houses("clips"), return_counts=True)
    found = {
        mask: statistics.within_houses(averaged["differences"][mask]["psnr"], houses_C)
        for mask in MASKS
    }
    return [
        {"house": str(name), "clips": int(count)}
        | {m: float(x[i]) if np.isfinite(x[i]) else None for m, x in found.items()}
        for i, (name, count) in enumerate(zip(names, counts, strict=True))
    ]


def _short(report: Report) -> str:
    """Return a folder name: the run's, with the report's name unless it is the default report."""
    run = report.folder.parent.resolve().name
    return run if report.folder.name == OWN else f"{run}-{report.folder.resolve().name}"
