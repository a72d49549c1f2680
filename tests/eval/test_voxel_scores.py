"""Scores of voxel worlds: unseen walls, doorways, what is lost, and how they are reported."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets, worlds
from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import MANIFEST
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode
from pewm_jax.data.voxels import VoxelGrid, VoxelsConfig
from pewm_jax.eval import horizon, voxel_edits, voxel_report, voxel_scores
from pewm_jax.eval.voxel_scores import UnseenCells
from pewm_jax.houses.generate import object_boxes
from pewm_jax.houses.kinds import FURNITURE, kind_of
from pewm_jax.io.store import ResultCache
from pewm_jax.memory import class_grid
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.report import labels
from pewm_jax.types import Camera, Frames, WorldState
from pewm_jax.worlds.persist import state as windows
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.worlds.persist.tiny_persist import MASKED, MODEL

CONFIG = Config(model=MASKED, train=PersistTrainConfig())


def cells(house, wall, made, unseen=None):
    shape = np.ones_like(wall, bool) if unseen is None else unseen
    return UnseenCells(house, shape, wall, made)


def test_iou_counts_walls_of_unseen_cells_over_all_places():
    wall = np.zeros((4, 4, 4), bool)
    wall[0] = True
    half = wall.copy()
    half[0, :2] = False
    unseen = np.ones((4, 4, 4), bool)
    unseen[0, 2:] = False
    assert voxel_scores.iou([cells("a", wall, wall)], [wall]) == 1
    assert voxel_scores.iou([cells("a", wall, half)], [half]) == 0.5
    assert voxel_scores.iou([cells("a", wall, half, unseen)], [half]) == 0
    both = [cells("a", wall, wall), cells("b", wall, half)]
    assert voxel_scores.iou(both, [wall, half]) == 24 / 32


def test_the_prior_is_the_mean_layout_of_other_houses_at_its_best_threshold():
    one, two = np.zeros((2, 2, 2), bool), np.zeros((2, 2, 2), bool)
    one[0], two[0], two[1, 0] = True, True, True
    some = [cells("a", one, one), cells("a", one, one), cells("b", two, one)]
    first, again, last = voxel_scores.mean_layouts(some)
    np.testing.assert_array_equal(first, two)  # of the other house
    np.testing.assert_array_equal(again, two)
    np.testing.assert_array_equal(last, one)
    found = voxel_scores.unseen_scores(some)
    assert found["iou"] == 12 / 14
    assert found["prior"] == 12 / 18
    assert (found["places"], found["houses"]) == (3, 2)
    others = [cells("c", one, None), cells("d", two, None)]
    np.testing.assert_allclose(voxel_scores.mean_layouts(some, others)[0], (one + 1.0 * two) / 2)
    assert voxel_scores.unseen_scores(some, others)["prior"] == 12 / 14  # cut above one half


def test_the_lead_over_the_prior_has_an_interval_over_houses():
    wall, half = np.ones((2, 2, 2), bool), np.zeros((2, 2, 2), bool)
    half[0] = True
    alike = [cells(house, wall, wall) for house in "abab"]
    assert voxel_scores.ratio_interval(alike, [wall] * 4, [half] * 4) == (2, 2)
    unlike = [cells(house, wall, wall) for house in "abc"]
    low, high = voxel_scores.ratio_interval(unlike, [wall, wall, half], [half] * 3)
    assert 1 <= low < 5 / 3 < high <= 2
    alone = [cells("a", wall, wall)]
    assert np.isnan(voxel_scores.ratio_interval(alone, [wall], [half])).all()


def test_observed_walls_are_extended_as_a_baseline():
    wall = np.zeros((9, 9, 9), bool)
    wall[1:8, 4, 2:7] = True
    unseen = np.ones((9, 9, 9), bool)
    unseen[3:7] = False  # the middle of the wall is seen
    assert voxel_scores.extended([cells("a", wall, wall, unseen)]) == 3 / 4  # one cell too many
    unseen[0] = False
    assert voxel_scores.extended([cells("a", wall, wall, unseen)]) == 3 / 4
    wall[8, 4, 2:7] = True
    assert voxel_scores.extended([cells("a", wall, wall, unseen)]) == 1
    unseen[:5] = True  # three columns are too short for a line
    assert voxel_scores.extended([cells("a", wall, wall, unseen)]) == 0

    seen = np.zeros((9, 9, 9), bool)
    seen[2, [1, 3, 4, 6], 3] = seen[2, 4, 5] = True
    made = voxel_scores.extend(seen, 1)
    np.testing.assert_array_equal(np.unique(np.argwhere(made)[:, 0]), [2])
    np.testing.assert_array_equal(np.unique(np.argwhere(made)[:, 1]), np.arange(8))
    np.testing.assert_array_equal(np.unique(np.argwhere(made)[:, 2]), [3, 4, 5])
    assert made.sum() == 8 * 3
    np.testing.assert_array_equal(voxel_scores.extend(made.swapaxes(0, 1), 0), made.swapaxes(0, 1))


def test_walls_are_classes_of_walls_in_any_colour():
    names = ("empty", "wall/red", "door/red", "trim", "sofa/blue", "doorway/blue")
    assert voxel_scores.wall_classes(names).tolist() == [False, True, False, True, False, True]


def test_places_are_spread_over_episodes_and_frames():
    some = [SimpleNamespace(length=20), SimpleNamespace(length=12), SimpleNamespace(length=4)]
    found = voxel_scores.places(some, 5, 8)
    assert len(found) == 4  # two of each episode that is long enough
    assert [number for number, _ in found] == [0, 1, 0, 1]
    assert all(7 <= at < some[number].length for number, at in found)
    assert found[0][1] < found[2][1]


def blank(side=24):
    return ClassGrid(np.zeros((side, side, 8), np.int16), np.zeros(3, np.float32))


def test_a_doorway_is_passable_if_two_lanes_are_free():
    model = dataclasses.replace(
        MASKED, memory=dataclasses.replace(MASKED.memory, cell_m=(0.25, 0.25, 0.25))
    )
    config = SimpleNamespace(model=model)
    way = voxel_scores.way_through((2.0, 1.0, 2.12, 1.9), 0.0, 0.25)
    assert way.shape[0] == 4
    grid = blank()
    assert voxel_scores.passable(config, grid, way)
    grid.classes_XYZ[:, 5, 2] = 3  # one lane of four is blocked
    assert voxel_scores.passable(config, grid, way)
    grid.classes_XYZ[:, 6, 2] = 3
    assert not voxel_scores.passable(config, grid, way)
    grid = blank()
    grid.classes_XYZ[:, :, 7] = 3  # a lintel above the head
    grid.classes_XYZ[:, :, 0] = 3  # a sill
    assert voxel_scores.passable(config, grid, way)
    outside = voxel_scores.cells_at(grid, 0.25, np.array([[-1.0, 0, 0], [0.1, 0.1, 1.8]]))
    np.testing.assert_array_equal(outside, [-1, 3])


@pytest.fixture(scope="module")
def episode():
    voxels = VoxelsConfig(
        record=True, cell=0.5, side=12, kinds="groups", colours=1, pictures="cells"
    )
    config = CollectConfig(
        "data", train=1, frames=12, size=16, moving=True, voxels=voxels, turn_around=1.0
    )
    return read_episode(make_episode(config, "train", 0))


@pytest.mark.slow
def test_recorded_windows_agree_with_what_frames_show(episode):
    seen = episode.frames(range(4, 12))
    found = voxel_scores.compare_window(CONFIG, episode, 11, seen)
    assert found.house == episode.scene
    assert found.unseen_XYZ.any()
    assert not found.unseen_XYZ.all()
    # The window is that of a world that began at the first of the frames.
    began, now = (np.asarray(seen.camera.world_from_camera)[k, :3, 3] for k in (0, -1))
    low = np.asarray(MASKED.memory.empty(MASKED, began).low_3)
    window = low, np.asarray(windows.first_cell(MASKED, low, now))
    same = voxel_scores.compare_window(CONFIG, episode, 11, seen, *window)
    np.testing.assert_array_equal(found.wall_XYZ, same.wall_XYZ)
    last = jax.tree.map(lambda x: x[-1:], seen)
    fewer = voxel_scores.compare_window(CONFIG, episode, 11, last, *window)
    assert (fewer.unseen_XYZ | ~found.unseen_XYZ).all()
    assert fewer.unseen_XYZ.sum() > found.unseen_XYZ.sum()
    assert voxel_scores.house_of("scene0000_00") is None
    assert voxel_scores.house_of(episode.scene) is not None


@pytest.mark.slow
def test_open_doorways_of_generated_houses_are_found():
    """Houses have sills, and doors that open as the agent approaches."""
    config = presets.load("persist")
    voxels = VoxelsConfig(
        record=True, cell=0.25, side=40, kinds="groups", colours=8, pictures="cells"
    )
    made = CollectConfig("data", train=3, frames=40, size=32, moving=True, voxels=voxels)
    found = [read_episode(make_episode(made, "train", number)) for number in range(3)]
    starts = [voxel_scores.most_doorways(config, one, range(7, 40), 8) for one in found]
    counts = [
        len(voxel_scores.open_doorways(config, one, at, 8))
        for one, at in zip(found, starts, strict=True)
    ]
    assert sum(counts) >= 2


def test_a_walk_begins_where_most_doorways_are_seen_open(monkeypatch):
    seen = {7: 1, 8: 0, 9: 2, 10: 2}
    monkeypatch.setattr(voxel_scores, "open_doorways", lambda c, e, at, n: [at] * seen[at])
    assert voxel_scores.most_doorways(CONFIG, None, range(7, 11), 8) == 9
    assert voxel_scores.most_doorways(CONFIG, None, range(8, 9), 8) == 8


def pose(x, y, yaw):
    made = np.eye(4, dtype=np.float32)
    cos, sin = np.cos(yaw), np.sin(yaw)
    made[:3, :3] = [[sin, 0, cos], [-cos, 0, sin], [0, -1, 0]]
    made[:3, 3] = x, y, 1.25
    return made


def frames(count, value=0.0):
    camera = Camera(
        np.tile(np.array([8, 8, 8, 8], np.float32), (count, 1)),
        np.stack([pose(3, 3, 0.1 * k) for k in range(count)]),
    )
    shape = (count, 16, 16)
    return Frames(np.full((*shape, 3), value, np.float32), np.ones(shape, np.float32), camera)


def test_a_cell_of_which_one_pixel_is_seen_is_not_unseen():
    seen = frames(1)
    depth = np.zeros((1, 16, 16), np.float32)
    depth[0, 8, 8] = 1.0  # 1 m ahead of (3, 3, 1.25)
    shown = np.asarray(voxel_scores._shown(MASKED, jnp.array([2.0, 1.0, 0.0]), depth, seen.camera))
    assert shown[4, 3:5, 2].any()


def test_points_count_as_shown_in_front_of_the_depth():
    seen = frames(1)
    points = np.array([[3.5, 3, 1.25], [4.5, 3, 1.25], [2.5, 3, 1.25]])
    np.testing.assert_array_equal(voxel_scores._points_shown(seen, points), [True, False, False])


@pytest.mark.parametrize(
    ("closed", "shown", "count"),
    [(4, range(4), 0), (4, range(8), 1), (4, [7], 1), (0, [0], 1), (8, range(8), 0)],
)
def test_a_doorway_that_was_closed_when_it_was_last_seen_was_not_seen_open(
    monkeypatch, closed, shown, count
):
    """The door is closed in the first frames, and the images show what is there in some."""
    house = {"doorways": [(0, 1, 5.0, 2.5, 5.1, 3.5)]}
    monkeypatch.setattr(voxel_scores, "house_of", lambda scene: house)
    classes = np.zeros((8, 40, 40, 40), np.uint16)
    classes[:closed, 28, 18:22, 16:25] = 3

    def see(indices):
        depth = np.full((8, 16, 16), 0.5, np.float32)
        depth[list(shown)] = 6.0
        camera = Camera(np.tile(np.float32([8] * 4), (8, 1)), np.stack([pose(3, 3, 0.0)] * 8))
        return jax.tree.map(
            lambda x: x[list(indices)], Frames(np.zeros((8, 16, 16, 3), np.float32), depth, camera)
        )

    episode = SimpleNamespace(
        scene="house-0",
        world_from_camera=np.stack([pose(3, 3, 0.0)] * 8),
        frames=see,
        voxels=lambda indices: SimpleNamespace(
            classes_TXYZ=classes[list(indices)],
            origin_T3=np.tile(np.float32([-2, -2, -4]), (len(indices), 1)),
        ),
    )
    config = presets.load("persist")
    assert len(voxel_scores.open_doorways(config, episode, 7, 8)) == count


def test_long_walks_compare_what_is_seen_again_at_their_start_and_end(monkeypatch):
    """A world that forgets: after the walk its frames are darker, and a doorway is walled up."""
    way = voxel_scores.way_through((2.0, 2.0, 2.12, 4.0), 0.0, 0.5)

    def start(model, params, seen):
        grid = ClassGrid(jnp.zeros((24, 24, 8), jnp.int16), jnp.zeros(3))
        return WorldState(jax.tree.map(lambda x: jnp.asarray(x[-1:]), seen), grid)

    def imagine(model, params, state, control, key, **_):
        dark = (state.map.classes_XYZ > 0).any()
        steps = control if not hasattr(control, "camera") else control.camera.intrinsics_4
        made = jax.tree.map(jnp.asarray, frames(len(steps)))
        rgb = made.rgb_THWC + 0.1 * 2 + 0.2 * 2 * dark
        walled = state.map.classes_XYZ.at[4:6].set(3)
        after = dataclasses.replace(state.map, classes_XYZ=walled)
        return WorldState(state.frame, after), dataclasses.replace(made, rgb_THWC=rgb)

    monkeypatch.setattr(worlds, "start", start)
    monkeypatch.setattr(worlds, "imagine", imagine)
    walk = horizon.RecordedWalk(
        "w", frames(2), np.zeros((5, 3), np.float32), np.zeros((5, 16, 16, 3), np.uint8), None,
        None, None, None,
    )  # fmt: skip
    found = voxel_scores.long_walks(CONFIG, {}, [walk, walk], [[way], [way, way]])
    assert found.video.shape == (2, 5, 16, 16, 3)
    before, after = found.seen
    np.testing.assert_allclose([before, after], [20, -20 * np.log10(0.3)], atol=1e-3)
    assert found.doorways == (3, 0)


def test_mechanisms_are_settings_of_the_world_that_are_switched_off():
    config = CONFIG.with_model(
        empty_prior=2.0,
        guess_logit=1.0,
        shown_logit=2.0,
        body_m=0.2,
        moving=("door",),
        colour_reach_m=1.0,
    )
    rows = {name: voxel_scores.variant(config, name).model for name in voxel_scores.MECHANISMS}
    assert rows["as trained"] == config.model
    assert rows["persistence_logit"].kept_logits == (0, 0, 0)
    assert rows["empty_prior"].empty_prior == 0
    assert rows["observation_logit"].observation_logit == 0
    assert rows["body"].body_m == 0
    assert rows["moving"].moving == ()
    assert rows["colour_reach_m"].colour_reach_m == 0
    hold = config.model.persistence_logit
    assert rows["guesses"].kept_logits == (hold, hold, hold)
    assert [rows[name].sampled for name in ("persistence_logit", "sampled")] == ["always"] * 2
    assert [rows[name].sampled for name in ("empty_prior", "guesses")] == ["new"] * 2
    steps = [rows[name].voxel_noise.sample_steps for name in ("as trained", "sample_steps")]
    assert steps == [2, 1]
    assert voxel_scores.mechanisms(config) == list(rows)
    # A mechanism that the world does not have gets no row.
    published = dataclasses.replace(CONFIG, model=MODEL)
    assert voxel_scores.mechanisms(published) == [
        "as trained",
        "persistence_logit",
        "observation_logit",
    ]


FACTS = {
    "unseen": {
        "iou": 0.3, "prior": 0.12, "times_low": 2.2, "times_high": 2.9, "extended": 0.19,
        "places": 24.0, "houses": 16.0,
    },
    "known": {"psnr": 22.5, "frames": 32},
    "long": {"data": "d", "walks": 2, "frames": 600, "ends": [200, 400, 600], "beside": ["small"]},
    "rows": {
        "as trained": {
            "iou": 0.3, "psnr": [15.0, 14.5, 14.25], "seen": [20.0, 19.75], "lost": 0.25,
            "doorways": [6, 5], "fvd": 512.0,
        },
        "empty_prior": {
            "iou": 0.2, "psnr": [14.0, 13.5, 13.25], "seen": [20.0, 18.0], "lost": 2.0,
            "doorways": [6, 3], "fvd": 900.0,
        },
        "small": {"psnr": [13.0, 13.0, 13.0], "fvd": 800.0},
    },
}  # fmt: skip


def test_the_terminal_shows_each_score_and_a_row_for_each_mechanism():
    said = "\n".join(labels.format_voxels({"voxels": FACTS}))
    for wanted in (
        "0.300",
        "0.120 (2.50 [2.20, 2.90] times)",
        "extended, 0.190",
        "22.50 dB",
        "+0.25 dB",
        "of 6 doorways seen open 5",
        "as trained 512; small 800",
    ):
        assert wanted in said, wanted
    table = labels.voxel_table(FACTS).text()
    assert len(table) == 4
    assert "empty_prior 0" in table[2]
    assert "20.00 → 18.00" in table[2]
    assert "3 of 6" in table[2]
    assert "–" in table[3]
    short = FACTS | {"long": None, "rows": {"as trained": {"iou": 0.3}}}
    assert "Long walks are not measured" in labels.format_voxels({"voxels": short})[-1]
    assert len(labels.voxel_table(short).text()) == 2
    assert labels.format_voxels({"voxels": None}) == []


def test_long_walks_without_data_are_refused(tmp_path):
    chosen = dataclasses.replace(CONFIG.evaluate, long=str(tmp_path))
    with pytest.raises(UserError, match=r"evaluate\.long is .* does not exist"):
        voxel_report.settings_of(dataclasses.replace(CONFIG, evaluate=chosen))
    assert voxel_report.settings_of(CONFIG)["frames"] == 0


def test_what_cannot_be_measured_is_refused_before_anything_is_imagined(tmp_path, monkeypatch):
    def one(length, cell=0.5):
        grid = VoxelGrid(cell, MASKED.memory.recorded, ("empty", "mine"))
        info = {"pictures": MASKED.memory.pictures}
        return SimpleNamespace(name="walk", length=length, voxel_grid=grid, info=info)

    def refuses(message, episodes, **changes):
        chosen = dataclasses.replace(CONFIG.evaluate, **changes)
        with pytest.raises(UserError, match=message):
            voxel_report.require_data(dataclasses.replace(CONFIG, evaluate=chosen), episodes)

    cell = MASKED.memory.cell_m[0]
    voxel_report.require_data(CONFIG, [one(9, cell)])
    refuses("have no voxels", [SimpleNamespace(voxel_grid=None)])
    refuses("has grids of", [one(9, 3 * cell)])
    (tmp_path / "revisit").mkdir()
    (tmp_path / "revisit" / MANIFEST).write_text("{}")
    monkeypatch.setattr(voxel_report, "EpisodeSource", lambda _: [one(56, cell)] * 2)
    long = {"long": str(tmp_path), "split": "revisit", "batch": 2, "long_frames": 30}
    own = [one(9, cell)]
    refuses("has 56 frames, and long walks need", own, **(long | {"long_frames": 55}))
    refuses(r"FVD needs two windows", own, **(long | {"fvd": "on", "batch": 1}))
    size = SimpleNamespace(height=99, width=16)
    world = SimpleNamespace(model=SimpleNamespace(clip=size))
    opened = SimpleNamespace(config=world, weights_hash="")
    monkeypatch.setattr(voxel_report, "open_run", lambda _: opened)
    refuses("names other, which has images of 16×99", own, **long, beside=("other",))
    chosen = dataclasses.replace(CONFIG.evaluate, **long)
    voxel_report.require_data(dataclasses.replace(CONFIG, evaluate=chosen), own)


def test_an_edit_is_made_in_another_room_and_seen_later(episode):
    house = voxel_scores.house_of(episode.scene)
    assert house is not None
    kinds = {kind: list(voxel_edits._places(house, kind, 0.0, 0.25)) for kind in voxel_edits.KINDS}
    assert len(kinds["door"]) == len(house["doorways"])
    assert len(kinds["wall"]) >= 3 * len(house["rooms"])
    for kind, found in kinds.items():
        for place in found:
            assert (place.box_23[1] > place.box_23[0]).all(), kind
            assert (place.move is not None) == (kind == "wall")
    boxes = object_boxes(int(house["seed"]))
    assert any(kind_of(name) in FURNITURE for name in boxes)
    assert all((box[1] >= box[0]).all() for box in boxes.values())


class Corridor:
    """An episode in three rooms in a row, whose walls hide all that is not in the agent's room."""

    scene, width, height = "house-0", 16, 16
    intrinsics_4 = np.array([8, 8, 8, 8], np.float32)
    house = {  # noqa: RUF012 - it is not changed
        "seed": 0,
        "rooms": [(0, 0, 3, 3), (3.1, 0, 6.1, 3), (6.2, 0, 9.2, 3)],
        "doorways": [(1, 2, 6.1, 1.0, 6.2, 2.0)],
    }

    def __init__(self, x, yaw):
        self.name = f"from {x[0]}"
        self.world_from_camera = np.stack([pose(a, 1.5, b) for a, b in zip(x, yaw, strict=True)])
        self.length = len(x)
        self.actions = np.zeros((self.length - 1, 3), np.float32)

    def frames(self, indices):
        (at,) = indices
        x = self.world_from_camera[at][0, 3]
        wall = 3.0 if x < 3 else 6.15 if x < 6.15 else 9.2
        facing = self.world_from_camera[at][0, 2] > 0
        depth = np.full((1, 16, 16), wall - x if facing else 0.5, np.float32)
        return SimpleNamespace(depth_THW=depth)


