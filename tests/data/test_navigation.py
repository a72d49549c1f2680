"""Where an agent can be: against rooms whose free floor is known."""

import itertools

import numpy as np
import pytest
import trimesh

from pewm_jax.config import UserError
from pewm_jax.data import navigation as nav
from pewm_jax.data.scenes import Scene, from_trimesh, house


def room(*obstacles: trimesh.Trimesh, floor_z: float = 0.0, width: float = 6.0) -> Scene:
    """A box of width × 4 × 2.5 m seen from inside, corner at the origin, with things in it."""
    shell = trimesh.creation.box((width, 4.0, 2.5))
    shell.invert()
    shell.apply_translation([width / 2, 2.0, 1.25])
    scene = trimesh.Scene([shell, *obstacles])
    scene.apply_translation([0, 0, floor_z])
    return from_trimesh(scene, "room")


def block(x: tuple, y: tuple, z: tuple) -> trimesh.Trimesh:
    bounds = np.array([x, y, z], float)
    box = trimesh.creation.box(np.ptp(bounds, axis=1))
    box.apply_translation(bounds.mean(1))
    return box


@pytest.mark.parametrize("floor_z", [0.0, -1.37, 3.2])
def test_an_empty_room_is_free_up_to_the_agents_radius(floor_z):
    grid = nav.navigable(room(floor_z=floor_z), agent_radius_m=0.3)
    assert grid.floor_z == pytest.approx(floor_z, abs=1e-6)
    free = grid.centre_of(np.argwhere(grid.free_YX))
    assert free.min() >= 0.3 - 0.051
    assert (free <= np.array([6.0, 4.0]) - 0.3 + 0.051).all()
    assert grid.area == pytest.approx((6 - 0.6) * (4 - 0.6), rel=0.12)


def test_furniture_blocks_and_what_hangs_high_does_not():
    table = block((2, 4), (1, 3), (0.7, 0.75))
    grid = nav.navigable(room(table))
    assert not nav.is_free(grid, np.array([3.0, 2.0]))
    assert not nav.is_free(grid, np.array([1.9, 2.0]))
    assert nav.is_free(grid, np.array([1.0, 2.0]))
    lamp = block((2, 4), (1, 3), (1.9, 2.1))
    assert nav.is_free(nav.navigable(room(lamp)), np.array([3.0, 2.0]))
    tall = block((2, 4), (1, 3), (0.0, 2.2))
    assert not nav.is_free(nav.navigable(room(tall)), np.array([3.0, 2.0]))
    rug = block((2, 4), (1, 3), (0.0, 0.02))
    assert nav.is_free(nav.navigable(room(rug)), np.array([3.0, 2.0]))


def test_a_wall_thinner_than_a_cell_divides_and_the_larger_side_is_kept():
    wall = block((3.98, 4.02), (0, 4), (0, 2.5))
    grid = nav.navigable(room(wall))
    free = grid.centre_of(np.argwhere(grid.free_YX))
    assert free[:, 0].max() < 3.9
    assert free[:, 0].min() < 0.4


def rooms_reached(grid, rooms):
    """Whether some free cell lies in each room x0, y0, x1, y1."""
    centres = grid.centre_of(np.argwhere(grid.free_YX))
    inside = [((np.array(room[:2]) < centres) & (centres < room[2:])).all(-1) for room in rooms]
    return [bool(each.any()) for each in inside]


def test_a_door_must_be_wider_than_the_agent():
    def with_gap(width):
        low = block((2.95, 3.05), (0, 2 - width / 2), (0, 2.5))
        high = block((2.95, 3.05), (2 + width / 2, 4), (0, 2.5))
        return nav.navigable(room(low, high))

    sides = [[0, 0, 2.9, 4], [3.1, 0, 6, 4]]
    assert rooms_reached(with_gap(0.95), sides) == [True, True]
    assert sum(rooms_reached(with_gap(0.3), sides)) == 1


