"""Counts from jaxprs and shapes agree with compiled steps: FLOPs and state 2 %, traffic 10 %."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.plan import programs as training_plans

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def measured():
    done = subprocess.run(
        [sys.executable, str(HERE / "programs.py")],
        env={**os.environ, "PYTHONPATH": str(HERE.parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", training_plans.VARIANTS)
def test_the_sums_agree_with_the_compiled_step(measured, name):
    one = measured[name]
    assert one["unknown"] == []
    assert one["flops_expected"] == pytest.approx(one["flops"], rel=0.02)
    assert one["state_expected"] == pytest.approx(one["state"], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["all-gather", "reduce-scatter"])
def test_the_traffic_of_weights_agrees_with_the_compiled_step(measured, kind):
    one = measured["stage 2, tensor 2 × fsdp 4"]
    assert one["sent_expected"][kind] == pytest.approx(one["sent"][kind], rel=0.1)
