"""DINOv2 by itself: sizes, preprocessing, and batches spread over devices."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import ConfigError, UserError
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config, published
from tests.helpers import randomised
from tests.properties import examples

ROOT = Path(__file__).parents[3]
TINY = DINOv2Config(layers=2, heads=2, width=16, patch=14, pretrained_size=42)


@pytest.fixture(scope="module")
def params():
    return randomised(dinov2.init, TINY, jax.random.key(0))


def images(batch, height, width):
    return np.random.default_rng(0).normal(size=(batch, height, width, 3)).astype(np.float32)


@pytest.mark.parametrize("size", [(43, 42), (42, 13), (0, 14)])
def test_sizes_that_are_no_multiple_of_the_patch_are_refused(params, size):
    with pytest.raises(UserError, match=r"multiples of its patch of 14; the nearest"):
        dinov2.apply(TINY, params, images(1, *size))
    with pytest.raises(UserError, match="multiples of its patch of 14"):
        dinov2.preprocess(jnp.zeros((1, 32, 32, 3)), size)


def test_images_of_another_kind_are_refused(params):
    for wrong in (np.zeros((1, 42, 42, 3), np.uint8), np.zeros((42, 42, 3), np.float32)):
        with pytest.raises(UserError, match="floats of shape"):
            dinov2.apply(TINY, params, wrong)


def test_there_is_no_other_published_size():
    assert published("giant", registers=True).hidden == 4096
    with pytest.raises(ConfigError, match="no DINOv2 'huge'"):
        published("huge")  # type: ignore[arg-type]


def test_the_order_of_a_batch_is_the_order_of_its_tokens(params):
    batch = images(3, 42, 28)
    compute = jax.jit(dinov2.apply, static_argnums=0)
    tokens, turned = compute(TINY, params, batch), compute(TINY, params, batch[::-1])
    np.testing.assert_allclose(turned[::-1], tokens, rtol=1e-4, atol=1e-5)


@examples(40)
@given(st.integers(1, 40), st.integers(1, 40), st.booleans())
def test_interpolation_keeps_constants_and_the_order_of_places(old, new, antialias):
    weights = dinov2.resize_matrix(old, new, antialias)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-5)
    np.testing.assert_allclose(weights[::-1, ::-1], weights, atol=2e-6)
    if old == new:
        np.testing.assert_array_equal(weights, np.eye(old, dtype=np.float32))


def test_preprocessing_keeps_a_flat_colour_and_the_place_of_things():
    flat = np.broadcast_to(np.float32([0.5, -1, 1]), (1, 20, 30, 3))
    out = dinov2.preprocess(flat, (28, 42))
    want = (np.array([0.75, 0, 1]) - dinov2.MEAN_3) / dinov2.STD_3
    assert out.shape == (1, 28, 42, 3)
    np.testing.assert_allclose(out, np.broadcast_to(want, out.shape), rtol=1e-4)
    spot = -np.ones((1, 32, 32, 3), np.float32)
    spot[0, 20:24, 4:8] = 1
    row, column = np.argwhere(np.asarray(dinov2.preprocess(spot, 56))[0, ..., 0] > 2).mean(0)
    np.testing.assert_allclose([row, column], [22 / 32 * 56 - 0.5, 6 / 32 * 56 - 0.5], atol=0.1)


def test_preprocessing_stays_within_colours():
    """Bicubic rings at edges; what leaves [−1, 1] is cut off, as images of 8 bits do."""
    step = np.where(np.arange(40)[:, None] < 20, -1, 1) * np.ones((1, 40, 40, 3), np.float32)
    step = np.swapaxes(step, 1, 2)
    out = np.asarray(dinov2.preprocess(step, 28)) * dinov2.STD_3 + dinov2.MEAN_3
    assert out.min() >= -1e-6
    assert out.max() <= 1 + 1e-6


@pytest.mark.slow
def test_eight_devices_share_a_batch_of_frames_and_compute_what_one_does():
    script = Path(__file__).with_name("devices.py")
    done = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "8 devices, equal"


def test_a_lone_processor_takes_image_by_image_and_computes_what_all_together_give(
    params, monkeypatch
):
    batch, found = images(9, 28, 28), {}
    for devices in (1, 2):
        monkeypatch.setattr(jax, "device_count", lambda n=devices: n)
        program = jax.jit(lambda p, x: dinov2.apply(TINY, p, x)).lower(params, batch).compile()
        costs = program.cost_analysis() or {}
        found[devices] = program(params, batch), costs["flops"]
    np.testing.assert_allclose(found[1][0], found[2][0], rtol=1e-4, atol=1e-5)
    one_image = found[2][1] / 9
    assert found[1][1] < 7 * one_image, "a loop's body is counted once"
