"""What a camera sees of a memory: the nearest point of each pixel, by a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.geometry import cameras, zbuffer
from pewm_jax.memory import interface as memories
from pewm_jax.memory import rendering, voxel_map
from pewm_jax.memory import rendering as views
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.types import Camera, Frames
from tests.helpers import random_camera, tiny_model
from tests.memory.test_memories import ALL, KINDS, model_of, scene, seen
from tests.properties import examples

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


@examples(15)
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


@pytest.mark.slow(but=("voxel", "surfels"))
@pytest.mark.parametrize("kind", KINDS)
def test_every_memory_can_be_rendered(kind):
    model = model_of(kind)
    memory, _ = seen(model, scene(), ALL)
    camera = jax.tree.map(jnp.asarray, random_camera(np.random.default_rng(3), 3, HEIGHT, WIDTH))
    view = render(model, memory, camera, HEIGHT, WIDTH)
    colours = kind in ("points", "surfels", "none")
    assert memories.shows_colours(model) == (colours and kind != "none")
    channels = 3 if colours else model.memory.encoder.channels
    assert model.memory.rendered_channels == channels
    assert view.features_THWF.shape == (3, HEIGHT, WIDTH, channels)
    assert view.depth_THW.shape == view.seen_THW.shape == (3, HEIGHT, WIDTH)
    assert bool(view.seen_THW.any()) == (kind != "none")
    points, _, valid = model.memory.to_points(model, memory)
    points = np.asarray(points)[np.asarray(valid)]
    alone = by_loop(points, points[:, :1], np.ones(len(points), bool), camera, HEIGHT, WIDTH)[2]
    known = np.asarray(view.seen_THW | (view.depth_THW > 0))
    assert known[alone].all(), "where a point is, something is seen, or its back is known"
    assert float(known.mean()) >= alone.mean()


@pytest.mark.slow
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


surfels = jax.jit(
    rendering.splat_surfels, static_argnums=(5, 6), static_argnames=("most", "average")
)
fill = jax.jit(views.fill_nearest)


def covered_by_loop(points, size, valid, camera, most):
    """The nearest point that covers each pixel and its depth, point by point, pixel by pixel."""
    depth = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    index = np.full((HEIGHT, WIDTH), len(points))
    uv, z = (np.asarray(x) for x in cameras.project(points, camera))
    for p in np.flatnonzero(valid & (z > rendering.NEAREST_M)):
        half = size[p] / 2 * np.asarray(camera.intrinsics_4[:2]) / z[p]
        first, wide = (
            np.asarray(x)[0] for x in zbuffer.pixel_window(uv[p][None], half[None], most)
        )
        for row in range(first[1], first[1] + wide[1]):
            for column in range(first[0], first[0] + wide[0]):
                inside = 0 <= row < HEIGHT and 0 <= column < WIDTH
                if inside and z[p] < depth[row, column]:
                    depth[row, column], index[row, column] = z[p], p
    return depth, index


def shown_by_loop(points, features, valid, camera, front, covering, average):
    """What is not behind the front, shared by the pixels around it, or the nearest of a pixel."""
    uv, z = (np.asarray(x) for x in cameras.project(points, camera))
    image = np.zeros((HEIGHT, WIDTH, features.shape[1] + 1))
    weight, nearest = np.zeros((HEIGHT, WIDTH)), np.full((HEIGHT, WIDTH), np.inf)
    for p in np.flatnonzero(valid & (z > rendering.NEAREST_M)):
        corner = np.floor(uv[p] - 0.5) if average else np.floor(uv[p])
        share = (uv[p] - 0.5 - corner) if average else np.zeros(2)
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)) if average else ((0, 0),):
            column, row = (corner + np.array([i, j])).astype(int)
            if not (0 <= row < HEIGHT and 0 <= column < WIDTH):
                continue
            if z[p] > front[row, column] + rendering.tolerance(front[row, column]):
                continue
            part = (share[0] if i else 1 - share[0]) * (share[1] if j else 1 - share[1])
            value = np.append(features[p], z[p])
            if average:
                image[row, column] += part * value
                weight[row, column] += part
            elif z[p] < nearest[row, column]:
                image[row, column], weight[row, column] = value, 1
                nearest[row, column] = z[p]
    direct = weight > rendering.LEAST
    image = image / np.where(direct, weight, 1)[..., None]
    rest = ~direct & (covering < len(points))
    image[rest] = np.concatenate([features, z[:, None]], 1)[covering[rest]]
    return np.where((direct | rest)[..., None], image, 0), direct | rest


@pytest.mark.parametrize("average", [True, False])
@pytest.mark.parametrize("most", [1, 3, 4])
@pytest.mark.parametrize("seed", [0, 1])
def test_points_with_a_size_are_drawn_as_by_a_loop(seed, most, average):
    camera = random_camera(np.random.default_rng(seed), 2, HEIGHT, WIDTH)
    points, features, valid = cloud(seed, 80)
    size = np.random.default_rng(seed).uniform(0.01, 1.2, len(points)).astype(np.float32)
    view = surfels(points, features, size, valid, camera, HEIGHT, WIDTH, most=most, average=average)
    for t in range(2):
        one = jax.tree.map(lambda x, t=t: x[t], camera)
        front, covering = covered_by_loop(points, size, valid, one, most)
        image, seen = shown_by_loop(points, features, valid, one, front, covering, average)
        np.testing.assert_array_equal(view.seen_THW[t], seen)
        np.testing.assert_allclose(view.features_THWF[t], image[..., :-1], atol=1e-4)
        np.testing.assert_allclose(view.depth_THW[t], image[..., -1], atol=1e-4)
        assert seen.any()


@examples(25)
@given(seed=st.integers(0, 100_000), most=st.integers(1, 5))
def test_a_window_holds_the_pixel_of_its_point_and_has_the_size_of_its_point(seed, most):
    rng = np.random.default_rng(seed)
    uv, half = rng.uniform(-3, 9, (50, 2)), rng.uniform(0, 3, (50, 2))
    begin, wide = (np.asarray(x) for x in zbuffer.pixel_window(uv, half, most))
    assert ((wide >= 1) & (wide <= most)).all()
    assert ((begin <= np.floor(uv)) & (np.floor(uv) < begin + wide)).all()
    assert (np.abs(wide - np.clip(2 * half, 1, most)) <= 1 + 1e-4).all()


def wall(distance, spacing, across=2.5):
    """Points of a wall that stands ahead, in a square raster."""
    steps = np.arange(-across, across, spacing) + spacing / 2
    y, z = np.meshgrid(steps, steps)
    return np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], -1).astype(np.float32)


@pytest.mark.slow(but="False")
@pytest.mark.parametrize("average", [True, False])
def test_a_wall_is_not_seen_through_the_wall_before_it(average):
    """Both of a raster of 10 cm; the near one is seen so closely that its points lie apart."""
    size, spacing = 32, 0.1
    near, far = wall(1.0, spacing, 1.5), wall(3.0, spacing / 4, 4.0)
    points = np.concatenate([near, far])
    colour = np.concatenate([np.ones(len(near)), -np.ones(len(far))]).astype(np.float32)[:, None]
    camera = looking_ahead(size, size)
    wide = np.where(np.arange(len(points)) < len(near), spacing, spacing / 4).astype(np.float32)
    everything = np.ones(len(points), bool)
    plain = splat(points, colour, everything, camera, size, size)
    assert (np.asarray(plain.features_THWF) < 0).sum() > 100, "points alone show what is behind"
    view = surfels(points, colour, wide, everything, camera, size, size, most=3, average=average)
    assert np.asarray(view.seen_THW).all()
    np.testing.assert_allclose(view.features_THWF, 1, atol=1e-5)
    np.testing.assert_allclose(view.depth_THW, 1, atol=1e-5)
    half = near[:, 1] < 0  # where the near wall ends, the far one is seen
    points, colour, wide = (
        np.concatenate([x[: len(near)][half], x[len(near) :]]) for x in (points, colour, wide)
    )
    everything = np.ones(len(points), bool)
    view = surfels(points, colour, wide, everything, camera, size, size, most=3, average=average)
    image = np.asarray(view.features_THWF)[0, ..., 0]
    np.testing.assert_allclose(image[:, size // 2 :], 1, atol=1e-5)
    np.testing.assert_allclose(image[:, : size // 2 - 2], -1, atol=1e-5)


@pytest.mark.slow
def test_points_with_a_size_are_drawn_alike_in_a_batch_and_again():
    camera = jax.tree.map(jnp.asarray, random_camera(np.random.default_rng(5), 2, HEIGHT, WIDTH))
    points, features, valid = (jnp.stack([jnp.asarray(x)] * 2) for x in cloud(5))
    size = jnp.full(points.shape[:2], 0.3)
    draw = lambda p, f, s, v: rendering.splat_surfels(p, f, s, v, camera, HEIGHT, WIDTH)  # noqa: E731
    many = jax.jit(jax.vmap(draw))
    first, again = many(points, features, size, valid), many(points, features, size, valid)
    alone = jax.jit(draw)(points[0], features[0], size[0], valid[0])
    for a, b, c in zip(*map(jax.tree.leaves, (first, again, alone)), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_allclose(a[1], c, atol=1e-5)


@pytest.mark.parametrize("share", [0.003, 0.02, 0.3])
@pytest.mark.parametrize("shape", [(7, 12), (24, 17), (1, 5)])
def test_holes_are_filled_from_the_nearest_hit(shape, share):
    rng = np.random.default_rng(3)
    seen = rng.random((4, *shape)) < share
    seen[:3, 0, 2], seen[3] = True, False
    value = rng.normal(size=(*seen.shape, 2)).astype(np.float32) * seen[..., None]
    depth = rng.uniform(1, 5, seen.shape).astype(np.float32) * seen
    view = fill(rendering.View(value, depth, seen))
    np.testing.assert_array_equal(view.seen_THW, seen)
    np.testing.assert_array_equal(view.features_THWF[seen], value[seen])
    assert not np.asarray(view.depth_THW)[3].any(), "an empty image stays empty"
    farther = total = 0
    for t in range(3):
        hits = np.argwhere(seen[t])
        for row, column in np.argwhere(~seen[t]):
            distance = ((hits - (row, column)) ** 2).sum(1)
            filled = np.asarray(view.depth_THW)[t, row, column]
            (source,) = np.flatnonzero(depth[t][tuple(hits.T)] == filled)
            np.testing.assert_array_equal(
                view.features_THWF[t, row, column], value[t][tuple(hits[source])]
            )
            farther += distance[source] > distance.min()
            assert np.sqrt(distance[source]) <= np.sqrt(distance.min()) + 1
            total += 1
    assert farther <= 0.01 * total
