"""EgoWM's ablation by one command: ways of giving actions to a network, trained for equal time.

Rows: the actions added to the time embedding (the paper), as further tokens that the network
attends to, as further input channels, and a model that was trained without actions; beside them the
observed frame, repeated. Every row has the same codec, network, data, seed and clips. Each gets as
many steps as its time allows (``step_times``). A warped observed frame would tell every row how the
agent moves, and so would drawn arms, so all get it as it is instead (``model.observed every``, no
gate, no ``control.drawn``); LPIPS is not in their loss, since the stage without actions cannot have
it. Trained rows and scores are stored, so that the same command resumes.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import Config, UserError, to_dict
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.errors import require
from pewm_jax.eval import steering
from pewm_jax.io import atomic, weights
from pewm_jax.io.store import TABLE, ResultCache, file_hash, inputs_hash, require_same_inputs
from pewm_jax.report.labels import PUBLISHED_FRAMES
from pewm_jax.report.table import Cell, Table, row, with_interval
from pewm_jax.studies import step_times
from pewm_jax.train import loop
from pewm_jax.train.runs import WEIGHTS
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from pewm_jax.worlds.stages import Stage

Log = Callable[[str], Any]
ROWS = ("timestep", "attention", "channels", "none")
"""Ways of conditioning; ``none`` is trained without actions."""
LABELS = {
    "timestep": "time embedding (the paper)",
    "attention": "tokens that are attended to",
    "channels": "input channels",
    "none": "trained without actions",
    "copy": "the observed frame, repeated",
}
PLAN, RESULTS, PAGE = "plan.json", "results.json", "conditioning.md"


@dataclasses.dataclass(frozen=True)
class Study:
    """The settings of the ablation.

    Attributes:
        base: the settings that all rows share: an EgoWM world with the control ``actions``.
        out: the folder of the results.
        minutes: minutes of training steps of each row; processor time on a CPU.
        steps: number of steps of each row instead; 0 for equal time.
        seeds: training seeds.
        rows: the rows.
        clips: number of held-out clips.
    """

    base: Config
    out: Path
    minutes: float = 30.0
    steps: int = 0
    seeds: tuple[int, ...] = (0,)
    rows: tuple[str, ...] = ROWS
    clips: int = 96

    def __post_init__(self):
        """Validate."""
        model = self.base.model
        require(
            isinstance(model, EgoWM) and isinstance(model.control, ModulationConfig),
            "the ablation compares ways of giving actions to the world egowm: use a preset of that "
            "with the control actions, such as egowm.",
        )
        require(self.minutes > 0, f"--minutes is {self.minutes}: use minutes above 0.")
        require(self.steps >= 0, f"--steps is {self.steps}: use 0 for equal time, or more.")
        require(self.clips >= 1, f"--clips is {self.clips}: use 1 or more.")
        distinct = len(set(self.seeds)) == len(self.seeds)
        require(
            bool(self.seeds) and distinct and min(self.seeds, default=-1) >= 0,
            f"--seeds are {list(self.seeds)}: give distinct seeds of 0 or more.",
        )
        unknown = sorted(set(self.rows) - set(ROWS))
        require(
            not unknown and bool(self.rows),
            f"--rows are {', '.join(self.rows)}: choose from {', '.join(ROWS)}.",
        )

    def folder(self, name: str, seed: int) -> Path:
        """Return the run's folder of a row."""
        return self.out / f"seed{seed}" / name

    def config(self, name: str, seed: int, steps: int) -> Config:
        """Return the settings of one training."""
        base, train = self.base, self.base.train
        assert isinstance(train, EgoWMTrainConfig)
        inject = "timestep" if name == "none" else name
        assert isinstance(base.model.control, ModulationConfig)
        control = dataclasses.replace(base.model.control, inject=inject, drawn=False)
        trained = dataclasses.replace(train.adapt, steps=steps)
        skipped = dataclasses.replace(train.adapt, steps=0)
        stages = (trained, skipped) if name == "none" else (skipped, trained)
        model: dict[str, Any] = {"control": control}
        if base.model.observed == "warped":
            model["observed"] = "every"
        start: dict[str, Any] = {"start": ""}
        codec = base.model.codec
        if not isinstance(codec, PixelConfig):  # the weights of an autoencoder are needed
            start = {"start": train.start, "fresh": (r"(backbone|control)/.*",)}
        elif codec.gate:
            model["codec"] = dataclasses.replace(codec, gate=0)
        return dataclasses.replace(
            base.with_model(**model),
            train=dataclasses.replace(
                train,
                run=str(self.folder(name, seed)),
                **start,
                seed=seed,
                video=stages[0],
                adapt=stages[1],
                gate=dataclasses.replace(train.gate, steps=0),
                denoised_lpips=0.0,
                preview_every=0,
            ),
        )

    def stage(self, name: str) -> Stage:
        """Return the stage that a row trains."""
        video, adapt, _ = self.base.model.stages()
        return video if name == "none" else adapt


def run(study: Study, log: Log = print) -> Path:
    """Train and score the rows, and write the table.

    Returns:
        The path of the table in Markdown; in the same folder are ``.csv`` and ``results.json``.

    Raises:
        UserError: the data are missing or unsuitable, or the folder has results of other settings.
        Interrupted: finished work is stored; the same call resumes.
    """
    names = {"data": "train", "split": study.base.evaluate.split}
    folders = {key: Path(study.base.data.path) / name for key, name in names.items()}
    for folder in folders.values():
        EpisodeSource(folder)  # names a folder that does not exist, and how to make it
    about = {
        "model": inputs_hash([to_dict(study.base.model), to_dict(study.base.evaluate)]),
        **{key: file_hash(folder / MANIFEST) for key, folder in folders.items()},
        "minutes": None if study.steps else study.minutes,
        "steps": study.steps,
        "clips": study.clips,
    }
    require_same_inputs(study.out, about, "trainings")
    plan = _planned(study, log)
    found: dict[str, dict[int, Any]] = {name: {} for name in study.rows}
    for seed in study.seeds:
        for name in study.rows:
            log(f"{LABELS[name]}, training seed {seed}: {plan[name]['steps']} steps")
            found[name][seed] = _trained_and_scored(study, name, seed, plan[name]["steps"], log)
            _write(study, about, plan, {k: v for k, v in found.items() if v})
    return study.out / PAGE


