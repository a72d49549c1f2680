"""House-v0: Gymnasium's rules, goals within bounds, walls that hold, refusals in a sentence."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import trimesh
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

import pewm_jax.planning
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.navigation import is_free, line_is_free, shortest_path
from pewm_jax.data.simulator import move, open_simulator
from pewm_jax.geometry.cameras import transform_points
from pewm_jax.planning import observations, oracle, scores
from pewm_jax.planning.house import HouseEnv
from pewm_jax.planning.house_config import HouseConfig
from tests.data.two_rooms import two_rooms
from tests.properties import examples

ROOT = Path(__file__).parents[2]
SMALL = {"height": 12, "width": 16}


def house(**settings):
    return HouseEnv(**{**SMALL, **settings})


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    """A room of 5 × 3 m, as a file."""
    room = trimesh.creation.box([5, 3, 2.5])
    room.invert()
    room.apply_translation([0, 0, 1.25])
    path = tmp_path_factory.mktemp("mesh") / "room.ply"
    room.export(path)
    return path


def equal(a, b):
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("task", ["point", "image"])
def test_gymnasium_finds_nothing_wrong(actions, task):
    env = gymnasium.make(
        pewm_jax.planning.HOUSE_ID, actions=actions, task=task, render_mode="rgb_array", **SMALL
    )
    check_env(env.unwrapped)
    env.close()


def test_every_episode_lies_within_its_bounds_and_says_so():
    env = house(min_distance_m=2.0, max_distance_m=4.0, task="image")
    for seed in range(8):
        seen, info = env.reset(seed=seed)
        assert 2 <= info["geodesic_distance"] == info["shortest_path"] <= 4
        task = env.task
        way = shortest_path(env.grid, task.start_3[:2], task.goal_3[:2])
        length = np.linalg.norm(np.diff(way, axis=0), axis=-1).sum()
        np.testing.assert_allclose(info["shortest_path"], length)
        np.testing.assert_allclose(info["goal_pose"][:2, 3], task.goal_3[:2], atol=1e-5)
        goal = env._simulator.frames(task.goal_3[None])
        np.testing.assert_array_equal(seen["goal"], goal.rgb_THWC[0])


def test_houses_of_one_split_are_drawn():
    env = house(house=2, houses=2)
    names = {env.reset(seed=seed)[1]["scene"] for seed in range(12)}
    assert names == {"house-000002", "house-000005"}


def test_what_is_seen_is_what_episodes_hold():
    """The goal in the agent's frame is the goal in the world; depth and pose are the renderer's."""
    env = house()
    seen, info = env.reset(seed=1)
    forward, left = seen["goal"]
    ahead = np.array([[-left, 0.0, forward]])  # OpenCV: x to the right, z forward
    np.testing.assert_allclose(
        transform_points(seen["pose"], ahead)[0, :2], info["goal_pose"][:2, 3], atol=1e-4
    )
    frames = observations.frames_of([seen, seen], env.intrinsics_4)
    again = env._simulator.frames(env.planar[None])
    np.testing.assert_array_equal(frames.depth_THW[1], again.depth_THW[0])
    np.testing.assert_array_equal(frames.camera.world_from_camera[0], seen["pose"])
    np.testing.assert_array_equal(frames.camera.intrinsics_4[0], env.intrinsics_4)
    assert frames.depth_THW.min() > 0


def test_looking_around_ends_where_it_began_and_changes_nothing():
    env = house()
    seen, _ = env.reset(seed=2)
    around = env.look_around()
    assert around.depth_THW.shape == (12, 12, 16)
    np.testing.assert_array_equal(around.rgb_THWC[-1], seen["rgb"])
    np.testing.assert_array_equal(around.camera.world_from_camera[-1], seen["pose"])
    yaw = observations.planar_of(around.camera.world_from_camera)[:, 2]
    np.testing.assert_allclose(np.diff(np.unwrap(yaw)), np.radians(30), atol=1e-5)
    turned = env.step(1)[0]
    np.testing.assert_allclose(around.camera.world_from_camera[0], turned["pose"], atol=1e-6)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("degrees", [180.0, 16.0])
def test_the_oracle_reaches_every_goal_and_the_rewards_add_up(actions, degrees):
    env = house(actions=actions, success_deg=degrees)
    for seed in range(3):
        _, first = env.reset(seed=seed)
        total, walked = 0.0, [env.planar]
        for action in oracle.actions(env):
            _, reward, terminated, truncated, info = env.step(action)
            total += reward
            walked.append(env.planar)
            assert terminated == info["success"]
            assert not truncated
            assert not info["collision"]
        assert info["success"]
        assert info["geodesic_distance"] <= 0.5
        assert np.degrees(info["yaw_error"]) <= degrees
        left = first["geodesic_distance"] - info["geodesic_distance"]
        np.testing.assert_allclose(total, left + env.config.success_reward)
        np.testing.assert_allclose(info["path_length"], scores.path_length(walked))
        np.testing.assert_allclose(info["spl"], min(1, info["shortest_path"] / info["path_length"]))
        assert info["spl"] > 0.9
        with pytest.raises(UserError, match="outside of an episode"):
            env.step(env.action_space.sample())


def test_an_episode_is_cut_off():
    env = house(max_steps=3)
    env.reset(seed=0)
    ends = [env.step(1)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


ROOMS = two_rooms()
FREE = np.argwhere(ROOMS.free_YX)
NUMBER = st.floats(-0.6, 0.6)


@given(
    cell=st.integers(0, len(FREE) - 1),
    inside=st.tuples(st.floats(-0.499, 0.499), st.floats(-0.499, 0.499)),
    yaw=st.floats(-4, 4),
    moves=st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=1, max_size=6),
    sliding=st.booleans(),
)
@examples(150)
def test_no_move_ends_in_a_wall_or_leads_through_one(cell, inside, yaw, moves, sliding):
    planar = np.array([*(ROOMS.centre_of(FREE[cell]) + np.array(inside) * ROOMS.cell_m), yaw])
    for action in moves:
        after, collided = move(ROOMS, planar, np.array(action), sliding=sliding)
        assert is_free(ROOMS, after[:2])
        assert line_is_free(ROOMS, planar[:2], after[:2])
        assert -np.pi < after[2] <= np.pi
        turned = (after[2] - planar[2] - action[2] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(turned, 0, atol=1e-9)
        travelled = np.linalg.norm(after[:2] - planar[:2])
        if not collided:
            np.testing.assert_allclose(travelled, np.hypot(*action[:2]), atol=1e-9)
        elif not sliding:
            assert travelled == 0
        else:
            assert travelled <= np.hypot(*action[:2]) + 1e-9
        planar = after


def test_at_a_wall_one_stays_or_slides_along_it():
    at_wall, slanted = np.array([2.75, 1.0, 0.0]), np.array([0.2, 0.25, 0.0])
    stayed, collided = move(ROOMS, at_wall, slanted)
    assert collided
    np.testing.assert_array_equal(stayed, at_wall)
    slid, collided = move(ROOMS, at_wall, slanted, sliding=True)
    assert collided
    np.testing.assert_allclose(slid, [2.75, 1.25, 0.0])


def test_walls_hold_in_a_house_too():
    env = house(actions="continuous", max_steps=80)
    env.reset(seed=4)
    env.action_space.seed(0)
    collisions = 0
    for _ in range(60):
        before = env.planar
        info = env.step(env.action_space.sample())[4]
        assert is_free(env.grid, env.planar[:2])
        assert info["collision"] == (info["collision"] and np.all(before[:2] == env.planar[:2]))
        collisions += info["collision"]
        if info["success"]:
            break
    assert collisions


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_several_houses_step_at_once(mode):
    options = {"vector_kwargs": {"context": "spawn"}} if mode == "async" else {}
    envs = gymnasium.make_vec(
        pewm_jax.planning.HOUSE_ID, num_envs=2, vectorization_mode=mode, **options, **SMALL
    )
    seen, info = envs.reset(seed=[5, 6])
    after = envs.step(np.array([0, 1]))
    envs.close()
    for row, seed in enumerate((5, 6)):
        env = house()
        alone, told = env.reset(seed=seed)
        equal(alone, {name: value[row] for name, value in seen.items()})
        np.testing.assert_array_equal(info["goal_pose"][row], told["goal_pose"])
        alone, reward, *_ = env.step(row)
        equal(alone, {name: value[row] for name, value in after[0].items()})
        assert after[1][row] == reward


def test_a_mesh_is_walked_like_a_house(mesh):
    env = house(scene=str(mesh), max_distance_m=4.0)
    seen, info = env.reset(seed=0)
    assert info["scene"] == "room"
    assert seen["pose"][2, 3] == pytest.approx(1.25, abs=1e-3)
    for action in oracle.actions(env):
        info = env.step(action)[4]
    assert info["success"]


def test_the_simulator_shares_scenes():
    one, other = (open_simulator(house_seed=0, height=size) for size in (8, 12))
    assert one.scene is other.scene
    assert one.frames(np.zeros((1, 3))).depth_THW.shape == (1, 8, 64)


@pytest.mark.parametrize(
    ("kind", "action"),
    [
        ("discrete", 3),
        ("discrete", -1),
        ("discrete", 0.0),
        ("discrete", [0, 1]),
        ("discrete", None),
        ("continuous", [np.nan, 0, 0]),
        ("continuous", [0, np.inf, 0]),
        ("continuous", [0.26, 0, 0]),
        ("continuous", [0, 0]),
        ("continuous", 0),
        ("continuous", "forward"),
    ],
)
def test_actions_outside_of_the_space_are_refused_and_change_nothing(kind, action):
    env = house(actions=kind)
    env.reset(seed=0)
    before = env.planar
    with pytest.raises(UserError, match=r"^step\(\) got the action .*\.$"):
        env.step(action)
    np.testing.assert_array_equal(env.planar, before)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"taks": "image"}, "no setting 'taks' (did you mean task?)"),
        ({"task": "sound"}, "House.task is 'sound': use point or image."),
        ({"height": 0}, "House.height is 0"),
        ({"house": -1}, "House.house is -1"),
        ({"max_steps": 1.5}, "House.max_steps is 1.5"),
        ({"success_m": float("nan")}, "House.success_m is nan: use a number."),
        ({"step_m": 0}, "actions.step_m is 0"),
        ({"turn_deg": 200}, "actions.turn_deg is 200"),
        ({"hfov": 180}, "House.hfov is 180"),
        ({"camera_height": 0}, "House.camera_height is 0"),
        ({"success_deg": 0}, "House.success_deg is 0"),
        ({"success_m": 2.0}, "House.min_distance_m is 1.0"),
        ({"min_distance_m": 9, "max_distance_m": 8}, "House.min_distance_m is 9"),
        ({"render_mode": "human"}, "House has no render_mode 'human'"),
        ({"scene": "nowhere.glb"}, "nowhere.glb is not a file"),
    ],
)
def test_settings_that_cannot_work_are_refused_in_a_sentence(settings, says):
    with pytest.raises(UserError) as caught:
        HouseEnv(**settings)
    assert says in str(caught.value)
    assert str(caught.value).endswith(".")


def test_calls_at_the_wrong_time_are_refused(mesh):
    env = house(render_mode="rgb_array")
    for act in (env.render, env.look_around, env.goal_frame, lambda: oracle.actions(env)):
        with pytest.raises(UserError, match="call reset"):
            act()
    with pytest.raises(UserError, match="call reset"):
        env.step(0)
    with pytest.raises(UserError, match="no options, got goal"):
        env.reset(options={"goal": 1})
    with pytest.raises(ConfigError, match="House"):
        HouseConfig(up="x")
    with pytest.raises(UserError, match="one of the two"):
        HouseEnv(HouseConfig(), task="image")
    wide = house(scene=mesh, min_distance_m=10.0)
    with pytest.raises(
        UserError, match=r"room has no two places with .* from 10 to 30 m .* are [2-5]\.\d"
    ):
        wide.reset(seed=0)


def test_the_oracle_says_where_it_knows_no_way(mesh):
    env = house(scene=mesh, max_distance_m=4.0, step_m=2.0, turn_deg=180.0, success_deg=5.0)
    env.reset(seed=0)
    with pytest.raises(UserError, match="do not lead to this goal"):
        oracle.actions(env)
    with pytest.raises(UserError, match="the oracle needs a house"):
        oracle.actions(gymnasium.make("CartPole-v1"))


def test_every_setting_is_explained():
    text = (ROOT / "pewm_jax/planning/house_config.py").read_text()
    for field in dataclasses.fields(HouseConfig):
        before, _, after = text.partition(f"    {field.name}: ")
        assert before != text
        assert after.partition("\n")[2].lstrip().startswith('"""'), field.name


def test_without_gymnasium_the_rest_works_and_the_house_is_refused_in_a_sentence():
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "import pewm_jax, pewm_jax.planning.scores, pewm_jax.planning.imagined\n"
        "try: import pewm_jax.planning.house\n"
        "except pewm_jax.UserError as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "pip install 'pewm-jax[planning]'" in done.stdout
    assert done.stdout.count("\n") == 1