def test_paths_go_around_and_are_no_longer_than_needed():
    wall = block((2.9, 3.1), (0, 3), (0, 2.5))
    grid = nav.navigable(room(wall))
    start, goal = np.array([1.0, 0.5]), np.array([5.0, 0.5])
    path = nav.shortest_path(grid, start, goal)
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], [start, goal])
    for a, b in itertools.pairwise(path):
        assert nav.line_is_free(grid, a, b)
    length = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()
    shortest = 2 * np.hypot(2.0, 2.5)
    assert shortest < length < 1.2 * shortest
    assert len(path) < 12
    assert nav.distance_field(grid, goal)[tuple(grid.cell_of(start))] >= length - 0.15
    assert nav.shortest_path(grid, start, np.array([3.0, 0.5])) is None
    assert nav.shortest_path(grid, np.array([-5.0, 0.5]), goal) is None


def test_a_straight_line_stays_straight():
    grid = nav.navigable(room())
    path = nav.shortest_path(grid, np.array([0.5, 0.5]), np.array([5.3, 3.1]))
    assert path is not None
    assert len(path) == 2


def test_distances_are_symmetric_and_grow_from_the_source():
    grid = nav.navigable(room(block((2.9, 3.1), (0, 3), (0, 2.5))))
    rng = np.random.default_rng(0)
    points = nav.sample_free(grid, rng, 6)
    fields = [nav.distance_field(grid, p) for p in points]
    for i, a in enumerate(points):
        assert fields[i][tuple(grid.cell_of(a))] == 0
        for j, b in enumerate(points):
            there, back = fields[i][tuple(grid.cell_of(b))], fields[j][tuple(grid.cell_of(a))]
            assert there == pytest.approx(back)
            assert there >= np.linalg.norm(a - b) - 2 * grid.cell_m
    assert np.isinf(fields[0][~grid.free_YX]).all()
    assert np.isfinite(fields[0][grid.free_YX]).all()


def test_samples_are_free_and_cover_the_floor():
    grid = nav.navigable(room())
    points = nav.sample_free(grid, np.random.default_rng(1), 500)
    assert nav.is_free(grid, points).all()
    assert (points.min(0) < 0.6).all()
    assert (points.max(0) > [5.4, 3.4]).all()
    outside = np.array([-3.0, 9.0])
    assert nav.is_free(grid, nav.nearest_free(grid, outside))


@pytest.mark.parametrize("seed", range(12))
def test_every_room_of_a_house_can_be_reached_through_its_doorways(seed):
    scene = house(seed)
    grid = nav.navigable(scene)
    assert grid.floor_z == pytest.approx(0, abs=0.02)
    assert all(rooms_reached(grid, scene.metadata["rooms"]))
    for _, _, x0, y0, x1, y1 in scene.metadata["doorways"]:
        assert nav.is_free(grid, np.array([(x0 + x1) / 2, (y0 + y1) / 2]))
    assert grid.area > 3.0 * len(scene.metadata["rooms"])


def test_the_storey_near_a_height_is_found():
    upstairs = block((0, 3), (0, 4), (2.8, 3.0))
    scene = room(upstairs)
    assert nav.navigable(scene).floor_z == pytest.approx(0, abs=1e-6)
    grid = nav.navigable(scene, near_z=3.1)
    assert grid.floor_z == pytest.approx(3.0, abs=1e-6)
    assert nav.is_free(grid, np.array([1.5, 2.0]))
    assert not nav.is_free(grid, np.array([4.5, 2.0]))
    with pytest.raises(UserError, match="no floor near the height"):
        nav.navigable(scene, near_z=1.5)


def test_places_where_nobody_can_stand_are_refused_in_a_sentence():
    with pytest.raises(UserError, match="no place where an agent"):
        nav.navigable(room(), agent_radius_m=2.5)
    with pytest.raises(UserError, match="above 0 metres"):
        nav.navigable(room(), cell_m=0.0)
    with pytest.raises(UserError, match="unit is metres"):
        nav.navigable(room(width=40_000.0))
    upright = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 0, 2]], [[0, 1, 2]])
    with pytest.raises(UserError, match="no level surface"):
        nav.navigable(from_trimesh(upright, "wall"))
