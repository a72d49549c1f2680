"""Orbax checkpoints: written in the background, published atomically, and verified when read.

One folder per stage. Each checkpoint has four items: ``weights``, the inference weights, which can
be loaded alone; ``state``, the rest of the training state (trained parameters and optimizer
moments; frozen parameters are in ``weights``); ``data``, the position in the data; ``config``, the
experiment. Arrays can be restored to any mesh and any number of devices and processes.

Orbax writes into a temporary folder; ``checkpoint_files`` adds a manifest of checksums and renames
it. A checkpoint that does not match its manifest is moved aside, and the previous one is used.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import errno
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
import orbax.checkpoint as ocp
from etils import epath

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.io import tree
from pewm_jax.train import checkpoint_files, processes, runs
from pewm_jax.train.step import TrainState, inference_params
from pewm_jax.types import Params
from pewm_jax.worlds import lora
from pewm_jax.worlds.stages import Stage

WEIGHTS_ITEM = checkpoint_files.WEIGHTS_ITEM
STATE_ITEM, DATA_ITEM, CONFIG_ITEM = "state", "data", "config"

_MOMENT_S, _SHARE = 2.0, 0.02
"""Longest wait of ``settle``: the larger of these seconds and this share of the save interval."""


class Checkpoints:
    """The checkpoints of one stage of one run; a context manager that waits for pending writes.

    On construction, damaged checkpoints newer than the newest intact one are moved aside. All
    processes of a job construct this, and call its methods in the same order.

    Raises:
        UserError: checkpoints exist, and all are damaged; or one cannot be written.
    """

    def __init__(self, run: Path, config: Config, stage: Stage, log: Callable[[str], None] = print):
        self.run = run
        self.folder = checkpoint_files.of(run, stage.name).resolve()
        self.config = config
        self.stage = stage
        self._writer = ocp.AsyncCheckpointer(ocp.CompositeCheckpointHandler())
        self._pool = concurrent.futures.ThreadPoolExecutor(1, "checkpoint")
        self._finishing: concurrent.futures.Future[None] | None = None
        self._began, self._interval, self._settled = time.monotonic(), 0.0, True
        self._latest: int | None = processes.run_on_process_0(lambda: _clean_up(self.folder, log))
        self._quiet, self._failed = Quiet(), False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            with self._writing():
                try:
                    self.wait()
                finally:
                    self._pool.shutdown()
                    self._writer.close()
        except UserError:
            if error is None:
                raise
        finally:
            if processes.is_primary():
                checkpoint_files.clear(self.folder)  # left by a failed write
            if not self._failed:  # after a failed write, threads may still print
                self._quiet.end()

    def latest(self) -> int | None:
        """Return the step of the newest complete checkpoint, or None."""
        return self._latest

    def save(self, state: TrainState) -> None:
        """Copy the state to the host and write it in the background; wait for the previous one."""
        self.wait()
        step = int(state.step)
        if step == self._latest:
            return
        settings = self.stage.settings(self.config)
        position = {
            "stage": self.stage.number,
            "step": step,
            "seed": self.stage.data_seed(self.config),
            "batch": settings.batch,
            "clips": step * settings.batch,
            **lora.reference(self.config),
        }
        items = {
            WEIGHTS_ITEM: ocp.args.StandardSave(_weights(self.stage, state)),
            STATE_ITEM: ocp.args.StandardSave(_training_state(self.stage, state)),
            DATA_ITEM: ocp.args.JsonSave(position),
            CONFIG_ITEM: ocp.args.JsonSave(configuration.to_dict(self.config)),
        }
        with self._writing():
            self._writer.save(
                checkpoint_files.writing(self.folder, step),
                args=ocp.args.Composite(**items),
                force=True,
            )
        self._finishing = self._pool.submit(self._finish, step)
        now = time.monotonic()
        self._interval, self._began, self._settled = now - self._began, now, False

    def wait(self, seconds: float | None = None) -> None:
        """Block until all writes are on disk, or ``seconds`` have passed."""
        if self._finishing is None:
            return
        concurrent.futures.wait([self._finishing], seconds)
        if self._finishing.done():
            finished, self._finishing = self._finishing, None
            with self._writing():
                finished.result()

    def settle(self) -> None:
        """Wait, up to a limit, for a save in progress; called before each step is reported.

        So a reported step is at most one save interval ahead of the newest complete checkpoint: a
        killed run loses no more than that. The wait ends after two seconds or a fiftieth of the
        interval, whichever is longer.
        """
        reasonable = max(_MOMENT_S, _SHARE * self._interval)
        self.wait(0 if self._settled else reasonable)
        self._settled = True

    def restore(self, like: TrainState, start: Params | None = None) -> TrainState:
        """Restore the newest checkpoint, with the shardings of the abstract state ``like``.

        ``start`` are the parameters that checkpoints do not hold (``Stage.stored``), on the
        devices.

        Raises:
            UserError: there is no checkpoint, it belongs to another configuration or to other start
                weights, or it cannot be read.
        """
        items = {
            WEIGHTS_ITEM: ocp.args.StandardRestore(_weights(self.stage, like)),
            STATE_ITEM: ocp.args.StandardRestore(_training_state(self.stage, like)),
        }
        read = self._read(items)
        whole = lora.complete(self.stage, read[WEIGHTS_ITEM], start or {})
        ema, frozen = tree.split(whole, self.stage.averaged)
        rest = read[STATE_ITEM]
        return TrainState(
            params=tree.merge(rest["trained"], frozen),
            ema=ema,
            opt_state=rest["opt_state"],
            step=rest["step"],
        )

    def restore_weights(self, like: TrainState) -> Params:
        """Read only the weights in the newest checkpoint; see ``restore``."""
        wanted = ocp.args.StandardRestore(_weights(self.stage, like))
        return self._read({WEIGHTS_ITEM: wanted})[WEIGHTS_ITEM]

    def publish(self, params: Params) -> None:
        """Write the newest checkpoint's weights to the run's ``weights.safetensors``.

        ``params`` are those weights. They are used if there is one process; otherwise process 0
        reads them from the checkpoint into host memory.
        """
        self.wait()
        step, alone = self._require_step(), jax.process_count() == 1

        def write() -> None:
            if not runs.is_published(self.run, self.stage, step):
                whole = params if alone else _read_arrays(self.folder / str(step), params)
                runs.publish(self.run, self.stage, step, whole)

        processes.run_on_process_0(write)

    def _finish(self, step: int) -> None:
        """Wait for Orbax, add the manifest, rename the checkpoint, and delete old ones."""
        self._writer.wait_until_finished()
        if processes.is_primary():
            checkpoint_files.put(self.folder, step)
            checkpoint_files.prune(
                self.folder, self.config.train.keep, self.config.train.keep_every
            )
        self._latest = step

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise ``OSError`` as a ``UserError`` that names the newest intact checkpoint."""
        try:
            yield
        except (OSError, ValueError, RuntimeError) as error:
            if isinstance(error, UserError):
                raise
            self._failed = True
            whole = self._latest
            kept = (
                "no earlier checkpoint exists"
                if whole is None
                else f"the checkpoint of step {whole} is kept"
            )
            raise UserError(
                f"A checkpoint in {self.folder} cannot be written ({_reason(error)}); {kept}: free "
                "space or allow writing there, then run the same command again to resume."
            ) from None

    def _require_step(self) -> int:
        if self._latest is None:
            raise UserError(f"{self.folder} has no complete checkpoint; train this stage first.")
        return self._latest

    def _read(self, items: dict[str, Any]) -> Any:
        """Read items of the newest checkpoint, which must have this configuration."""
        self.wait()
        folder = self.folder / str(self._require_step())
        with _reading(folder):
            there = configuration.from_dict(Config, _read_json(folder / CONFIG_ITEM))
            wrong = runs.differences(runs.identity(there), runs.identity(self.config))
            if wrong:
                raise UserError(
                    f"{folder} is a checkpoint of another configuration ({runs.phrase(wrong)}): "
                    "choose another folder with --train.run, or restore the settings."
                )
            _require_base(self.config, folder)
            return self._writer.restore(folder, args=ocp.args.Composite(**items))


