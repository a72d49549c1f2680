"""Collect a dataset of houses or meshes; the command is resumable.

The unit of work is a shard. A shard is written under a temporary name and then renamed;
``dataset.json`` is written when all shards of a split exist. A shard is a pure function of the
settings and its number, so the files depend neither on interruptions nor on the engine that makes
them: this process, a pool of processes, or a Ray cluster. Machines of a cluster send the bytes of a
shard back; a shared folder is not needed.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import hashlib
import importlib.metadata
import multiprocessing
import os
import platform
import signal
import socket
import tempfile
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import jax

from pewm_jax.config import UserError
from pewm_jax.data import resume, shading
from pewm_jax.data.dataset import Shard, write_shard
from pewm_jax.data.make_episode import SPLITS, CollectConfig, make_episode, settings_of
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter

SHARDS_PER_PROCESSOR = 2
"""Shards submitted to a cluster per processor: one in progress and one waiting."""
RETRIES = 3
"""Retries of a shard whose worker or machine was lost."""
CONNECT_S = 10.0
"""Timeout of the connection to a cluster, seconds."""
CANCEL_S = 5.0
"""Timeout for cancelled shards to stop, seconds."""
DIED = (
    "a worker process died (killed, or out of memory); run the same command again to resume, with "
    "fewer --workers if memory is short."
)
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Environment variables for Ray: no usage reports, no warning about unused GPUs."""
PACKAGES = ("bodies", "config", "geometry", "houses", "data", "io")
"""Packages of this library whose code can change the bytes of a shard."""
LIBRARIES = (
    "numpy",
    "scipy",
    "trimesh",
    "embreex",
    "opencv-python-headless",
    "array_record",
    "jax",
    "jaxlib",
)
"""Libraries whose versions can change the bytes of a shard."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One shard to make: the settings, its split, the file to write, and its episodes."""

    config: CollectConfig
    split: str
    path: Path
    indices: range

    def run(self) -> Shard:
        """Make the shard and write its file."""
        records = (make_episode(self.config, self.split, i) for i in self.indices)
        return write_shard(self.path, records)


def collect(config: CollectConfig, log: Callable[[str], None] = print) -> None:
    """Create a dataset, or its missing shards; ``log`` receives the lines to print.

    Raises:
        UserError: a mesh has no floor to walk on, the output folder contains a dataset with other
            settings, there is no renderer, a worker process died, or a cluster cannot be reached.
    """
    for path in config.scene:
        if not path.is_file():
            raise UserError(f"{path} does not exist; give --scene the path of a mesh file.")
    counts = {split: config.episodes(split) for split in SPLITS}
    splits = resume.unfinished_splits(
        config.out,
        counts,
        lambda split: settings_of(config, split),
        config.shard_episodes,
        overwrite=config.overwrite,
    )
    if not splits:
        log(f"{config.out} is complete with these settings: nothing to do.")
        return
    if config.scene and len(config.scene) < sum(map(bool, counts.values())):
        log(f"fewer meshes ({len(config.scene)}) than splits: the splits share their scenes.")
    shading.require_embree()
    require(config)
    for split in splits:
        split.prepare()
    jobs = [
        Job(config, split.folder.name, path, indices)
        for split in splits
        for path, indices in split.missing().items()
    ]
    if existing := sum(len(split.done) for split in splits):
        log(f"resuming: {existing} files exist, {len(jobs)} are missing.")
    frames = sum(len(job.indices) for job in jobs) * config.frames
    done = {split.folder.name: split.done for split in splits}
    with (
        Meter(f"collecting {config.out}", frames, "frames") as meter,
        contextlib.closing(run(jobs, config, log)) as made,
    ):
        for job, shard in made:
            done[job.split][shard.file] = shard
            meter.advance(len(job.indices) * config.frames)
    for split in splits:
        split.publish(counts[split.folder.name] * config.frames)
    log(meter.summary())


