"""Batches placed on the devices ahead of time; each process reads its own rows."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import queue
import threading
import types
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from jax.sharding import Sharding

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import read_manifest
from pewm_jax.io import atomic, tensor_files, tree
from pewm_jax.io.progress import Meter
from pewm_jax.train.stages import Stage
from pewm_jax.types import Clip, Params

AHEAD = 2
_POLL_S = 0.2


def rows_of(where: Sharding, batch: int) -> slice:
    """Return the rows of a batch that this process reads: all from its first to its last.

    Processes whose devices hold the same rows (they share a clip's tokens or heads) get the same
    slice. Where the mesh interleaves processes, the slice includes rows of others.

    Args:
        where: the sharding of the batch.
        batch: its size in all processes together.
    """
    held = _held(where, batch)
    return slice(int(held[0]), int(held[-1]) + 1)


def place(clip: Clip, where: Sharding, batch: int) -> Clip:
    """Make a batch that is spread over all processes from the rows that each of them has.

    Args:
        clip: the rows of this process, as ``rows_of`` says.
        where: the sharding of every array.
        batch: the size of the batch in all processes together.
    """
    held = _held(where, batch)
    own = held - held[0]
    if len(own) <= own[-1]:  # JAX takes a process's own rows only, without those in between
        clip = jax.tree.map(lambda rows: rows[own], clip)
    shapes = jax.tree.map(lambda rows: (batch, *rows.shape[1:]), clip)
    return jax.make_array_from_process_local_data(where, clip, shapes)


def _held(where: Sharding, batch: int) -> np.ndarray:
    """Return the numbers of the rows on this process's devices, ascending."""
    parts = where.addressable_devices_indices_map((batch,)).values()
    return np.unique([row for index in parts if index for row in range(batch)[index[0]]])


class Feed:
    """Reads batches in a thread and places them on the devices, a few ahead.

    A context manager and an iterator; an error of the source is raised where the batch would have
    been taken.

    Args:
        batches: the source; it is closed at the end when it has a ``close`` method.
        where: the placement of every array of a batch.
        batch: clips per batch, of which the source has this process's rows; None where there is
            but one process.
        ahead: batches kept ready.
    """

    def __init__(
        self,
        batches: Iterator[Clip],
        where: Sharding,
        batch: int | None = None,
        ahead: int = AHEAD,
    ):
        self._batches = batches
        self._where, self._batch = where, batch
        self._ready: queue.Queue[Clip | BaseException] = queue.Queue(ahead)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._fill, name="feed", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    def __iter__(self) -> Feed:
        return self

    def __next__(self) -> Clip:
        """Take the next batch, waiting for it where the source is slower than training."""
        item = self._ready.get()
        if isinstance(item, BaseException):
            raise item
        return item

    def _fill(self) -> None:
        try:
            for batch in self._batches:
                if not self._put(self._placed(batch)):
                    break
            else:
                self._put(UserError("The training data ended before the training did."))
        except BaseException as error:  # noqa: BLE001 - handed to the thread that trains
            self._put(error)
        finally:
            close = getattr(self._batches, "close", None)
            if close is not None:
                close()

    def _placed(self, clip: Clip) -> Clip:
        if self._batch is None:
            return jax.device_put(clip, self._where)
        return place(clip, self._where, self._batch)

    def _put(self, item: Clip | BaseException) -> bool:
        """Wait for room; False when the training is over."""
        while not self._over.is_set():
            try:
                self._ready.put(item, timeout=_POLL_S)
            except queue.Full:
                continue
            return True
        return False


PREPARED_DIGESTS = "prepared.json"
"""In the run's folder: stage → digest of the weights that prepared its clips."""
PREPARED_VERSION = 1
"""Of what prepared clips hold; another one prepares them again."""


def uses_prepared(config: Config, stage: Stage) -> bool:
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


def prepare_clips(
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
    file = run / PREPARED_DIGESTS
    known = json.loads(file.read_text("utf-8")) if file.is_file() else {}
    if done and stage.name in known:
        return known[stage.name]
    found = _digest(stage, params)
    if not done and known.get(stage.name) != found:
        atomic.write_text(file, json.dumps(known | {stage.name: found}, indent=1) + "\n")
    return found


def _digest(stage: Stage, params: Params) -> str:
    return tree.digest({name: params[name] for name in stage.prepares_by if name in params})


def prepared_seed(config: Config, stage: Stage) -> int:
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
        "version": PREPARED_VERSION,
        "model": model,
        "data": data,
        "split": [shard.sha256 for shard in split.shards],
        "weights": weights,
        "memory": stage.memory,
        "by": stage.prepares_by,
        "seed": prepared_seed(config, stage),
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


def draw_prepared(
    prepared: Sequence[Clip], batch: int, seed: int, start: int = 0
) -> Iterator[Clip]:
    """Draw batches without end; batch k depends on the seed and on k alone.

    Every clip comes once before any comes again, in another order each time.

    Args:
        prepared: from ``prepare_clips``: batches that hold N clips in all.
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


def prepared_rows(config: Config, stage: Stage, number: int) -> list[int]:
    """Return which of the prepared clips are in batch ``number``; see ``draw_prepared``.

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
