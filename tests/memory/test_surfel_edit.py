"""Boxes of surfels erased, moved and copied; and any memory by the same two functions."""

import dataclasses

import jax
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.memory import surfels, voxel_map
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from tests.helpers import tiny_model
from tests.memory.test_surfels import drawn, insert

CONFIG = SurfelConfig(cell_m=(0.5,) * 3, cells=(16, 16, 16), capacity=400, tokens=8)
MODEL = tiny_model(memory=CONFIG)
BOX = np.array([[-1.0, -1.0, -1.0], [0.5, 1.0, 1.0]], np.float32)
erase = jax.jit(lambda model, *args: model.memory.erase(model, *args), static_argnums=0)
move = jax.jit(
    lambda model, *args, **options: model.memory.move(model, *args, **options),
    static_argnums=0,
    static_argnames="leave",
)


def a_world(seed=0, observed=True, spread=1.9):
    return insert(
        CONFIG, MODEL.memory.empty(MODEL, np.zeros(3)), drawn(seed, spread=spread), observed
    )


def held(world):
    points, colours, normals, _, valid = (np.asarray(x) for x in surfels.means(CONFIG, world))
    return points[valid], colours[valid], normals[valid]


def inside(points, box=BOX):
    return ((points >= box[0]) & (points < box[1])).all(-1)


def turned(quarters, shift):
    c, s = np.cos(quarters * np.pi / 2).round(), np.sin(quarters * np.pi / 2).round()
    transform = np.eye(4, dtype=np.float32)
    transform[:2, :2] = [[c, -s], [s, c]]
    transform[:3, 3] = shift
    return transform


def ordered(*columns):
    rows = np.concatenate(columns, 1)
    return rows[np.lexsort(rows.round(3).T)]


def test_what_is_in_an_erased_box_is_gone_and_the_rest_is_untouched():
    before = a_world()
    after = erase(MODEL, before, BOX)
    points, colours, normals = held(before)
    kept = ~inside(points)
    assert 0 < kept.sum() < len(points)
    for one, other in zip((points, colours, normals), held(after), strict=True):
        np.testing.assert_array_equal(one[kept], other)
    assert int(after.occupied) == kept.sum()
    assert (np.diff(np.asarray(after.cell_V)[: kept.sum()]) > 0).all()


@pytest.mark.parametrize("quarters", [0, 1])
def test_a_box_that_is_moved_arrives_whole_with_its_colours_and_its_sides(quarters):
    transform = turned(quarters, (0.5, 0, 2.5))
    before = erase(MODEL, a_world(), np.array([[-9, -9, 1], [9, 9, 9]]))  # free where it goes
    after = move(MODEL, before, BOX, transform)
    points, colours, normals = held(before)
    taken = inside(points)
    there = points[taken] @ transform[:3, :3].T + transform[:3, 3]
    expected = ordered(
        np.concatenate([there, points[~taken]]),
        np.concatenate([colours[taken], colours[~taken]]),
        np.concatenate([normals[taken] @ transform[:3, :3].T, normals[~taken]]),
    )
    np.testing.assert_allclose(ordered(*held(after)), expected, atol=1e-5)
    assert int(after.occupied) == int(before.occupied)
    assert int(after.dropped) == int(after.outside) == 0


def test_a_copy_is_in_both_places_and_takes_the_place_of_what_was_there():
    world = insert(CONFIG, a_world(0, observed=False), drawn(1, spread=0.9), True)
    shift = turned(0, (0, 0, 0.5))
    after = move(MODEL, world, BOX, shift, leave=True)
    points, colours, _ = held(world)
    found, shown, _ = held(after)
    cell = np.floor(points * 2).astype(int)
    here = {tuple(c): k for k, c in enumerate(cell)}
    moved = {(x, y, z + 1): here[x, y, z] for x, y, z in (tuple(c) for c in cell[inside(points)])}
    assert moved.keys() & here.keys()
    observed = np.asarray(after.observed_V)[: len(found)]
    was = np.asarray(world.observed_V)[: len(points)]
    for k, place in enumerate(tuple(c) for c in np.floor(found * 2).astype(int)):
        source = moved.get(place, here.get(place))
        np.testing.assert_allclose(shown[k], colours[source], atol=1e-5)
        assert observed[k] == was[source]
    assert len(found) == len(moved.keys() | here.keys())


def test_what_does_not_fit_and_what_leaves_the_grid_is_counted():
    world = a_world()
    after = move(MODEL, world, BOX, turned(0, (0, 0, 100.0)))
    count = inside(held(world)[0]).sum()
    assert int(after.outside) == count
    assert int(after.occupied) == int(world.occupied) - count
    full = dataclasses.replace(CONFIG, capacity=int(world.occupied))
    tight = CONFIG.trimmed(world)
    tight = jax.tree.map(lambda x: x[: full.capacity] if np.ndim(x) else x, tight)
    tight = dataclasses.replace(tight, origin_3=world.origin_3)
    after = tiny_model(memory=full).memory.move(
        tiny_model(memory=full), tight, BOX, turned(0, (0, 0, 3.0)), leave=True
    )
    assert int(after.dropped) > 0
    assert int(after.occupied) == full.capacity


def test_any_memory_of_places_is_edited_by_the_same_functions_and_others_say_so():
    config = VoxelConfig(cell_m=(0.25,) * 3, cells=(16, 16, 16), capacity=300, tokens=4)
    model = tiny_model(memory=config)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.5, 1.5, (100, 3)).astype(np.float32)
    values = rng.normal(size=(100, model.memory.encoder.channels)).astype(np.float32)
    empty = voxel_map.empty(config, np.zeros(3), values.shape[1])
    insert = jax.jit(voxel_map.insert, static_argnums=0)
    world = insert(config, empty, points, values, np.ones(100, bool))
    shift = turned(0, (0.5, 0, 0))
    jax.tree.map(
        np.testing.assert_array_equal,
        model.memory.move(model, world, BOX, shift),
        voxel_map.move(config, world, BOX, shift),
    )
    jax.tree.map(
        np.testing.assert_array_equal,
        model.memory.erase(model, world, BOX),
        voxel_map.erase(config, world, BOX),
    )
    with_images = tiny_model(memory=ImagesConfig(encoder=PatchColoursConfig(patch=8)))
    assert model.memory.EDITABLE
    assert not with_images.memory.EDITABLE
    with pytest.raises(UserError, match="cannot be edited"):
        with_images.memory.erase(with_images, None, BOX)


@pytest.mark.parametrize(
    ("box", "transform", "says"),
    [
        (BOX[::-1], np.eye(4), "lower"),
        (BOX[0], np.eye(4), r"shape \(2, 3\)"),
        (BOX, 2 * np.eye(4), "not rigid"),
        (BOX, np.eye(3), "rigid 4×4"),
    ],
)
def test_what_is_no_box_and_what_is_no_motion_is_refused(box, transform, says):
    with pytest.raises(UserError, match=says):
        MODEL.memory.move(MODEL, a_world(), box, transform)