def test_a_door_is_opened_from_a_third_room_if_any_walk_leads_from_one(monkeypatch):
    monkeypatch.setattr(voxel_edits, "house_of", lambda scene: Corridor.house)
    monkeypatch.setattr(voxel_edits, "_is_closed", lambda *arguments: True)
    monkeypatch.setattr(voxel_edits, "_changed", lambda *arguments: np.ones(4))
    third = Corridor(np.arange(0.5, 5.0, 0.5), np.zeros(9))
    found = voxel_edits.plan(MASKED, third, "door")
    assert found is not None
    at = third.world_from_camera[found.start][0, 3]
    assert at < 3  # in the room that the door does not belong to
    assert 6.15 - at <= voxel_edits.REACH_M
    # In the door's own rooms, the agent turns away from the door and back to it.
    beside = Corridor(np.full(6, 4.0), np.array([np.pi, np.pi, np.pi, 0, 0, 0]))
    behind = Corridor(np.linspace(7, 4, 6), np.array([0, 0, 0, 0, 0, 0]))
    for own in (beside, behind):
        assert voxel_edits.plan(MASKED, own, "door") is None
    assert voxel_edits.plan(MASKED, beside, "door", beside=True) is None
    found = voxel_edits.plan(MASKED, behind, "door", beside=True)
    assert found is not None
    assert behind.world_from_camera[found.start][0, 3] > 6.2
    first = functools.partial(voxel_edits.first_plan, MASKED)
    assert first([behind, third], "door")[0] is third
    assert first([beside, behind], "door")[0] is behind
    assert first([beside], "door") == (None, None)
    # The wall of the next room is not seen from behind, which is a wall of the agent's own room.
    assert voxel_edits.plan(MASKED, beside, "wall") is None