def _planned(study: Study, log: Log) -> dict[str, dict[str, Any]]:
    """Return the seconds per step and the number of steps of each row; measured once."""
    path = study.out / PLAN
    seconds: dict[str, float] = {}
    if path.exists():
        try:
            seconds = {str(k): float(v) for k, v in json.loads(path.read_text("utf-8")).items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise UserError(
                f"{path} is damaged ({error}), but it defines the lengths of trainings: restore "
                "it, or use another folder by --out."
            ) from None
    if not study.steps and set(study.rows) - set(seconds):
        trainings = {
            name: (LABELS[name], study.config(name, 0, 1), study.stage(name)) for name in ROWS
        }
        seconds = step_times.measure(trainings, log)
        atomic.write_text(path, json.dumps(seconds, indent=1) + "\n")

    def steps(name: str) -> int:
        return study.steps or max(round(60 * study.minutes / seconds[name]), 1)

    return {name: {"seconds": seconds.get(name), "steps": steps(name)} for name in study.rows}


def _trained_and_scored(study: Study, name: str, seed: int, steps: int, log: Log) -> dict[str, Any]:
    """Train a row, unless it is trained, and return its scores, ``Steered.facts``."""
    config = study.config(name, seed, steps)
    folder = study.folder(name, seed)
    loop.train(config, log=log)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    cache = ResultCache(study.out, TABLE)
    digest = file_hash(folder / WEIGHTS)[:16]

    def score() -> dict[str, Any]:
        log(f"scoring {name} …")
        params = weights.load(folder / WEIGHTS)
        episodes = EpisodeSource(Path(config.data.path) / config.evaluate.split)
        measures = steering.Measures.chosen(config, episodes)
        found = steering.measure(config, params, episodes, study.clips, measures=measures)
        return found.facts() | {"clips_are": found.walks.about}

    return cache.compute(f"scores/{name}-seed{seed}-{digest}", score)


def _write(
    study: Study,
    about: Mapping[str, Any],
    plan: Mapping[str, Any],
    found: Mapping[str, Mapping[int, Any]],
) -> None:
    """Write the table of all scores so far."""
    day = dt.datetime.now(dt.UTC).date().isoformat()
    facts = {**about, "rows": plan, "date": day}
    numbers = {"about": facts, "results": {k: dict(v) for k, v in found.items()}}
    text = json.dumps(numbers, indent=1, allow_nan=False, ensure_ascii=False)
    atomic.write_text(study.out / RESULTS, text + "\n")
    table = table_of(found, plan)
    first = next(iter(next(iter(found.values())).values()))
    length = f"{study.steps} steps" if study.steps else f"{study.minutes:g} minutes of steps"
    introduction = (
        f"Every row was trained for {length} with training seed "
        f"{', '.join(map(str, study.seeds))}; {first['clips_are']}. Means over houses of the first "
        "training seed, in brackets the 95 % interval of a bootstrap over them. *Other*: with the "
        "actions of a clip in another house."
    )
    lines = [
        "# Ways of giving actions to a network",
        introduction,
        table.markdown(),
        "`results.json` has all numbers, per frame and per training seed.",
    ]
    atomic.write_text(study.out / PAGE, "\n\n".join(lines) + "\n")
    atomic.write_text((study.out / PAGE).with_suffix(".csv"), table.csv())


def table_of(found: Mapping[str, Mapping[int, Any]], plan: Mapping[str, Any]) -> Table:
    """Return the table: a row per way of conditioning, and one of copying."""
    firsts = {name: next(iter(each.values())) for name, each in found.items()}
    some = next(iter(firsts.values()))
    known = [name for name in steering.SCORES if name in some["scores"]]
    frames = len(some["per_frame"]["true"]["mean"])
    at = [t for t in PUBLISHED_FRAMES if t <= frames] or [frames]
    heads = ["", "steps", "PSNR, dB", "PSNR, true − other"]
    for name in known:
        title = some["scores"][name]["name"]
        if name == "lpips":
            heads += [f"{title}, frame {t}" for t in at]
        else:
            heads += [title, f"{title}, other"]

    def cells(facts: Mapping[str, Any], kind: str) -> list[Cell | str]:
        own = kind == steering.TRUE
        gain = facts["all"].get("true - shuffled") if own else None
        out: list[Cell | str] = [with_interval(facts["all"][kind], 2)]
        out.append(with_interval(gain, 2, sign=True) if gain else "–")
        for name in known:
            score = facts["scores"][name]
            digits = 1 if name == "scs" else 3
            if name == "lpips":
                steps = score["per_frame"][kind]
                each = [{k: steps[k][t - 1] for k in ("mean", "low", "high")} for t in at]
                out += [with_interval(entry, digits) for entry in each]
            else:
                out.append(with_interval(score["all"][kind], digits))
                out.append(with_interval(score["all"]["shuffled"], digits) if own else "–")
        return out

    rows = [
        row(LABELS[name], str(plan[name]["steps"]), *cells(facts, steering.TRUE))
        for name, facts in firsts.items()
    ]
    rows.append(row(LABELS["copy"], "–", *cells(some, steering.COPY)))
    return Table(tuple(heads), rows)
