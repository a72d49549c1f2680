"""What a camera sees of a memory: the nearest point of each pixel, by a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pewm_jax.config import VoxelConfig
from pewm_jax.geometry import cameras
from pewm_jax.memory import memories, rendering, voxel_map
from pewm_jax.types import Camera, Frames
from tests.helpers import random_camera, tiny_model
from tests.memory.test_memory_rivals import ALL, KINDS, model_of, scene, seen

HEIGHT, WIDTH = 6, 9
splat = jax.jit(rendering.splat, static_argnums=(4, 5))
insert_frames = jax.jit(voxel_map.insert_frames, static_argnums=0)
render = jax.jit(memories.render, static_argnums=(0, 3, 4))


def by_loop(points, features, valid, camera, height, width):
    """The nearest point of each pixel, point after point; the lowest index wins ties."""
    count = len(camera.world_from_camera)
    image = np.zeros((count, height, width, features.shape[-1]), np.float32)
    depth = np.full((count, height, width), np.inf, np.float32)
    for t in range(count):
        one = Camera(camera.intrinsics_4[t], camera.world_from_camera[t])
        uv, z = (np.asarray(x) for x in cameras.project(points, one))
        for p in range(len(points)):
            column, row = np.floor(uv[p]).astype(int)
            if not valid[p] or z[p] <= rendering.NEAREST_M:
                continue
            if 0 <= row < height and 0 <= column < width and z[p] < depth[t, row, column]:
                depth[t, row, column], image[t, row, column] = z[p], features[p]
    covered = np.isfinite(depth)
    return image, np.where(covered, depth, 0), covered


def cloud(seed, count=150):
    """Points before, behind and beside the cameras, some of them twice in one place."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2.5, 2.5, (count, 3)).astype(np.float32)
    points[count // 2 : count // 2 + 30] = points[:30]
    features = rng.normal(size=(count, 2)).astype(np.float32)
    return points, features, rng.random(count) < 0.8


def compare(view, expected):
    image, depth, covered = expected
    np.testing.assert_array_equal(view.seen_THW, covered)
    np.testing.assert_array_equal(view.features_THWF, image)
    np.testing.assert_allclose(view.depth_THW, depth, rtol=1e-6)


@settings(max_examples=15)
@given(seed=st.integers(0, 100_000))
def test_each_pixel_shows_its_nearest_point(seed):
    camera = random_camera(np.random.default_rng(seed), 2, HEIGHT, WIDTH)
    given_points = cloud(seed)
    view = splat(*given_points, camera, HEIGHT, WIDTH)
    compare(view, by_loop(*given_points, camera, HEIGHT, WIDTH))
    assert np.asarray(view.seen_THW).any()


def looking_ahead(height=HEIGHT, width=WIDTH):
    pose = cameras.pose_from_yaw(np.zeros(3), 0.0)
    return Camera(cameras.intrinsics_from_fov(height, width, 90.0)[None], pose[None])


def test_what_is_behind_beside_too_near_or_not_there_is_not_seen():
    points = np.array([[-1, 0, 0], [1, 9, 0], [0.04, 0, 0], [1, 0, 0]], np.float32)
    valid = np.array([True, True, True, False])
    view = splat(points, np.ones((4, 1), np.float32), valid, looking_ahead(), HEIGHT, WIDTH)
    assert not np.asarray(view.seen_THW).any()
    np.testing.assert_array_equal(view.features_THWF, 0)
    np.testing.assert_array_equal(view.depth_THW, 0)


def test_the_nearest_is_in_front_and_of_equals_the_first():
    points = np.array([[3, 0.1, 0.1], [2, 0.1, 0.1], [2, 0.1, 0.1]], np.float32)
    names = np.array([[1.0], [2.0], [3.0]], np.float32)
    everything = np.ones(3, bool)
    for order, first in (([0, 1, 2], 2), ([2, 1, 0], 3)):
        view = splat(points[order], names[order], everything, looking_ahead(), HEIGHT, WIDTH)
        (shown,) = view.features_THWF[view.seen_THW]
        assert float(shown[0]) == first
        np.testing.assert_allclose(view.depth_THW[view.seen_THW], 2, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_every_memory_can_be_rendered(kind):
    model = model_of(kind)
    memory, _ = seen(model, scene(), ALL)
    camera = jax.tree.map(jnp.asarray, random_camera(np.random.default_rng(3), 3, HEIGHT, WIDTH))
    view = render(model, memory, camera, HEIGHT, WIDTH)
    channels = model.memory.encoder.channels
    assert view.features_THWF.shape == (3, HEIGHT, WIDTH, channels)
    assert view.depth_THW.shape == view.seen_THW.shape == (3, HEIGHT, WIDTH)
    points = (np.asarray(x) for x in memories.to_points(model, memory))
    compare(view, by_loop(*points, camera, HEIGHT, WIDTH))
    assert bool(view.seen_THW.any()) == (kind != "none")


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_of_memories_is_rendered_as_one_by_one(kind):
    model = model_of(kind)
    made = [seen(model, scene(seed), ALL)[0] for seed in range(2)]
    drawn = [random_camera(np.random.default_rng(seed), 2, HEIGHT, WIDTH) for seed in range(2)]
    stack = lambda *x: jnp.stack([jnp.asarray(y) for y in x])  # noqa: E731
    many = jax.jit(jax.vmap(lambda memory, c: memories.render(model, memory, c, HEIGHT, WIDTH)))
    both = many(jax.tree.map(stack, *made), jax.tree.map(stack, *drawn))
    for i in range(2):
        alone = render(model, made[i], drawn[i], HEIGHT, WIDTH)
        for a, b in zip(jax.tree.leaves(both), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.35, -0.5])
def test_the_map_of_a_wall_is_where_the_wall_is(yaw):
    """Seen by the camera that saw the wall: no cell's centre is half a cell from the wall."""
    height, width, cell, wall = 32, 48, 0.25, 3.1
    pose = cameras.pose_from_yaw(np.array([0.1, -0.2, 0.3]), yaw)
    camera = Camera(cameras.intrinsics_from_fov(height, width, 70.0)[None], pose[None])
    rays = np.asarray(cameras.ray_directions(camera.intrinsics_4, height, width))[0]
    across = rays @ pose[:3, :3].T[:, 0]  # how much nearer the wall is, per metre of depth
    depth = ((wall - 0.1) / across)[None].astype(np.float32)
    rgb = np.zeros((1, height, width, 3), np.float32)
    model = tiny_model(memory=VoxelConfig(cell_m=(cell,) * 3, cells=(64, 64, 32)))
    voxels = voxel_map.empty(model.memory, np.zeros(3), 6)
    patches = np.zeros((1, 4, 6, 6), np.float32)
    voxels = insert_frames(model.memory, voxels, Frames(rgb, depth, camera), patches)
    assert int(voxels.dropped) == int(voxels.outside) == 0
    view = render(model, voxels, camera, height, width)
    found = np.asarray(view.seen_THW)
    assert found.sum() > 100
    # A cell lies anywhere within a pixel; the wall is measured at its middle.
    focal = camera.intrinsics_4[0, 0]
    slack = view.depth_THW * 0.5 / focal * np.abs(pose[0, :2]).sum()
    off = np.abs(view.depth_THW - depth) * across
    assert (off <= cell / 2 + slack + 1e-4)[found].all()
    assert off[found].max() > 0.01, "cells are no points"
