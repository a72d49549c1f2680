"""Evaluate a trained run: write ``report/`` with metrics.json, index.html and images."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.data.loader import require_recorded
from pewm_jax.eval import loaded_run as runs
from pewm_jax.eval import reproject, results, steering, voxel_report
from pewm_jax.eval.clips import ClipChoice, fingerprint, lacking_geometry, steered_by_record
from pewm_jax.eval.gallery import make_gallery
from pewm_jax.eval.long_rollouts import LongRollouts, roll_long
from pewm_jax.eval.metrics.selection import ReportMetrics, select_metrics
from pewm_jax.eval.mirror import Mirror, mirror_test, way_out
from pewm_jax.eval.protocol import (
    Protocol,
    apply_protocol_file,
    describe_shortened,
    resolve_clips,
    save_protocol,
)
from pewm_jax.eval.reproject import ReprojectChoice, choose_settings
from pewm_jax.eval.results import compute_metrics
from pewm_jax.eval.runner import Methods, ModelRunner, print_now, workers
from pewm_jax.eval.scoring import Scored, score_coverage, score_table
from pewm_jax.io import atomic
from pewm_jax.io.store import ResultCache, file_hash
from pewm_jax.nn import target
from pewm_jax.report.evaluation_page import Gallery, evaluation_page
from pewm_jax.report.labels import score_lines, summary_lines
from pewm_jax.report.pictures import ROWS, save_png
from pewm_jax.train import processes

TRAINED_ON = "train"
"""The training split."""
REPORT_VERSION = 14
"""Increase it whenever the same scores would give a different report."""
PAGE, METRICS, STRIP, MOVING = "index.html", "metrics.json", "strip.png", "strip.gif"
PROTOCOL = "protocol.json"
"""File of the protocol in a report's folder; another run can be evaluated with it."""


def override(config: Config, **changes: Any) -> Config:
    """Return the configuration with overrides of the evaluation's settings.

    Args:
        config: the run's configuration.
        changes: fields of ``EvalConfig``, ``steps`` (of the sampler) and ``data`` (folder of the
            data set). None keeps the setting.

    Raises:
        ConfigError: a value is invalid.
    """
    changes = {key: value for key, value in changes.items() if value is not None}
    steps, data = changes.pop("steps", None), changes.pop("data", None)
    for name in ("none", "lpips", "protocol", "fvd", "scs", "long"):
        if name in changes:
            changes[name] = str(changes[name])
    if steps is not None:
        if not config.model.sample_steps:
            raise UserError(
                f"--steps is {steps}, but this world has no sampler with a number of steps: "
                "omit it."
            )
        config = dataclasses.replace(config, model=config.model.with_sample_steps(steps))
    if data is not None:
        config = dataclasses.replace(config, data=dataclasses.replace(config.data, path=str(data)))
    return dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, **changes))


