"""The processes of one job: joining, agreeing on values, and exiting together.

All processes run the same program in the same order. Only process 0 writes files. Decisions that
must be the same in all processes are made by ``agree`` and ``Votes``.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from orbax.checkpoint import multihost

from pewm_jax.config import Join, UserError
from pewm_jax.errors import report

HEARTBEAT_S = 20
"""Seconds without a heartbeat after which a process counts as dead and all others exit."""
GONE = (
    "Another process of this job has exited or cannot be reached: read the output of the other "
    "processes, then start all of them again to resume from the last checkpoint."
)
"""Printed when a process notices that another one is gone."""
_LEAVE_S = 60
"""Seconds that a finished process waits for the others to finish."""
_REPORT_S = 5
"""Seconds that a process that has reported an error waits for the others to report theirs."""
_COMMUNICATION = ("gloo", "nccl", "unavailable", "deadline", "connect", "coordination", "socket")
"""Parts of the messages that JAX raises when another process is gone."""

BARRIER_S = 7 * 24 * 3600
"""Timeout of ``barrier`` in seconds; a process that is gone is noticed earlier."""

T = TypeVar("T")


@contextlib.contextmanager
def joined(launch: Join) -> Iterator[None]:
    """Join the processes of a job for the duration of the context, if ``launch`` asks for it.

    Inside, only process 0 prints. An error ends this process, with one sentence and the exit code
    of ``errors.report``, as soon as the others have reported one too, or after ``_REPORT_S``; the
    others notice within ``HEARTBEAT_S``. JAX may write more to standard error, or abort this
    process (SIGABRT) when process 0 is gone.

    Raises:
        UserError: there are no processes to join.
    """
    if not launch.distributed:
        yield
        return
    start(launch)
    with _quiet_but_first():
        try:
            yield
            _finish()
            jax.distributed.shutdown()
        except BaseException as error:  # noqa: BLE001 - reported, whatever it is
            code = _report(error)
            sys.stderr.flush()
            try:
                if not is_lost(error):
                    _let_others_report()
            finally:
                os._exit(code)  # a normal exit would wait for processes that wait for this one


def start(launch: Join) -> None:
    """Join the other processes of the job, if ``launch`` asks for it; call before using any device.

    If ``launch`` names no coordinator, JAX reads it from the environment (SLURM, Kubernetes, Cloud
    TPU, Open MPI). If not all processes have joined within ``launch.patience`` seconds, this
    process prints an error and exits.

    Raises:
        UserError: there are no processes to join, or the coordinator's port is in use.
    """
    if not launch.distributed:
        return
    given: dict[str, Any] = {}
    if launch.coordinator:
        given = {
            "coordinator_address": launch.coordinator,
            "num_processes": launch.processes,
            "process_id": launch.process,
        }
        if launch.process == 0:
            _require_free(launch.coordinator)
    # Training handles SIGTERM itself (``signals``), so JAX must not.
    jax.config.update("jax_enable_preemption_service", False)
    late = threading.Timer(launch.patience, _give_up, (launch,))
    late.daemon = True
    late.start()
    try:
        jax.distributed.initialize(
            **given,
            initialization_timeout=launch.patience + 60,  # ``_give_up`` must come first
            heartbeat_timeout_seconds=HEARTBEAT_S,
            shutdown_timeout_seconds=_LEAVE_S,
        )
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise UserError(
            f"--distributed found no processes to join ({reason}): name them with --coordinator, "
            "--processes and --process, or omit --distributed."
        ) from None
    finally:
        late.cancel()


def is_primary() -> bool:
    """Return whether this is process 0, which writes logs, pictures and unsharded files."""
    return jax.process_index() == 0


def wait(name: str) -> None:
    """Wait until all processes have reached the barrier ``name``."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def barrier(name: str, patience_s: float = BARRIER_S) -> None:
    """Wait until all processes have reached the barrier ``name``, without using devices.

    ``wait`` is for steps of one program: it uses devices, whose collectives time out. ``barrier``
    is for processes whose parts of some work take minutes or hours.
    """
    if jax.process_count() > 1:
        multihost.get_barrier_sync_fn()(key=name, timeout_ms=int(1000 * patience_s))


def agree(value: Any) -> Any:
    """Return process 0's value, which JSON can express, in all processes."""
    if jax.process_count() == 1:
        return value
    text = json.dumps(value).encode() if is_primary() else b""
    size = multihost_utils.broadcast_one_to_all(np.asarray(len(text), np.int32))
    padded = np.frombuffer(text.ljust(int(size), b" "), np.uint8)
    return json.loads(bytes(multihost_utils.broadcast_one_to_all(padded)))


def run_on_process_0(work: Callable[[], Any]) -> Any:
    """Call a function in process 0 only, and return its result, which JSON can express, in all.

    Raises:
        UserError: in all processes, if the function raises it or ``OSError`` in process 0.
    """
    outcome: dict[str, Any] = {}
    if is_primary():
        try:
            outcome = {"result": work()}
        except (UserError, OSError) as error:
            if jax.process_count() == 1:
                raise
            outcome = {"refused": str(error)}
    outcome = agree(outcome)
    if "refused" in outcome:
        raise UserError(outcome["refused"])
    return outcome["result"]


