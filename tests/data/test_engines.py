"""Collecting on a Ray cluster: the very files of the local pool, the same words at its end."""

from __future__ import annotations

import hashlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pewm_jax.cli import main as program
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import collect as engines
from pewm_jax.data.collect import Job, collect
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.make_episode import CollectConfig

ROOT = Path(__file__).parents[2]
SMALL = {"train": 3, "validation": 0, "test": 1, "frames": 30, "size": 16, "shard_episodes": 1}


@pytest.fixture(scope="module")
def cluster():
    """One processor of this machine."""
    ray = pytest.importorskip("ray", reason="collecting on a cluster needs pewm-jax[ray]")
    config = CollectConfig(Path("x"), engine="ray", workers=1)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in engines.QUIET.items():
            patch.setenv(name, value)
        with engines.cluster(ray, config, lambda _: None):
            yield ray


def fingerprints(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def jobs(out, count, **settings):
    config = CollectConfig(out, **{**SMALL, "engine": "ray", **settings})
    return [Job(config, "train", out / f"{k}.array_record", range(k, k + 1)) for k in range(count)]


@pytest.mark.slow
def test_a_cluster_makes_the_very_files_of_the_local_pool_and_only_those_that_miss(
    cluster, tmp_path
):
    collect(CollectConfig(tmp_path / "pool", workers=1, **SMALL))
    want = fingerprints(tmp_path / "pool")
    there = CollectConfig(tmp_path / "ray", engine="ray", **SMALL)
    collect(there)
    assert fingerprints(there.out) == want

    lost, kept = sorted(there.out.glob("train/*.array_record"))[:2]
    lost.unlink()
    made = kept.stat().st_mtime_ns
    said = []
    collect(there, said.append)
    assert said[0] == "resuming: 2 files exist, 1 are missing."
    assert fingerprints(there.out) == want
    assert kept.stat().st_mtime_ns == made

    collect(CollectConfig(there.out, **SMALL), said.append)
    assert "nothing to do" in said[-1], "the engine is no setting of the files"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("broken", "says"),
    [
        (lambda job, software: os._exit(1), "a worker process died .*run the same command again"),
        (
            lambda job, software: engines.make_bytes(job, {**software, "numpy": "1.0"}),
            "has numpy .*, the requesting machine has 1.0: install the same version",
        ),
        (
            lambda job, software: (engines.make_bytes(job, software)[0], b"other bytes"),
            "arrived damaged; run the same command again",
        ),
    ],
    ids=["died", "other software", "damaged"],
)
def test_what_goes_wrong_elsewhere_is_a_sentence_here(cluster, tmp_path, monkeypatch, broken, says):
    monkeypatch.setattr(engines, "make_bytes", broken)
    monkeypatch.setattr(engines, "RETRIES", 0)
    (job,) = jobs(tmp_path, 1)
    with pytest.raises(UserError, match=says):
        list(engines.run([job], job.config))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_meshes_are_named_where_they_are_missing(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (job,) = jobs(tmp_path, 1, scene=(Path("here.ply"),))
    with pytest.raises(UserError, match=f"{tmp_path}/here.ply does not exist on .* every machine"):
        list(engines.run([job], job.config))


@pytest.mark.slow
def test_the_rest_is_given_up_when_it_is_not_wanted_any_more(cluster, tmp_path, monkeypatch):
    given_up = []
    cancel = cluster.cancel
    monkeypatch.setattr(cluster, "cancel", lambda ref: (given_up.append(ref), cancel(ref)))
    many = jobs(tmp_path, 40)
    made = engines.run(many, many[0].config)
    next(made)
    made.close()
    assert len(given_up) == engines.SHARDS_PER_PROCESSOR - 1
    assert len(list(tmp_path.iterdir())) == 1
    limit = time.monotonic() + 20
    while cluster.available_resources().get("CPU") != 1 and time.monotonic() < limit:
        time.sleep(0.05)
    assert cluster.available_resources()["CPU"] == 1


@pytest.mark.slow
def test_ctrl_c_ends_the_cluster_that_was_started_and_the_pool_goes_on(tmp_path):
    pytest.importorskip("ray", reason="collecting on a cluster needs pewm-jax[ray]")
    options = {**SMALL, "train": 200, "test": 0}
    flags = [f"--{k.replace('_', '-')}={v}" for k, v in options.items()]
    flags += ["--engine=ray", "--workers=2"]
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "pewm_jax", "data", "collect", str(tmp_path), *flags],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    # Starting a cluster takes seconds, or minutes on a busy machine: its first shard is waited for.
    while not list(tmp_path.glob("train/*.array_record")) and process.poll() is None:
        time.sleep(0.01)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, err = process.communicate()
    assert (process.returncode, err) == (
        130,
        "Interrupted; run the same command again to resume.\n",
    )
    assert "ray: 2 processors of 1 machine.\n" in out
    with pytest.raises(UserError, match="did not finish"):
        EpisodeSource(tmp_path / "train")
    there = len(list(tmp_path.glob("train/*.array_record")))
    assert list(tmp_path.glob("train/*.partial")) == []
    assert 1 <= there < 200