def evaluate(
    run: str | Path,
    *,
    out: str | Path | None = None,
    log: Callable[[str], Any] = print_now,
    config: Config | None = None,
    **changes: Any,
) -> Path:
    """Evaluate a trained run and write its report.

    Several processes (``train.processes``) share the work, and the devices of a process share its
    batches; process 0 writes the report.

    After an interruption, finished scores are reused. A report that is complete for these weights
    and this protocol is not written again.

    Args:
        run: a run folder made by ``train.py``.
        out: the output folder; by default ``RUN/report``, or ``RUN/report-NAME`` for other data or
            another split than the run's own.
        log: prints a line.
        config: the run's configuration, if already loaded.
        changes: as for ``override``; with a protocol file, not the settings that it fixes.

    Returns:
        The path of the page.

    Raises:
        UserError: the run, its weights or the data are missing, damaged or incompatible.
    """
    loaded = runs.open_run(run, config)
    job = _open_job(loaded, changes)
    config, folder = job.config, Path(out) if out else runs.report_folder(loaded, job.config)
    processes.barrier("evaluate: begin")
    complete = is_complete(
        folder, config, job.fingerprint, job.none_weights, job.compared, job.validation_hash
    )
    processes.barrier("evaluate: decided")  # nobody may write before all have checked
    if complete:
        log("the report is complete for these weights and this protocol; nothing to do")
        return folder / PAGE
    make_folder(folder)
    cache = workers().first_alone(
        lambda: ResultCache.for_weights(folder / "partial", loaded.weights_hash, job.fingerprint),
        "folder",
    )
    if job.metrics.lpips is None:
        log(job.metrics.about["lpips"])
    choice = workers().first_alone(
        lambda: choose_settings(config, cache, log, job.lacking), "reprojection"
    )
    log(f"reprojection: {choice.why}")
    protocol, clips, rollouts = resolve_clips(config, job.episodes, job.protocol, str(job.split))
    log(f"protocol {protocol.sha256[:12]}: {len(clips)} clips, {len(rollouts)} long rollouts")
    if not job.protocol and (short := describe_shortened(config, protocol)):
        log(short)
    methods = _methods(job, choice, log, cameras=protocol.control == "cameras")
    measured = _measure(job, methods, cache, clips, rollouts, log)
    if not processes.is_primary():
        processes.barrier("evaluate: report")  # a device collective would time out
        return folder / PAGE
    log("drawing the report …")
    metrics = _metrics(job, measured, protocol, choice)
    save_protocol(folder / PROTOCOL, protocol, {"data": str(job.split)})
    _write(folder, metrics, make_gallery(config, job.episodes, measured.long), measured)
    processes.barrier("evaluate: report")
    for line in [*score_lines(metrics), *summary_lines(metrics)]:
        log(line)
    return folder / PAGE


@dataclasses.dataclass(frozen=True)
class _Job:
    """The inputs and settings of an evaluation; ``config`` has the overrides and the protocol's.

    ``lacking`` says which scores the data do not allow, "" if they have depth and poses.
    """

    loaded: runs.LoadedRun
    has_memory: bool
    none: runs.LoadedRun | None
    config: Config
    protocol: Protocol | None
    episodes: EpisodeSource
    metrics: ReportMetrics
    validation_hash: str
    data_hash: str
    lacking: str

    @property
    def split(self) -> Path:
        """Return the folder of the episodes."""
        return Path(self.config.data.path) / self.config.evaluate.split

    @property
    def none_weights(self) -> str:
        """Return the hash of the weights of ``none``, or ""."""
        return self.none.weights_hash if self.none else ""

    @functools.cached_property
    def compared(self) -> dict[str, Any]:
        """Return the entries of the protocol that optional metrics depend on."""
        if not self.config.model.capabilities.voxels:
            return self.metrics.hashes
        return {**self.metrics.hashes, "voxels": voxel_report.settings_of(self.config)}

    @property
    def fingerprint(self) -> str:
        """Return the hash of all that scores depend on."""
        return fingerprint(
            self.config,
            self.loaded.weights_hash,
            self.data_hash,
            self.metrics.lpips.sha256 if self.metrics.lpips else "",
            self.protocol.pieces_sha256 if self.protocol else "",
            self.validation_hash if self.protocol else "",
        )


def _open_job(loaded: runs.LoadedRun, changes: Mapping[str, Any]) -> _Job:
    """Load the data, the metrics and the reference run; raise if a part is missing or unfit."""
    has_memory = runs.has_memory(loaded)
    config, protocol = apply_protocol_file(override(loaded.config, **changes), changes)
    split = Path(config.data.path) / config.evaluate.split
    episodes = EpisodeSource(split)
    require_recorded(config.model, episodes)
    voxel_report.require_data(config, episodes)
    none = runs.open_none(loaded, config)
    data_hash = file_hash(split / MANIFEST)
    metrics = select_metrics(
        config,
        accelerator=target.current().platform != "cpu",
        ids=all(episodes[index].has_ids for index in range(len(episodes))),
    )
    validation = reproject.data_hash(config)
    loaded = runs.with_precision(loaded, config.evaluate.quantize)
    return _Job(
        *(loaded, has_memory, none, config, protocol, episodes, metrics, validation, data_hash),
        lacking=lacking_geometry(episodes),
    )


