"""Several processes train as one: the same losses, one log, one decision, no one left waiting."""

import json
import signal
import time

import jax
import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.config import Launch, UserError
from pewm_jax.data import loader
from pewm_jax.data.collect import collect
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.io import runtime
from pewm_jax.train import processes
from tests.train import processes as jobs

FAKE = {"FAKE": "1"}
STAGES = ("--train.stage1.batch", 8, "--train.stage2.batch", 8, "--train.save_every", 5)
HAND = Launch(distributed=True, coordinator="node-0:1234", processes=2, process=1)


@pytest.fixture
def joining(monkeypatch):
    """What jax.distributed.initialize is called with."""
    calls = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **given: calls.append(given))
    monkeypatch.setattr(jax.config, "update", lambda *setting: None)
    return calls


def test_without_the_flag_nothing_is_joined(joining):
    with processes.joined(Launch()):
        processes.start(Launch())
    assert joining == []


def test_processes_are_joined_by_hand_or_as_jax_finds_them(joining):
    processes.start(HAND)
    processes.start(Launch(distributed=True, patience=7))
    by_hand, found = joining
    assert by_hand["coordinator_address"] == "node-0:1234"
    assert (by_hand["num_processes"], by_hand["process_id"]) == (2, 1)
    assert not found.keys() & {"coordinator_address", "num_processes", "process_id"}
    assert found["initialization_timeout"] > 7


def test_nothing_to_join_is_said_in_a_sentence(capsys, monkeypatch):
    def initialize(**_given):
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    monkeypatch.setattr(jax.config, "update", lambda *setting: None)
    with pytest.raises(UserError, match="--distributed found no processes to join"):
        processes.start(Launch(distributed=True))
    for address in ("node-0", ":1234", "node-0:0", "node-0:65536"):
        by_hand = ["--coordinator", address, "--processes", "2", "--process", "0"]
        assert program.main(["train", "tiny", "--distributed", *by_hand]) == 2
        assert "HOST:PORT" in capsys.readouterr().err