def run(
    jobs: list[Job], config: CollectConfig, log: Callable[[str], None] = print
) -> Generator[tuple[Job, Shard]]:
    """Make shards with the engine of the settings; yield each when it is done.

    Raises:
        UserError: a worker died, the cluster cannot be reached or cannot make the same shards, or
            an episode cannot be made.
    """
    if config.engine == "ray":
        return on_cluster(jobs, config, log)
    return on_processes(jobs, config.workers or os.cpu_count() or 1)


def on_processes(jobs: list[Job], workers: int) -> Generator[tuple[Job, Shard]]:
    """Make shards in this process or in a pool of processes."""
    if min(workers, len(jobs)) <= 1:
        for job in jobs:
            yield job, job.run()
        return
    others = set(multiprocessing.active_children())
    done = False
    # Spawned, not forked: JAX runs threads, and a fork of a process with threads may hang.
    pool = concurrent.futures.ProcessPoolExecutor(
        min(workers, len(jobs)), multiprocessing.get_context("spawn"), _start_worker
    )
    try:
        with _sigint(signal.SIG_IGN):  # workers spawned here inherit it from the start, for good
            futures = {pool.submit(job.run): job for job in jobs}
        for future in concurrent.futures.as_completed(futures):
            yield futures[future], future.result()
        done = True
    except BrokenProcessPool:
        raise UserError(DIED) from None
    finally:
        if not done:  # their unfinished files have temporary names and are made again
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _start_worker() -> None:
    """Set up a worker that uses one thread, ignores Ctrl-C, and exits with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    jax.config.update("jax_platforms", "cpu")  # workers must not allocate accelerator memory
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()


def on_cluster(
    jobs: list[Job], config: CollectConfig, log: Callable[[str], None] = print
) -> Generator[tuple[Job, Shard]]:
    """Make shards on the machines of a Ray cluster; arguments and errors as for ``run``.

    Few shards are submitted at a time, so that results do not fill the cluster's memory, but more
    than there are processors, so that an autoscaling cluster adds machines.
    """
    ray = _import_ray()
    with cluster(ray, config, log):
        make = ray.remote(num_cpus=1, max_retries=RETRIES)(make_bytes)
        software = software_here()
        waiting, running = list(reversed(jobs)), {}
        try:
            while waiting or running:
                processors = int(ray.cluster_resources().get("CPU", 1))
                while waiting and len(running) < (
                    config.workers or SHARDS_PER_PROCESSOR * max(processors, 1)
                ):
                    job = waiting.pop()
                    running[make.remote(_with_absolute_paths(job), software)] = job
                ready, _ = ray.wait(list(running), num_returns=1)
                job = running.pop(ready[0])
                yield job, _write_received(job.path, *ray.get(ready[0]))
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, UserError):
                raise UserError(str(error.cause)) from None
            raise
        except ray.exceptions.RayError:
            raise UserError(DIED) from None
        finally:
            for reference in running:
                with contextlib.suppress(ray.exceptions.RayError):
                    ray.cancel(reference)
            if running:
                ray.wait(list(running), num_returns=len(running), timeout=CANCEL_S)


def make_bytes(job: Job, software: Mapping[str, str]) -> tuple[Shard, bytes]:
    """Make a shard on another machine; return its description and the bytes of its file.

    Args:
        job: the shard; only the last part of its path is used.
        software: the versions on the requesting machine, see ``software_here``.

    Raises:
        UserError: this machine has other software, or lacks a mesh.
    """
    here = software_here()
    for name in software:
        if here[name] != software[name]:
            raise UserError(
                f"{platform.node()} has {name} {here[name]}, the requesting machine has "
                f"{software[name]}: install the same version on every machine of the cluster, "
                "because the shards could differ."
            )
    for path in job.config.scene:
        if not path.is_file():
            raise UserError(
                f"{path} does not exist on {platform.node()}; put the meshes of --scene at the "
                "same path on every machine of the cluster."
            )
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory(prefix="pewm-collect-") as folder:
        shard = dataclasses.replace(job, path=Path(folder) / job.path.name)
        return shard.run(), shard.path.read_bytes()


def software_here() -> dict[str, str]:
    """Return the versions that a shard's bytes depend on; for this library, a hash of its code."""
    root = Path(__file__).parents[1]
    code = hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((root / package).glob("*.py")):
            code.update(path.name.encode() + path.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in LIBRARIES}
    return {"pewm_jax with hash": code.hexdigest()[:12], **versions}


