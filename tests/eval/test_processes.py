"""Several processes with several devices each find the numbers of one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pewm_jax.eval import runner
from tests.eval.processes import score
from tests.eval.scene import write_split

HERE = Path(__file__).parent
SCRIPT = str(HERE / "processes.py")
PATIENCE_S = 300


def test_every_piece_is_done_once_and_light_ones_are_shared_apart(monkeypatch):
    keys = [(name, number) for number in range(3) for name in ("a", "b", "light")]
    monkeypatch.setattr(runner.jax, "process_count", lambda: 2)
    parts = []
    for index in range(2):
        monkeypatch.setattr(runner.jax, "process_index", lambda index=index: index)
        parts.append(runner.workers().assign_work(keys, lambda key: key[0] == "light"))
    assert sorted(parts[0] + parts[1]) == sorted(keys)
    assert [sum(key[0] != "light" for key in part) for part in parts] == [3, 3]
    assert [sum(key[0] == "light" for key in part) for part in parts] == [2, 1]


@pytest.mark.parametrize(("devices", "batch", "used"), [(4, 8, 4), (4, 6, 3), (4, 5, 1), (1, 8, 1)])
def test_as_many_devices_are_used_as_divide_a_batch(devices, batch, used, monkeypatch):
    monkeypatch.setattr(runner.jax, "make_mesh", lambda shape, *_, devices: (shape, devices))
    made = runner.mesh_of(list("abcd")[:devices], batch)
    assert made == (None if used == 1 else ((used,), list("abcd")[:used]))


@pytest.mark.slow
def test_two_processes_of_four_devices_find_what_one_finds(tmp_path, monkeypatch):
    write_split(tmp_path / "data" / "revisit", episodes=2)
    quick = os.environ.get("XLA_FLAGS", "")
    environment = {
        **os.environ,
        "PYTHONPATH": f"{HERE.parents[1]}:{HERE}",
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{quick} --xla_force_host_platform_device_count=4",
    }
    with socket.socket() as held:
        held.bind(("", 0))  # alone: no one else is given this port, but it can be listened at
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        where = ["--distributed", "--coordinator", f"localhost:{held.getsockname()[1]}"]
        where += ["--processes", "2", "--patience", "120"]
        running = [
            subprocess.Popen(
                [sys.executable, SCRIPT, str(tmp_path), *where, "--process", str(index)],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for index in range(2)
        ]
        try:
            monkeypatch.setattr(runner, "rollout", runner.rollout)  # put back in the end
            alone = score(tmp_path, ())
            said = [process.communicate(timeout=PATIENCE_S) for process in running]
        finally:
            for process in running:
                process.kill()
    assert [process.returncode for process in running] == [0, 0], said
    assert said[0][0].endswith("2 processes, 8 devices\n")
    assert said[1][0] == ""
    with np.load(tmp_path / "found.npz") as found:
        assert set(found.files) == set(alone)
        for name, array in alone.items():
            np.testing.assert_allclose(found[name], array, rtol=1e-4, atol=1e-4, err_msg=name)
    pieces = [sorted(p.name for p in tmp_path.glob(f"partial-{n}/*/*/*.npz")) for n in (0, 4)]
    assert pieces[0] == pieces[1]