def test_an_edit_is_shown_where_it_changes_the_image(episode):
    recorded = episode.voxels([0])
    pose = np.asarray(episode.camera(range(1, 4)).world_from_camera)[:, :3, 3]
    # A block of what surrounds the agent changes most of the image, a distant cell nothing.
    around = np.stack([pose.min(0) - 2.5, pose.max(0) + 2.5])
    nothing = np.stack([pose.min(0) + 100, pose.min(0) + 101])
    assert (recorded.classes_TXYZ > 0).any()
    shares = [
        voxel_edits._changed(MASKED, episode, voxel_edits.Plan("x", 0, 3, box))
        for box in (around, nothing)
    ]
    assert [len(one) for one in shares] == [3, 3]
    assert shares[0].max() > 0.3
    assert not shares[1].any()


def test_an_edit_changes_the_box_alone():
    memory = MASKED.memory
    grid = memory.empty(MASKED, jnp.zeros(3))
    low = np.asarray(grid.low_3)
    box = np.stack([low + 1, low + 2])
    grid = class_grid.place(memory, grid, box.astype(np.float32), 3)
    state = WorldState(None, grid)  # type: ignore[arg-type]
    move = np.eye(4)
    move[0, 3] = 1.0
    moved = voxel_edits.apply(MASKED, state, voxel_edits.Plan("x", 0, 1, box, move))
    gone = voxel_edits.apply(MASKED, state, voxel_edits.Plan("x", 0, 1, box))
    assert (np.asarray(moved.map.classes_XYZ) == 3).sum() == 8
    assert (np.asarray(moved.map.classes_XYZ)[4:6, 2:4, 2:4] == 3).all()
    assert not (np.asarray(gone.map.classes_XYZ) == 3).any()
    assert (np.asarray(class_grid.observed(gone.map)) == 1).sum() == 8


