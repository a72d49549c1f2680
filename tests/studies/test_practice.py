"""Practice in imagination: walls hold, equal seeds walk alike, and the whole study runs."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.cli import main as program
from pewm_jax.cli import studies as commands
from pewm_jax.config import ActionConfig, ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.simulator import move
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.io import weights
from pewm_jax.planning import practice
from pewm_jax.planning.practice import FloorMap, ImaginedEnvironment, Practice, SimulatedEnvironment
from pewm_jax.studies import deciders, goals
from pewm_jax.studies import practice as study
from pewm_jax.studies.practice import COLUMNS
from pewm_jax.studies.practice_piece import LEARNED, ROWS, PracticeConfig
from pewm_jax.types import Camera, Frames
from tests.helpers import random_world
from tests.planning.page import blocks
from tests.train.test_nomad import experiment

MOTION = ActionConfig()
ERRAND = PracticeConfig(
    houses=1,
    tasks=2,
    actions=4,
    most=3,
    practice=Practice(walks=2, blocks=2),
    steps=1,
    shown=1,
)


def forward(rgb_SHWC, goal_HWC, key):
    return np.zeros(4, int)


@pytest.fixture(scope="module")
def world():
    config = presets.load("tiny")
    return config, random_world(config, scale=0.3)


@pytest.fixture(scope="module")
def home():
    return goals.open_goal(0, houses=2, actions=4, context=4, motion=MOTION, size=16)


@pytest.fixture(scope="module")
def made(tmp_path_factory, world):
    """The whole study, with a world and a policy that know nothing."""
    folder = tmp_path_factory.mktemp("practice")
    config, params = world
    weights.save(folder / "world" / "weights.safetensors", params)
    configuration.save(config, folder / "world" / "config.json")
    policy = experiment(folder / "policy", steps=1, save_every=100)
    policy = dataclasses.replace(policy, model=dataclasses.replace(policy.model, clip=_clip(8)))
    weights.save(
        folder / "policy" / "weights.safetensors",
        policy.model.init(jax.random.key(1)),
    )
    configuration.save(policy, folder / "policy" / "config.json")
    page = study.run(
        folder / "world", folder / "policy", folder / "out", ERRAND, log=lambda _: None
    )
    return folder, page


def _clip(frames):
    return configuration.ClipConfig(frames=frames, height=16, width=16)


@pytest.mark.slow
def test_the_whole_study_is_made_kept_and_goes_on(made):
    folder, page = made
    results = json.loads((folder / "out" / "results.json").read_text())
    assert tuple(results["rows"]) == ROWS
    assert set(results["differences"]) >= {"memory - before", "memory - empty", "real - memory"}
    assert set(results["walked"]) == set(LEARNED)
    assert results["walked"]["real"]["through_walls"] == 0
    assert (results["houses"], results["tasks"]) == (1, 2)
    assert "practised in the world, with its memory" in page.read_text()
    assert page.with_suffix(".png").stat().st_size > 0
    pieces = sorted((folder / "out").glob("house*/*/scores.json"))
    assert len(pieces) == len(ROWS)
    before = [file.stat().st_mtime_ns for file in pieces]
    study.run(folder / "world", folder / "policy", folder / "out", ERRAND, log=lambda _: None)
    assert [file.stat().st_mtime_ns for file in pieces] == before
    runs = [
        (folder / "out" / "house0000" / f"{how}-seed0" / "run" / "weights.safetensors")
        for how in LEARNED
    ]
    began = (folder / "policy" / "weights.safetensors").read_bytes()
    assert len({began, *(run.read_bytes() for run in runs)}) == 4, "each has learned something else"
    undisturbed = pieces[0].read_bytes(), pieces[-1].read_bytes()
    pieces[0].unlink()  # as if killed: the walks are there, the training is made anew
    pieces[-1].unlink()
    study.run(folder / "world", folder / "policy", folder / "out", ERRAND, log=lambda _: None)
    assert (pieces[0].read_bytes(), pieces[-1].read_bytes()) == undisturbed
    other = dataclasses.replace(ERRAND, steps=2)
    with pytest.raises(UserError, match=r"contains pieces of other settings \(steps\)"):
        study.run(folder / "world", folder / "policy", folder / "out", other, log=lambda _: None)


@pytest.mark.slow
def test_what_it_learns_from_are_whole_walks_of_its_own_actions(made):
    folder, _ = made
    for how in LEARNED:
        source = EpisodeSource(folder / "out" / "house0000" / f"{how}-seed0" / "data" / "train")
        assert len(source) == 2
        episode = source[0]
        assert episode.length == 1 + 2 * 4
        moved = np.linalg.norm(np.diff(episode.world_from_camera[:, :2, 3], axis=0), axis=-1)
        stepped = np.asarray(episode.action_ids) == 0
        np.testing.assert_allclose(moved[~stepped], 0, atol=1e-5)
        if how != "real":  # where no wall holds
            np.testing.assert_allclose(moved[stepped], MOTION.step_m, atol=1e-4)


@pytest.mark.slow
def test_the_page_runs_as_it_is_written(made, world, home):
    folder, _ = made
    config, params = world
    opened = deciders.open_policy(folder / "policy")
    given = {"config": config, "params": params, "frames": home.context}
    given |= {"policy": opened.config.model.policy, "weights": opened.weights}
    exec(compile(blocks("Practice in imagination", "python"), "docs/planning.md", "exec"), given)
    first, second = given["walks"]
    assert first.frames.rgb_THWC.shape == (1 + 2 * 4, 16, 16, 3)
    assert len(second.actions_N) == 2 * 4


@pytest.mark.slow
def test_a_policy_and_a_world_of_other_steps_are_refused(made, tmp_path):
    folder, _ = made
    config = configuration.load(folder / "policy" / "config.json")
    longer = dataclasses.replace(config.model, actions=ActionConfig(step_m=0.5))
    configuration.save(dataclasses.replace(config, model=longer), tmp_path / "config.json")
    (tmp_path / "weights.safetensors").write_bytes(
        (folder / "policy" / "weights.safetensors").read_bytes()
    )
    with pytest.raises(UserError, match="uses other actions than"):
        study.run(folder / "world", tmp_path, tmp_path / "out", ERRAND, log=lambda _: None)
    short = dataclasses.replace(ERRAND, practice=Practice(walks=1, blocks=1))
    with pytest.raises(UserError, match="use more --blocks"):
        study.run(folder / "world", folder / "policy", tmp_path / "o", short, log=lambda _: None)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file: choose a folder"):
        study.run(folder / "world", folder / "policy", tmp_path / "file", ERRAND)
    with pytest.raises(UserError, match="contains no policy"):
        deciders.open_policy(folder / "world")
    with pytest.raises(UserError, match="train a policy first"):
        deciders.open_policy(tmp_path / "nothing")
    with pytest.raises(ConfigError, match="nor the folder of a trained NoMaD"):
        program.execute(["table2", "--policy", str(tmp_path / "nothing")])


@pytest.mark.slow
def test_a_trained_nomad_proposes_for_table_2(made, home):
    folder, _ = made
    name, policy = commands._policy(str(folder / "policy"))
    assert name.startswith("policy-")
    first = deciders.proposed(policy, home, 3)
    assert first.shape == (3, 4)
    np.testing.assert_array_equal(first, deciders.proposed(policy, home, 3))
    with pytest.raises(UserError, match="use a shorter --horizon"):
        policy(dataclasses.replace(home.input, actions=9), 1)


def test_differences_are_paired_and_over_houses():
    def pieces(values):
        return [
            {"house": house, "walked": {}, "tasks": [{"success": v} for v in tasks]}
            for house, tasks in zip(("a", "b"), values, strict=True)
        ]

    made = {
        "chance": [[0, 0]] * 2,
        "before": [[0, 0], [0, 100]],
        "empty": [[0, 0], [0, 100]],
        "real": [[100, 100]] * 2,
    }
    made = {how: pieces(values) for how, values in made.items()}
    found = study.summary(made | {"memory": pieces([[0, 100], [100, 100]])})
    assert found["rows"]["memory"]["success"]["mean"] == 75
    gained = found["differences"]["memory - before"]["success"]
    assert (gained["mean"], gained["low"], gained["high"]) == (50, 50, 50)
    assert found["differences"]["real - memory"]["success"]["mean"] == 25


def test_real_walks_end_at_walls_by_turning(home):
    place = SimulatedEnvironment(home.simulator, MOTION, home.context)
    many = Practice(walks=3, blocks=6)
    for walk in practice.walks(place, home.context, forward, many, 0):
        poses = walk.frames.camera.world_from_camera
        moved = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=-1)
        np.testing.assert_allclose(moved[walk.actions_N == 0], MOTION.step_m, atol=1e-4)
        assert (walk.actions_N != 0).any()  # a house is not 6 m wide everywhere


@pytest.mark.slow
def test_equal_seeds_walk_alike_and_other_seeds_do_not(world, home):
    config, params = world
    place, few = ImaginedEnvironment(config, params, home.context), Practice(walks=1, blocks=1)

    def drawn(rgb_SHWC, goal_HWC, key):
        return np.asarray(jax.random.randint(key, (4,), 1, 3))

    one, same, other = (
        next(practice.walks(place, home.context, drawn, few, seed)) for seed in (0, 0, 3)
    )
    np.testing.assert_array_equal(one.frames.rgb_THWC, same.frames.rgb_THWC)
    assert not np.array_equal(one.frames.rgb_THWC, other.frames.rgb_THWC)
    starts = home.context.camera.world_from_camera
    begun = one.frames.camera.world_from_camera[0]
    assert any(np.allclose(begun, pose, atol=1e-6) for pose in starts)


@pytest.mark.slow
def test_where_a_step_is_not_possible_the_block_is_a_turn(world, home, monkeypatch):
    config, params = world
    place = ImaginedEnvironment(config, params, home.context)
    monkeypatch.setattr(place, "possible", lambda state, actions: 2)
    (walk,) = practice.walks(place, home.context, forward, Practice(walks=1, blocks=1), 0)
    assert walk.actions_N[:2].tolist() == [0, 0]
    assert walk.actions_N[2] == walk.actions_N[3] != 0
    assert len(walk.frames.depth_THW) == 5


def test_both_worlds_meet_the_walls_that_the_pictures_show(world, home):
    config, params = world
    imagined = [
        ImaginedEnvironment(config, params, home.context, memory=memory) for memory in (True, False)
    ]
    assert [place.memory for place in imagined] == [True, False]
    ways = np.zeros((4, 12), int)
    ways[:, 0] = [0, 1, 2, 1]
    states = [place.begin(len(home.context.depth_THW) - 1)[0] for place in imagined]
    found = [
        [place.possible(state, way) for way in ways]
        for place, state in zip(imagined, states, strict=True)
    ]
    assert found[0] == found[1]
    assert max(found[0]) < 12, "no room is 3 m wide in every direction of this house's first task"


def test_what_the_pictures_show_to_be_free_is_free_and_what_not_is_not():
    """The map of the floor agrees with the house's own collisions, both ways."""
    agree = {True: [], False: []}
    for number in range(2):
        goal = goals.open_goal(number, houses=2, actions=8, context=24, motion=MOTION, size=64)
        floor, rng = FloorMap(), np.random.default_rng(number)
        floor.add(goal.context)
        places = goals.sample_free(goal.simulator.grid, rng, 1500)
        near = np.linalg.norm(places - goal.walk_T3[0, :2], axis=-1) < 1.5
        for xy in places[near][:150]:
            planar = np.array([*xy, rng.uniform(-np.pi, np.pi)])
            _, collided = move(goal.simulator.grid, planar, goal.table_A3[0])
            ahead = planar[:2] + 0.25 * np.array([np.cos(planar[2]), np.sin(planar[2])])
            agree[not collided].append(floor.free(planar[:2], ahead) == (not collided))
    assert len(agree[False]) > 20
    assert np.mean(agree[True]) > 0.9
    assert np.mean(agree[False]) > 0.7


