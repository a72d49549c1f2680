"""Practice in imagination: walls hold, equal seeds walk alike, and the whole study runs."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets, weights
from pewm_jax.commands import table2 as table2_command
from pewm_jax.config import ActionConfig, ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.simulator import open_simulator
from pewm_jax.geometry.cameras import intrinsics_from_fov
from pewm_jax.planning import practice
from pewm_jax.planning.practice import Imagined, Practice, Real
from pewm_jax.studies import deciders, goals, policies
from pewm_jax.studies import practice as study
from pewm_jax.types import Frames
from pewm_jax.worlds import nomad as nomad_world
from tests.helpers import init_world, randomise
from tests.planning.planning_page import blocks
from tests.training.test_training_nomad import experiment

MOTION = ActionConfig()
ERRAND = study.Errand(
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
    return config, randomise(init_world(config, jax.random.key(0)), scale=0.3)


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
        nomad_world.init(policy.model, jax.random.key(1)),
    )
    configuration.save(policy, folder / "policy" / "config.json")
    page = study.run(
        folder / "world", folder / "policy", folder / "out", ERRAND, say=lambda _: None
    )
    return folder, page


def _clip(frames):
    return configuration.ClipConfig(frames=frames, height=16, width=16)


def test_the_whole_study_is_made_kept_and_goes_on(made):
    folder, page = made
    results = json.loads((folder / "out" / "results.json").read_text())
    assert set(results["rows"]) == {"before", *study.LEARNED}
    assert set(results["differences"]) >= {"memory - before", "memory - empty", "real - memory"}
    assert (results["houses"], results["tasks"]) == (1, 2)
    assert "practised in the world, with its memory" in page.read_text()
    assert page.with_suffix(".png").stat().st_size > 0
    pieces = sorted((folder / "out").glob("house*/*/scores.json"))
    assert len(pieces) == 4
    before = [file.stat().st_mtime_ns for file in pieces]
    study.run(folder / "world", folder / "policy", folder / "out", ERRAND, say=lambda _: None)
    assert [file.stat().st_mtime_ns for file in pieces] == before
    other = dataclasses.replace(ERRAND, steps=2)
    with pytest.raises(UserError, match=r"holds pieces of other settings \(steps\)"):
        study.run(folder / "world", folder / "policy", folder / "out", other, say=lambda _: None)


def test_what_it_learns_from_are_whole_walks_of_its_own_actions(made):
    folder, _ = made
    for how in study.LEARNED:
        source = EpisodeSource(folder / "out" / "house0000" / f"{how}-seed0" / "data" / "train")
        assert len(source) == 2
        episode = source[0]
        assert episode.length == 1 + 2 * 4
        moved = np.linalg.norm(np.diff(episode.world_from_camera[:, :2, 3], axis=0), axis=-1)
        stepped = np.asarray(episode.action_ids) == 0
        np.testing.assert_allclose(moved[~stepped], 0, atol=1e-5)
        if how != "real":  # where no wall holds
            np.testing.assert_allclose(moved[stepped], MOTION.step_m, atol=1e-4)


def test_the_page_runs_as_it_is_written(made, world, home):
    folder, _ = made
    config, params = world
    opened = policies.open_policy(folder / "policy")
    given = {"config": config, "params": params, "frames": home.context}
    given |= {"policy": opened.config.model.policy, "weights": opened.weights}
    exec(compile(blocks("Practice in imagination", "python"), "docs/planning.md", "exec"), given)
    first, second = given["walks"]
    assert first.frames.rgb_THWC.shape == (1 + 2 * 4, 16, 16, 3)
    assert len(second.actions_N) == 2 * 4


def test_a_policy_and_a_world_of_other_steps_are_refused(made, tmp_path):
    folder, _ = made
    config = configuration.load(folder / "policy" / "config.json")
    longer = dataclasses.replace(config.model, actions=ActionConfig(step_m=0.5))
    configuration.save(dataclasses.replace(config, model=longer), tmp_path / "config.json")
    (tmp_path / "weights.safetensors").write_bytes(
        (folder / "policy" / "weights.safetensors").read_bytes()
    )
    with pytest.raises(UserError, match="takes other steps than"):
        study.run(folder / "world", tmp_path, tmp_path / "out", ERRAND, say=lambda _: None)
    with pytest.raises(UserError, match="trained no policy"):
        policies.open_policy(folder / "world")
    with pytest.raises(UserError, match="train a policy first"):
        policies.open_policy(tmp_path / "nothing")
    with pytest.raises(ConfigError, match="nor the folder of a trained NoMaD"):
        table2_command.main(["--policy", str(tmp_path / "nothing")])


def test_a_trained_nomad_proposes_for_table_2(made, home):
    folder, _ = made
    name, policy = table2_command._policy(str(folder / "policy"))
    assert name.startswith("policy-")
    first = deciders.proposed(policy, home, 3)
    assert first.shape == (3, 4)
    np.testing.assert_array_equal(first, deciders.proposed(policy, home, 3))
    with pytest.raises(UserError, match="use a shorter --horizon"):
        policy(dataclasses.replace(home.asked, actions=9), 1)


def test_differences_are_paired_and_over_houses():
    def pieces(values):
        return [
            {"house": house, "tasks": [{"success": v} for v in tasks]}
            for house, tasks in zip(("a", "b"), values, strict=True)
        ]

    made = {"before": [[0, 0], [0, 100]], "empty": [[0, 0], [0, 100]], "real": [[100, 100]] * 2}
    made = {how: pieces(values) for how, values in made.items()}
    found = study.summary(made | {"memory": pieces([[0, 100], [100, 100]])})
    assert found["rows"]["memory"]["success"]["mean"] == 75
    gained = found["differences"]["memory - before"]["success"]
    assert (gained["mean"], gained["low"], gained["high"]) == (50, 50, 50)
    assert found["differences"]["real - memory"]["success"]["mean"] == 25


def test_real_walks_end_at_walls_by_turning(home):
    place = Real(home.simulator, MOTION, home.context)
    many = Practice(walks=3, blocks=6)
    for walk in practice.walks(place, home.context, forward, many, 0):
        poses = walk.frames.camera.world_from_camera
        moved = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=-1)
        np.testing.assert_allclose(moved[walk.actions_N == 0], MOTION.step_m, atol=1e-4)
        assert (walk.actions_N != 0).any()  # a house is not 6 m wide everywhere


def test_equal_seeds_walk_alike_and_other_seeds_do_not(world, home):
    config, params = world
    place, few = Imagined(config, params, home.context), Practice(walks=1, blocks=1)

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


def test_a_blocked_step_is_imagined_as_a_turn(world, home, monkeypatch):
    config, params = world
    asked = []

    def nothing_after_the_second(depth_HW, intrinsics_4, way_m):
        asked.append(depth_HW)
        return len(asked) != 3

    monkeypatch.setattr(practice, "free", nothing_after_the_second)
    place = Imagined(config, params, home.context)
    (walk,) = practice.walks(place, home.context, forward, Practice(walks=1, blocks=1), 0)
    assert walk.actions_N[:2].tolist() == [0, 0]
    assert walk.actions_N[2] == walk.actions_N[3] != 0
    assert len(walk.frames.depth_THW) == 5


@pytest.mark.parametrize(("ahead", "room"), [(0.3, False), (0.44, False), (0.46, True)])
def test_a_wall_ahead_is_seen_and_the_floor_is_none(ahead, room):
    intrinsics = intrinsics_from_fov(32, 32, 90.0)
    rows = (np.indices((32, 32))[0] + 0.5 - intrinsics[3]) / intrinsics[1]
    floor = np.where(rows > 0, 1.25 / np.maximum(rows, 1e-6), 9.0)
    assert practice.free(floor.astype(np.float32), intrinsics, 0.25)
    wall = np.minimum(floor, ahead).astype(np.float32)
    assert practice.free(wall, intrinsics, 0.25) == room
    wall[:, :4] = wall[:, -4:] = 0  # no measurement
    assert practice.free(wall, intrinsics, 0.25) == room


def test_what_is_free_by_depth_is_mostly_free_in_the_house():
    """The rule is about the agent's body; it agrees with the house's own collisions."""
    simulator = open_simulator(house_seed=2, height=64, width=64)
    rng, agree = np.random.default_rng(0), []
    place = Real(simulator, MOTION, _none())
    for xy in goals.sample_free(simulator.grid, rng, 120):
        planar = np.array([*xy, rng.uniform(-np.pi, np.pi)])
        possible = place.go(planar, np.array([0]), jax.random.key(0))[2] == 1
        depth = simulator.frames(planar[None]).depth_THW[0]
        agree.append(practice.free(depth, simulator.intrinsics_4, MOTION.step_m) == possible)
    assert np.mean(agree) > 0.85


def _none():
    return Frames(np.zeros((0, 1, 1, 3), np.uint8), np.zeros((0, 1, 1)), None)


@pytest.mark.parametrize("wrong", [{"walks": 0}, {"blocks": 0}, {"with_goal": 1.5}])
def test_bad_practice_is_refused(wrong):
    with pytest.raises(ConfigError, match="practice"):
        Practice(**wrong)
