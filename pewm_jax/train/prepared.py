"""Clips prepared once and drawn again and again.

What a step computes with frozen weights, before anything that is trained, is the same each time a
clip is drawn: its latents, its memory, what the memory shows. On a CPU that takes longer than the
step itself. With ``data.prepared`` that many clips are prepared before the first step, kept in this
process's main memory, and batches are drawn from them. With ``data.prepared_path`` they lie in that
folder instead, a file for each batch: the next run that prepares the same finds them, and one that
was stopped goes on where it stopped. A subfolder is named by a hash of all that they depend on.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import read_manifest
from pewm_jax.io import atomic, tensor_files, tree
from pewm_jax.io.progress import Meter
from pewm_jax.train.stages import Stage
from pewm_jax.types import Clip, Params

DIGESTS = "prepared.json"
"""In the run's folder: stage → digest of the weights that prepared its clips."""
VERSION = 1
"""Of what prepared clips hold; another one prepares them again."""


def applies(config: Config, stage: Stage) -> bool:
    """Tell whether a stage's clips are prepared once.

    Raises:
        UserError: they should be, but the world cannot, or there are several processes.
    """
    if not config.data.prepared:
        return False
    if stage.prepare is None:
        raise UserError(
            f"data.prepared is {config.data.prepared}, but stage {stage.name} prepares nothing: "
            "use data.prepared 0."
        )
    if jax.process_count() > 1:
        raise UserError(
            f"data.prepared is {config.data.prepared}, but there are {jax.process_count()} "
            "processes: prepared clips are kept by one; use data.prepared 0."
        )
    return True


def gather(
    config: Config,
    stage: Stage,
    params: Params,
    read: Callable[[int], Iterator[Clip]],
    unless_stopped: Callable[[Callable[[], Any]], Any],
    digest: str = "",
) -> list[Clip] | None:
    """Prepare at least ``data.prepared`` clips, no more than are drawn, or find them prepared.

    Args:
        config: the experiment.
        stage: says how (``Stage.prepare``).
        params: the weights.
        read: returns the batches of clips to prepare, from that of the given number on.
        unless_stopped: calls what it is given, or returns None when training shall stop.
        digest: from ``start_digest``; if empty, that of ``params``.

    Returns:
        Batches of NumPy arrays, in memory or in files that are mapped; None if training shall stop.
    """
    assert stage.prepare is not None
    make = jax.jit(functools.partial(stage.prepare, config.model))
    count = _batches(config, stage)
    folder = None
    if config.data.prepared_path:
        folder = _folder(config, stage, digest or _digest(stage, params))
    kept: list[Clip] = []
    if folder is not None:
        like = jax.eval_shape(make, params, next(read(0)))
        while len(kept) < count and (file := _file(folder, len(kept))).is_file():
            kept.append(_mapped(file, like))
    if len(kept) == count:
        return kept
    batches = read(len(kept))
    with Meter(f"preparing {stage.title}'s clips", count - len(kept), "batches") as meter:
        for number in range(len(kept), count):
            batch = unless_stopped(lambda: next(batches))
            if batch is None:
                return None
            clip = jax.device_get(make(params, batch))
            if folder is not None:
                leaves = _named(clip)
                file = _file(folder, number)
                tensor_files.write(file, leaves, leaves.items(), tensor_files.header({}))
                clip = _mapped(file, like)
            kept.append(clip)
            meter.advance(1)
    return kept


def start_digest(run: Path, stage: Stage, params: Params, done: int) -> str:
    """Return the digest of the weights that prepare clips, as the stage started with them.

    A stage may train some of them, as stage ``gate`` trains a part of the codec. So the digest is
    written into the run's folder before the first step, and read when the stage is resumed.

    Args:
        run: the run's folder.
        stage: the stage.
        params: all parameters after ``done`` steps.
        done: steps of the stage done before.
    """
    file = run / DIGESTS
    known = json.loads(file.read_text("utf-8")) if file.is_file() else {}
    if done and stage.name in known:
        return known[stage.name]
    found = _digest(stage, params)
    if not done and known.get(stage.name) != found:
        atomic.write_text(file, json.dumps(known | {stage.name: found}, indent=1) + "\n")
    return found


