"""All memories behind one interface: what each keeps, and what they have in common."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax import registry as kinds
from pewm_jax.config import ConfigError
from pewm_jax.geometry import cameras
from pewm_jax.memory import cells, images, points, voxel_map
from pewm_jax.memory import interface as memories
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.memory.points import PointsConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import Map2DConfig, VoxelConfig
from pewm_jax.types import Camera, Frames
from pewm_jax.worlds import world_model
from tests.helpers import TINY, random_camera, random_frames, tiny_model, with_reader
from tests.properties import examples

KINDS = {
    "voxel": VoxelConfig,
    "images": ImagesConfig,
    "map2d": Map2DConfig,
    "points": PointsConfig,
    "surfels": SurfelConfig,
    "none": NoMemoryConfig,
}
SEEDS = st.integers(0, 100_000)
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)


def test_every_kind_of_memory_is_tested():
    ours = {
        name
        for name in kinds.names("memory")
        if kinds.named("memory", name).settings.__module__.startswith("pewm_jax.")
    }
    assert ours == {*KINDS, "grid"}  # the state of the world persist, tested in test_persist.py


def model_of(kind, positions="projective", **changes):
    """The tiny model with another memory."""
    model = with_reader(TINY, looks=8, positions=positions)
    settings = {f.name: getattr(model.memory, f.name) for f in dataclasses.fields(model.memory)}
    settings |= {"snapshots": 3} if kind == "images" else {}
    return tiny_model(memory=KINDS[kind](**settings | changes))


def scene(seed=0, count=4):
    frames = random_frames(np.random.default_rng(seed), count)
    rgb = np.asarray(frames.rgb_THWC, np.float32) / 127.5 - 1
    return jax.tree.map(jnp.asarray, Frames(rgb, frames.depth_THW, frames.camera))


def encoded(frames):
    return TINY.memory.encoder.encode({}, frames.rgb_THWC)


@functools.partial(jax.jit, static_argnums=0)
def seen(model, frames, valid_T):
    """The memory of some frames and its tokens for cameras elsewhere."""
    memory = model.memory.empty(model, frames.camera.world_from_camera[0, :3, 3])
    memory = memories.insert(model, {}, memory, frames, encoded(frames), valid_T)
    camera = jax.tree.map(jnp.asarray, random_camera(np.random.default_rng(9), 5))
    return memory, model.memory.read(model, memory, camera)


ALL = np.ones(4, bool)


@EVERY_KIND
def test_tokens_of_every_memory_have_the_same_shapes_and_blank_masked_ones(kind):
    model = model_of(kind)
    _, tokens = seen(model, scene(), ALL)
    count = model.memory.tokens
    assert tokens.features_MF.shape == (count, model.memory.encoder.channels)
    assert tokens.points_world_M3.shape == (count, 3)
    assert tokens.valid_M.shape == (count,)
    assert tokens.valid_M.dtype == bool
    assert bool(tokens.valid_M.any()) == (kind != "none")
    np.testing.assert_array_equal(tokens.features_MF[~tokens.valid_M], 0)
    assert np.isfinite(tokens.features_MF).all()
    assert np.isfinite(tokens.points_world_M3).all()


@EVERY_KIND
@pytest.mark.parametrize("positions", ["projective", "sinusoid"])
def test_every_memory_costs_the_same_parameters(kind, positions):
    def shapes(kind):
        make = functools.partial(world_model.init, model_of(kind, positions=positions))
        return jax.tree.map(lambda x: x.shape, jax.eval_shape(make, jax.random.key(0)))

    assert shapes(kind) == shapes("voxel")


@EVERY_KIND
def test_nothing_is_remembered_of_invalid_frames_and_of_pixels_without_depth(kind):
    model, frames = model_of(kind), scene()
    blank = dataclasses.replace(frames, depth_THW=jnp.zeros_like(frames.depth_THW))
    for given_frames, valid in ((frames, ~ALL), (blank, ALL)):
        _, tokens = seen(model, given_frames, valid)
        assert not tokens.valid_M.any()
    some = np.array([True, False, True, False])
    other = jax.tree.map(
        lambda x: jnp.where(some.reshape(-1, *[1] * (x.ndim - 1)), x, x * 0.7), frames
    )
    for a, b in zip(*(jax.tree.leaves(seen(model, f, some)) for f in (frames, other)), strict=True):
        np.testing.assert_array_equal(a, b)


@EVERY_KIND
def test_a_memory_keeps_its_structure_so_that_a_rollout_can_carry_it(kind):
    model, frames = model_of(kind), scene()
    before = jax.eval_shape(lambda: model.memory.empty(model, jnp.zeros(3)))
    after = jax.eval_shape(
        lambda: memories.insert(
            model, {}, model.memory.empty(model, jnp.zeros(3)), frames, encoded(frames)
        )
    )
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.leaves(before) == jax.tree.leaves(after)


@pytest.mark.slow(but=("voxel", "surfels"))
@EVERY_KIND
def test_batched_memories_equal_single_ones(kind):
    model = model_of(kind)
    # What hides what is decided by rounding in scenes as wild as these.
    model = dataclasses.replace(model, memory=dataclasses.replace(model.memory, choose="nearest"))
    worlds = [scene(seed) for seed in range(2)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    many = jax.jit(jax.vmap(lambda frames: seen(model, frames, ALL)[1]))(stacked)

    def in_order(tokens):
        """Sort tokens by place: of cells seen alike, rounding decides which is named first."""
        rows = np.concatenate([tokens.points_world_M3, tokens.features_MF], -1)
        rows = rows[np.asarray(tokens.valid_M)]
        return rows[np.lexsort(rows[:, :3].round(3).T)]

    for index, frames in enumerate(worlds):
        alone = seen(model, frames, ALL)[1]
        mine = jax.tree.map(lambda x, index=index: x[index], many)
        np.testing.assert_allclose(in_order(mine), in_order(alone), atol=1e-5)


@EVERY_KIND
def test_every_memory_can_be_drawn(kind):
    model = model_of(kind)
    memory, _ = seen(model, scene(), ALL)
    places, values, valid = model.memory.to_points(model, memory)
    shades = model.point_colours(values)
    assert shades.shape == places.shape == (len(valid), 3)
    assert np.abs(np.asarray(shades)).max() <= 1 + 1e-6
    assert bool(valid.any()) == (kind != "none")


@given(seed=SEEDS, count=st.integers(1, 5))
@examples(20)
def test_greedy_cover_is_what_it_says(seed, count):
    rng = np.random.default_rng(seed)
    nowhere, sets = 12, 6
    cell_XC = rng.integers(0, nowhere + 1, (sets, 5)).astype(np.int32)
    chosen, gain, missed = images.greedy_cover(jnp.asarray(cell_XC), count, nowhere)
    covers = [set(row.tolist()) - {nowhere} for row in cell_XC]
    left = set().union(*covers)
    everything = len(left)
    for best, added in zip(chosen.tolist(), gain.tolist(), strict=True):
        sizes = [len(cover & left) for cover in covers]
        assert added == max(sizes)
        assert best == sizes.index(max(sizes))
        left -= covers[best]
    assert int(missed) == len(left)
    best = max(len(set().union(*some)) for some in itertools.combinations(covers, count))
    assert everything - int(missed) >= (1 - 1 / math.e) * best


def test_snapshots_stand_where_their_patches_show_and_repetition_adds_none():
    model = model_of("images")
    frames = scene(count=4)
    _, tokens = seen(model, frames, ALL)
    rows, columns = model.memory.patch_grid(model)
    assert rows * columns * 3 <= model.memory.tokens
    size = np.array([24 / columns, 16 / rows])
    uv, z = cameras.project(tokens.points_world_M3[None], frames.camera)
    patch = np.floor(np.asarray(uv) / size)
    index = np.arange(model.memory.tokens) % (rows * columns)
    home = np.stack([index % columns, index // columns], -1)
    at_home = ((patch == home).all(-1) & (np.asarray(z) > 0)).any(0)
    assert at_home[np.asarray(tokens.valid_M)].all()
    twice = jax.tree.map(lambda x: jnp.concatenate([x[:2], x[:2]]), frames)
    kept, _ = seen(model, twice, ALL)
    assert int(kept.valid_KP.any(1).sum()) <= 2


@pytest.mark.slow
def test_snapshots_chosen_over_time_stay_the_best_of_what_was_kept():
    model, frames = model_of("images", snapshots=2), scene(count=4)
    memory = model.memory.empty(model, frames.camera.world_from_camera[0, :3, 3])
    more = jax.jit(memories.insert, static_argnums=0)
    covered = []
    for index in range(4):
        one = jax.tree.map(lambda x, i=index: x[i : i + 1], frames)
        memory = more(model, {}, memory, one, encoded(one))
        covered.append(len(np.unique(memory.cell_KC)) - 1)
    assert covered == sorted(covered)
    at_once, _ = seen(model, frames, ALL)
    assert covered[-1] >= (1 - 1 / math.e) * (len(np.unique(at_once.cell_KC)) - 1)
    assert int(memory.dropped) > 0


def cloud_of(model, places, rgb, valid, cloud=None):
    cloud = model.memory.empty(model, np.zeros(3)) if cloud is None else cloud
    return insert_points(model.memory, cloud, places, rgb, valid)


insert_points = jax.jit(points.insert, static_argnums=0)


def random_points(seed, count=40):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-2, 2, (count, 3)).astype(np.float32)
    places[0] = (np.nan, 50, 0)[seed % 3]
    rgb = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    return places, rgb, rng.random(count) < 0.8


@given(seed=SEEDS)
@examples(20)
def test_a_point_is_the_mean_of_its_cell_however_the_points_come(seed):
    model = model_of("points", cell_m=(1, 0.5, 2), cells=(4, 8, 2), capacity=64, tokens=4)
    config = model.memory
    places, rgb, valid = random_points(seed)
    origin = np.asarray(cells.origin(config, np.zeros(3)))
    expected, outside = {}, 0
    for place, colour, ok in zip(places.astype(float), rgb.astype(float), valid, strict=True):
        inside = np.isfinite(place).all()
        index = np.floor((place - origin) / config.cell_m) if inside else np.full(3, -1)
        inside = inside and (index >= 0).all() and (index < config.cells).all()
        outside += ok and not inside
        if ok and inside:
            expected.setdefault(tuple(index), []).append(np.concatenate([place, colour]))
    order = np.random.default_rng(seed + 1).permutation(len(places))
    half = cloud_of(model, places[order[:20]], rgb[order[:20]], valid[order[:20]])
    both = cloud_of(model, places[order[20:]], rgb[order[20:]], valid[order[20:]], half)
    for cloud in (cloud_of(model, places, rgb, valid), both):
        where, values, there = (np.asarray(x) for x in model.memory.to_points(model, cloud))
        assert int(cloud.outside) == outside
        assert int(cloud.occupied) == there.sum() == len(expected)
        found = {
            tuple(np.floor((w - origin) / config.cell_m)): np.concatenate([w, v[:3]])
            for w, v in zip(where[there], values[there], strict=True)
        }
        assert found.keys() == expected.keys()
        for cell, rows in expected.items():
            np.testing.assert_allclose(found[cell], np.mean(rows, 0), atol=1e-4)
        np.testing.assert_array_equal(values[there, 3], 1)
        np.testing.assert_array_equal(values[:, 4:], 0)


def test_points_that_do_not_fit_are_counted_and_the_earlier_ones_stay():
    model = model_of("points", cell_m=(1, 1, 1), cells=(8, 1, 1), capacity=3, tokens=3)
    line = np.array([[x + 0.5, 0, 0] for x in range(-4, 4)], np.float32)
    rgb, valid = np.zeros((8, 3), np.float32), np.ones(8, bool)
    cloud = cloud_of(model, line[4:6], rgb[4:6], valid[4:6])
    cloud = cloud_of(model, line, rgb, valid, cloud)
    np.testing.assert_array_equal(cloud.cell_V, [0, 4, 5])
    assert (int(cloud.occupied), int(cloud.dropped)) == (3, 5)
    np.testing.assert_array_equal(cloud.sums_V7[:, 0], [1, 2, 2])


@pytest.mark.slow
def test_the_map_from_above_is_the_maximum_over_the_height():
    model = model_of("map2d", cell_m=(0.5, 0.5, 0.5), cells=(24, 24, 8))
    frames = scene()
    above, tokens = seen(model, frames, ALL)
    centre = np.asarray(frames.camera.world_from_camera[0, :3, 3])
    flat = model.memory.grid
    places, values, valid = (np.asarray(x) for x in model.memory.to_points(model, above))
    np.testing.assert_allclose(places[valid, 2], centre[2], atol=1e-5)
    assert np.asarray(tokens.valid_M).any()

    tall = dataclasses.replace(model.memory, cells=(24, 24, 16))
    voxels = voxel_map.empty(tall, centre, 6)
    voxels = voxel_map.insert_frames(tall, voxels, frames, encoded(frames))
    where, parts, there = (np.asarray(x) for x in voxel_map.to_points(tall, voxels))
    inside = there & (np.abs(where[:, 2] - centre[2]) <= flat.cell_m[2] / 2 - 0.5)
    columns = {}
    for place, value in zip(where[inside], parts[inside], strict=True):
        key = tuple(np.round(place[:2], 3))
        columns[key] = np.maximum(columns.get(key, -np.inf), value)
    found = {
        tuple(np.round(p[:2], 3)): v for p, v in zip(places[valid], values[valid], strict=True)
    }
    assert columns.keys() <= found.keys()
    for key, value in columns.items():
        assert (found[key] >= value - 1e-6).all()


def test_in_view_first_then_near():
    camera = Camera(
        cameras.intrinsics_from_fov(16, 16, 90)[None],
        cameras.pose_from_yaw(np.zeros(3), 0.0)[None],
    )
    ahead, behind = [[4.0, 0, 0], [2.0, 0, 0]], [[-1.0, 0, 0], [-5.0, 0, 0]]
    places = np.array([behind[1], ahead[0], behind[0], ahead[1], [1, 0, 0]], np.float32)
    valid = np.array([True, True, True, True, False])
    order = cells.in_view_first(places, valid, camera, (16, 16), 9)
    np.testing.assert_array_equal(order, [3, 1, 2, 0, 4])


def test_more_snapshots_than_tokens_are_refused():
    with pytest.raises(ConfigError, match=r"memory\.snapshots 9 exceeds memory\.tokens 8"):
        ImagesConfig(snapshots=9, tokens=8)
