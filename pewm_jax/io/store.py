"""Results that survive an interruption: one file per finished piece of work, written atomically.

A long loop over independent pieces (clips to score, decisions of a study, episodes to encode) keeps
the result of each piece in a ``ResultCache``. If it is interrupted, the same call resumes: it reads
the finished pieces and computes only the rest::

    cache = ResultCache(folder)
    results = map_resumable(clips, name_of_clip, score_clips, cache=cache)

What a result depends on is part of the piece's name (``inputs_hash``), part of the folder's name
(``ResultCache.for_weights``), or written beside the results and compared (``require_same_inputs``).
A partial file counts as missing. ``ProgressFile`` keeps the state of a loop whose rounds build on
one another.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import shutil
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import atomic

SETTINGS = "settings.json"
"""File that stores the inputs of a folder's results (``require_same_inputs``)."""
PATIENCE_S = 60.0
"""Seconds to wait until a file written by another process becomes visible."""
DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    KeyError,
    RuntimeError,  # zipfile: a damaged header names an unknown compression method
    ValueError,  # NumPy, JSON, UTF-8
)
"""Exceptions raised by readers of NumPy and JSON files if a file is damaged or truncated."""

Arrays = dict[str, np.ndarray]
K = TypeVar("K", bound=Hashable)
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Format:
    """How a result is stored; ``read`` raises one of ``DAMAGED`` for a damaged file."""

    suffix: str
    write: Callable[[Path, Any], None]
    read: Callable[[Path], Any]


def _write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], save: Callable[..., None] = np.savez
) -> None:
    with path.open("wb") as file:
        save(file, **arrays)


def _read_arrays(path: Path) -> Arrays:
    # Read from memory: for a damaged file, zipfile may seek before its beginning, which raises
    # OSError on a file, like an error of the disk.
    found = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
    if isinstance(found, np.ndarray):
        raise ValueError("it contains one unnamed array")  # noqa: TRY004 - one of ``DAMAGED``
    with found as arrays:
        return {key: arrays[key] for key in arrays.files}


def _write_table(path: Path, table: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(table, allow_nan=False) + "\n", "utf-8")


def _read_table(path: Path) -> dict[str, Any]:
    found = json.loads(path.read_text("utf-8"))
    if not isinstance(found, dict):
        raise ValueError("it contains no table")  # noqa: TRY004 - one of ``DAMAGED``
    return found


ARRAYS = Format(".npz", _write_arrays, _read_arrays)
"""Named NumPy arrays."""
COMPRESSED = Format(
    ".npz", functools.partial(_write_arrays, save=np.savez_compressed), _read_arrays
)
"""Named NumPy arrays, compressed, for files in a repository."""
TABLE = Format(".json", _write_table, _read_table)
"""A table of plain values."""


