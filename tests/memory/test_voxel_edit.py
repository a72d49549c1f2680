import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.memory import cells as grid_cells
from pewm_jax.memory import voxel_map
from pewm_jax.memory.voxel_map import VoxelConfig
from tests.helpers import rigid
from tests.properties import examples

CONFIG = VoxelConfig(cell_m=(0.25, 0.25, 0.5), cells=(24, 24, 8), capacity=400, tokens=4)
SEEDS = st.integers(0, 100_000)
insert, erase, copy, move, paste, merge = (
    jax.jit(f, static_argnums=0)
    for f in (
        voxel_map.insert,
        voxel_map.erase,
        voxel_map.copy,
        voxel_map.move,
        voxel_map.paste,
        voxel_map.merge,
    )
)


def a_map(seed, count=150, reach=1.4):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach, reach, (count, 3)).astype(np.float32)
    values = rng.normal(size=(count, 3)).astype(np.float32)
    voxels = voxel_map.empty(CONFIG, np.zeros(3), 3)
    return insert(CONFIG, voxels, points, values, np.ones(count, bool))


def a_box(seed):
    corners = np.random.default_rng(seed).uniform(-1.6, 1.6, (2, 3))
    return np.sort(corners, 0).astype(np.float32)


def shifted(x=0.0, y=0.0, z=0.0):
    step = np.eye(4, dtype=np.float32)
    step[:3, 3] = x, y, z
    return step


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def centres(voxels):
    points, values, valid = (np.asarray(x) for x in voxel_map.to_points(CONFIG, voxels))
    return points[valid], values[valid]


@examples(15)
@given(seed=SEEDS)
def test_erase_forgets_a_box_and_paste_restores_it(seed):
    voxels, box = a_map(seed), a_box(seed)
    piece, rest = copy(CONFIG, voxels, box), erase(CONFIG, voxels, box)
    inside = ((centres(voxels)[0] >= box[0]) & (centres(voxels)[0] < box[1])).all(-1)
    assert int(piece.occupied) == inside.sum()
    assert int(rest.occupied) == (~inside).sum()
    np.testing.assert_array_equal(centres(piece)[1], centres(voxels)[1][inside])
    equal(paste(CONFIG, rest, piece, np.eye(4)), voxels)
    equal(merge(CONFIG, rest, piece), voxels)
    equal(erase(CONFIG, rest, box), rest)


def test_what_moves_by_whole_cells_keeps_its_features_and_comes_back():
    voxels = a_map(3, reach=1.0)
    box = np.array([[-1.5, -1.5, -2], [1.5, 1.5, 2]], np.float32)
    there = shifted(1.25, -0.75, 0.5)
    moved = move(CONFIG, voxels, box, there)
    places, values = centres(voxels)
    np.testing.assert_allclose(centres(moved)[0], places + there[:3, 3], atol=1e-5)
    np.testing.assert_array_equal(centres(moved)[1], values)
    back = move(CONFIG, moved, box + there[:3, 3], shifted(-1.25, 0.75, -0.5))
    equal(back, voxels)


def test_a_quarter_turn_is_exact():
    voxels = a_map(4)
    turn = np.eye(4, dtype=np.float32)
    turn[:2, :2] = [[0, -1], [1, 0]]
    blank = voxel_map.empty(CONFIG, np.zeros(3), 3)
    places, values = centres(voxels)
    turned = places @ turn[:3, :3].T
    expected = insert(CONFIG, blank, turned, values, np.ones(len(places), bool))
    equal(paste(CONFIG, blank, voxels, turn), expected)


@examples(10)
@given(seed=SEEDS)
def test_each_cell_takes_the_one_its_centre_comes_from(seed):
    """Against the definition, over all cells of the grid, for any rigid motion."""
    voxels = a_map(seed)
    motion = rigid(np.random.default_rng(seed))
    motion[:3, 3] /= 3
    blank = voxel_map.empty(CONFIG, np.zeros(3), 3)
    pasted = paste(CONFIG, blank, voxels, motion)
    cells = np.arange(np.prod(CONFIG.cells))
    origin = np.asarray(voxels.origin_3, np.float64)
    there = np.asarray(grid_cells.centres(CONFIG, origin, cells), np.float64)
    here = (there - motion[:3, 3]) @ motion[:3, :3].astype(np.float64)
    place = (here - origin) / CONFIG.cell_m
    clear = (np.abs(place - np.round(place)) > 1e-3).all(-1)
    inside = ((place >= 0) & (place < CONFIG.cells)).all(-1)
    index = np.clip(np.floor(place).astype(int), 0, np.array(CONFIG.cells) - 1)
    source = np.where(inside, np.ravel_multi_index(index.T, CONFIG.cells), -1)
    held = dict(
        zip(*(np.asarray(x) for x in (voxels.cell_of_slot_V, voxels.features_VF)), strict=True)
    )
    got = dict(
        zip(*(np.asarray(x) for x in (pasted.cell_of_slot_V, pasted.features_VF)), strict=True)
    )
    assert int(pasted.dropped) == 0
    found = 0
    for cell in cells[clear]:
        assert (source[cell] in held) == (cell in got)
        if cell in got:
            found += 1
            np.testing.assert_array_equal(got[cell], held[source[cell]])
    assert found > 20


def test_what_is_pasted_beyond_the_grid_or_the_capacity_is_counted():
    voxels = a_map(5)
    everywhere = np.array([[-2, -2, -2], [2, 2, 2]], np.float32)
    gone = move(CONFIG, voxels, everywhere, shifted(x=100))
    assert int(gone.occupied) == 0
    assert int(gone.outside) == int(voxels.occupied)
    small = dataclasses.replace(CONFIG, capacity=40, tokens=4)
    full = paste(small, voxel_map.empty(small, np.zeros(3), 3), voxels, np.eye(4))
    assert int(full.dropped) == int(voxels.occupied) - 40
    equal(full.cell_of_slot_V, voxels.cell_of_slot_V[:40])


def test_where_both_have_a_cell_the_maximum_counts():
    a, b = a_map(6), a_map(7)
    equal(paste(CONFIG, a, b, np.eye(4)), merge(CONFIG, a, b))


@pytest.mark.parametrize(
    ("act", "sentence"),
    [
        (lambda m: voxel_map.erase(CONFIG, m, np.zeros(6)), r"shape \(2, 3\)"),
        (lambda m: voxel_map.copy(CONFIG, m, [[1, 0, 0], [0, 1, 1]]), "lower one first"),
        (lambda m: voxel_map.paste(CONFIG, m, m, jnp.eye(3)), "4×4"),
        (lambda m: voxel_map.paste(CONFIG, m, m, np.diag([2, 2, 2, 1])), "not rigid"),
        (lambda m: voxel_map.paste(CONFIG, m, m, np.diag([1, 1, -1, 1])), "not rigid"),
        (lambda m: voxel_map.paste(CONFIG, m, m, np.full((4, 4), np.nan)), "not rigid"),
    ],
)
def test_what_is_no_box_and_no_transform_is_refused(act, sentence):
    with pytest.raises(UserError, match=sentence):
        act(voxel_map.empty(CONFIG, np.zeros(3), 3))