def _methods(
    job: _Job, choice: ReprojectChoice, log: Callable[[str], Any], *, cameras: bool
) -> Methods:
    """Return the methods to evaluate."""

    def runner(run: runs.LoadedRun, config: Config) -> ModelRunner:
        size, context = job.config.evaluate.batch, job.config.data.context
        devices = jax.local_devices()
        return ModelRunner(config, run.params, size, context, log, cameras=cameras, devices=devices)

    model = runner(job.loaded, job.config)
    none = runner(job.none, job.none.config) if job.none else None
    settings = None if job.lacking else choice.settings
    return Methods(model, settings, none, job.none_weights, job.has_memory)


class _Measured(NamedTuple):
    """The measurements of an evaluation; None for what was not measured."""

    scored: Scored
    long: LongRollouts
    mirror: Mirror | None
    coverage: dict[str, float] | None
    steered: steering.Steered | None
    voxels: dict[str, Any] | None
    about: dict[str, str | None]


def _measure(
    job: _Job,
    methods: Methods,
    cache: ResultCache,
    clips: list[ClipChoice],
    rollouts: list[ClipChoice],
    log: Callable[[str], Any],
) -> _Measured:
    """Imagine and measure everything; results in ``cache`` are reused."""
    config, episodes, metrics = job.config, job.episodes, job.metrics
    scored = score_table(
        config, episodes, methods, cache, log, metrics.lpips, clips, metrics.i3d, metrics.structure
    )
    long = roll_long(config, episodes, methods, cache, log, metrics.lpips, rollouts)
    mirrored = mirror_test(config, episodes, methods, cache, rollouts, metrics.visits, log)
    covered = steered = about_steering = None
    if methods.remembers and config.model.capabilities.coverage:
        covered = score_coverage(config, episodes, methods.model, cache, log, clips)
    if steered_by_record(config.model) or not methods.model.cameras:
        arms = bool(config.model.batch_spec.actions) and steering.shows_arms(episodes)
        measures = steering.Measures(metrics.lpips, metrics.structure, arms)
        steered, about_steering = steering.score(
            config, job.loaded.params, episodes, clips, cache, log, measures
        )
    voxels = voxel_report.score(config, job.loaded.params, episodes, cache, log, metrics.i3d)
    about = {"mirror": way_out(config, rollouts)[1], "steering": about_steering}
    return _Measured(scored, long, mirrored, covered, steered, voxels, about)


def _metrics(
    job: _Job, measured: _Measured, protocol: Protocol, choice: ReprojectChoice
) -> dict[str, Any]:
    """Return the content of ``metrics.json``."""
    i3d, consistency = job.metrics.i3d, job.metrics.structure
    metrics = compute_metrics(job.config, *measured[:3], i3d, consistency)
    metrics["coverage"] = measured.coverage
    metrics["steering"] = measured.steered and measured.steered.facts()
    metrics["voxels"] = measured.voxels
    wanted = job.config.model.batch_spec.actions
    if steered_by_record(job.config.model):
        metrics["protocol"]["motion"] = f"the recorded actions of {wanted} numbers"
    elif protocol.control == "cameras":
        metrics["protocol"]["motion"] = "the recorded cameras, in six degrees of freedom"
    if job.lacking:
        metrics["protocol"] |= {"seen": None, "seen_share": None, "geometry": job.lacking}
    trained_on = Path(job.loaded.config.data.path) / TRAINED_ON
    metrics["protocol"] |= held_out(metrics["protocol"]["scene_names"], trained_on) | {
        "reproject": choice.facts(),
        "none": runs.none_facts(job.none, job.loaded) if job.none else None,
        **job.metrics.about,
        "lpips_name": job.metrics.lpips_name,
        **measured.about,
        **job.compared,
        "weights_sha256": job.loaded.weights_hash,
        "dataset_sha256": job.data_hash,
        "protocol_sha256": protocol.sha256,
        "protocol_file": job.config.evaluate.protocol if job.protocol else None,
        "fingerprint": job.fingerprint,
        "report_version": REPORT_VERSION,
    }
    return metrics