def _weights(stage: Stage, state: TrainState) -> Params:
    """Return the inference weights that a checkpoint holds."""
    return lora.stored(stage, inference_params(stage, state))


def _require_base(config: Config, folder: Path) -> None:
    """Refuse to resume adapters on other start weights than those that they were trained on."""
    facts = _read_json(folder / DATA_ITEM)
    now = lora.reference(config)
    if now and facts.get(lora.BASE_HASH) != now[lora.BASE_HASH]:
        raise UserError(
            f"{folder} holds adapters of other weights than those in {config.train.start}: restore "
            "the weights that the run was started with, or choose another folder with --train.run."
        )


def read_weights(folder: Path, like: Callable[[Config, int], Params]) -> tuple[Config, Params]:
    """Read the experiment and the inference weights, NumPy arrays, in one checkpoint's folder.

    ``like`` is called with the experiment and the stage's number for the shapes of the weights.

    Raises:
        UserError: the weights are damaged.
    """
    found = checkpoint_files.flaws(folder, (WEIGHTS_ITEM, DATA_ITEM, CONFIG_ITEM))
    if found:
        raise UserError(
            f"The checkpoint {folder} is damaged ({tree.listing(found, 2)}): copy it again, or "
            "load another one."
        )
    with _reading(folder):
        config = configuration.from_dict(Config, _read_json(folder / CONFIG_ITEM))
        position = _read_json(folder / DATA_ITEM)
    return config, _read_arrays(folder, like(config, position["stage"]))


