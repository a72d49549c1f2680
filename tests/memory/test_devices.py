"""Maps of a batch live on the devices of their batch members: no map ever travels."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@pytest.mark.slow
def test_a_batch_of_maps_is_built_where_its_frames_are():
    done = subprocess.run(
        [sys.executable, str(HERE / "devices.py")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    measured = json.loads(done.stdout.splitlines()[-1])
    assert measured["same"] == [True] * 8
    assert set(map(tuple, measured["places"].values())) == {(2,)}, "two of eight on each of four"
    assert measured["moved"] == []
