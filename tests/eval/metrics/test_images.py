"""Image measures against naive references and their properties."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.eval.metrics.images import (
    MASKS,
    PSNR_CEILING,
    SUMS,
    error_sums,
    gaussian_window,
    psnr,
    ssim_map,
    unit_colours,
)
from pewm_jax.types import Camera, Frames
from tests.properties import examples


def naive_ssim_map(a, b):
    """SSIM pixel by pixel in float64, as the paper writes it."""
    window = np.outer(gaussian_window(), gaussian_window()).astype(np.float64)
    window /= window.sum()
    height, width, _ = a.shape
    out = np.zeros((height - 10, width - 10))
    for i in range(height - 10):
        for j in range(width - 10):
            values = []
            for c in range(3):
                x = a[i : i + 11, j : j + 11, c].astype(np.float64)
                y = b[i : i + 11, j : j + 11, c].astype(np.float64)
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                values.append(
                    (2 * mx * my + 1e-4)
                    * (2 * cov + 9e-4)
                    / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
                )
            out[i, j] = np.mean(values)
    return out


def frames(rgb, depth):
    count = rgb.shape[0]
    pose = np.broadcast_to(np.eye(4, dtype=np.float32), (count, 4, 4))
    return Frames(rgb, depth, Camera(np.ones((count, 4), np.float32), pose))


def test_ssim_equals_the_naive_loop():
    rng = np.random.default_rng(0)
    a = rng.random((17, 14, 3)).astype(np.float32)
    b = np.clip(a + 0.2 * rng.standard_normal(a.shape), 0, 1).astype(np.float32)
    np.testing.assert_allclose(ssim_map(a, b), naive_ssim_map(a, b), atol=2e-5)


@examples(25)
@given(st.integers(0, 2**31), st.floats(0.01, 0.5))
def test_ssim_is_symmetric_and_one_only_for_equal_images(seed, noise):
    rng = np.random.default_rng(seed)
    a = rng.random((13, 13, 3)).astype(np.float32)
    b = np.clip(a + noise * rng.standard_normal(a.shape), 0, 1).astype(np.float32)
    np.testing.assert_allclose(ssim_map(a, a), 1, atol=1e-5)
    np.testing.assert_allclose(ssim_map(a, b), ssim_map(b, a), atol=1e-5)
    assert ssim_map(a, b).mean() < 1


@given(st.floats(1e-9, 1.0))
def test_psnr_of_a_known_error(error):
    assert float(psnr(error)) == pytest.approx(-10 * np.log10(error), abs=1e-3)


def test_psnr_of_equal_images_is_finite():
    assert float(psnr(0.0)) == PSNR_CEILING


def test_colours_of_both_kinds_meet():
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_allclose(
        unit_colours(codes), unit_colours(codes.astype(np.float32) / 127.5 - 1), atol=1e-6
    )
    assert float(unit_colours(np.float32(3.0))) == 1.0


@examples(20)
@given(st.integers(0, 2**31))
def test_sums_are_those_of_masked_pixels_alone(seed):
    rng = np.random.default_rng(seed)
    shape = (2, 16, 12)
    true = frames(
        rng.uniform(-1, 1, (*shape, 3)).astype(np.float32),
        rng.uniform(0.5, 5, shape).astype(np.float32) * (rng.random(shape) > 0.2),
    )
    guess = frames(
        rng.uniform(-1, 1, (*shape, 3)).astype(np.float32),
        rng.uniform(0.5, 5, shape).astype(np.float32),
    )
    seen = (rng.random(shape) > 0.5) & (true.depth_THW > 0)
    unseen = ~seen & (true.depth_THW > 0)
    sums = np.asarray(error_sums(guess, true, jnp.asarray(seen), jnp.asarray(unseen)))
    assert sums.shape == (2, len(MASKS), len(SUMS))
    squared = ((guess.rgb_THWC - true.rgb_THWC) / 2) ** 2
    off = np.abs(guess.depth_THW - true.depth_THW)
    for k, mask in enumerate((seen, unseen, np.ones(shape, bool))):
        for t in range(2):
            got = dict(zip(SUMS, sums[t, k], strict=True))
            valid = mask[t] & (true.depth_THW[t] > 0)
            assert got["squared"] == pytest.approx(squared[t][mask[t]].sum(), rel=1e-4)
            assert got["colours"] == 3 * mask[t].sum()
            assert got["windows"] == mask[t, 5:-5, 5:-5].sum()
            assert got["depth_abs"] == pytest.approx(off[t][valid].sum(), rel=1e-4)
            assert got["depth_rel"] == pytest.approx(
                (off[t][valid] / true.depth_THW[t][valid]).sum(), rel=1e-4
            )
            assert got["depths"] == valid.sum()


def test_errors_outside_a_mask_do_not_count():
    shape = (1, 24, 24)
    true = frames(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
    spoiled = np.zeros((*shape, 3), np.float32)
    spoiled[:, :, 18:] = 1
    mask = np.zeros(shape, bool)
    mask[:, :, :12] = True
    sums = np.asarray(
        error_sums(frames(spoiled, true.depth_THW), true, jnp.asarray(mask), jnp.asarray(~mask))
    )
    seen, unseen = sums[0, 0], sums[0, 1]
    assert seen[SUMS.index("squared")] == 0
    assert unseen[SUMS.index("squared")] > 0
    assert seen[SUMS.index("ssim")] == pytest.approx(seen[SUMS.index("windows")], rel=1e-5)
