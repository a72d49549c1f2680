"""Trainings of several real processes for ``test_processes``; run, it is train.py.

By the environment, ``FAKE`` puts the small model of ``fakes`` in place of the real one,
``PAUSE`` seconds are slept for every batch, ``TERM_AT`` sends the process SIGTERM when it reads
that batch, ``NAN_AT`` makes the loss of that step NaN, ``MEET`` has processes meet and do nothing
else, and ``PLACE`` has them place batches on meshes of every kind.
"""

import contextlib
import importlib
import importlib.abc
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pewm_jax.cli import main as program
from pewm_jax.cli import parser as cli
from pewm_jax.train import feed, processes

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PATIENCE_S = 120


class Job:
    """Processes of one training, started together; killed at the end if they are still there.

    Args:
        argv: arguments of train.py, for all of them.
        processes: how many; one is not distributed.
        devices: simulated in each.
        settings: the environment variables above.
        slurm: whether the processes find one another by what SLURM tells its tasks.
    """

    def __init__(self, argv, processes=1, devices=1, settings=(), slurm=False):
        quick = os.environ.get("XLA_FLAGS", "")
        shared = {
            **os.environ,
            "PYTHONPATH": f"{ROOT}:{HERE}",
            "JAX_PLATFORMS": "cpu",
            "XLA_FLAGS": f"{quick} --xla_force_host_platform_device_count={devices}",
        }
        self.running, self.written, self.files = [], [], contextlib.ExitStack()
        port = self.files.enter_context(held_port())
        for index in range(processes):
            own, joining = dict(settings), ["--distributed"]
            if slurm:
                own |= task_of_slurm(port, processes, index)
            else:
                joining = by_hand(port, processes, index)
            command = [sys.executable, __file__, *argv, *(joining if processes > 1 else ())]
            kept = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115 - closed in the end
            files = [self.files.enter_context(file) for file in kept]
            self.written.append(files)
            self.running.append(
                subprocess.Popen(
                    list(map(str, command)),
                    stdout=files[0],
                    stderr=files[1],
                    env=shared | own,
                )
            )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.running:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()
        self.files.close()

    def end(self):
        """Wait for all to end; returns their exit codes, outputs and errors."""
        until = time.monotonic() + PATIENCE_S
        codes = [process.wait(until - time.monotonic()) for process in self.running]
        return codes, *([self.read(index, kind) for index in range(len(codes))] for kind in (0, 1))

    def read(self, index, kind):
        """Return what a process has written so far: 0 output, 1 errors."""
        return Path(f"/proc/self/fd/{self.written[index][kind].fileno()}").read_text()


def finish(argv, **options):
    """Run a job that must succeed; returns what its processes printed."""
    with Job(argv, **options) as job:
        codes, outputs, errors = job.end()
    assert codes == [0] * len(codes), errors
    return outputs


@contextlib.contextmanager
def held_port():
    """A port that nothing else is given meanwhile, but that can be listened at."""
    with socket.socket() as held:
        held.bind(("", 0))  # alone: so no one is given a port that another holds
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        yield held.getsockname()[1]


def by_hand(port, processes, index):
    """Return the flags of one process: for two of them those that the documentation gives."""
    lines = (ROOT / "docs" / "distributed.md").read_text().splitlines()
    command = "pewm-jax train demo --data.prepared 0 "
    two = [line.removeprefix(command) for line in lines if line.startswith(command)]
    assert len(two) == 2
    flags = two[min(index, 1)] if processes == 2 else f"{two[0][:-1]}{index}"
    return flags.replace("1234", str(port)).replace("processes 2", f"processes {processes}").split()


def task_of_slurm(port, tasks, index):
    """Return the variables that SLURM sets for a task, as far as JAX reads them."""
    return {
        "SLURM_JOB_ID": "1",
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": str(tasks),
        "SLURM_PROCID": str(index),
        "SLURM_LOCALID": str(index),
        "JAX_COORDINATOR_PORT": str(port),
    }


def metrics(run):
    path = run / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def losses(run):
    """Return (stage, step) → loss, each once."""
    lines = metrics(run)
    found = {(line["stage"], line["step"]): line["loss"] for line in lines}
    assert len(found) == len(lines)
    return found


def wait_for(ready, job):
    """Wait until something is so, while all processes of a job are there."""
    until = time.monotonic() + PATIENCE_S
    while not ready():
        assert time.monotonic() < until, [job.read(index, 1) for index in range(len(job.running))]
        codes = [process.poll() for process in job.running]
        assert codes == [None] * len(codes), [job.read(index, 1) for index in range(len(codes))]
        time.sleep(0.05)


def told_at(read, batch, pause=0.0):
    """Return a loader of clips that sends this process SIGTERM when it reads a certain batch."""

    def clips(*args, start_step=0, **options):
        for step, clip in enumerate(read(*args, start_step=start_step, **options), start_step + 1):
            if step == batch:
                os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(pause)
            yield clip

    return clips


def meet(argv):
    """Do nothing but agree, again and again."""
    launch = program.read("train", ["tiny", *argv], "train.py")[0].launch
    with processes.joined(launch):
        for count in itertools.count():
            processes.agree(count)
            print(count, flush=True)
            time.sleep(0.01)


def place(argv):
    """Place a batch on meshes of every kind, and check what lies on each device of this process."""
    launch = program.read("train", ["tiny", *argv], "train.py")[0].launch
    with processes.joined(launch):
        first, second = np.asarray(jax.devices()).reshape(2, -1)
        count = len(first)
        interleaved = np.stack([first, second], axis=1).ravel()
        for devices, split in [
            ([*first, *second], 2 * count),  # each process has rows of its own
            ([*first, *second], count),  # one row is on devices of both
            (interleaved, 2 * count),  # every second row is another process's
            (interleaved, count),  # all rows are on both
        ]:
            mesh = Mesh(np.reshape(devices, (split, -1)), ("data", "tensor"))
            where = NamedSharding(mesh, PartitionSpec("data"))
            whole = np.arange(4 * count * 3).reshape(4 * count, 3)
            rows = feed.rows_of(where, len(whole))
            placed = feed.place({"x": whole[rows]}, where, len(whole))["x"]
            assert placed.shape == whole.shape
            assert placed.sharding == where
            for part in placed.addressable_shards:
                np.testing.assert_array_equal(part.data, whole[part.index])
        print("placed", flush=True)
        return 0


class WithoutTorch(importlib.abc.MetaPathFinder):
    """Finds no torch: where it is installed, TensorBoard's writer loads it, for seconds."""

    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            raise ModuleNotFoundError(name)


def main():
    sys.meta_path.insert(0, WithoutTorch())
    if "MEET" in os.environ:
        return cli.run(meet)
    if "PLACE" in os.environ:
        return cli.run(place)
    loader = importlib.import_module("pewm_jax.data.loader")
    if "FAKE" in os.environ:
        patch = importlib.import_module("pytest").MonkeyPatch()
        fakes = importlib.import_module("tests.train.fakes")
        fakes.install(patch)
        if "NAN_AT" in os.environ:
            fakes.install(patch, fakes.loss_of_depth)
            patch.setattr(loader, "clips", fakes.without_depth_at(int(os.environ["NAN_AT"])))
    loader.clips = told_at(
        loader.clips, int(os.environ.get("TERM_AT", "0")), float(os.environ.get("PAUSE", "0"))
    )
    return cli.run(lambda argv: program.execute(["train", *argv]))


if __name__ == "__main__":
    sys.exit(main())