class Ray:
    """Has ``init`` and ``shutdown`` as Ray has; Ctrl-C is pressed while it starts."""

    def __init__(self, presses):
        self.presses, self.done = presses, []

    def is_initialized(self):
        return False

    def init(self, **_):
        self.done.append("starts")
        for _ in range(self.presses):
            os.kill(os.getpid(), signal.SIGINT)
        self.done.append("is up")

    def shutdown(self):
        self.done.append("ends")


@pytest.mark.parametrize(
    ("presses", "done"), [(1, ["starts", "is up", "ends"]), (2, ["starts", "ends"])]
)
def test_ctrl_c_while_a_cluster_starts_waits_for_it_and_twice_does_not(presses, done):
    """Ray that is interrupted in its start leaves processes behind, or crashes."""
    ray, before = Ray(presses), signal.getsignal(signal.SIGINT)
    config = CollectConfig(Path("x"), engine="ray")
    with pytest.raises(KeyboardInterrupt), engines.cluster(ray, config, pytest.fail):
        pytest.fail("work began")
    assert ray.done == done
    assert signal.getsignal(signal.SIGINT) is before


def test_the_code_that_is_compared_is_all_that_makes_episodes():
    """Machines whose houses differ must not make shards of one dataset."""
    program = "import sys, pewm_jax.data.make_episode; print(*sys.modules)"
    modules = subprocess.check_output([sys.executable, "-c", program], cwd=ROOT, text=True)
    names = [name.split(".") for name in modules.split() if name.startswith("pewm_jax.")]
    chapters = {name[1] for name in names if (ROOT / "pewm_jax" / name[1]).is_dir()}
    assert chapters == set(engines.PACKAGES)


def test_an_engine_that_cannot_be_used_is_refused_before_anything_is_touched(
    tmp_path, monkeypatch, capsys
):
    flags = ["collect", str(tmp_path / "out"), "--engine", "ray"]
    monkeypatch.setitem(sys.modules, "ray", None)
    assert program.main(["data", *flags]) == 2
    assert "pip install 'pewm-jax[ray]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_cluster_that_does_not_answer_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", object())
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
        flags = ["collect", str(tmp_path / "out"), "--engine", "ray", "--address", address]
        assert program.main(["data", *flags]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: there is no Ray cluster at --address {address} (Connection refu")
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_address_without_its_engine_or_port_is_refused():
    with pytest.raises(ConfigError, match="needs --engine ray"):
        CollectConfig(Path("x"), address="auto")
    for address in ("machine", "1234", "machine:0", "machine:65536"):
        with pytest.raises(ConfigError, match=r"use HOST:PORT .* or auto"):
            CollectConfig(Path("x"), engine="ray", address=address)
