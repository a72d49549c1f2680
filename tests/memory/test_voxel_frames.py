"""The fused pass equals its definition: upsample, unproject, take the maximum of every pixel."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.geometry import cameras
from pewm_jax.memory import cells, voxel_frames, voxel_map
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.types import Frames
from tests.helpers import random_camera
from tests.properties import examples

CONFIG = VoxelConfig(cell_m=(0.5, 0.5, 1.0), cells=(40, 40, 12), capacity=700, tokens=8)
T, H, W, F = 3, 32, 48, 5
SEEDS = st.integers(0, 100_000)
insert_frames = jax.jit(voxel_map.insert_frames, static_argnums=0)
pixel_cells = jax.jit(voxel_frames.pixel_cells, static_argnums=0)
compact = jax.jit(voxel_frames.compact, static_argnums=(2, 3))


def blank(dtype=jnp.float32, channels=F):
    return voxel_map.empty(CONFIG, np.zeros(3), channels, dtype)


def a_clip(seed, kind, size=(T, H, W), holes=0.1):
    """Frames of a box-shaped room, or of noise, some pixels without depth; and patch features."""
    rng = np.random.default_rng(seed)
    frames, height, width = size
    camera = random_camera(rng, frames, height, width)
    rays = np.asarray(cameras.ray_directions(camera.intrinsics_4, height, width))
    rays = np.einsum("tij,thwj->thwi", camera.world_from_camera[:, :3, :3], rays)
    start = camera.world_from_camera[:, None, None, :3, 3]
    walls = np.where(rays > 0, 3.1 - start, -3.3 - start)
    depth = (walls / np.where(rays == 0, 1e-9, rays)).min(-1)
    if kind == "noise":
        depth = rng.uniform(0.3, 9, size)
    depth = np.where(rng.random(size) < holes, 0, depth).astype(np.float32)
    patches = rng.normal(size=(frames, 4, 5, F)).astype(np.float32)
    return Frames(np.zeros((frames, 1, 1, 3), np.float32), depth, camera), patches


@jax.jit
def by_definition(frames, patches, valid_T):
    points = cameras.unproject(frames.depth_THW, frames.camera).reshape(-1, 3)
    shape = (*frames.depth_THW.shape, patches.shape[-1])
    values = jax.image.resize(patches, shape, "bilinear").reshape(-1, shape[-1])
    valid = (frames.depth_THW > 0) & valid_T[:, None, None]
    voxels = blank(channels=shape[-1])
    return voxel_map.insert(CONFIG, voxels, points, values, valid.reshape(-1))


def cells_seen(frames):
    """Return the cells (T, H, W) of valid pixels, with their border, and the number outside."""
    valid_T = np.ones(len(frames.depth_THW), bool)
    return pixel_cells(CONFIG, blank().origin_3, frames.depth_THW, frames.camera, valid_T)


def take(clip, which):
    return jax.tree.map(lambda x: x[np.asarray(which)], clip)


def same_map(a, b, **tolerance):
    for name in ("cell_of_slot_V", "occupied", "dropped", "outside"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_allclose(a.features_VF, b.features_VF, **tolerance)


@examples(10)
@given(seed=SEEDS, kind=st.sampled_from(["room", "noise"]))
def test_it_equals_inserting_every_upsampled_pixel(seed, kind):
    frames, patches = a_clip(seed, kind)
    valid = np.random.default_rng(seed).random(T) < 0.8
    fused = insert_frames(CONFIG, blank(), frames, patches, valid)
    same_map(fused, by_definition(frames, patches, valid), atol=2e-6)
    assert kind == "room" or not valid.any() or int(fused.outside) > 0


def test_neither_order_nor_batching_nor_repetition_of_frames_matters():
    clip = a_clip(1, "room")
    once = insert_frames(CONFIG, blank(), *clip)
    back = insert_frames(CONFIG, blank(), *take(clip, [2, 0, 1]))
    same_map(once, back, rtol=1e-6)
    parts = blank()
    for frame in (1, 0, 2):
        parts = insert_frames(
            CONFIG, parts, *take(clip, [frame] * 3), np.array([True, False, True])
        )
    assert int(parts.occupied) == int(once.occupied)
    np.testing.assert_array_equal(parts.cell_of_slot_V, once.cell_of_slot_V)
    np.testing.assert_allclose(parts.features_VF, once.features_VF, rtol=1e-6)


def test_few_corners_are_read_on_walls_and_all_of_them_on_noise():
    square, _ = voxel_frames.between(128, 6)
    no_cell = cells.nowhere(CONFIG)
    shares, outside = [], []
    for kind in ("room", "noise"):
        seen, count = cells_seen(a_clip(2, kind, (1, 128, 128), holes=0)[0])
        found = voxel_frames.corners(seen, square, square, no_cell)
        shares.append(float((found > 0).mean()))
        outside.append(float(count) / 128**2)
        assert not found[seen[:, 1:-1, 1:-1] == no_cell].any()
    assert shares[0] < 0.25
    assert shares[1] > 0.8 * (1 - outside[1])


@examples(10)
@given(seed=SEEDS, kind=st.sampled_from(["room", "noise"]))
def test_every_cell_of_a_frame_is_that_of_one_of_its_first_pixels(seed, kind):
    seen, _ = cells_seen(a_clip(seed, kind)[0])
    squares = (voxel_frames.between(H, 4)[0], voxel_frames.between(W, 5)[0])
    found = np.asarray(voxel_frames.corners(seen, *squares, cells.nowhere(CONFIG)))
    for cell_HW, kind_HW in zip(np.asarray(seen)[:, 1:-1, 1:-1], found, strict=True):
        firsts = set(cell_HW[kind_HW == 2])
        assert firsts == set(cell_HW[cell_HW < cells.nowhere(CONFIG)])


@examples(20)
@given(seed=SEEDS, size=st.sampled_from([1, 31, 32, 33, 1024, 1025, 3000]))
def test_compaction_lists_the_values_in_order(seed, size):
    rng = np.random.default_rng(seed)
    mask, values = rng.random(size) < rng.random(), np.arange(size, dtype=np.int32)
    room = int(rng.integers(1, size + 1))
    listed, count = compact(mask, values, room, -1)
    expected = values[mask]
    assert count == len(expected)
    np.testing.assert_array_equal(listed[: len(expected)], expected[:room])
    assert (listed[len(expected) :] == -1).all()


@pytest.mark.slow
def test_large_pictures_of_walls_and_of_noise_in_one_batch():
    """Large enough for the short way; the members of the batch need different numbers of blocks."""
    pair = [a_clip(seed, kind, (2, 256, 256)) for seed, kind in ((3, "room"), (4, "noise"))]
    stacked = jax.tree.map(lambda *x: np.stack(x), *pair)
    both = jax.jit(jax.vmap(lambda f, p: voxel_map.insert_frames(CONFIG, blank(), f, p)))(*stacked)
    for i, (frames, patches) in enumerate(pair):
        expected = by_definition(frames, patches, np.ones(2, bool))
        same_map(jax.tree.map(lambda x, i=i: x[i], both), expected, atol=2e-6)


def test_a_bfloat16_map_is_the_rounded_float32_map():
    frames, patches = a_clip(5, "room")
    rounded = jnp.asarray(patches, jnp.bfloat16)
    half = insert_frames(CONFIG, blank(jnp.bfloat16), frames, rounded)
    assert half.features_VF.dtype == jnp.bfloat16
    full = insert_frames(CONFIG, blank(), frames, rounded.astype(jnp.float32))
    np.testing.assert_array_equal(half.features_VF, full.features_VF.astype(jnp.bfloat16))


@pytest.mark.slow
def test_upsampled_features_never_exist_and_the_extent_costs_nothing():
    frames, _ = a_clip(6, "room", (4, 128, 128))
    patches = np.zeros((4, 8, 8, 64), np.float32)
    plans = []
    for cells_of_grid in ((20, 20, 6), (2000, 2000, 100)):
        config = dataclasses.replace(CONFIG, cells=cells_of_grid, capacity=200)
        voxels = voxel_map.empty(config, np.zeros(3), 64)
        plan = insert_frames.lower(config, voxels, frames, patches).compile().memory_analysis()
        plans.append(plan.temp_size_in_bytes + plan.output_size_in_bytes)
    upsampled = 4 * 128 * 128 * 64 * 4
    assert max(plans) < 0.6 * upsampled
    assert abs(plans[1] - plans[0]) < 0.01 * plans[0]


@jax.jit
def there_and_back(depth_THW, camera):
    points = cameras.unproject(depth_THW, camera).reshape(T, -1, 3)
    return points, *cameras.project(points, camera)


@examples(20)
@given(seed=SEEDS)
def test_every_point_projects_back_into_its_pixel_and_lies_in_its_cell(seed):
    frames, _ = a_clip(seed, "noise")
    depth = np.where(frames.depth_THW > 0, frames.depth_THW, 1.0)
    points, uv, z = there_and_back(depth, frames.camera)
    grid = cameras.pixel_grid(H, W).reshape(-1, 2)
    np.testing.assert_allclose(uv, np.broadcast_to(grid, uv.shape), atol=0.02)
    np.testing.assert_array_equal(np.floor(uv), np.broadcast_to(np.floor(grid), uv.shape))
    np.testing.assert_allclose(z, depth.reshape(T, -1), rtol=1e-4)

    origin = blank().origin_3
    seen, outside = cells_seen(dataclasses.replace(frames, depth_THW=depth))
    found = seen[:, 1:-1, 1:-1].reshape(T, -1)
    assert outside == (found == cells.nowhere(CONFIG)).sum()
    place = np.asarray((points - origin) / np.asarray(CONFIG.cell_m))
    clear = (np.abs(place - np.round(place)) > 1e-4).all(-1)
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(found[clear], cells.keys(CONFIG, origin, points)[clear])


def test_a_map_given_away_is_reused():
    clip, voxels = a_clip(7, "room"), blank()
    giving = jax.jit(voxel_map.insert_frames, static_argnums=0, donate_argnums=1)
    expected = insert_frames(CONFIG, voxels, *clip)
    given_away = jax.tree.map(jnp.copy, voxels)
    same_map(giving(CONFIG, given_away, *clip), expected)
    assert given_away.features_VF.is_deleted()


@pytest.mark.parametrize("side", [(8, 8), (5, 7), (12, 3), (4, 4)])
def test_places_between_patches_are_those_of_resize(side):
    pixels, patches = side
    values = np.random.default_rng(0).normal(size=patches).astype(np.float32)
    square, share = voxel_frames.between(pixels, patches)
    ends = [np.clip(square + i, 0, patches - 1) for i in (0, 1)]
    mine = values[ends[0]] * (1 - share) + values[ends[1]] * share
    theirs = jax.image.resize(values, (pixels,), "bilinear", antialias=False)
    np.testing.assert_allclose(mine, theirs, atol=1e-6)
