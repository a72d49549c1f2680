"""The march through a grid meets what a look at every cell finds, in the same order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.geometry import march
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.types import Camera
from tests.properties import examples

SHAPE, RAYS, LAYERS = (5, 4, 6), 32, 15  # 15 = as many cells as a ray can enter
LOW, CELL = np.array([-1.0, 0.5, -0.25]), 0.5
marched = jax.jit(march.march, static_argnums=5)


def brute_force(ids, origin, direction):
    """All occupied cells that a ray enters, by a look at each: (entry, length in it, id)."""
    found = []
    for cell in np.argwhere(ids):
        low, high = LOW + cell * CELL, LOW + (cell + 1) * CELL
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - origin) / direction, (high - origin) / direction
        near, far = np.minimum(a, b), np.maximum(a, b)
        for axis in np.flatnonzero(direction == 0):
            inside = low[axis] <= origin[axis] < high[axis]
            near[axis], far[axis] = (-np.inf, np.inf) if inside else (np.inf, -np.inf)
        enter, leave = max(near.max(), 0.0), far.min()
        if leave > enter:
            found.append((enter, leave - enter, int(ids[tuple(cell)])))
    return sorted(found)


@examples(40)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.booleans())
def test_the_march_is_brute_force(seed, share, axes):
    compare(seed, share, axes, SHAPE)


def test_ways_of_more_cells_than_a_word_has_bits_and_more_rays_than_a_chunk(monkeypatch):
    monkeypatch.setattr(march, "CHUNK", 12)
    fresh = jax.jit(lambda *given: march.march(*given, LAYERS))
    compare(0, 0.02, False, (33, 20, 27), lambda *given: fresh(*given[:-1]))


def compare(seed, share, axes, shape, marched=marched):
    """Compare what random rays through a random grid meet with a look at every cell."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(1, 9, shape) * (rng.random(shape) < share)
    middle = LOW + CELL * np.array(shape) / 2
    origins = middle + rng.normal(0, 0.3 * CELL * max(shape), (RAYS, 3))
    directions = rng.normal(0, 1, (RAYS, 3)) * rng.uniform(0.2, 3, (RAYS, 1))
    if axes:  # along one or two axes, where the others never change
        directions *= rng.random((RAYS, 3)) < 0.5
        directions[(directions == 0).all(-1), 0] = 1
    single = [x.astype(np.float32) for x in (origins, directions)]
    hits = marched(ids, LOW.astype(np.float32), np.float32(CELL), *single, LAYERS)
    for ray in range(RAYS):
        length = np.linalg.norm(single[1][ray])
        expected = brute_force(ids, *(x[ray].astype(np.float64) for x in single))
        clear = [one for one in expected if one[1] * length > 1e-3]
        count = int((hits.ids_L[ray] != 0).sum())
        assert (np.asarray(hits.ids_L[ray, count:]) == 0).all(), "no gaps"
        entries = np.asarray(hits.distance_L[ray, :count])
        assert (np.diff(entries) >= 0).all(), "nearest first"
        found = list(zip(entries.tolist(), np.asarray(hits.ids_L[ray]).tolist(), strict=False))
        for enter, _, name in clear:  # a cell that is merely touched may be left out
            near = [one for one in found if abs(one[0] - enter) * length < 1e-4]
            assert name in [one[1] for one in near], (expected, found)
        for enter, name in found:
            place = (single[0][ray] + enter * single[1][ray] - LOW) / CELL
            cells = np.argwhere(ids == name) + 0.5
            assert np.abs(cells - place).max(-1).min() < 0.5 + 1e-3


def test_the_nearest_cells_are_kept_and_sides_are_told():
    ids = np.zeros(SHAPE, int)
    ids[1:, 2, 3] = [1, 2, 3, 4]
    origin = (LOW + CELL * np.array([-0.5, 2.5, 3.5])).astype(np.float32)
    rays = np.stack([origin, origin + np.float32([1.25 + 0.25, 0, 0])])
    directions = np.float32([[2, 0, 0], [-1, 0, 0]])
    hits = marched(ids, LOW.astype(np.float32), np.float32(CELL), rays, directions, 2)
    np.testing.assert_array_equal(hits.ids_L, [[1, 2], [2, 1]])
    np.testing.assert_allclose(hits.distance_L, [[0.375, 0.625], [0, 0.25]], atol=1e-6)
    np.testing.assert_array_equal(hits.side_L, [[0, 0], [-1, 0]])


def test_a_wall_is_seen_at_its_depth():
    """Through the pixels of a level camera, and depth is along z and not along the ray."""
    ids = np.zeros((40, 40, 20), int)
    ids[30] = 7
    low, cell = np.float32([0, 0, 0]), np.float32(0.1)
    pose = pose_from_yaw(np.array([1.05, 2.0, 1.0]), 0.0)
    camera = Camera(intrinsics_from_fov(6, 8, 60.0)[None], pose[None])
    seen = jax.jit(march.through_pixels, static_argnums=(4, 5, 6))(
        ids, low, cell, jax.tree.map(jnp.asarray, camera), 6, 8, 1
    )
    assert seen.ids_L.shape == (1, 6, 8, 1)
    on_wall = np.asarray(seen.ids_L[0, :, :, 0]) == 7
    assert on_wall.mean() > 0.5
    np.testing.assert_allclose(np.asarray(seen.distance_L)[0][on_wall], 1.95, atol=1e-4)


def test_a_grid_whose_cells_have_no_number_is_refused():
    with pytest.raises(UserError, match="1022"):
        march.march(np.zeros((2000, 2000, 2000), bool), LOW, CELL, *np.ones((2, 1, 3)), 1)


@pytest.mark.parametrize("axis", range(3))
def test_a_ray_beside_the_grid_meets_nothing(axis):
    ids = np.ones(SHAPE, int)
    origin = LOW - 0.3
    direction = np.zeros(3)
    direction[axis] = 1.0
    single = [np.float32(x)[None] for x in (origin, direction)]
    hits = marched(ids, LOW.astype(np.float32), np.float32(CELL), *single, LAYERS)
    assert (np.asarray(hits.ids_L) == 0).all()