@contextlib.contextmanager
def on_process_0(context: contextlib.AbstractContextManager[Any]) -> Iterator[None]:
    """Enter a context in process 0 only; raises as ``run_on_process_0`` does."""
    with contextlib.ExitStack() as held:

        def enter() -> None:
            held.enter_context(context)

        run_on_process_0(enter)
        yield


def is_lost(error: BaseException) -> bool:
    """Return whether an error means that another process is gone or cannot be reached."""
    status, _, reason = str(error).partition(": ")
    return (
        jax.process_count() > 1
        and isinstance(error, (RuntimeError, ValueError))  # JAX raises both
        and re.fullmatch("[A-Z_]+", status) is not None
        and any(word in f"{status} {reason}".lower() for word in _COMMUNICATION)
    )


def gather(tree: T) -> T:
    """Gather arrays that are sharded over processes to process 0, as NumPy arrays; called by all.

    Leaves are gathered one by one, so no device holds more than one gathered array. In the other
    processes the arrays are empty.
    """
    if jax.process_count() == 1:
        return tree

    def whole(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable:
            if leaf.is_fully_replicated:
                leaf = leaf.addressable_data(0)
            else:
                leaf = multihost_utils.process_allgather(leaf, tiled=True)
        return np.asarray(leaf) if is_primary() else np.zeros(0)

    return jax.tree.map(whole, tree)


class Votes:
    """Agree on a stop signal that any process received, one step later and without waiting.

    Every process votes once after every step. A vote is a small computation over all devices,
    queued behind the step; its result is ready by the next vote. So all processes learn of a signal
    after the same step.
    """

    def __init__(self) -> None:
        self._last: jax.Array | None = None
        if jax.process_count() == 1:
            return
        self._largest = _largest_of_all()

    def cast(self, number: int | None) -> int | None:
        """Vote for a signal of this process, or None, and return the result of the previous vote.

        It is the largest number that any process voted, or None; with one process, its own number,
        immediately.
        """
        if jax.process_count() == 1:
            return number
        before, self._last = self._last, self._largest(number or 0)
        return None if before is None else (int(before) or None)


def _largest_of_all() -> Callable[[int], jax.Array]:
    """Return a function that returns the maximum of all processes' numbers, on every device."""
    mesh = Mesh(np.asarray(jax.devices()), ("all",))
    each = NamedSharding(mesh, P("all"))
    largest = jax.jit(jnp.max, out_shardings=NamedSharding(mesh, P()))

    def ask(number: int) -> jax.Array:
        own = np.full(1, number, np.int32)
        shape = (jax.device_count(),)
        return largest(jax.make_array_from_callback(shape, each, lambda _index: own))

    return ask


def _finish() -> None:
    """Wait until all devices of all processes are done.

    ``wait`` waits for the first device of each process only. A device that is still connecting when
    JAX's coordinator exits would hang, and its process with it.
    """
    jax.block_until_ready(_largest_of_all()(0))


def _require_free(coordinator: str) -> None:
    """Refuse the coordinator's address if another program listens there."""
    port = int(coordinator.rpartition(":")[2])
    try:
        with socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(("", port))
            trial.listen()
    except OSError as error:
        raise UserError(
            f"--coordinator {coordinator}: port {port} cannot be used here ({error.strerror}); "
            "choose another port for all processes."
        ) from None


def _give_up(launch: Join) -> NoReturn:
    """Print that not all processes have joined, and exit; JAX would print a stack trace."""
    where = f" at {launch.coordinator}" if launch.coordinator else ""
    who = f"process {launch.process} of {launch.processes}" if launch.coordinator else "this one"
    sys.stderr.write(
        f"error: Not all processes of this training have joined{where} within {launch.patience} s, "
        f"says {who}: start all of them, make sure that they can reach process 0 there, or wait "
        "longer with --patience.\n"
    )
    sys.stderr.flush()
    os._exit(2)


@contextlib.contextmanager
def _quiet_but_first() -> Iterator[None]:
    """Allow only process 0 to print to stdout, and suppress C++ output (Gloo)."""
    sys.stdout.flush()
    before, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    with (
        os.fdopen(nothing, "w") as silence,
        os.fdopen(before, "w") as speech,
        contextlib.redirect_stdout(speech if is_primary() else silence),
    ):
        try:
            yield
        finally:
            speech.flush()
            os.dup2(before, 1)


def _let_others_report() -> None:
    """Wait until other processes report the same error: JAX aborts them when process 0 exits."""
    with contextlib.suppress(Exception):  # the error is not shared, or they are gone
        multihost.get_barrier_sync_fn()(key="reported", timeout_ms=1000 * _REPORT_S)
        if is_primary():
            time.sleep(0.5)  # let the others exit first


def _report(error: BaseException) -> int:
    """Print an error as the command line does and return the exit code."""
    if is_lost(error):
        error = UserError(GONE)
    if not isinstance(error, (UserError, OSError, KeyboardInterrupt)):
        sys.excepthook(type(error), error, error.__traceback__)
        return 1
    return report(error)
