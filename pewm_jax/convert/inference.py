"""Export a training run for inference: averaged weights in 16 or 8 bits, settings, a model card.

::

    DST/config.json           the run's settings
        weights.safetensors   all weights of the run, floats rounded to bfloat16 or float16; or
                              kernels to int8 (``nn.deferred.quantize``), the rest to float16
        base.json             the checkpoint the run started from, if any
        README.md             the model card

``pewm_jax.load(DST)`` returns the leaves in the stored dtype, which halves the memory, or kernels
that are stored in 8 bits in float32; the networks still compute in ``model.dtype``, because every
layer casts its weights to it.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import __version__, worlds
from pewm_jax import config as configuration
from pewm_jax import registry as kinds
from pewm_jax.config import Config, UserError, World
from pewm_jax.convert import pipeline
from pewm_jax.data.dataset import read_manifest
from pewm_jax.eval.clips import steered_by_record
from pewm_jax.eval.evaluate import METRICS
from pewm_jax.io import sources, tensor_files, tree, weights
from pewm_jax.io.store import file_hash
from pewm_jax.nn import deferred
from pewm_jax.report import labels
from pewm_jax.report.labels import MASK_NAMES, METHOD_NAMES, METRIC_NAMES, heading, number
from pewm_jax.train import runs
from pewm_jax.types import Params
from pewm_jax.worlds import quantized, rollouts

CARD = "README.md"
INT8 = "int8"
REPORT = Path("report") / METRICS
TRAINED_ON = "train"
"""The training split."""


def export(
    run: Path,
    dst: Path,
    dtype: str | None = "bfloat16",
    *,
    name: str = "",
    log: Callable[[str], Any] = print,
) -> Path:
    """Write the inference weights and settings of a training run into a new folder, ``dst``.

    The run is a folder made by ``train.py`` (or a converted checkpoint in the same form). Its
    weights file already contains the EMA of trained weights and the frozen weights. ``dtype`` None
    stores them unchanged. ``name`` is the model's on the card, by default that of the folder.

    Raises:
        UserError: ``dst`` exists; or the run is missing, damaged, a policy, or has no weights yet.
    """
    if not run.is_dir():
        raise UserError(f"{run} is not a folder; give a run made by train.py.")
    with pipeline.new_folder(dst) as folder:
        log(f"reading {run} …")
        config, params = rollouts.load_finished(run)
        if not config.model.EXPORTED:
            raise UserError(
                f"{run} contains a {kinds.of(config.model).name}, which has no inference form: copy"
                " its config.json and weights.safetensors, which pewm_jax.load reads."
            )
        origin = base_record(run, config)
        metadata = weights.metadata(run / runs.WEIGHTS)
        facts = CardFacts(
            name=name or dst.name,
            dtype=dtype,
            version=__version__,
            config=config,
            params=params,
            stage=metadata.get("stage"),
            step=metadata.get("step"),
            base=sources.read_json(origin) if origin else None,
            metrics=_metrics(run),
        )
        log(f"writing {_count(params) / 1e6:.1f} million parameters …")
        if dtype is None:
            weights.save(folder / runs.WEIGHTS, params, metadata)
        else:
            leaves = tree.flatten(params)
            if dtype == INT8:
                leaves = _in_8_bits(leaves)
            kept = jnp.dtype(jnp.float16 if dtype == INT8 else dtype)
            _write(folder / runs.WEIGHTS, leaves, {**metadata, "dtype": dtype}, kept)
        configuration.save(config, folder / runs.CONFIG)
        if origin:
            shutil.copyfile(origin, folder / runs.BASE)
        (folder / CARD).write_text(write_card(facts), encoding="utf-8")
    log(f"{dst} is ready: pewm_jax.load({str(dst)!r})")
    return dst


def narrow(leaf: Any, dtype: Any = jnp.bfloat16) -> np.ndarray:
    """Return an array with floats rounded to 16 bits; other dtypes unchanged.

    Raises:
        UserError: a float is beyond the range of float16.
    """
    array = np.asarray(leaf)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        return array
    with np.errstate(over="ignore"):
        rounded = array.astype(dtype)
    if np.isfinite(array).all() and not np.isfinite(rounded).all():
        raise UserError("the weights exceed the range of float16: use --dtype bfloat16.")
    return rounded


def _in_8_bits(leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Return leaves with kernels in int8, and their scales; codecs and encoders stay as they are.

    Scales are float32: rounded to 16 bits, those of small weights would lose their precision.
    """
    found: dict[str, Any] = {}
    for name, leaf in leaves.items():
        kernel = name.endswith("kernel") and deferred.is_matrix(name, np.shape(leaf))
        if kernel and name.split("/", maxsplit=1)[0] not in quantized.WHOLE:
            made = deferred.quantize(leaf, INT8, stacked=deferred.is_stacked(name))
            found |= {name: made.values, name + weights.SCALE: made.scale}
        else:
            found[name] = leaf
    return found


