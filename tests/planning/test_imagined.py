"""Worlds as environments: pure functions that jit and vmap, and the house's spaces."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import pewm_jax
from pewm_jax import presets, worlds
from pewm_jax.config import UserError
from pewm_jax.data.simulator import open_simulator
from pewm_jax.data.trajectories import advance
from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.planning import imagined, oracle
from pewm_jax.planning.house import HouseEnv
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.planning.imagined_env import WorldModelEnv
from pewm_jax.planning.observations import planar_of
from pewm_jax.worlds.codec import CodecTask
from tests.helpers import random_world
from tests.planning.page import blocks

TINY = presets.load("tiny")
CONFIG = TINY.with_model(
    backbone=dataclasses.replace(TINY.model.backbone, layers=1),
    memory=dataclasses.replace(
        TINY.model.memory,
        capacity=1024,
        imagined_edge=0.0,  # untrained models imagine nothing but edges
    ),
    noise=dataclasses.replace(TINY.model.noise, sample_steps=1),
)
"""The preset ``tiny``, smaller still."""
MODEL = CONFIG.model
KEY = jax.random.key(3)
reset, step = imagined.reset, imagined.step
"""Compiled once by themselves, for the environment too."""


def close(a, b, atol=1e-4):
    """Equal up to rounding; colours may differ by one level."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        levels = np.asarray(x).dtype == np.uint8
        np.testing.assert_allclose(
            np.asarray(x, np.float64), np.asarray(y, np.float64), atol=1.01 if levels else atol
        )


@pytest.fixture(scope="module")
def params():
    return random_world(CONFIG, scale=0.1)