def inputs_hash(inputs: Any) -> str:
    """Return a hash of JSON-serializable values, regardless of the order of keys."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def file_hash(path: Path) -> str:
    """Return the sha256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class ResultCache:
    """Named results in a folder, one file each.

    Args:
        folder: the folder; created when the first result is written.
        kind: how a result is stored.
    """

    def __init__(self, folder: Path, kind: Format = ARRAYS):
        self.folder, self.format = folder, kind

    @classmethod
    def for_weights(
        cls, folder: Path, weights: str, fingerprint: str, kind: Format = ARRAYS
    ) -> ResultCache:
        """Return the cache of results that depend on weights and on a protocol.

        Its folder is ``folder/WEIGHTS/FINGERPRINT``. Results of other weights are deleted. Results
        of other protocols are kept, so a quick evaluation with fewer clips does not discard the
        results of the full one.

        Args:
            folder: the folder of all results of a report.
            weights: hash of the weights.
            fingerprint: hash of weights and protocol.
            kind: how a result is stored.
        """
        cache = cls(folder / weights[:16] / fingerprint[:16], kind)
        cache.folder.mkdir(parents=True, exist_ok=True)
        for other in folder.iterdir():
            if other != cache.folder.parent and other.is_dir():
                shutil.rmtree(other)
        return cache

    def path(self, name: str) -> Path:
        """Return the file of a result, whether or not it exists; ``name`` may contain slashes."""
        return self.folder / f"{name}{self.format.suffix}"

    def get(self, name: str) -> Any | None:
        """Return a finished result, or None if there is none or its file is damaged."""
        try:
            return self.format.read(self.path(name))
        except (FileNotFoundError, *DAMAGED):
            return None

    def put(self, name: str, result: T) -> T:
        """Write a result atomically, and return it."""
        path = self.path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic.replacing(path) as partial:
            self.format.write(partial, result)
        return result

    def compute(self, name: str, work: Callable[[], T]) -> T:
        """Return a result from its file, or compute and write it."""
        found = self.get(name)
        return self.put(name, work()) if found is None else found

    def wait_for(self, name: str, patience_s: float = PATIENCE_S) -> Any:
        """Return a result computed by another process of this job.

        Raises:
            UserError: the file does not appear, because the processes share no folder.
        """
        until = time.monotonic() + patience_s
        while (found := self.get(name)) is None:
            if time.monotonic() > until:
                raise UserError(
                    f"{self.path(name)} was written by another process of this job but is not "
                    "visible here: all processes must share the run's folder; put the run on a "
                    "shared disk."
                )
            time.sleep(min(0.5, patience_s))
        return found


@dataclasses.dataclass(frozen=True)
class Workers:
    """The processes that share the work of a loop; ``barrier`` waits until all have called it."""

    count: int = 1
    index: int = 0
    barrier: Callable[[str], None] = lambda _name: None

    def assign_work(
        self, keys: Sequence[K], is_light: Callable[[K], bool] | None = None
    ) -> list[K]:
        """Return this process's pieces: every P-th heavy one and every P-th light one.

        The assignment depends only on a piece's position in the list, which is the same in all
        processes, so they agree on it without communication, even when the job is resumed.
        """
        light = {key: bool(is_light and is_light(key)) for key in keys}
        chosen: set[K] = set()
        for kind in (False, True):
            chosen.update([key for key in light if light[key] == kind][self.index :: self.count])
        return [key for key in keys if key in chosen]

    def first_alone(self, work: Callable[[], T], what: str) -> T:
        """Call a function in process 0 before all other processes call it; return its result.

        Args:
            work: stores its result in a file; a second call reads that file.
            what: name of the work, a different one for each call.
        """
        result = work() if self.index == 0 else None
        self.barrier(what)
        return work() if result is None else result


ALONE = Workers()


def map_resumable(
    keys: Iterable[K],
    key_of_inputs: Callable[[K], str],
    work: Callable[[list[K]], Iterable[tuple[K, T]]],
    *,
    cache: ResultCache,
    what: str = "pieces",
    log: Callable[[str], Any] | None = None,
    is_usable: Callable[[K, T], bool] = lambda _key, _result: True,
    workers: Workers = ALONE,
    group_of: Callable[[K], Hashable] | None = None,
    is_light: Callable[[K], bool] | None = None,
) -> dict[K, T]:
    """Compute the results of all pieces of work that are not in the cache.

    Args:
        keys: the pieces; with several workers in the same order in all of them.
        key_of_inputs: the name of a piece's result. It contains all that the result depends on
            in addition to the cache's folder, for instance by ``inputs_hash``.
        work: called once with the pieces that this process must compute, in order, if there are
            any. It yields each with its result, which is written before the next one is computed.
        cache: where results are stored.
        what: name of the work for messages, a different one for each call of a job.
        log: prints how many results are reused.
        is_usable: whether a stored result can be used, or must be recomputed.
        workers: the processes that share the work. All of them get all results.
        group_of: pieces of one group are computed by one process, such as the metrics of one
            rollout. By default every piece is a group of its own.
        is_light: whether a piece, and its group, is cheap compared with the others.

    Returns:
        The result of every piece, in the order of ``keys``.

    Raises:
        UserError: the result of another process is not visible to this one.
    """
    keys = list(dict.fromkeys(keys))
    names = {key: key_of_inputs(key) for key in keys}
    known: dict[K, T] = {}
    for key, name in names.items():
        found = cache.get(name)
        if found is not None and is_usable(key, found):
            known[key] = found
    if known and log is not None:
        log(f"{len(known)} of {len(keys)} {what} are reused from an earlier run")
    first_of_group: dict[Hashable, K] = {}
    group = {key: group_of(key) if group_of else key for key in keys}
    for key in keys:
        first_of_group.setdefault(group[key], key)
    own = set(workers.assign_work(list(first_of_group.values()), is_light))
    missing = [key for key in keys if key not in known and first_of_group[group[key]] in own]
    if missing:
        for key, result in work(missing):
            known[key] = cache.put(names[key], result)
    workers.barrier(what)
    return {key: known[key] if key in known else cache.wait_for(names[key]) for key in keys}


