"""Micro-batches on several devices are those on one, and no device sends its clips."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
DEVICES = """
import json, os, re
os.environ["XLA_FLAGS"] += " --xla_force_host_platform_device_count=4"
import jax, numpy as np
from pewm_jax import presets
from pewm_jax.config import MeshConfig
from pewm_jax.train import sharding, step
from pewm_jax.worlds.pewm.world import STAGES
from tests.train import fakes

config = fakes.with_stage(presets.load("tiny"), "stage1", batch=8, micro_batches=2)
clip = fakes.clip(config, 8, 0)
out = {"losses": [], "norms": []}
for count, arranged in ((1, MeshConfig()), (4, MeshConfig(data=2, fsdp=2))):
    mesh = sharding.make_mesh(jax.devices()[:count], arranged)
    state = step.initial_state(config, STAGES[0], mesh)
    run = step.compile_step(config, STAGES[0], mesh, clip)
    key = jax.device_put(step.noise_key(config, STAGES[0]), sharding.replicated(mesh))
    for _ in range(2):
        state, metrics = run(state, jax.device_put(clip, sharding.of_batch(mesh)), key)
    out["losses"].append(float(metrics["loss"]))
    out["norms"].append(float(metrics["grad_norm"]))
moved = re.findall(r"= u8\\[.*(?:all-gather|all-to-all|collective-permute).*", run.as_text())
print(json.dumps({**out, "moved": moved}))
"""


@pytest.mark.slow
def test_four_devices_compute_what_one_computes_without_sending_clips():
    done = subprocess.run(
        [sys.executable, "-c", DEVICES],
        env={
            **os.environ,
            "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
            "PYTHONPATH": str(ROOT),
            "JAX_PLATFORMS": "cpu",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    for one, four in (found["losses"], found["norms"]):
        np.testing.assert_allclose(four, one, rtol=1e-5)
    assert found["moved"] == []
    assert "rematerialization" not in done.stderr