def test_a_port_in_use_is_refused(joining):
    with jobs.socket.create_server(("", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port} cannot be used"):
            processes.start(Launch(True, f"localhost:{port}", 2, 0))
    assert joining == []


def test_one_process_agrees_with_itself():
    assert processes.is_primary()
    assert processes.agree({"a": [1, None]}) == {"a": [1, None]}
    assert processes.run_on_process_0(lambda: "x") == "x"
    votes = processes.Votes()
    assert [votes.cast(None), votes.cast(15)] == [None, 15]
    tree = {"a": np.arange(3)}
    assert processes.gather(tree) is tree
    with pytest.raises(OSError, match="full"):
        processes.run_on_process_0(lambda: (_ for _ in ()).throw(OSError("full")))


def run_here(monkeypatch, argv, term_at=0):
    """Run train.py in this process, with one device; returns its exit code."""
    monkeypatch.setattr(runtime, "cache_compilation", lambda folder: None)
    monkeypatch.setattr(loader, "clips", jobs.told_at(loader.clips, term_at))
    return program.main(["train", *map(str, argv)])


@pytest.mark.slow
def test_two_processes_of_two_devices_compute_the_losses_of_one(tmp_path, monkeypatch):
    data = tmp_path / "data"
    collect(CollectConfig(out=data, train=2, validation=0, test=0, frames=24, size=16, workers=1))
    argv = ["tiny", "--data.path", data, "--train.stage1.steps", 20, "--train.stage1.batch", 4]
    argv += ["--train.stage2.steps", 0, "--model.backbone.layers", 1]
    argv += ["--train.save_every", 20]
    one, two = tmp_path / "one", tmp_path / "two"
    assert run_here(monkeypatch, [*argv, "--train.run", one]) == 0
    spoken, silent = jobs.finish(
        [*argv, "--train.run", two, "--train.mesh.fsdp", 2], processes=2, devices=2
    )
    assert spoken.endswith(f"Trained: {two}/weights.safetensors\n")
    assert silent == ""
    expected, found = jobs.losses(one), jobs.losses(two)
    assert list(found) == list(expected) == [(1, step) for step in range(1, 21)]
    np.testing.assert_allclose(list(found.values()), list(expected.values()), rtol=1e-5)


@pytest.mark.slow
def test_a_run_goes_on_with_other_numbers_of_devices_and_processes(
    fake_model, tmp_path, monkeypatch
):
    argv = ["tiny", *STAGES, "--train.stage1.steps", 14, "--train.stage2.steps", 6]
    once, often = tmp_path / "once", tmp_path / "often"
    assert run_here(monkeypatch, [*argv, "--train.run", once]) == 0
    argv += ["--train.run", often]
    with jobs.Job(argv, devices=8, settings=FAKE | {"TERM_AT": "6"}) as job:
        codes, _, errors = job.end()
    assert codes == [143], errors
    on_eight = len(jobs.metrics(often))
    assert run_here(monkeypatch, argv, term_at=11) == 143
    on_one = len(jobs.metrics(often)) - on_eight
    jobs.finish(argv, processes=4, settings=FAKE)
    expected, found = jobs.losses(once), jobs.losses(often)
    assert min(on_eight, on_one, len(found) - 6 - on_eight - on_one) > 0
    assert list(found) == list(expected)
    np.testing.assert_allclose(list(found.values()), list(expected.values()), rtol=1e-5)


def test_every_process_places_its_rows_whatever_the_mesh():
    assert jobs.finish([], processes=2, devices=3, settings={"PLACE": ""}) == ["placed\n", ""]


@pytest.mark.slow
def test_a_signal_to_one_stops_all_after_the_same_step(tmp_path):
    run = tmp_path / "run"
    argv = ["tiny", *STAGES, "--train.stage1.steps", 10_000, "--train.run", run]
    with jobs.Job(argv, processes=2, settings=FAKE | {"PAUSE": "0.02"}) as job:
        jobs.wait_for(lambda: len(jobs.metrics(run)) > 6, job)
        job.running[1].send_signal(signal.SIGTERM)
        codes, _, errors = job.end()
    assert codes == [143, 143], errors
    done = len(jobs.metrics(run))
    for told in errors:
        assert (
            f"Stopped after step {done} of stage 1; everything is saved: run the same command "
            "again to resume.\n"
        ) in told
    assert (run / "checkpoints" / "stage1" / str(done)).is_dir()


@pytest.mark.slow
def test_what_is_not_finite_stops_all_or_is_skipped_by_all(tmp_path):
    run, step = tmp_path / "run", 4
    argv = ["tiny", *STAGES, "--train.stage1.steps", 6, "--train.stage2.steps", 0]
    argv += ["--train.run", run]
    nan = FAKE | {"NAN_AT": str(step)}
    with jobs.Job(argv, processes=2, settings=nan) as job:
        codes, _, errors = job.end()
    assert codes == [2, 2], errors
    for told in errors:
        assert f"error: Stage 1 stopped at step {step}: loss nan" in told
    assert len(json.loads((run / "nonfinite-stage1-4.json").read_text())["records"]) == 8

    argv[-1] = run = tmp_path / "skipping"
    jobs.finish([*argv, "--train.on_nonfinite", "skip"], processes=2, settings=nan)
    (entry,) = (json.loads(line) for line in (run / "nonfinite.jsonl").read_text().splitlines())
    assert entry["step"] == step
    assert [line["skipped"] for line in jobs.metrics(run)] == [0, 0, 0, 1, 1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_when_one_is_killed_the_other_says_so_and_ends(killed):
    by_slurm = killed == 1  # once by hand, once as JAX finds the processes itself
    with jobs.Job([], processes=2, settings={"MEET": ""}, slurm=by_slurm) as job:
        jobs.wait_for(lambda: "10\n" in job.read(0, 0), job)
        job.running[killed].kill()
        began = time.monotonic()
        codes, outputs, errors = job.end()
    assert time.monotonic() - began < processes.HEARTBEAT_S + 40
    assert codes[killed] == -signal.SIGKILL
    ours = codes[1 - killed] == 2 and f"error: {processes.GONE}\n" in errors[1 - killed]
    jaxs = codes[1 - killed] == -signal.SIGABRT and "another task died" in errors[1 - killed]
    # JAX's own thread ends what is left of a job whose first process is gone, if it is the faster.
    assert ours or (jaxs and killed == 0), errors[1 - killed]
    assert outputs[1] == ""


@pytest.mark.slow
@pytest.mark.parametrize("process", [0, 1])
def test_processes_that_do_not_meet_say_so_in_time(process):
    argv = ["--distributed", "--patience", 1, "--processes", 2, "--process", process]
    with (
        jobs.held_port() as port,
        jobs.Job([*argv, "--coordinator", f"localhost:{port}"], settings={"MEET": ""}) as job,
    ):
        codes, _, errors = job.end()
    assert codes == [2]
    assert "error: Not all processes of this training have joined at localhost:" in errors[0]
