"""Eight devices compute what one computes, however they are arranged, and none holds it all."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SHARED = [
    ("stage1", "data 8"),
    ("stage1", "fsdp 8"),
    ("stage1", "tensor 2 fsdp 4"),
    ("stage1", "context 4 data 2"),
    ("stage2", "tensor 2 fsdp 4"),
    ("stage2", "context 4 data 2"),
]
MUON = "one", "tensor 2 fsdp 4"


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    done = subprocess.run(
        [sys.executable, str(HERE / "devices.py"), str(tmp_path_factory.mktemp("run"))],
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "rematerialization" not in done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "mesh"), SHARED)
def test_eight_devices_compute_the_losses_of_one(measured, stage, mesh):
    alone, shared = (np.array(measured["losses"][f"{stage} {name}"]) for name in ("one", mesh))
    assert len(alone) == 20
    assert len(set(alone)) == 20
    np.testing.assert_allclose(shared, alone, rtol=1e-5)


@pytest.mark.slow
def test_muon_and_chained_clips_compute_on_eight_devices_what_they_do_on_one(measured):
    alone, shared = (np.array(measured["losses"][f"muon {name}"]) for name in MUON)
    assert len(set(alone)) == 3
    np.testing.assert_allclose(shared, alone, rtol=1e-4)


@pytest.mark.slow
def test_a_batch_is_shared_over_data_and_fsdp(measured):
    rows = {name.removeprefix("stage1 "): rows for name, rows in measured["rows"].items()}
    assert rows["one"] == [8]
    assert rows["data 8"] == rows["fsdp 8"] == [1]
    assert rows["tensor 2 fsdp 4"] == [2]
    assert rows["context 4 data 2"] == [4]


@pytest.mark.slow
def test_copies_of_the_weights_only_add_up_their_gradients(measured):
    kinds = {kind for kind, _, _ in measured["moved"]["stage1 data 8"]}
    assert kinds == {"all-reduce"}


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "mesh"), [SHARED[1], SHARED[2], SHARED[4]])
def test_weights_are_gathered_layer_by_layer(measured, stage, mesh):
    gathered = [part for part in measured["moved"][f"{stage} {mesh}"] if part[0] == "all-gather"]
    layers = [size for _, size, where in gathered if "while/body" in where]
    assert len(layers) >= 6
    assert max(layers) < measured["stacked"]
    assert not any("shard_map" in where and "attention" not in where for _, _, where in gathered)


@pytest.mark.slow
def test_no_device_ever_holds_the_whole_state(measured):
    fresh = measured["fresh"]
    assert fresh["made"] < fresh["whole"] / 4
    assert not fresh["communicates"]
    assert measured["split"] > 40


@pytest.mark.slow
def test_a_checkpoint_of_eight_devices_is_restored_on_one(measured):
    assert measured["restored"] is True
    assert measured["restored_on"] == 1
