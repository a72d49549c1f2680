"""Holes are filled from the nearest known pixel; images without holes are left alone."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pewm_jax.geometry import depth_images

fill = jax.jit(depth_images.fill_depth, static_argnums=1)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.02, 0.3, 0.9]))
def test_a_hole_takes_the_depth_of_a_nearest_pixel(seed, share):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 5, (2, 9, 14)).astype(np.float32) * (rng.random((2, 9, 14)) < share)
    filled = np.asarray(fill(depth, 7.0))
    for before, after in zip(depth, filled, strict=True):
        known = np.argwhere(before > 0)
        if not len(known):
            assert (after == 7).all()
            continue
        for place in np.ndindex(before.shape):
            distance = np.hypot(*(known - place).T)
            off = min(np.hypot(*(np.array(p) - place)) for p in np.argwhere(before == after[place]))
            assert off <= 1.3 * distance.min() + 1.0  # jump flooding is seldom off, by little


def test_without_holes_nothing_changes():
    depth = np.random.default_rng(0).uniform(1, 5, (2, 8, 8)).astype(np.float32)
    np.testing.assert_array_equal(fill(depth, 7.0), depth)
