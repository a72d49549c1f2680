"""Eight devices compute what one computes, and their checkpoints are readable by one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    done = subprocess.run(
        [sys.executable, str(HERE / "training_devices.py"), str(tmp_path_factory.mktemp("run"))],
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_eight_devices_share_a_batch_and_compute_the_losses_of_one(measured):
    assert measured["batch_on"] == {"1": 1, "8": 8}
    losses = measured["losses"]
    np.testing.assert_allclose(losses["8"], losses["1"], rtol=1e-5, atol=1e-6)
    assert len(set(losses["1"])) == len(losses["1"])


def test_a_checkpoint_of_eight_devices_is_restored_on_one(measured):
    assert measured["restored"] is True
    assert measured["restored_on"] == 1
