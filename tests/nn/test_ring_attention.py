"""Ring attention on eight simulated devices is attention, forward and backward."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
DEVICES = """
import dataclasses, json, os
os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=8"
import jax, jax.numpy as jnp, numpy as np
from pewm_jax.config import MeshConfig
from pewm_jax.nn import attention, ring_attention
from pewm_jax.train import sharding

def difference(got, want):
    got, want = (np.asarray(x, np.float32) for x in (got, want))
    return float(np.abs(got - want).max() / np.abs(want).max())

def rms(got, want):
    got, want = (np.asarray(x, np.float32) for x in (got, want))
    return float(np.sqrt(np.square(got - want).mean()) / np.abs(want).max())

def case(context, queries, keys, padding, dtype, logits):
    ring_attention.LOGITS = logits
    mesh = sharding.make_mesh(arranged=MeshConfig(context=context))
    rng = np.random.default_rng(0)
    q, k, v, weight = (
        jnp.asarray(rng.normal(0, 2, (8 // context, 3, n, 16)), dtype)
        for n in (queries, keys, keys, queries)
    )
    real = None
    if padding > 0:  # a whole part may be padding
        real = np.arange(keys - padding)
    elif padding < 0:
        real = np.sort(rng.permutation(keys)[:padding])

    def plain(q, k, v):
        if real is not None:
            k, v = k[:, :, real], v[:, :, real]
        wide = (x.astype(jnp.float32) for x in (q, k, v))
        return attention.plain_attention(*wide)

    def loss(attend):
        return lambda *x: (attend(*x).astype(jnp.float32) * weight.astype(jnp.float32)).sum()

    def ring(q, k, v):
        return attention.attention(q, k, v, "ring", real)

    want = plain(q, k, v), *jax.grad(loss(plain), (0, 1, 2))(q, k, v)
    with jax.set_mesh(mesh):
        run = jax.jit(lambda *x: (ring(*x), *jax.grad(loss(ring), (0, 1, 2))(*x)))
        compiled = run.lower(q, k, v).compile()
        got = compiled(q, k, v)
    text = compiled.as_text()
    return {
        "worst": max(map(difference, got, want)),
        "rms": max(map(rms, got, want)),
        "ring": "collective-permute" in text,
        "gathered": any("all-gather" in line and "16]" in line for line in text.splitlines()),
    }

def transformer():
    # Its tokens are padded for four devices along context.
    from pewm_jax.models.cogvideox import model
    from tests.helpers import TINY, randomised

    config = dataclasses.replace(TINY.backbone, in_channels=4, out_channels=4, attention="ring")
    params = randomised(model.init, config, jax.random.key(0))
    rng = np.random.default_rng(0)
    latents = jnp.asarray(rng.normal(size=(2, 3, 6, 6, 4)), jnp.float32)
    text = jnp.zeros((2, config.text_length, config.text_dim))

    def loss(params, x):
        out = model.apply(config, params, x, text, jnp.full(2, 500))
        return jnp.square(out).mean(), out

    run = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, want), slope = run(params, latents)
    with jax.set_mesh(sharding.make_mesh(arranged=MeshConfig(context=4))):
        compiled = run.lower(params, latents).compile()
        (_, got), other = compiled(params, latents)
    pairs = [(got, want), *zip(jax.tree.leaves(other), jax.tree.leaves(slope))]
    worst = max(difference(*pair) for pair in pairs if np.abs(pair[1]).max())
    return {"worst": worst, "ring": "collective-permute" in compiled.as_text()}

large, small = 2**20, 40
out = {
    "transformer": transformer(),
    "even": case(8, 32, 32, 0, "float32", large),
    "odd parts, blocks": case(4, 28, 20, 0, "float32", small),
    "padding at the end": case(8, 40, 40, 11, "float32", large),
    "scattered padding, blocks": case(4, 20, 36, -7, "float32", small),
    "bfloat16": case(8, 64, 64, 3, "bfloat16", large),
    "cannot be split": case(8, 31, 33, 2, "float32", large),
}
print(json.dumps(out))
"""


@pytest.fixture(scope="module")
def measured():
    done = subprocess.run(
        [sys.executable, "-c", DEVICES],
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    "case", ["even", "odd parts, blocks", "padding at the end", "scattered padding, blocks"]
)
def test_values_and_gradients_are_those_of_the_whole(measured, case):
    assert measured[case]["worst"] < 1e-5
    assert measured[case]["ring"]
    assert not measured[case]["gathered"]


def test_a_transformer_on_a_ring_is_that_on_one_device(measured):
    assert measured["transformer"]["worst"] < 1e-4
    assert measured["transformer"]["ring"]


def test_in_16_bits_only_rounding_differs(measured):
    assert measured["bfloat16"]["worst"] < 1e-2
    assert measured["bfloat16"]["rms"] < 2e-3
    assert measured["bfloat16"]["ring"]


def test_tokens_that_the_devices_do_not_divide_are_computed_without_a_ring(measured):
    assert measured["cannot be split"]["worst"] < 1e-5
    assert not measured["cannot be split"]["ring"]
