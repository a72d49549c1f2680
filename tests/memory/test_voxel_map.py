import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.geometry import cameras
from pewm_jax.memory import voxel_map
from pewm_jax.types import Camera, Frames
from tests.helpers import TINY, random_frames
from tests.properties import examples

CONFIG = dataclasses.replace(TINY.memory, cell_m=(0.5, 0.25, 1.0), cells=(6, 8, 3))
insert = jax.jit(voxel_map.insert, static_argnums=0)
insert_frames = jax.jit(voxel_map.insert_frames, static_argnums=0)
merge = jax.jit(voxel_map.merge, static_argnums=0)
SEEDS = st.integers(0, 100_000)


def fresh(config=CONFIG, channels=4):
    return voxel_map.empty(config, np.zeros(3, np.float32), channels)


def random_points(seed, count=60):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (count, 3)).astype(np.float32)
    return points, rng.normal(size=(count, 4)).astype(np.float32), rng.random(count) < 0.8


def cells_of(config, voxels):
    """The map as a plain dictionary: cell → features."""
    cells, values = np.asarray(voxels.cell_of_slot_V), np.asarray(voxels.features_VF)
    return {int(c): values[i] for i, c in enumerate(cells) if c < math.prod(config.cells)}


def identical(a, b):
    """Equal bit for bit, layout and counts included."""
    jax.tree.map(np.testing.assert_array_equal, a, b)


def inside(points):
    half = np.array(CONFIG.cells) * CONFIG.cell_m / 2
    low = np.round(-half / CONFIG.cell_m) * CONFIG.cell_m
    place = (points - low) / CONFIG.cell_m
    return ((place >= 0) & (place < CONFIG.cells)).all(-1)


def same(a, b):
    assert a.keys() == b.keys()
    for cell, value in a.items():
        np.testing.assert_array_equal(value, b[cell])


def reference(config, points, values, valid):
    """The definition, cell by cell, in float64."""
    cells, outside = {}, 0
    origin = -np.array(config.cells) * np.array(config.cell_m) / 2
    origin = np.round(origin / config.cell_m) * config.cell_m
    for point, value, ok in zip(points.astype(float), values.astype(float), valid, strict=True):
        if not ok:
            continue
        index = np.floor((point - origin) / config.cell_m).astype(int)
        if (index < 0).any() or (index >= config.cells).any():
            outside += 1
            continue
        cell = int(np.ravel_multi_index(index, config.cells))
        cells[cell] = np.maximum(cells.get(cell, -np.inf), value)
    return cells, outside


def test_where_nothing_was_observed_features_are_below_any_other():
    assert np.isneginf(fresh().features_VF).all()
    voxels = insert(CONFIG, fresh(), *random_points(0))
    held = np.asarray(voxels.cell_of_slot_V) < math.prod(CONFIG.cells)
    assert 0 < held.sum() < len(held)
    assert np.isneginf(voxels.features_VF[~held]).all()
    assert np.isfinite(voxels.features_VF[held]).all()
    assert (np.asarray(voxels.features_VF)[held] < 0).any()


@examples(25)
@given(seed=SEEDS)
def test_a_cell_is_the_maximum_of_its_points(seed):
    points, values, valid = random_points(seed)
    voxels = insert(CONFIG, fresh(), points, values, valid)
    expected, outside = reference(CONFIG, points, values, valid)
    same(cells_of(CONFIG, voxels), {c: v.astype(np.float32) for c, v in expected.items()})
    assert int(voxels.occupied) == len(expected)
    assert int(voxels.outside) == outside
    assert int(voxels.dropped) == 0


@examples(15)
@given(seed=SEEDS)
def test_order_repetition_and_batching_do_not_matter(seed):
    points, values, valid = random_points(seed)
    once = insert(CONFIG, fresh(), points, values, valid)
    order = np.random.default_rng(seed).permutation(len(points))
    identical(once, insert(CONFIG, fresh(), points[order], values[order], valid[order]))
    half = len(points) // 2
    parts = fresh()
    for part in (slice(half, None), slice(None, half), slice(half, None)):
        parts = insert(CONFIG, parts, points[part], values[part], valid[part])
    repeated = (valid[half:] & ~inside(points[half:])).sum()
    assert int(parts.outside) == int(once.outside) + repeated, "points outside count every time"
    identical(once, dataclasses.replace(parts, outside=once.outside))


@examples(15)
@given(seed=SEEDS)
def test_inserting_after_one_another_is_merging(seed):
    a, b = random_points(seed), random_points(seed + 1)
    maps = [insert(CONFIG, fresh(), *part) for part in (a, b)]
    after = insert(CONFIG, maps[0], *b)
    identical(merge(CONFIG, *maps), after)
    identical(merge(CONFIG, *maps[::-1]), after)