def _write(path: Path, leaves: Mapping[str, Any], metadata: Mapping[str, str], dtype: Any) -> None:
    """Write the weights leaf by leaf, rounding one at a time; scales as they are."""

    def rounds(name: str, leaf: Any) -> bool:
        return jnp.issubdtype(leaf.dtype, jnp.floating) and not name.endswith(weights.SCALE)

    like = {
        name: jax.ShapeDtypeStruct(np.shape(leaf), dtype if rounds(name, leaf) else leaf.dtype)
        for name, leaf in leaves.items()
    }

    def narrowed() -> Iterator[tuple[str, np.ndarray]]:
        for name, leaf in leaves.items():
            yield name, narrow(leaf, dtype) if rounds(name, leaf) else np.asarray(leaf)

    tensor_files.write(path, like, narrowed(), tensor_files.header(metadata))


def base_record(run: Path, config: Config) -> Path | None:
    """Return the ``base.json`` of the run, or of the folder it started from, if there is one."""
    places = [run, *([Path(config.train.start)] if config.train.start else [])]
    found = [place / runs.BASE for place in places if (place / runs.BASE).is_file()]
    return found[0] if found else None


def _metrics(run: Path) -> dict[str, Any] | None:
    """Return the metrics of the run's report, if it exists and evaluates these weights."""
    path = run / REPORT
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text("utf-8"))
        scored = found["protocol"]["weights_sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if scored == file_hash(run / runs.WEIGHTS) else None


@dataclasses.dataclass(frozen=True)
class CardFacts:
    """The contents of a model card.

    Attributes:
        name: name of the model, the heading.
        dtype: precision to which weights are rounded, or None.
        version: of this library.
        config: the run's settings.
        params: its weights.
        stage: number of the last finished stage, "0" for converted weights before training.
        step: number of steps of that stage.
        base: the ``base.json`` of the checkpoint that the run started from, if any.
        metrics: the report of these weights, if any.
    """

    name: str
    dtype: str | None
    version: str
    config: Config
    params: Params
    stage: str | None
    step: str | None
    base: Mapping[str, Any] | None
    metrics: Mapping[str, Any] | None


def write_card(facts: CardFacts) -> str:
    """Return the card in Markdown."""
    parts = [f"# {facts.name}", _what(facts), _use(facts), _data(facts), _training(facts)]
    parts += [_scores(facts.metrics, facts.dtype), *_steering(facts.metrics), _licence(facts)]
    return "\n\n".join(parts) + "\n"


def _count(params: Params) -> int:
    return sum(np.size(leaf) for leaf in jax.tree.leaves(params))


def _what(facts: CardFacts) -> str:
    config, clip = facts.config, facts.config.model.clip
    counts = {part: _count(tree) for part, tree in facts.params.items()}
    rows = [f"| {part} | {count / 1e6:.2f} |" for part, count in counts.items()]
    table = "\n".join(["| part | million parameters |", "|---|---:|", *rows])
    if not isinstance(config.model, World):
        return f"{config.model.CARD[0]} pewm_jax {facts.version}.\n\n{table}".lstrip()
    parts, can = config.model.facts, config.model.capabilities
    memory = "no memory"
    if can.memory:
        memory = (
            f"a memory of kind `{parts.memory}`" if parts.memory else "a memory of its own kind"
        )
    if can.memory_parameters and can.memory_parameters not in facts.params:
        memory = "no memory (only its first stage is trained)"
    made_of = [f"image features `{parts.encoder}`"] * bool(parts.encoder and can.memory)
    made_of += [f"codec `{parts.codec}`"] * bool(parts.codec)
    made_of = ", ".join(["", " and ".join(made_of)]) if made_of else ""
    size = f"{clip.frames} frames of {clip.width} × {clip.height} pixels"
    seen = "colour and depth" if can.depth else "in colour"
    given = "A persistent embodied world model: given posed RGB-D frames"
    if not can.memory:
        given = f"An embodied world model: given {'an RGB-D' if can.depth else 'a'} frame"
    return (
        f"{given} and an agent's actions, it "
        f"imagines what the agent will see, {seen}, in clips of {size}, with {memory}{made_of}."
        f"\n\n{table}\n\n"
        "Weights are the moving average of the trained parameters and the unchanged base weights "
        f"elsewhere{_rounding(facts.dtype)}; they compute in "
        f"{config.model.dtype}. Written by "
        f"pewm_jax {facts.version}."
    )


def _use(facts: CardFacts) -> str:
    model = facts.config.model
    if not isinstance(model, World):
        return f"## Use\n\n{model.CARD[1].format(name=facts.name)}"
    clip, actions = facts.config.model.clip, facts.config.model.actions
    length, numbers = clip.frames - 1, model.batch_spec.actions
    steps = f"[0] * {length}"
    how = (
        f"Actions: 0 forward {actions.step_m:g} m, 1 left and 2 right {actions.turn_deg:g}°, or "
        f"floats\n(dx, dy, dyaw); {length} a clip."
    )
    if steered_by_record(model):
        steps = "control"
        what = f"(n, {numbers}) actions"
        if model.capabilities.body:
            what += f" of the body `{model.capabilities.body}`"
        if "state_A" in model.batch_spec.names:
            what += f", ({numbers},) state of the agent at the present frame"
        how = f"`control` is a `pewm_jax.Control`: (n,) cameras, {what}; {length} frames a clip."
    return f"""## Use

```python
import jax
import pewm_jax

config, params = pewm_jax.load("{facts.name}")
state = pewm_jax.start(config, params, frames)  # pewm_jax.Frames, {clip.height} × {clip.width}
state, imagined = pewm_jax.rollout(config, params, state, {steps}, jax.random.key(0))
```

{how}{_sampler(model)}"""


def _sampler(model: World) -> str:
    """Return a sentence on the sampler and the noise; empty for a world without a sampler."""
    names = " ".join(filter(None, (model.facts.noise, model.facts.sampler)))
    return f" Sampling: {names}, {model.sample_steps} steps." if names else ""


def _data(facts: CardFacts) -> str:
    config = facts.config
    if facts.stage == "0":
        return "## Data\n\nNone: see the data of the original checkpoint."
    name = Path(config.data.path).name
    try:
        manifest = read_manifest(Path(config.data.path) / TRAINED_ON, check_files=False)
    except UserError:
        size = "which no longer exists, so its size is unknown"
    else:
        made = manifest.settings.get("made_by")
        how = f", made by `{made}`" if made else ""
        size = f"split `{TRAINED_ON}`: {manifest.records} episodes, {manifest.frames} frames{how}"
    context = ""
    if config.model.batch_spec.context:
        context = f", with up to {config.data.context} earlier frames as context"
    return (
        f"## Data\n\n`{name}`, {size}. Clips take every {config.data.stride_min} to "
        f"{config.data.stride_max} actions a frame{context}."
    )


def _training(facts: CardFacts) -> str:
    train = facts.config.train
    head = "## Training\n\n"
    if facts.stage == "0":
        return head + "None: these are converted weights, before training."
    rows = ["| stage | steps | batch | learning rate | what learns |", "|---|---:|---:|---:|---|"]
    for number_, stage, what in (
        (str(stage.number), stage.settings(facts.config), ", ".join(stage.trained))
        for stage in worlds.stages(facts.config.model)
    ):
        if stage.steps == 0:
            done = "–"
        elif number_ == facts.stage and facts.step is not None:
            done = facts.step
        else:
            done = str(stage.steps) if number_ < (facts.stage or "") else f"0 of {stage.steps}"
        rows.append(f"| {number_} | {done} | {stage.batch} | {stage.learning_rate:g} | {what} |")
    tail = f"\n\nMoving average {train.ema:g}, seed {train.seed}"
    if facts.config.model.facts.noise:
        tail += f", noise {facts.config.model.facts.noise}"
    tail += f". It started from `{train.start}`." if train.start else "."
    return head + "\n".join(rows) + tail


def _rounding(dtype: str | None) -> str:
    """Return what the card says about the precision of the weights."""
    if dtype is None:
        return ""
    if dtype != INT8:
        return ", rounded to 16 bits"
    return ", kernels rounded to 8 bits and all else, with codecs and encoders, to 16 bits"


def _scores(metrics: Mapping[str, Any] | None, dtype: str | None) -> str:
    head = "## Scores\n\n"
    if metrics is None:
        return head + "None: these weights have no report; `python evaluate.py RUN` writes one."
    protocol = metrics["protocol"]
    shown = {
        metric: (heading(metric, protocol), digits)
        for metric, (_, digits) in METRIC_NAMES.items()
        if any(
            metric in scores for masks in metrics["results"].values() for scores in masks.values()
        )
    }
    rows = [
        "| pixels | method | " + " | ".join(name for name, _ in shown.values()) + " |",
        "|---|---|" + "---:|" * len(shown),
    ]
    for mask, where in MASK_NAMES.items():
        for method, label in METHOD_NAMES.items():
            if method not in metrics["results"]:
                continue
            scores = metrics["results"][method][mask]
            cells = [
                number(scores[m], digits) if m in scores else "–"
                for m, (_, digits) in shown.items()
            ]
            rows.append(f"| {where} | {label} | " + " | ".join(cells) + " |")
    new = {True: "none of which", False: "some of which", None: "of which it is not known which"}
    said = (
        f"\n\nMeasured{' before rounding' * bool(dtype)}: {protocol['clips']} clips in "
        f"{protocol['scenes']} scenes, {new[protocol['held_out']]} it was trained in, seeds "
        f"{', '.join(map(str, protocol['seeds']))}, {protocol['sampling_steps']} sampling steps, "
        f"protocol {protocol['fingerprint'][:12]}."
    )
    voxels = "".join(f"\n\n{line}" for line in labels.format_voxels(metrics))
    return head + "\n".join(rows) + said + voxels


def _steering(metrics: Mapping[str, Any] | None) -> list[str]:
    """Return what a report says about the actions; empty if it was not measured."""
    if metrics is None or not metrics.get("steering"):
        return []
    found = metrics["steering"]
    clips = f"{found['clips']} clips, {100 * found['forward']:.0f} % of whose steps go forward"
    return [
        f"With other actions ({clips}):",
        "\n".join(f"- {x}" for x in labels.format_steering(metrics)),
    ]


def _licence(facts: CardFacts) -> str:
    head = "## Licence\n\n"
    if "encoder" in facts.params:
        head += "The image encoder is a converted DINOv2: its weights keep their own licence.\n\n"
    if facts.base is None:
        return head + (
            "Trained from random weights: the trainer chooses a licence and is "
            "responsible for the data."
        )
    name = facts.base.get("name", "a converted checkpoint")
    said = facts.base.get("licence", "not stated")
    return head + (
        f"Made from `{name}`, whose licence is: {said}. It applies to everything "
        "derived from it, including these weights."
    )
