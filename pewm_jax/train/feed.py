"""Batches placed on the devices ahead of time, and clips that are prepared once."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Sharding

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import read_manifest
from pewm_jax.io import atomic, tensor_files, tree
from pewm_jax.io.progress import Meter
from pewm_jax.types import Clip, Params
from pewm_jax.worlds.stages import Stage

AHEAD = 2
"""Number of batches kept ready on the devices."""
_POLL_S = 0.2


def rows_of(where: Sharding, batch: int) -> slice:
    """Return the rows of a batch that this process reads: all from its first to its last.

    Processes whose devices need the same rows (they share a clip's tokens or heads) get the same
    slice. If the mesh interleaves processes, the slice includes rows of other processes.
    """
    held = _rows_on_process(where, batch)
    return slice(int(held[0]), int(held[-1]) + 1)


def place(clip: Clip, where: Sharding, batch: int) -> Clip:
    """Make a global batch from the rows that each process has read (``rows_of``)."""
    held = _rows_on_process(where, batch)
    own = held - held[0]
    if len(own) <= own[-1]:  # JAX takes only the rows that the process owns
        clip = jax.tree.map(lambda rows: rows[own], clip)
    shapes = jax.tree.map(lambda rows: (batch, *rows.shape[1:]), clip)
    return jax.make_array_from_process_local_data(where, clip, shapes)


def _rows_on_process(where: Sharding, batch: int) -> np.ndarray:
    """Return the indices of the rows on this process's devices, in ascending order."""
    parts = where.addressable_devices_indices_map((batch,)).values()
    return np.unique([row for index in parts if index for row in range(batch)[index[0]]])


class Feed:
    """Reads batches in a thread and places a few of them on the devices ahead of time.

    A context manager and an iterator; an error of the source is raised by ``next``.

    Args:
        batches: the source; closed at the end if it has a ``close`` method.
        where: the sharding of every array of a batch.
        batch: the global batch size; the source yields only this process's rows.
    """

    def __init__(self, batches: Iterator[Clip], where: Sharding, batch: int):
        self._batches = batches
        self._where, self._batch = where, batch
        self._ready: queue.Queue[Clip | BaseException] = queue.Queue(AHEAD)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._fill, name="feed", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def __iter__(self) -> Feed:
        return self

    def __next__(self) -> Clip:
        """Return the next batch; wait if the source is slower than training."""
        item = self._ready.get()
        if isinstance(item, BaseException):
            raise item
        return item

    def _fill(self) -> None:
        try:
            for batch in self._batches:
                if not self._put(place(batch, self._where, self._batch)):
                    break
            else:
                self._put(UserError("The training data ended before the last training step."))
        except BaseException as error:  # noqa: BLE001 - re-raised in the training thread
            self._put(error)
        finally:
            close = getattr(self._batches, "close", None)
            if close is not None:
                close()

    def _put(self, item: Clip | BaseException) -> bool:
        """Wait for space in the queue; return False if training has ended."""
        while not self._over.is_set():
            try:
                self._ready.put(item, timeout=_POLL_S)
            except queue.Full:
                continue
            return True
        return False


PREPARED_DIGESTS = "prepared.json"
"""File in the run's folder: stage → digest of the weights that prepared its clips."""
PREPARED_VERSION = 1
"""Version of the format of prepared clips; clips of another version are prepared again."""


def uses_prepared(config: Config, stage: Stage) -> bool:
    """Return whether a stage's clips are prepared once.

    Raises:
        UserError: ``data.prepared`` is set, but the world prepares nothing or there are several
            processes.
    """
    if not config.data.prepared:
        return False
    if stage.prepare is None:
        raise UserError(
            f"data.prepared is {config.data.prepared}, but stage {stage.name} prepares nothing: "
            "set data.prepared to 0."
        )
    if jax.process_count() > 1:
        raise UserError(
            f"data.prepared is {config.data.prepared}, but there are {jax.process_count()} "
            "processes, and prepared clips need a single process: set data.prepared to 0."
        )
    return True


class Prepared:
    """Clips that are prepared once and drawn repeatedly, all of them or the newest.

    With ``data.refresh`` R, the clips of step n are the loader's batches from n div R on: after
    every R steps the oldest batch gives way to a new one. So the clips of a step do not depend on
    interruptions.

    Args:
        config: the experiment.
        stage: defines the preparation (``Stage.prepare``).
        params: the weights; those that prepare clips are copied.
        read: returns an iterator over the batches to prepare, starting at a batch number.
        done: steps that are done.
        digest: from ``start_digest``; if empty, the digest of ``params`` is used.
    """

    def __init__(
        self,
        config: Config,
        stage: Stage,
        params: Params,
        read: Callable[[int], Iterator[Clip]],
        done: int = 0,
        digest: str = "",
    ):
        assert stage.prepare is not None
        self._config, self._stage, self._read = config, stage, read
        weights = {name: params[name] for name in stage.prepares_by if name in params}
        # A training step may reuse the memory of its arguments.
        self._weights = jax.tree.map(jnp.copy, weights) if config.data.refresh else weights
        self._make = jax.jit(functools.partial(stage.prepare, config.model))
        self._folder: Path | None = None
        if config.data.prepared_path:
            self._folder = _folder(config, stage, digest or _digest(stage, params))
        self._done = done
        self.batches: list[Clip] = []
        self._source: Iterator[Clip] | None = None

    @functools.cached_property
    def _like(self) -> Clip:
        return jax.eval_shape(self._make, self._weights, next(self._read(0)))

    def _next(self) -> int:
        """Return the loader's number of the batch that is prepared next."""
        return _oldest(self._config, self._done) + len(self.batches)

    def fill(self, unless_stopped: Callable[[Callable[[], Any]], Any]) -> bool:
        """Prepare ``data.prepared`` clips, in whole batches, at most those drawn; or read them.

        ``unless_stopped`` calls its argument, and returns None if training must stop. Returns
        whether all are there.
        """
        count = _batches(self._config, self._stage)
        while len(self.batches) < count and (clip := self._kept()) is not None:
            self.batches.append(clip)
        if len(self.batches) == count:
            return True
        missing = count - len(self.batches)
        with Meter(f"preparing {self._stage.title}'s clips", missing, "batches") as meter:
            for _ in range(missing):
                # Of the batches after a missing one some may be there.
                clip = self._kept()
                if clip is None and (clip := unless_stopped(self._prepare)) is None:
                    return False
                self.batches.append(clip)
                meter.advance(1)
        return True

    def draw(self, batch: int, seed: int) -> Iterator[Clip]:
        """Yield the batches of the steps that are left, endlessly."""
        refresh = self._config.data.refresh
        if not refresh:
            yield from draw_prepared(self.batches, batch, seed, self._done)
        for number in itertools.count(self._done):
            if number > self._done and number % refresh == 0:
                clip = self._kept()
                self.batches.append(self._prepare() if clip is None else clip)
                self.batches.pop(0)
                self._done = number
                self._delete_old(number)
            yield _stacked(self.batches, _rows_of_window(len(self.batches), batch, seed, number))

    def _delete_old(self, number: int) -> None:
        """Delete the files that no resumed training needs after this step.

        Batches are drawn ahead of training, which resumes at its last checkpoint.
        """
        if self._folder is None:
            return
        earliest = max(number - self._config.train.save_every - AHEAD - 1, 0)
        for file in self._folder.glob("*.safetensors"):
            if int(file.stem) < _oldest(self._config, earliest):
                file.unlink(missing_ok=True)

    def _kept(self) -> Clip | None:
        """Return the next batch from disk; None if it is not there."""
        if self._folder is None or not (file := _file(self._folder, self._next())).is_file():
            return None
        self._source = None  # it would yield the batch that is read here
        return _map_file(file, self._like)

    def _prepare(self) -> Clip:
        """Prepare the next batch, and keep it on disk if asked for."""
        if self._source is None:
            self._source = self._read(self._next())
        clip = jax.device_get(self._make(self._weights, next(self._source)))
        if self._folder is None:
            return clip
        leaves = _clip_arrays(clip)
        file = _file(self._folder, self._next())
        tensor_files.write(file, leaves, leaves.items(), tensor_files.header({}))
        return _map_file(file, self._like)


def _oldest(config: Config, done: int) -> int:
    """Return the loader's number of the oldest prepared batch after a number of steps."""
    return done // config.data.refresh if config.data.refresh else 0


def start_digest(run: Path, stage: Stage, params: Params, done: int) -> str:
    """Return the digest of the weights that prepare clips, as they were at the start of the stage.

    A stage may train some of these weights: stage ``gate`` trains a part of the codec. So the
    digest is written into the run's folder before the first step, and read when the stage is
    resumed. ``params`` are those after ``done`` steps.
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
    """Return the seed that selects the clips to prepare, the same in all stages with a memory."""
    return config.train.seed + 1 + stage.memory


def _folder(config: Config, stage: Stage, weights: str) -> Path:
    """Return the folder of prepared clips; its name is a hash of all that they depend on."""
    model = configuration.to_dict(config.model)
    if "backbone" not in stage.prepares_by:
        for part in ("backbone", "noise", *(() if stage.memory else ("memory",))):
            model.pop(part, None)
    reader, control = model.get("memory", {}).get("reader", {}), model.get("control", {})
    model.pop("asked_alone", None)  # what is prepared does not depend on it, nor on these
    for setting in ("inject", "body"):
        control.pop(setting, None)
    # The only values of earlier versions, whose prepared clips are still used.
    earlier = (reader, "picture", "pixels"), (model, "observed", "first")
    earlier = (*earlier, (model.get("noise", {}), "rendered_until", 0.0))
    earlier = (*earlier, (model, "own_m", 0.0), (control, "drawn", False))
    earlier = (*earlier, (model, "draft", {"kind": "none"}))
    if model.get("codec", {}).get("kind") == "pixel":
        earlier = (*earlier, (model["codec"], "gate", 0))
    for section, setting, value in earlier:
        if section.get(setting) == value:
            del section[setting]
    data = configuration.to_dict(config.data)
    split = read_manifest(Path(config.data.path) / "train")
    for setting in ("path", "features", "prepared", "prepared_path", "refresh", "workers"):
        data.pop(setting)
    data.pop("bad_records")
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
    if "backbone" in stage.prepares_by and not stage.memory:
        # Earlier versions imagined these clips without guidance and noise.
        guided = config.model.noise.guidance != 1 or getattr(config.model, "image_noise", 0.0)
        facts |= {"as_in_rollouts": True} if guided else {}
    text = json.dumps(facts, sort_keys=True)
    kind = "memory" if stage.memory else "frames"
    name = f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return Path(config.data.prepared_path) / name


def _clip_arrays(clip: Clip) -> dict[str, Any]:
    """Return the arrays of a clip by their names in files, unchanged since earlier versions."""
    renamed = {"readout": "sight"}
    found = {}
    for path, leaf in tree.flatten(clip).items():
        first, slash, rest = path.removeprefix("extras/").partition("/")
        found[renamed.get(first, first) + slash + rest] = leaf
    return found


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:05}.safetensors"


def _map_file(file: Path, like: Clip) -> Clip:
    """Memory-map a file of prepared clips; raise UserError if its shapes differ."""
    found, names = tensor_files.mapped(file), _clip_arrays(like)
    for name, leaf in names.items():
        if name not in found or found[name].shape != leaf.shape or found[name].dtype != leaf.dtype:
            raise UserError(
                f"{file} does not contain the prepared clips that this run needs ({name} differs): "
                "delete its folder to prepare them again."
            )
    return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name in names])


def draw_prepared(
    prepared: Sequence[Clip], batch: int, seed: int, start: int = 0
) -> Iterator[Clip]:
    """Yield batches of prepared clips endlessly; batch k depends only on the seed and k.

    Each epoch contains every clip once, in a new order. ``start`` is the number of the first batch.
    """
    count = sum(len(jax.tree.leaves(part)[0]) for part in prepared)
    for number in itertools.count(start):
        yield _stacked(prepared, _rows(count, batch, seed, number))


def _stacked(prepared: Sequence[Clip], rows: Sequence[int]) -> Clip:
    """Return the batch of these rows of all prepared batches."""
    sizes = [len(jax.tree.leaves(part)[0]) for part in prepared]
    places = [(part, row) for part, size in enumerate(sizes) for row in range(size)]
    chosen = [places[row] for row in rows]
    clips = (jax.tree.map(lambda x, r=row: x[r], prepared[part]) for part, row in chosen)
    return jax.tree.map(lambda *rows: np.stack(rows), *clips)


def prepared_rows(config: Config, stage: Stage, number: int) -> list[int]:
    """Return the indices of the prepared clips in batch ``number``; see ``Prepared``.

    With loader batches of size B, clip r is row r mod B of loader batch r div B.
    """
    batch, seed = stage.settings(config).batch, stage.data_seed(config)
    count = _batches(config, stage)
    if not config.data.refresh:
        return _rows(count * batch, batch, seed, number)
    first = _oldest(config, number) * batch
    return [first + row for row in _rows_of_window(count, batch, seed, number)]


def _rows_of_window(count: int, batch: int, seed: int, number: int) -> list[int]:
    """Draw the rows of one batch from ``count`` batches, which change with time."""
    drawn = np.random.default_rng((seed, number)).choice(count * batch, batch, replace=False)
    return [int(row) for row in drawn]


def _batches(config: Config, stage: Stage) -> int:
    """Return the number of batches of clips to prepare."""
    settings = stage.settings(config)
    return min(-(-config.data.prepared // settings.batch), max(settings.steps, 1))


def _rows(count: int, batch: int, seed: int, number: int) -> list[int]:
    places = range(number * batch, (number + 1) * batch)
    return [int(_order(count, seed, place // count)[place % count]) for place in places]


@functools.lru_cache(maxsize=4)
def _order(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)