def test_an_unseen_floor_is_free_and_no_measurement_is_nothing():
    floor = FloorMap()
    assert floor.free(np.zeros(2), np.array([0.25, 0.0]))
    pose = pose_from_yaw(np.array([0.0, 0.0, 1.25]), 0.0)
    camera = Camera(intrinsics_from_fov(16, 16, 90.0)[None], pose[None])
    floor.add(Frames(np.zeros((1, 16, 16, 3), np.uint8), np.zeros((1, 16, 16)), camera))
    assert floor.free(np.zeros(2), np.array([0.25, 0.0]))
    wall = np.full((1, 16, 16), 0.45)
    wall[:, :4] = 0
    floor.add(Frames(np.zeros((1, 16, 16, 3), np.uint8), wall, camera))
    assert not floor.free(np.zeros(2), np.array([0.25, 0.0]))
    assert floor.free(np.zeros(2), np.array([-0.25, 0.0]))


@pytest.mark.parametrize(
    "wrong", [np.array([0, 3]), np.array([-1]), np.zeros(2), np.zeros((1, 2), int)]
)
def test_a_policy_that_gives_no_actions_is_refused(home, wrong):
    place = SimulatedEnvironment(home.simulator, MOTION, home.context)
    with pytest.raises(UserError, match="the policy gave"):
        next(practice.walks(place, home.context, lambda *_: wrong, Practice(walks=1), 0))


