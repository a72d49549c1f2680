"""The report of a trained run: ``report/`` with metrics.json, index.html and its pictures."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.eval import loaded_run as runs
from pewm_jax.eval import protocol_file, reproject_choice, samples, steering
from pewm_jax.eval.covered import score_coverage
from pewm_jax.eval.fixed import decide, shortened
from pewm_jax.eval.gallery import make_gallery
from pewm_jax.eval.imagine import Imagination, print_now
from pewm_jax.eval.long_rollouts import LongRollouts, roll_long
from pewm_jax.eval.measure import measure
from pewm_jax.eval.methods import Methods
from pewm_jax.eval.metrics import chosen
from pewm_jax.eval.mirror import look_back, way_out
from pewm_jax.eval.partial import Partials
from pewm_jax.eval.protocol import ClipChoice, file_hash, fingerprint
from pewm_jax.eval.scoring import Scored, score_table
from pewm_jax.eval.shares import first_alone
from pewm_jax.io import atomic
from pewm_jax.report.evaluation_page import Gallery, evaluation_page
from pewm_jax.report.labels import score_lines, summary_lines
from pewm_jax.report.pictures import ROWS, save_png
from pewm_jax.train import processes

TRAINED_ON = "train"
"""The split that training reads."""
REPORT_VERSION = 11
"""Increase it whenever the same scores would give another report."""
PAGE, METRICS, STRIP, MOVING = "index.html", "metrics.json", "strip.png", "strip.gif"
PROTOCOL = "protocol.json"
"""The protocol of a report, in its folder; another run can be scored by it."""


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
    for name in ("none", "lpips", "protocol", "fvd", "scs"):
        if name in changes:
            changes[name] = str(changes[name])
    if steps is not None:
        if not config.model.sample_steps:
            raise UserError(
                f"--steps is {steps}, and this world has no sampler whose steps could be chosen: "
                "leave it out."
            )
        config = dataclasses.replace(config, model=config.model.with_sample_steps(steps))
    if data is not None:
        config = dataclasses.replace(config, data=dataclasses.replace(config.data, path=str(data)))
    return dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, **changes))


def evaluate(
    run: str | Path,
    *,
    out: str | Path | None = None,
    say: Callable[[str], Any] = print_now,
    **changes: Any,
) -> Path:
    """Score a trained run and write its report.

    Several processes (``training.processes``) share the work, and several devices of one process
    its batches; the first process writes the report.

    After an interruption, finished scores are reused. A report that is complete for these weights
    and this protocol is not written again.

    Args:
        run: a run folder made by ``train.py``.
        out: the folder to write; by default ``RUN/report``, or ``RUN/report-NAME`` for other data
            or another split than the run's own.
        say: shows a progress line.
        changes: as for ``override``; beside a protocol's file not what it fixes.

    Returns:
        The path of the page.

    Raises:
        UserError: the run, its weights or the data are absent, damaged, or do not fit together.
    """
    opened = runs.open_run(run)
    remembers = runs.remembers(opened)
    trained_on = Path(opened.config.data.path) / TRAINED_ON
    config, fixed = protocol_file.given(override(opened.config, **changes), changes)
    split = Path(config.data.path) / config.evaluate.split
    episodes = EpisodeSource(split)
    none = runs.open_none(opened, config)
    none_weights = none.weights_hash if none else ""
    data_hash = file_hash(split / MANIFEST)
    measures = chosen.choose(
        config,
        accelerator=jax.default_backend() != "cpu",
        ids=all(episodes[index].has_ids for index in range(len(episodes))),
    )
    lpips = measures.lpips
    validation = reproject_choice.data_hash(config)
    name = fingerprint(
        config,
        opened.weights_hash,
        data_hash,
        lpips.sha256 if lpips else "",
        fixed.pieces_sha256 if fixed else "",
        validation if fixed else "",
    )
    folder = Path(out) if out else runs.report_folder(opened, config)
    processes.meet("evaluate: begin")
    complete = is_complete(folder, config, name, none_weights, measures.hashes, validation)
    processes.meet("evaluate: decided")  # nobody writes before all have looked
    if complete:
        say("the report is complete for these weights and this protocol; nothing to do")
        return folder / PAGE
    make_folder(folder)
    partials = first_alone(
        lambda: Partials(folder / "partial", opened.weights_hash, name), "folder"
    )
    if lpips is None:
        say(measures.about["lpips"])
    choice = first_alone(
        lambda: reproject_choice.choose_settings(config, partials, say), "reprojection"
    )
    say(f"reprojection: {choice.why}")
    protocol, clips, rollouts = decide(config, episodes, fixed, str(split))
    cameras = protocol.control == "cameras"
    say(f"protocol {protocol.sha256[:12]}: {len(clips)} clips, {len(rollouts)} long rollouts")
    if not fixed and (short := shortened(config, protocol)):
        say(short)

    def imagination(which: runs.Opened, settings: Config) -> Imagination:
        batch, context = config.evaluate.batch, config.data.context
        return Imagination(
            settings,
            which.params,
            batch,
            context,
            say,
            cameras=cameras,
            devices=jax.local_devices(),
        )

    methods = Methods(
        imagination(opened, config),
        choice.settings,
        imagination(none, none.config) if none else None,
        none_weights,
        remembers,
    )
    scored = score_table(
        config, episodes, methods, partials, say, lpips, clips, measures.i3d, measures.structure
    )
    long = roll_long(config, episodes, methods, partials, say, lpips, rollouts)
    back = look_back(config, episodes, methods, partials, rollouts, measures.visits, say)
    asked, about_steering = _asked(opened, config, episodes, methods.model, partials, say, clips)
    if not processes.is_primary():
        processes.meet("evaluate: report")  # devices that wait for one another would give up
        return folder / PAGE
    say("drawing the report …")
    metrics = measure(config, scored, long, back, measures.i3d, measures.structure)
    metrics |= asked
    if cameras:
        metrics["protocol"]["motion"] = "the recorded cameras, in six degrees of freedom"
    metrics["protocol"] |= held_out(metrics["protocol"]["scene_names"], trained_on) | {
        "reproject": choice.facts(),
        "none": runs.none_facts(none, opened) if none else None,
        **measures.about,
        "lpips_name": measures.lpips_name,
        "mirror": way_out(config, rollouts)[1],
        "steering": about_steering,
        **measures.hashes,
        "weights_sha256": opened.weights_hash,
        "dataset_sha256": data_hash,
        "protocol_sha256": protocol.sha256,
        "protocol_file": config.evaluate.protocol if fixed else None,
        "fingerprint": name,
        "report_version": REPORT_VERSION,
    }
    protocol_file.save(folder / PROTOCOL, protocol, {"data": str(split)})
    _write(folder, metrics, make_gallery(config, episodes, long), scored, long)
    processes.meet("evaluate: report")
    for line in [*score_lines(metrics), *summary_lines(metrics)]:
        say(line)
    return folder / PAGE


def _asked(
    opened: runs.Opened,
    config: Config,
    episodes: EpisodeSource,
    model: Imagination,
    partials: Partials,
    say: Callable[[str], Any],
    clips: Sequence[ClipChoice],
) -> tuple[dict[str, Any], str | None]:
    """Return what only some models are asked: what the map covers, and whether actions steer.

    The second value is a sentence on the clips that say whether actions steer, or on why that is
    not measured; None of a model that is not steered by actions.
    """
    covered = steered = about = None
    # A memory that is the state of its world has no tokens that could be counted.
    if runs.remembers(opened) and config.model.capabilities.coverage:
        covered = score_coverage(config, episodes, model, partials, say, clips)
    if not model.cameras:
        steered, about = steering.score(config, opened.params, episodes, clips, partials, say)
    return {"coverage": covered, "steering": steered and steered.facts()}, about


def _write(
    folder: Path,
    metrics: dict[str, Any],
    gallery: Gallery,
    scored: Scored,
    long: LongRollouts,
) -> None:
    """Write all files of a report but its protocol; ``metrics.json``, which says so, at the end."""
    (folder / METRICS).unlink(missing_ok=True)
    names = ("protocol_sha256", "weights_sha256", "lpips_weights_sha256", "seeds")
    facts = {name: metrics["protocol"][name] for name in names}
    samples.save(folder, samples.gather(scored, long, **facts))
    _save_pictures(folder, gallery)
    page = evaluation_page(metrics, gallery)
    atomic.write_text(folder / PAGE, page)
    metrics["page_sha256"] = hashlib.sha256(page.encode()).hexdigest()
    atomic.write_text(folder / METRICS, json.dumps(metrics, indent=1, allow_nan=False) + "\n")


def _save_pictures(folder: Path, gallery: Gallery) -> None:
    """Write the strip, still and moving, and the frames of each long rollout and method."""
    save_png(folder / STRIP, gallery.strip)
    (folder / MOVING).write_bytes(gallery.moving)
    atomic.remove(folder / ROWS)
    for index, row in enumerate(gallery.rows):
        for name, picture in row.items():
            save_png(folder / ROWS / f"{index:02d}-{name}.png", picture)


def make_folder(folder: Path) -> None:
    """Make the folder of a report.

    Raises:
        UserError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder} cannot be made ({error.strerror}); choose another folder with --out."
        ) from None


def is_complete(
    folder: Path,
    config: Config,
    name: str,
    none_weights: str = "",
    extras: Mapping[str, Any] | None = None,
    validation: str = "",
) -> bool:
    """Tell whether a folder holds the complete report for a fingerprint, seeds, videos and rival.

    Args:
        folder: the report's.
        config: the run's configuration, with overrides for the evaluation.
        name: the fingerprint of weights and protocol.
        none_weights: sha256 of the weights of the model without a memory; "" if there is none.
        extras: entries of the protocol on measures that can be left out.
        validation: sha256 of the index of the split that chooses the reprojection's settings; ""
            if there is none. Reports of version 0.1 do not state it and are not complete: their
            partial scores are kept, and the report is written again.
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
            and all((folder / file).is_file() for file in (STRIP, PROTOCOL, samples.SAMPLES))
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