def test_merging_keeps_the_first_map_whole_and_counts_what_does_not_fit():
    config = dataclasses.replace(CONFIG, capacity=30, tokens=5)
    a, b = (insert(config, fresh(config), *random_points(s, 300)) for s in (0, 1))
    both = merge(config, a, b)
    assert int(a.dropped) > 0, "the first map is full"
    np.testing.assert_array_equal(both.cell_of_slot_V, a.cell_of_slot_V)
    new = set(np.asarray(b.cell_of_slot_V)) - set(np.asarray(a.cell_of_slot_V))
    assert int(both.dropped) == int(a.dropped) + int(b.dropped) + len(new)


def test_merging_grids_shifted_by_whole_cells():
    points, values, valid = random_points(5)
    shifted = voxel_map.empty(CONFIG, np.array([0.5, -0.25, 0.0], np.float32), 4)
    other = insert(CONFIG, shifted, points, values, valid)
    merged = merge(CONFIG, fresh(), other)
    here = insert(
        CONFIG, fresh(), points, values, valid & inside(points + np.array([-0.5, 0.25, 0]))
    )
    np.testing.assert_array_equal(merged.cell_of_slot_V, here.cell_of_slot_V)
    np.testing.assert_array_equal(merged.features_VF, here.features_VF)
    assert int(merged.outside) > int(other.outside), "cells beyond the first grid are counted"


def test_what_was_there_stays_when_the_capacity_is_full():
    config = dataclasses.replace(CONFIG, capacity=8, tokens=5)
    points, values, valid = random_points(0, 40)
    high, low = points[:, 0] > 0, points[:, 0] <= 0
    first = insert(config, fresh(config), points, values, valid & high)
    again = insert(config, first, points, values, valid & low)
    assert int(first.dropped) == 0
    assert 0 < int(first.occupied) < int(again.occupied) == 8
    assert set(np.asarray(first.cell_of_slot_V)) - set(np.asarray(again.cell_of_slot_V)) <= {144}
    everything, _ = reference(config, points, values, valid)
    assert int(again.dropped) == len(everything) - 8


@pytest.mark.parametrize("given_as", [jnp.float32, jnp.bfloat16])
def test_a_map_of_bfloat16_holds_the_rounded_maxima(given_as):
    points, values, valid = random_points(2)
    values = jnp.asarray(values, given_as)
    half = insert(
        CONFIG, voxel_map.empty(CONFIG, np.zeros(3), 4, jnp.bfloat16), points, values, valid
    )
    full = insert(CONFIG, fresh(), points, values, valid)
    np.testing.assert_array_equal(half.features_VF, full.features_VF.astype(jnp.bfloat16))


def test_negative_features_survive_and_zero_is_not_empty():
    point = np.zeros((1, 3), np.float32)
    voxels = insert(CONFIG, fresh(), point, np.full((1, 4), -5, np.float32), np.array([True]))
    _, values, valid = voxel_map.to_points(CONFIG, voxels)
    assert int(valid.sum()) == 1
    np.testing.assert_array_equal(values[valid], -5)


def test_what_does_not_fit_is_counted_and_what_stays_is_deterministic():
    config = dataclasses.replace(CONFIG, capacity=5, tokens=5)
    points, values, valid = random_points(1)
    everything, _ = reference(config, points, values, valid)
    small = insert(config, fresh(config), points, values, valid)
    assert int(small.occupied) == 5
    assert int(small.dropped) == len(everything) - 5
    assert sorted(cells_of(config, small)) == sorted(everything)[:5]
    for cell, value in cells_of(config, small).items():
        np.testing.assert_array_equal(value, everything[cell].astype(np.float32))


def test_points_that_are_not_numbers_are_outside():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]], np.float32)
    voxels = insert(CONFIG, fresh(), points, np.ones((3, 4), np.float32), np.ones(3, bool))
    assert int(voxels.occupied) == 1
    assert int(voxels.outside) == 2


def test_what_does_not_fit_together_is_refused():
    points, values, valid = random_points(1)
    for wrong in (
        (points, values[:-1], valid),
        (points, values[:, :3], valid),
        (points, values, valid[:-1]),
        (points[:, :2], values, valid),
    ):
        with pytest.raises(UserError, match=r"this map takes \(60, 3\), \(60, 4\), \(60,\)"):
            voxel_map.insert(CONFIG, fresh(), *wrong)
    frames = random_frames(np.random.default_rng(0), 2)
    for shape in ((1, 8, 12, 4), (2, 8, 12, 5), (2, 8, 4)):
        with pytest.raises(UserError, match=r"give \(2, rows, columns, 4\)"):
            voxel_map.insert_frames(CONFIG, fresh(), frames, np.zeros(shape, np.float32))


def test_grids_that_are_not_shifted_by_whole_cells_are_not_merged():
    moved = dataclasses.replace(fresh(), origin_3=fresh().origin_3 + np.float32(0.1))
    with pytest.raises(UserError, match="only whole cells can be merged"):
        voxel_map.merge(CONFIG, fresh(), moved)