def _write(folder: Path, metrics: dict[str, Any], gallery: Gallery, measured: _Measured) -> None:
    """Write all files of a report except its protocol; ``metrics.json`` last, as a marker."""
    (folder / METRICS).unlink(missing_ok=True)
    names = ("protocol_sha256", "weights_sha256", "lpips_weights_sha256", "seeds")
    facts = {name: metrics["protocol"][name] for name in names}
    samples = results.gather_samples(measured.scored, measured.long, **facts)
    results.save_samples(folder, samples)
    save_png(folder / STRIP, gallery.strip)
    (folder / MOVING).write_bytes(gallery.moving)
    atomic.remove(folder / ROWS)
    for index, row in enumerate(gallery.rows):
        for name, picture in row.items():
            save_png(folder / ROWS / f"{index:02d}-{name}.png", picture)
    page = evaluation_page(metrics, gallery)
    atomic.write_text(folder / PAGE, page)
    metrics["page_sha256"] = hashlib.sha256(page.encode()).hexdigest()
    atomic.write_text(folder / METRICS, json.dumps(metrics, indent=1, allow_nan=False) + "\n")


def make_folder(folder: Path) -> None:
    """Create the folder of a report.

    Raises:
        UserError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder} cannot be created ({error.strerror}); choose another folder with --out."
        ) from None


def is_complete(
    folder: Path,
    config: Config,
    name: str,
    none_weights: str = "",
    extras: Mapping[str, Any] | None = None,
    validation: str = "",
) -> bool:
    """Return whether a folder contains the complete report for these weights and this protocol.

    ``name`` is the fingerprint, ``extras`` the protocol entries of optional metrics. ``validation``
    is the sha256 of the index of the split that chooses the reprojection's settings; reports of
    version 0.1 do not contain it and count as incomplete: their partial scores are kept, and the
    report is written again.
    """
    try:
        metrics = json.loads((folder / METRICS).read_text("utf-8"))
        protocol = metrics["protocol"]
        return (
            protocol["fingerprint"] == name
            and protocol["report_version"] == REPORT_VERSION
            and protocol["seeds"] == list(config.evaluate.seeds)
            and (protocol["none"] or {}).get("weights_sha256", "") == none_weights
            and protocol["reproject"]["dataset_sha256"] == validation
            and protocol["config"]["evaluate"]["videos"] == config.evaluate.videos
            and protocol["config"]["evaluate"]["mirror"] == config.evaluate.mirror
            and {key: protocol[key] for key in extras or {}} == (extras or {})
            and metrics["page_sha256"] == file_hash(folder / PAGE)
            and all((folder / file).is_file() for file in (STRIP, PROTOCOL, results.SAMPLES))
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False


def held_out(scenes: Sequence[str], trained_on: Path) -> dict[str, Any]:
    """Compare the names of the scored scenes with those of the training split's scenes.

    Returns ``held_out``, True if no scene is shared, False if some are, None if the training data
    is not available; and ``trained_scenes``, the scored scenes that are shared.
    """
    try:
        source = EpisodeSource(trained_on)
        known = {source[index].scene for index in range(len(source))}
    except UserError:
        return {"held_out": None, "trained_scenes": []}
    shared = sorted(known & set(scenes))
    return {"held_out": not shared, "trained_scenes": shared}