def _digest(stage: Stage, params: Params) -> str:
    return tree.digest({name: params[name] for name in stage.prepares_by if name in params})


def seed(config: Config, stage: Stage) -> int:
    """Return the seed by which clips to prepare are chosen, alike in stages that read a memory."""
    return config.train.seed + 1 + stage.memory


def _folder(config: Config, stage: Stage, weights: str) -> Path:
    """Return the folder of these clips, named after all that they depend on.

    Args:
        config: the experiment.
        stage: the stage.
        weights: from ``start_digest``.
    """
    model = configuration.to_dict(config.model)
    if "backbone" not in stage.prepares_by:
        for part in ("backbone", "noise", *(() if stage.memory else ("memory",))):
            model.pop(part, None)
    reader = model.get("memory", {}).get("reader", {})
    if reader.get("picture") == "pixels":  # as it was before there was a choice
        del reader["picture"]
    data = configuration.to_dict(config.data)
    split = read_manifest(Path(config.data.path) / "train")
    for setting in ("path", "features", "prepared", "prepared_path", "workers", "bad_records"):
        data.pop(setting)
    facts = {
        "version": VERSION,
        "model": model,
        "data": data,
        "split": [shard.sha256 for shard in split.shards],
        "weights": weights,
        "memory": stage.memory,
        "by": stage.prepares_by,
        "seed": seed(config, stage),
        "batch": stage.settings(config).batch,
    }
    text = json.dumps(facts, sort_keys=True)
    kind = "memory" if stage.memory else "frames"
    name = f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return Path(config.data.prepared_path) / name


def _named(clip: Clip) -> dict[str, Any]:
    """Return the arrays of a clip by their names in files, which are those of earlier versions."""
    renamed = {"readout": "sight"}
    found = {}
    for path, leaf in tree.flatten(clip).items():
        first, slash, rest = path.removeprefix("extras/").partition("/")
        found[renamed.get(first, first) + slash + rest] = leaf
    return found


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:05}.safetensors"


def _mapped(file: Path, like: Clip) -> Clip:
    """Map a file of prepared clips, and refuse one of other shapes."""
    found, names = tensor_files.mapped(file), _named(like)
    for name, leaf in names.items():
        if name not in found or found[name].shape != leaf.shape or found[name].dtype != leaf.dtype:
            raise UserError(
                f"{file} does not hold the prepared clips that this run needs ({name} differs): "
                "remove its folder, and they are prepared again."
            )
    return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name in names])


def draw(prepared: Sequence[Clip], batch: int, seed: int, start: int = 0) -> Iterator[Clip]:
    """Draw batches without end; batch k depends on the seed and on k alone.

    Every clip comes once before any comes again, in another order each time.

    Args:
        prepared: from ``gather``: batches that hold N clips in all.
        batch: clips in a batch, at most N.
        seed: of the order.
        start: number of the first batch.
    """
    sizes = [len(jax.tree.leaves(part)[0]) for part in prepared]
    places = [(part, row) for part, size in enumerate(sizes) for row in range(size)]
    for number in itertools.count(start):
        chosen = [places[row] for row in _rows(len(places), batch, seed, number)]
        clips = (jax.tree.map(lambda x, r=row: x[r], prepared[part]) for part, row in chosen)
        yield jax.tree.map(lambda *rows: np.stack(rows), *clips)


def rows(config: Config, stage: Stage, number: int) -> list[int]:
    """Return which of the prepared clips are in batch ``number``; see ``draw``.

    Clip r was row r mod B of batch r div B of the loader, batches of B.
    """
    batch = stage.settings(config).batch
    count = _batches(config, stage) * batch
    return _rows(count, batch, stage.data_seed(config), number)


def _batches(config: Config, stage: Stage) -> int:
    """Return how many batches of clips are prepared."""
    settings = stage.settings(config)
    return min(-(-config.data.prepared // settings.batch), max(settings.steps, 1))


def _rows(count: int, batch: int, seed: int, number: int) -> list[int]:
    places = range(number * batch, (number + 1) * batch)
    return [int(_order(count, seed, place // count)[place % count]) for place in places]


@functools.lru_cache(maxsize=4)
def _order(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)