def test_batched_maps_equal_single_ones():
    sets = [random_points(s) for s in range(3)]
    stacked = [np.stack(x) for x in zip(*sets, strict=True)]
    many = jax.jit(jax.vmap(lambda p, f, v: voxel_map.insert(CONFIG, fresh(), p, f, v)))(*stacked)
    for i, one in enumerate(sets):
        same(
            cells_of(CONFIG, jax.tree.map(lambda x, i=i: x[i], many)),
            cells_of(CONFIG, insert(CONFIG, fresh(), *one)),
        )


def test_every_point_of_a_frame_is_within_half_a_cell_of_its_centre():
    config = TINY.memory
    rng = np.random.default_rng(0)
    frames = random_frames(rng, 2)
    frames = Frames(rng.uniform(-1, 1, frames.rgb_THWC.shape), frames.depth_THW, frames.camera)
    voxels = voxel_map.empty(config, np.zeros(3), 6)
    voxels = insert_frames(
        config,
        voxels,
        frames,
        config.encoder.encode({}, frames.rgb_THWC),
        np.array([True, False]),
    )
    points = np.asarray(
        cameras.unproject(
            frames.depth_THW[0],
            Camera(frames.camera.intrinsics_4[0], frames.camera.world_from_camera[0]),
        )
    )
    centres, _, valid = voxel_map.to_points(config, voxels)
    centres = np.asarray(centres[valid])
    gap = np.abs(points.reshape(-1, 1, 3) - centres).max(-1)
    inside = np.abs(points.reshape(-1, 3)).max(-1) < 2 - 1e-3
    assert inside.any()
    assert gap.min(1)[inside].max() <= 0.25 + 1e-4, "every pixel fell into a kept cell"
    assert gap.min(0).max() <= 0.25 + 1e-4, "every kept cell holds a pixel of the valid frame"


def test_pixels_without_depth_leave_no_trace():
    config = TINY.memory
    rng = np.random.default_rng(0)
    frames = random_frames(rng, 1)
    blank = Frames(rng.uniform(-1, 1, frames.rgb_THWC.shape), frames.depth_THW * 0, frames.camera)
    voxels = voxel_map.empty(config, np.zeros(3), 6)
    patches = config.encoder.encode({}, blank.rgb_THWC)
    voxels = insert_frames(config, voxels, blank, patches)
    assert int(voxels.occupied) == 0


def test_maps_of_one_world_share_their_cells():
    points, values, valid = random_points(3)
    a = voxel_map.empty(CONFIG, np.array([0.13, -0.07, 0.4]), 4)
    centre_a, _, kept = voxel_map.to_points(CONFIG, insert(CONFIG, a, points, values, valid))
    offset = np.asarray(centre_a)[np.asarray(kept)] / np.asarray(CONFIG.cell_m)
    np.testing.assert_allclose(offset - np.floor(offset), 0.5, atol=1e-4)


def test_tokens_are_in_view_first_then_nearest():
    config = dataclasses.replace(TINY.memory, cell_m=(0.5, 0.5, 0.5), cells=(40, 40, 8), tokens=3)
    ahead = [[4.25, 0.25, 0.25], [2.25, 0.25, 0.25]]
    behind = [[-0.75, 0.25, 0.25], [-5.25, 0.25, 0.25]]
    points = np.array([behind[1], ahead[0], behind[0], ahead[1]], np.float32)
    voxels = voxel_map.empty(config, np.zeros(3), 6)
    voxels = insert(config, voxels, points, np.ones((4, 6), np.float32), np.ones(4, bool))
    camera = Camera(
        cameras.intrinsics_from_fov(16, 16, 90)[None],
        cameras.pose_from_yaw(np.array([0, 0.25, 0.25]), 0.0)[None],
    )
    chosen = voxel_map.tokens(config, voxels, camera, (16, 16))
    np.testing.assert_allclose(chosen.points_world_M3, [ahead[1], ahead[0], behind[0]], atol=1e-5)
    more = voxel_map.tokens(dataclasses.replace(config, tokens=6), voxels, camera, (16, 16))
    np.testing.assert_array_equal(more.valid_M, [True] * 4 + [False] * 2)
    np.testing.assert_array_equal(more.features_MF[4:], 0)


def test_the_grid_is_never_allocated_with_features():
    config = dataclasses.replace(
        CONFIG, cells=(256, 256, 32), cell_m=(0.25, 0.25, 1.0), capacity=1000, tokens=10
    )
    shapes = jax.eval_shape(lambda: voxel_map.empty(config, jnp.zeros(3), 384))
    total = sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(shapes))
    assert total < 12e6, "the dense grid would be 1.6 GB in bfloat16"


def test_patch_colours_keep_both_ends_of_the_range():
    config = TINY.memory
    rgb = np.full((1, 4, 4, 3), 0.5, np.float32)
    rgb[:, :, 2:] = -1.0
    patches = np.asarray(config.encoder.encode({}, rgb))
    assert patches.shape == (1, 2, 2, 6)
    np.testing.assert_allclose(patches[0, 0, 0], [0.5] * 3 + [-0.5] * 3, atol=1e-6)
    both = np.maximum(patches[0, 0, 0], patches[0, 0, 1])
    np.testing.assert_allclose(config.encoder.colours(both), -0.25, atol=1e-6)