def require_same_inputs(
    folder: Path, inputs: Mapping[str, Any], what: str, ignored: Collection[str] = ()
) -> None:
    """Raise an error if a folder's results have other inputs; otherwise write the inputs there.

    Args:
        folder: the folder of the results.
        inputs: settings and hashes of weights by name, as plain values.
        what: what the results are, for the message.
        ignored: names that no stored result depends on.

    Raises:
        UserError: some inputs differ; names them.
    """
    file = folder / SETTINGS
    now = json.dumps({n: value for n, value in inputs.items() if n not in ignored}, indent=1)
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file: choose a folder with --out.")
    if file.exists():
        before = ResultCache(folder, TABLE).get(file.stem)
        if before is None:
            raise UserError(f"{file} is damaged: delete it if the settings have not changed.")
        wrong = [name for name, value in json.loads(now).items() if before.get(name) != value]
        if wrong:
            raise UserError(
                f"{folder} contains {what} of other settings ({', '.join(wrong)}): choose another "
                "folder with --out, or restore the settings."
            )
    folder.mkdir(parents=True, exist_ok=True)
    atomic.write_text(file, now + "\n")


def make_once(mark: Path, inputs: Any, make: Callable[[], None]) -> None:
    """Call a function, unless the JSON file ``mark`` records a call with the same plain inputs."""
    try:
        before = json.loads(mark.read_text("utf-8"))
    except (FileNotFoundError, ValueError):
        before = None
    if before is None or before != json.loads(json.dumps(inputs)):
        make()
        mark.parent.mkdir(parents=True, exist_ok=True)
        atomic.write_text(mark, json.dumps(inputs) + "\n")


class ProgressFile:
    """The state of a loop whose rounds build on one another, such as a search, in one file.

    Args:
        path: the file, ``.npz``.
        identity: hash of all that the state depends on.
        what: what the state belongs to, for messages: "a search".
    """

    IDENTITY = "who"
    """Name of the array with the identity."""

    def __init__(self, path: Path, identity: str, what: str):
        self.path, self.identity, self.what = path, identity, what

    def read(self) -> Arrays | None:
        """Return the arrays of the last ``write``, or None if there is no file.

        Raises:
            UserError: the file is damaged, or belongs to a loop with another identity.
        """
        try:
            arrays = _read_arrays(self.path)
            found = str(arrays.pop(self.IDENTITY))
        except FileNotFoundError:
            return None
        except (OSError, *DAMAGED) as error:
            raise UserError(
                f"{self.path} is not a checkpoint of {self.what}, or it is damaged "
                f"({type(error).__name__}): delete it to start again."
            ) from None
        if found != self.identity:
            raise UserError(
                f"{self.path} belongs to {self.what} with other inputs: choose another file, or "
                "delete it."
            )
        return arrays

    def write(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Replace the state atomically."""
        with atomic.replacing(self.path) as partial:
            _write_arrays(partial, {**arrays, self.IDENTITY: np.array(self.identity)})