def test_a_row_that_is_added_leaves_the_others_as_they_are(tmp_path, monkeypatch):
    """Long walks take hours: pieces are measured again only if their own inputs differ."""
    (tmp_path / "revisit").mkdir()
    manifest = tmp_path / "revisit" / voxel_report.MANIFEST
    manifest.write_text("{}")
    measured = []

    def measure(config, params, episodes, long, key):
        measured.append(key)
        if key[0] == "unseen":
            return dict.fromkeys(("iou", "prior", "extended", "places", "houses"), np.ones(()))
        video = np.zeros((1, 6, 2, 2, 3), np.uint8)
        return {
            "video": video, "seen": np.ones(2), "doorways": np.zeros(2), "psnr": np.ones(()),
            "count": np.ones(2),
        }  # fmt: skip

    walks = SimpleNamespace(walks=[0], truth=np.zeros((1, 6, 2, 2, 3), np.uint8))
    monkeypatch.setattr(voxel_report, "_measure", measure)
    monkeypatch.setattr(voxel_report, "_read_walks", lambda config: walks)
    monkeypatch.setattr(
        voxel_report, "open_run", lambda name: SimpleNamespace(weights_hash=name + "'s weights")
    )
    cache = ResultCache(tmp_path / "cache")

    def score(**changes):
        measured.clear()
        chosen = dataclasses.replace(CONFIG.evaluate, long=str(tmp_path), long_frames=6, **changes)
        config = dataclasses.replace(CONFIG, evaluate=chosen)
        facts = voxel_report.score(config, {}, [], cache, print)
        assert facts is not None
        return sorted(measured), list(facts["rows"])

    own = "as trained"
    first, rows = score()
    assert first == [("known", own), ("long", own), ("unseen", own)]
    more, rows = score(mechanisms="on", beside=("small",))
    assert ("beside", "small") in more
    assert not {*first} & {*more}
    assert rows == [*voxel_scores.mechanisms(CONFIG), "small"]
    assert score(beside=("small", "other"))[0] == [("beside", "other")]
    manifest.write_text("{ }")
    assert score()[0] == [("long", own)]
    monkeypatch.setattr(
        voxel_report, "open_run", lambda name: SimpleNamespace(weights_hash="trained again")
    )
    assert score(beside=("small",))[0] == [("beside", "small")]