@pytest.mark.parametrize(
    "wrong", [{"seeds": (-1,)}, {"learning_rate": float("nan")}, {"shown": -1}, {"tasks": 0}]
)
def test_bad_settings_of_a_study_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        PracticeConfig(**wrong)


@pytest.mark.parametrize("wrong", [{"walks": 0}, {"blocks": 0}, {"with_goal": 1.5}])
def test_bad_practice_is_refused(wrong):
    with pytest.raises(ConfigError, match="practice"):
        Practice(**wrong)


@pytest.mark.parametrize("better", [True, False])
def test_worlds_are_compared_only_where_the_house_itself_beats_chance(better):
    """It bounds what any world can teach; without it the page has no differences."""
    rng = np.random.default_rng(0)

    def pieces(share):
        return [
            {
                "house": f"house{house}",
                "walked": {},
                "tasks": [
                    dict.fromkeys(COLUMNS, 100.0 * (rng.random() < share)) for _ in range(12)
                ],
            }
            for house in range(12)
        ]

    shares = dict.fromkeys(("chance", "before", "memory", "empty"), 0.1)
    shares["real"] = 0.6 if better else 0.1
    made = {how: pieces(share) for how, share in shares.items()}
    found = study.summary(made)
    assert found["power"]["compares"] == better
    assert (found["power"]["p"] < 0.01) == better
    about = {
        "model": "small",
        "tasks": 12,
        "seeds": [0],
        "practice": {"walks": 1, "blocks": 1},
        "steps": 1,
        "actions": 8,
        "most": 24,
        "within_m": 0.35,
        "within_deg": 45.0,
        "date": "today",
    }
    text = study.markdown(found | {"about": about}, "")
    assert ("## Differences" in text) == better
    assert ("No comparison between worlds is drawn" in text) == (not better)