@functools.cache
def seen(seed=0):
    """Twelve frames of a house, where an agent turns; as many as it looks around with."""
    simulator = open_simulator(house_seed=0, height=16, width=16)
    cells = np.argwhere(simulator.grid.free_YX)
    x, y = simulator.grid.centre_of(cells[len(cells) // (2 + seed)])
    return simulator.frames(np.array([[x, y, 0.3 * k + seed] for k in range(12)]))


@pytest.fixture(scope="module")
def state(params):
    return reset(CONFIG, params, seen(), KEY)


def away(pose, action):
    """The pose after one action, worked out by hand."""
    x, y, yaw = advance(planar_of(pose), np.asarray(action, float))
    return pose_from_yaw(np.array([x, y, pose[2, 3]]), yaw)


@pytest.mark.slow
def test_after_reset_the_last_frame_is_what_is_seen(state):
    present = imagined.observation(state)
    np.testing.assert_array_equal(present["rgb"], seen().rgb_THWC[-1])
    np.testing.assert_array_equal(present["depth"], seen().depth_THW[-1])
    np.testing.assert_array_equal(present["pose"], seen().camera.world_from_camera[-1])
    assert int(state.steps) == 0


def test_a_step_shows_what_it_leads_to_and_remembers_it(params, state):
    """``worlds.imagine`` of one action; ``test_world`` says which frame of the clip that is."""
    action = np.array([0.2, -0.05, 0.3], np.float32)
    after, shown = step(CONFIG, params, state, action, KEY)
    assert {name: (x.shape, str(x.dtype)) for name, x in shown.items()} == {
        "rgb": ((16, 16, 3), "uint8"),
        "depth": ((16, 16), "float32"),
        "pose": ((4, 4), "float32"),
    }
    close(imagined.observation(after), shown)
    np.testing.assert_allclose(after.pose, away(np.asarray(state.pose), action), atol=1e-5)
    assert int(after.steps) == 1
    assert int(after.world.map.occupied) > int(state.world.map.occupied)


@pytest.mark.parametrize(
    ("action", "single"),
    [
        (0, True),
        (np.int64(1), True),
        (jnp.array(2), True),
        (np.zeros(3), True),
        ([0.1, 0.0, 0.0], True),
        ([0, 1, 2], False),
        (np.zeros((3, 3)), False),
        (np.zeros(3, np.int32), False),
        (seen().camera, False),
    ],
)
def test_one_action_is_told_from_a_block(monkeypatch, state, action, single):
    """Which of the two is asked of the world; what it answers does not count here."""
    asked = []

    def imagine(model, params, world, control, key):
        count = length(control)
        asked.append(count)
        return world, jax.tree.map(lambda x: jnp.repeat(x, count, 0), world.frame)

    monkeypatch.setattr(worlds, "imagine", imagine)
    _, shown = imagined.step(MODEL, {}, state, action, KEY)
    assert asked == [1 if single else length(action)]
    assert shown["depth"].ndim == (2 if single else 3)


def length(control):
    return len(getattr(control, "intrinsics_4", control))


@pytest.mark.slow
def test_jit_and_vmap_are_the_loop(params):
    """Three states with their own actions and keys, stepped together and one by one."""
    states = [reset(CONFIG, params, seen(k % 2), KEY) for k in range(3)]
    moves = jnp.array([[0.2, 0.0, 0.1], [0.1, 0.1, -0.4], [0.0, 0.0, 0.5]])
    keys = jax.random.split(KEY, 3)
    together = jax.tree.map(lambda *x: jnp.stack(x), *states)
    many = jax.jit(jax.vmap(functools.partial(imagined.step, MODEL), in_axes=(None, 0, 0, 0)))
    after, shown = many(params, together, moves, keys)
    for k in range(3):
        alone, one = step(CONFIG, params, states[k], np.asarray(moves[k]), keys[k])
        close(one, jax.tree.map(lambda x, k=k: x[k], shown), atol=2e-3)
        close(alone.world.frame, jax.tree.map(lambda x, k=k: x[k], after.world.frame), atol=2e-3)
        assert int(alone.steps) == int(after.steps[k]) == 1


def test_goals_are_tested_by_pose_or_by_a_cost(state):
    goal = away(np.asarray(state.pose), [0.3, 0.4, 0.5])
    np.testing.assert_allclose(imagined.distance(state.pose, goal), 0.5, atol=1e-5)
    np.testing.assert_allclose(imagined.turned(state.pose, goal), 0.5, atol=1e-5)
    poses = jnp.stack([state.pose, goal])
    assert imagined.reached(poses, goal, 0.1).tolist() == [False, True]
    assert imagined.reached(poses, goal, 0.6).tolist() == [True, True]
    assert imagined.reached(poses, goal, 0.6, 20.0).tolist() == [False, True]
    shown = imagined.observation(state)

    def darkness(rgb):
        return 255 - jnp.mean(rgb)

    value = float(darkness(shown["rgb"]))
    assert bool(imagined.satisfied(shown, darkness, value + 1))
    assert not bool(imagined.satisfied(shown, darkness, value - 1))


def world(params, **settings):
    return WorldModelEnv(CONFIG, params, HouseConfig(**settings))


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("task", ["point", "image"])
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
def test_gymnasium_finds_nothing_wrong(params, actions, task):
    check_env(world(params, actions=actions, task=task))


def test_a_policy_of_the_house_begins_alike_and_runs_unchanged(params):
    house = HouseEnv(height=16, width=16, task="image")
    env = world(params, task="image")
    assert env.observation_space == house.observation_space
    assert env.action_space == house.action_space
    real, told = house.reset(seed=5)
    dreamt, info = env.reset(seed=5)
    for name in real:
        np.testing.assert_array_equal(dreamt[name], real[name])
    for name in ("position_error", "yaw_error", "success", "steps", "path_length"):
        assert info[name] == pytest.approx(told[name], abs=1e-5)
    np.testing.assert_array_equal(info["goal_pose"], told["goal_pose"])
    np.testing.assert_array_equal(env.intrinsics_4, house.intrinsics_4)
    total = 0.0
    for action in oracle.actions(house):
        real = house.step(action)[0]
        dreamt, reward, terminated, truncated, info = env.step(action)
        total += reward
        np.testing.assert_allclose(dreamt["pose"], real["pose"], atol=1e-4)
        assert dreamt in env.observation_space
        if terminated or truncated:
            break
    assert terminated
    assert info["success"]
    nearer = told["position_error"] - info["position_error"]
    np.testing.assert_allclose(total, nearer + env.config.success_reward, atol=1e-4)
    with pytest.raises(UserError, match="outside of an episode"):
        env.step(0)


def test_the_same_seed_imagines_the_same(params):
    def shown(env, seed):
        env.reset(seed=seed)
        return env.step(0)[0]

    env = world(params)
    one, other, again = shown(env, 1), shown(env, 2), shown(world(params), 1)
    np.testing.assert_array_equal(one["rgb"], again["rgb"])
    assert not np.array_equal(one["rgb"], other["rgb"])


def test_frames_of_ones_own_and_a_cost_of_ones_own(params):
    goal = jax.tree.map(lambda x: x[:1], seen(1))

    def cost(rgb):
        return float(np.abs(rgb.astype(float) - goal.rgb_THWC[0]).mean())

    env = WorldModelEnv(
        CONFIG,
        params,
        HouseConfig(task="image", max_steps=2),
        cost=cost,
        cost_at_most=-1.0,
        render_mode="rgb_array",
    )
    first, info = env.reset(seed=0, options={"frames": seen(), "goal": goal})
    np.testing.assert_array_equal(first["rgb"], seen().rgb_THWC[-1])
    np.testing.assert_array_equal(first["goal"], goal.rgb_THWC[0])
    assert info["cost"] == cost(first["rgb"])
    after, reward, terminated, truncated, told = env.step(0)
    assert reward == pytest.approx(info["cost"] - told["cost"])
    assert told["cost"] == cost(after["rgb"])
    assert (terminated, truncated) == (False, False)
    np.testing.assert_array_equal(env.render(), after["rgb"])
    assert env.step(0)[2:4] == (False, True)


def test_the_models_size_and_actions_count(params):
    env = world(params, height=99, width=7, step_m=0.5, turn_deg=90.0, max_steps=7)
    assert (env.config.height, env.config.width, env.config.max_steps) == (16, 16, 7)
    assert env.config.step_m == MODEL.actions.step_m
    assert env.config.turn_deg == MODEL.actions.turn_deg


def test_what_cannot_be_is_refused_in_a_sentence(params):
    env = world(params)
    for act, says in (
        (lambda: env.step(0), "outside of an episode"),
        (lambda: env.reset(options={"frames": seen()}), "got the options frames: pass frames"),
        (lambda: env.reset(options={"goals": 1, "frames": 2}), "got the options frames, goals"),
        (
            lambda: env.reset(
                options={
                    "frames": dataclasses.replace(seen(), depth_THW=np.zeros((3, 8, 8))),
                    "goal": seen(),
                }
            ),
            "start() got colours",
        ),
        (lambda: WorldModelEnv(CONFIG, params, render_mode="human"), "no render_mode 'human'"),
        (lambda: WorldModelEnv(CodecTask(), {}), "CodecTask has no actions"),
        (lambda: WorldModelEnv(CONFIG, params, render_mode="rgb_array").render(), "first reset"),
    ):
        with pytest.raises(UserError, match=re.escape(says)) as caught:
            act()
        assert str(caught.value).endswith(".")
    env.reset(seed=0)
    with pytest.raises(UserError, match="got the action 7"):
        env.step(7)


@pytest.mark.slow
def test_the_examples_of_the_page_run(monkeypatch, capsys, params):
    """With a tiny world of random weights in the place of the one that comes with the library."""
    monkeypatch.setattr(pewm_jax, "load", {"small": (CONFIG, params)}.__getitem__)
    exec(blocks("House-v0", "python") + blocks("WorldModelEnv", "python"), {})
    out = capsys.readouterr().out
    assert "'depth': ((64, 64), 'float32')" in out
    assert "m to walk" in out
    assert "True 0." in out
    assert "(16, 16, 3) False" in out
