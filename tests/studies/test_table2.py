"""Table 2: the whole of it on a tiny setting, tasks that can be done, and scores that mean it."""

import csv
import dataclasses
import json

import jax
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.cli import main as program
from pewm_jax.config import ActionConfig, ConfigError, UserError
from pewm_jax.io import weights
from pewm_jax.planning import costs, scores
from pewm_jax.planning.settings import PlanConfig
from pewm_jax.studies import deciders, goals, table2
from pewm_jax.worlds import world_model
from tests.helpers import init_world, random_world

MOTION = ActionConfig()
PLAN = PlanConfig(horizon=4, candidates=6, elites=2, rounds=2)
ERRAND = table2.Table2Config(
    tasks=(3, 2),
    houses=2,
    proposals=(2,),
    plan=PLAN,
    policy="wander",
    cost="pixels",
    videos=1,
    multiples=(1, 2),
)


def task(number, actions=6):
    return goals.open_goal(number, houses=2, actions=actions, context=4, motion=MOTION, size=16)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A table of a tiny model with random weights."""
    folder = tmp_path_factory.mktemp("table2")
    config = presets.load("tiny")
    weights.save(folder / "run" / "weights.safetensors", init_world(config, jax.random.key(0)))
    configuration.save(config, folder / "run" / "config.json")
    page = table2.run(
        folder / "run", folder / "out", ERRAND, deciders.wanderer, costs.Pixels(), lambda _: None
    )
    return folder, page


@pytest.mark.slow
def test_the_whole_table_is_made(made):
    _, page = made
    results = json.loads((page.parent / "results.json").read_text())
    names = deciders.method_names((2,))
    assert tuple(results["rows"]) == names
    assert set(results["memory_minus_empty"]) == {"rank2", "mpc", "loop"}
    assert {far: found["tasks"] for far, found in results["distances"].items()} == {"4": 3, "8": 2}
    assert set(results["distances"]["8"]["rows"]) == set(names) - {"policy"}
    assert set(results["curves"]["mpc-memory"]) == {"6", "12"}
    text = page.read_text()
    assert text.count("\n| one plan, open loop · ") == 2 * 4 + 0
    assert text.count("\n| MPC, closed loop · ") == 2 * 4
    assert "## Goals 8 actions away" in text
    assert "The paper specifies neither the distance of its goals" in text
    with page.with_suffix(".csv").open() as file:
        assert {line["method"] for line in csv.DictReader(file)} == set(names)
    assert page.with_suffix(".tex").read_text().count(r"\\") == len(names) + 1
    assert page.with_suffix(".png").stat().st_size > 0
    assert (page.parent / "plan0.mp4").stat().st_size > 0


@pytest.mark.slow
def test_what_is_decided_is_kept_and_more_can_be_added(made):
    folder, page = made
    files = sorted((folder / "out").glob("decisions/**/*.json"))
    before = [file.stat().st_mtime_ns for file in files]
    methods = len(deciders.method_names((2,)))
    assert len(files) == 3 * methods + 2 * (methods - 1)

    def other(asked, count):
        return deciders.wanderer(asked, count, seed=1)

    more = dataclasses.replace(ERRAND, policy="mine:other")
    table2.run(folder / "run", folder / "out", more, other, costs.Pixels(), lambda _: None)
    assert [file.stat().st_mtime_ns for file in files] == before
    new = set((folder / "out").glob("decisions/**/*.json")) - set(files)
    assert {file.parent.parent.name for file in new} == {"mine.other"}  # plans are found again
    wrong = dataclasses.replace(ERRAND, cost="lpips")
    with pytest.raises(UserError, match="contains decisions of other settings"):
        table2.run(folder / "run", folder / "out", wrong, other, costs.Pixels(), lambda _: None)
    assert "mine:other" in page.read_text()


@pytest.mark.parametrize("number", range(4))
def test_a_task_can_be_done_and_its_goal_was_not_seen_from_there(number):
    goal = task(number)
    assert np.array_equal(goal.walked(goal.expert_N), goal.walk_T3)
    assert scores.sim(goal.walk_T3[0], goal.walk_T3[-1], goal.walk_T3[-1]) == pytest.approx(100)
    seen = goal.seen(goal.expert_N[None])
    np.testing.assert_array_equal(seen.rgb_THWC[0], goal.frame.rgb_THWC)
    poses = goal.context.camera.world_from_camera
    assert not any(np.allclose(pose, goal.frame.camera.world_from_camera[0]) for pose in poses)
    start = goal.simulator.world_from_camera(goal.walk_T3[0])
    np.testing.assert_allclose(poses[-1], start, atol=1e-6)  # the present frame is where it begins
    again = task(number)
    np.testing.assert_array_equal(again.context.rgb_THWC, goal.context.rgb_THWC)


def test_a_step_or_a_turn_short_is_there_and_two_are_not():
    start = np.array([0.3, -1.2, 0.7])
    ends = [[0.25, 0, 0], [0, 0, np.pi / 6], [0.5, 0, 0], [0, 0, np.pi / 3]]
    reached = [
        scores.success(start, start + end, table2.WITHIN_M, table2.WITHIN_DEG) for end in ends
    ]
    assert reached == [True, True, False, False]


@pytest.mark.slow
def test_only_the_mind_with_a_memory_sees_the_past():
    config = presets.load("tiny")
    predictors = deciders.Predictors(config, random_world(config, scale=0.3))
    goal = task(0, actions=4)
    blind = dataclasses.replace(
        goal,
        context=jax.tree.map(lambda x: np.concatenate([x[-1:]] * len(x)), goal.context),
    )
    walks = deciders.wanderer(goal.input, 3)
    seen = {
        (mind, name): np.asarray(predictors.rollout(mind, which)(walks).rgb_THWC)
        for mind in ("empty", "memory")
        for name, which in (("whole", goal), ("present", blind))
    }
    np.testing.assert_allclose(seen["empty", "whole"], seen["empty", "present"], atol=1e-5)
    assert not np.allclose(seen["memory", "whole"], seen["memory", "present"], atol=1e-3)
    assert not np.allclose(seen["memory", "whole"], seen["empty", "whole"], atol=1e-3)


@pytest.mark.parametrize("wrong", [np.zeros((2, 3), int), np.zeros((2, 4)), np.full((2, 4), 3)])
def test_proposals_that_are_none_are_refused(wrong):
    with pytest.raises(UserError, match=r"give \(2, 4\) integers below 3"):
        deciders.proposed(lambda asked, count: wrong, task(0, actions=4), 2)


def test_a_perfect_mind_and_a_true_cost_reach_what_a_policy_does_not():
    straight = costs.Distance(costs.straight)
    plan = PlanConfig(horizon=6, candidates=60, elites=12, rounds=8)
    reached, alone = [], []
    for number in range(6):
        goal = task(number)
        for name, kept in (("mpc-truth", reached), ("policy", alone)):
            found = deciders.decide(name, goal, _Truth(), _by_truth, straight, plan)
            kept.append(table2._scored(goal, found.actions_N)["sim"])
    assert np.mean(reached) > 97
    assert np.mean(alone) < 80


class _Truth:
    def rollout(self, mind, goal):
        assert mind == "truth"
        return goal.seen


def _by_truth(asked, count):
    return deciders.wanderer(asked, count)


def test_ranking_takes_the_best_proposal():
    goal = task(1)

    def policy(asked, count):
        walks = deciders.wanderer(asked, count)
        walks[2] = goal.expert_N
        return walks

    found = deciders.decide("rank5-truth", goal, _Truth(), policy, costs.Pixels(), PLAN)
    np.testing.assert_array_equal(found.actions_N, goal.expert_N)
    assert found.foreseen == pytest.approx(0)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--policy", "nothing"], "--policy nothing is neither one of wander"),
        (["--policy", "json:nothing"], "json has no function nothing"),
        (["--tasks", "0"], "--tasks needs one number of 1 or more"),
        (["--tasks", "4", "2"], "--tasks needs one number of 1 or more, or one for each"),
        (["--proposals", "0"], "--proposals needs distinct numbers of 1 or more"),
        (["--proposals", "8", "8"], "--proposals needs distinct numbers of 1 or more"),
        (["--elites", "99"], "plan.elites is 99"),
        (["--videos", "-1"], "--videos is -1: give at least 0"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(tmp_path, argv, words):
    with pytest.raises(ConfigError, match=words):
        program.execute(["table2", *argv, "--cost", "pixels", "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_reprojection_predicts_what_was_observed_where_nothing_moved():
    goal = task(0, actions=4)
    predictors = deciders.Predictors(presets.load("tiny"), {})
    there_and_back = np.array([[1, 2, 1, 2], [1, 1, 2, 2]])  # turns that cancel each other
    seen = np.asarray(predictors.rollout("reproject", goal)(there_and_back).rgb_THWC)
    present = np.asarray(goal.context.rgb_THWC[-1], np.float32) / 127.5 - 1
    assert seen.shape == (2, 1, *present.shape)
    for one in seen[:, 0]:
        assert np.mean((one - present) ** 2) < 0.02
    away = np.asarray(predictors.rollout("reproject", goal)(np.array([[1, 1, 1, 1]])).rgb_THWC)
    assert np.mean((away[0, 0] - present) ** 2) > 0.05


class _Spied(deciders.Predictors):
    """Predictors that note what they observe."""

    def observe(self, mind, state, frames):
        self.seen.append(frames)
        return super().observe(mind, state, frames)


def test_any_number_of_candidates_is_reprojected_by_one_program():
    mind = deciders.Predictors(presets.load("tiny"), {}).rollout("reproject", task(0))
    actions = np.random.default_rng(0).integers(0, 3, (7, 6))
    mind(actions)
    known = deciders._reproject._cache_size()
    for count in (1, 3, 7):
        one_by_one = [mind(actions[k : k + 1]).rgb_THWC[0] for k in range(count)]
        np.testing.assert_array_equal(mind(actions[:count]).rgb_THWC, np.stack(one_by_one))
    assert deciders._reproject._cache_size() == known


@pytest.mark.slow(only="memory")
@pytest.mark.parametrize("mind", ["truth", "reproject", "memory"])
def test_a_closed_loop_observes_what_is_really_seen_after_each_clip(mind):
    config = presets.load("tiny")  # 4 actions at once
    predictors = _Spied(config, random_world(config, scale=0.3))
    object.__setattr__(predictors, "seen", [])
    goal = task(1, actions=8)
    one = dataclasses.replace(PLAN, horizon=8, rounds=1)
    found = deciders.decide(f"loop-{mind}", goal, predictors, None, costs.Pixels(), one)
    assert len(found.actions_N) in (8, 12)  # and one clip to correct, where that promises more
    walk = goal.walked(found.actions_N)
    assert len(predictors.seen) == len(found.actions_N) // 4
    for number, frames in enumerate(predictors.seen):
        real = goal.simulator.frames(walk[1 + 4 * number : 5 + 4 * number])
        np.testing.assert_array_equal(frames.rgb_THWC, real.rgb_THWC)
        np.testing.assert_allclose(
            frames.camera.world_from_camera, real.camera.world_from_camera, atol=1e-6
        )


def test_a_closed_loop_with_the_truth_and_a_true_cost_comes_to_the_goal():
    goal = task(2, actions=8)
    predictors = deciders.Predictors(presets.load("tiny"), {})
    plan = dataclasses.replace(PLAN, horizon=8, candidates=40, elites=10, rounds=6)
    reached = deciders.decide(
        "loop-truth", goal, predictors, None, costs.Distance(costs.straight), plan
    ).actions_N
    before = scores.position_error(goal.walk_T3[0], goal.walk_T3[-1])
    after = scores.position_error(goal.walked(reached)[-1], goal.walk_T3[-1])
    assert after < 0.3 < before


def without_memory():
    """Return the settings and parameters of a model that was trained in stage 1 alone."""
    config = presets.load("tiny")
    stage2 = dataclasses.replace(config.train.stage2, steps=0)
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, stage2=stage2))
    return config, world_model.init(config.model, jax.random.key(1), memory=False)


@pytest.mark.slow
def test_a_model_trained_without_memory_decides_by_its_own_weights():
    config = presets.load("tiny")
    none, goal, actions = without_memory(), task(0, actions=4), np.array([[1, 0, 1, 2]])
    predictors = deciders.Predictors(config, random_world(config, scale=0.3), none=none)
    assert predictors.names == ("empty", "none", "reproject", "memory", "truth")
    assert {"rank2-none", "mpc-none", "loop-none"} <= set(
        deciders.method_names((2,), predictors.names)
    )
    alone = deciders.Predictors(*none)
    seen = predictors.rollout("none", goal)(actions).rgb_THWC
    np.testing.assert_array_equal(seen, alone.rollout("empty", goal)(actions).rgb_THWC)
    assert not np.array_equal(seen, predictors.rollout("empty", goal)(actions).rgb_THWC)


@pytest.mark.slow
def test_a_model_trained_without_memory_gets_rows(made, tmp_path):
    folder, _ = made
    config, params = without_memory()
    weights.save(tmp_path / "none" / "weights.safetensors", params)
    configuration.save(config, tmp_path / "none" / "config.json")
    asked = dataclasses.replace(
        ERRAND, tasks=(1,), videos=0, multiples=(1,), none=str(tmp_path / "none")
    )
    page = table2.run(
        folder / "run", tmp_path / "out", asked, deciders.wanderer, costs.Pixels(), lambda _: None
    )
    text = page.read_text()
    for what in ("ranking × 2", "one plan, open loop", "MPC, closed loop"):
        assert f"| {what} · a model trained without memory |" in text
        assert f"| {what} · reprojection, no network |" in text
    wrong = dataclasses.replace(asked, none=str(folder / "run"))
    with pytest.raises(
        UserError, match="was trained with a memory: use a run trained only in stage 1"
    ):
        table2.run(
            folder / "run", tmp_path / "o", wrong, deciders.wanderer, costs.Pixels(), lambda _: None
        )


@pytest.mark.parametrize("far", [["2"], ["1", "1"], ["3", "1"], ["0"]])
def test_distances_of_goals_that_cannot_be_are_refused(far):
    with pytest.raises(ConfigError, match="--multiples needs increasing numbers of 1 or more"):
        program.execute(["table2", "--multiples", *far])