def require(config: CollectConfig) -> None:
    """Raise UserError if Ray is not installed or no cluster responds.

    Before any file is written.
    """
    if config.engine != "ray":
        return
    _import_ray()
    host, colon, port = config.address.rpartition("/")[2].rpartition(":")
    if colon:  # Ray itself would wait for 15 minutes
        try:
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
        except OSError as error:
            raise UserError(_no_cluster(config, error.strerror or str(error))) from None


def _import_ray() -> Any:
    """Import Ray when it is needed: it is slow to import and an optional dependency."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    try:
        import ray  # noqa: PLC0415 - optional: only this engine needs it
    except ImportError:
        raise UserError(
            "--engine ray needs Ray, which is not installed: pip install 'pewm-jax[ray]'."
        ) from None
    return ray


def _no_cluster(config: CollectConfig, reason: str) -> str:
    where = f"at --address {config.address}" if config.address else "on this machine"
    return (
        f"there is no Ray cluster {where} ({reason}); start one with `ray start --head` "
        "(RAY_AUTH_MODE=token where it asks for one), or leave out --engine ray."
    )


@contextlib.contextmanager
def cluster(ray: Any, config: CollectConfig, log: Callable[[str], None]) -> Iterator[None]:
    """Connect to a cluster, or start one on this machine; keep a connection that exists already.

    Raises:
        UserError: there is no cluster.
    """
    if ray.is_initialized():
        yield
        return
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if not config.address:
        quiet |= {"num_cpus": config.workers or os.cpu_count() or 1, "include_dashboard": False}
    try:
        with warnings.catch_warnings(), sigint_postponed():
            # Ray starts programs of its own, which is safe although JAX runs threads.
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            try:
                ray.init(address=config.address or "local", **quiet)
            except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
                reason = " ".join(str(error).split()).partition(". ")[0]
                raise UserError(_no_cluster(config, reason[:160])) from None
        machines = sum(node["Alive"] for node in ray.nodes())
        processors = ray.cluster_resources().get("CPU", 0)
        log(f"ray: {processors:.0f} processors of {machines} machine{'s'[: machines > 1]}.")
        yield
    finally:
        ray.shutdown()


def _with_absolute_paths(job: Job) -> Job:
    """Return the job with absolute paths of the meshes; workers have another working folder."""
    scene = tuple(path.absolute() for path in job.config.scene)
    return dataclasses.replace(job, config=dataclasses.replace(job.config, scene=scene))


def _write_received(path: Path, made: Shard, content: bytes) -> Shard:
    """Write a shard that another machine made, after comparing its hash."""
    if hashlib.sha256(content).hexdigest() != made.sha256:
        raise UserError(f"{path} arrived damaged; run the same command again to resume.")
    atomic.write_bytes(path, content)
    return made


@contextlib.contextmanager
def _sigint(handler: Any) -> Iterator[None]:
    """Handle Ctrl-C by another handler inside the block."""
    if threading.current_thread() is not threading.main_thread():  # others cannot set signals
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if before is None else before)


@contextlib.contextmanager
def sigint_postponed() -> Iterator[None]:
    """Raise the KeyboardInterrupt of a first Ctrl-C after the block, that of a second at once.

    If Ray is interrupted while it starts, it leaves processes behind or crashes at its end.
    """
    pressed = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            signal.default_int_handler(number, frame)
        pressed = True

    with _sigint(note):
        yield
    if pressed:
        raise KeyboardInterrupt