def position(folder: Path) -> dict[str, Any]:
    """Return the position in the data of the checkpoint in a folder, and its start weights."""
    return _read_json(folder / DATA_ITEM)


def _read_json(item: Path) -> dict[str, Any]:
    return dict(ocp.JsonCheckpointHandler().restore(epath.Path(item)))


def _read_arrays(folder: Path, like: Params) -> Params:
    """Read the weights of a checkpoint into the memory of this process alone."""
    how = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), like)
    with _reading(folder):
        return ocp.PyTreeCheckpointHandler().restore(
            epath.Path((folder / WEIGHTS_ITEM).resolve()),
            args=ocp.args.PyTreeRestore(like, restore_args=how),
        )


def _clean_up(folder: Path, log: Callable[[str], None]) -> int | None:
    """Clean up the folder of a stage and return the step of its newest intact checkpoint."""
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint_files.clear(folder)
    return checkpoint_files.newest(folder, log)


@contextlib.contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Raise errors of reading an intact checkpoint as a ``UserError``."""
    try:
        yield
    except (ValueError, KeyError, TypeError, OSError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(
            f"{folder} cannot be read ({_reason(error)}): another version of the library may have "
            "written it: resume with that version, or choose another folder with --train.run."
        ) from None


def _reason(error: BaseException) -> str:
    message = getattr(error, "strerror", None) or str(error)
    full = os.strerror(errno.ENOSPC)
    if full in message:  # Orbax puts it at the end of a long message
        return full
    return " ".join(message.split())[:160]


def _training_state(stage: Stage, state: TrainState) -> dict[str, Any]:
    """Return what training needs besides the inference weights."""
    return {
        "trained": tree.select(state.params, stage.trained),
        "opt_state": state.opt_state,
        "step": jax.tree.map(lambda leaf: leaf, state.step),
    }


_LOGGERS = ("absl", "asyncio")


class Quiet:
    """Suppresses printing of failures in Orbax's threads, until ``end``."""

    def __init__(self) -> None:
        self._before = sys.unraisablehook
        sys.unraisablehook = self._unraisable
        for name in _LOGGERS:
            logging.getLogger(name).addFilter(self._has_no_trace)

    def end(self) -> None:
        """Print such failures again."""
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(self._has_no_trace)
        if sys.unraisablehook == self._unraisable:
            sys.unraisablehook = self._before

    def _unraisable(self, what: Any) -> None:
        """Drop the error of a write whose event loop was closed by another failed write."""
        if "Event loop is closed" not in str(what.exc_value):
            self._before(what)

    def _has_no_trace(self, record: logging.LogRecord) -> bool:
        return record.exc_info is None
