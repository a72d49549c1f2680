"""Kinematics by a list of joints: angles turn what hangs from a joint, and nothing else."""

import dataclasses
import re

import numpy as np
import pytest

from pewm_jax.bodies.humanoid import HUMANOID
from pewm_jax.bodies.kinematics import FORWARD, TURN, Body, Freedom, Joint, advance, walking
from pewm_jax.config import ConfigError, UserError

STILL = np.zeros((1, 3))


def at(link, *, planar=(0.0, 0.0, 0.0), scale=1.0, **angles):
    """Pose of a link of the humanoid with all joints at 0 but some."""
    state = np.zeros((1, HUMANOID.size))
    for name, value in angles.items():
        state[0, HUMANOID.index(name)] = value
    poses = HUMANOID.poses(np.array([planar]), state, scale)
    return poses[0, HUMANOID.links.index(link)]


def test_the_humanoid_has_the_degrees_of_freedom_of_the_data_set():
    names = [one.name for one in HUMANOID.freedoms]
    assert len(names) == 25
    assert names[0] == "hip_yaw"
    assert names[6] == "left_shoulder_pitch"
    assert names[13] == "right_shoulder_pitch"
    assert names[20:] == [
        "neck_pitch",
        "left_hand_closure",
        "right_hand_closure",
        "linear_velocity",
        "angular_velocity",
    ]
    moved = {joint.freedom for joint in HUMANOID.joints} - {""}
    assert moved == set(names[:-2])


def test_links_are_rigid_and_every_angle_moves_what_hangs_from_its_joint():
    rng = np.random.default_rng(0)
    planar = rng.uniform(-1, 1, (4, 3))
    state = rng.uniform(HUMANOID.low, HUMANOID.high, (4, HUMANOID.size))
    poses = HUMANOID.poses(planar, state)
    turn = poses[..., :3, :3]
    np.testing.assert_allclose(turn @ np.swapaxes(turn, -1, -2), np.eye(3) + 0 * turn, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turn), 1)
    parents = {joint.name: joint.parent for joint in HUMANOID.joints}

    def hangs(link, freedom):
        while link:
            if next(j for j in HUMANOID.joints if j.name == link).freedom == freedom:
                return True
            link = parents[link]
        return False

    for k, freedom in enumerate(HUMANOID.freedoms[:-2]):
        other = state.copy()
        other[:, k] = freedom.low + (freedom.high - state[:, k])
        changed = np.abs(HUMANOID.poses(planar, other) - poses).max((0, 2, 3)) > 1e-9
        assert changed.tolist() == [hangs(link, freedom.name) for link in HUMANOID.links]


def test_arms_rise_to_the_front_and_to_their_own_side():
    for side, sign in (("left", 1), ("right", -1)):
        hand = f"{side}_hand"
        hanging = at(hand)[:3, 3]
        raised = at(hand, **{f"{side}_shoulder_pitch": np.pi / 2})[:3, 3]
        np.testing.assert_allclose(raised - hanging, [0.52, 0, 0.52], atol=1e-9)
        aside = at(hand, **{f"{side}_shoulder_roll": np.pi / 2})[:3, 3]
        np.testing.assert_allclose(aside - hanging, [0, 0.52 * sign, 0.52], atol=1e-9)
        bent = at(hand, **{f"{side}_elbow_pitch": np.pi / 2})[:3, 3]
        np.testing.assert_allclose(bent - hanging, [0.25, 0, 0.25], atol=1e-9)
        tip = at(f"{side}_fingers", **{f"{side}_hand_closure": 1.0}) @ [0, 0, -1.0, 0]
        assert sign * tip[1] < -0.9  # towards the palm, which faces the body


def test_left_and_right_mirror_each_other():
    rng = np.random.default_rng(1)
    names = [one.name for one in HUMANOID.freedoms]
    angles = {
        name.removeprefix("left_"): rng.uniform(-0.5, 0.5)
        for name in names
        if name.startswith("left_")
    }
    mirror = np.diag([1.0, -1, 1])
    for link in ("upper_arm", "forearm", "hand", "fingers", "thumb"):
        left, right = (
            at(f"{side}_{link}", **{f"{side}_{name}": value for name, value in angles.items()})
            for side in ("left", "right")
        )
        np.testing.assert_allclose(mirror @ left[:3, 3], right[:3, 3], atol=1e-12)
        np.testing.assert_allclose(mirror @ left[:3, :3] @ mirror, right[:3, :3], atol=1e-12)


def test_a_crouch_keeps_the_torso_upright_and_lowers_it():
    crouch = at("torso", ankle_pitch=0.3, knee_pitch=0.6, hip_pitch=0.3)
    np.testing.assert_allclose(crouch[:3, :3], np.eye(3), atol=1e-12)
    assert crouch[2, 3] < at("torso")[2, 3] - 0.03


def test_the_camera_is_on_the_head_and_looks_where_the_body_goes():
    pose = HUMANOID.world_from_camera(np.array([[1.0, 2.0, 0.7]]), np.zeros((1, 25)), 2.0, 0.5)[0]
    ahead = [np.cos(0.7), np.sin(0.7), 0]
    np.testing.assert_allclose(pose[:3, 2], ahead, atol=1e-6)
    np.testing.assert_allclose(pose[:3, 1], [0, 0, -1], atol=1e-6)
    assert pose[2, 3] == pytest.approx(0.5 + 2 * HUMANOID.eye_m)
    down = np.zeros((1, 25))
    down[0, HUMANOID.index("neck_pitch")] = 0.4
    assert HUMANOID.world_from_camera(STILL, down)[0, 2, 2] == pytest.approx(-np.sin(0.4), abs=1e-6)


def test_walking_is_recovered_from_positions():
    rng = np.random.default_rng(2)
    moves = np.stack([rng.uniform(0, 0.3, 9), rng.uniform(-0.6, 0.6, 9)], 1)
    planar = [np.array([0.3, -0.1, 3.0])]
    for move in moves:
        planar.append(advance(planar[-1], move))
    found = walking(np.stack(planar))
    np.testing.assert_allclose(found[1:], moves, atol=1e-12)
    assert not found[0].any()


def test_cameras_follow_from_actions_wherever_the_body_stands():
    rng = np.random.default_rng(4)
    states = rng.uniform(0.3 * HUMANOID.low, 0.3 * HUMANOID.high, (6, HUMANOID.size))
    planar = [np.array([0.3, -0.1, 3.0])]
    for state in states[1:]:
        planar.append(advance(planar[-1], state))
    poses = HUMANOID.world_from_camera(np.stack(planar), states, 1.7, floor_z=0.4)
    found = HUMANOID.cameras_along(poses[0], states[0], states[1:], 1.7)
    np.testing.assert_allclose(found, poses[1:], atol=1e-5)


WALK = (Freedom(FORWARD, -1, 1), Freedom(TURN, -1, 1))
ONE = Body("one", (Freedom("a", -1, 1), *WALK), (Joint("arm", "", (0, 0, 1), freedom="a"),), "arm")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"freedoms": WALK[::-1]}, "the last two degrees of freedom must be linear_velocity"),
        ({"joints": ONE.joints * 2}, "two links of one name"),
        ({"joints": (Joint("arm", "leg", (0, 0, 1)),)}, "comes before its parent 'leg'"),
        ({"joints": (Joint("arm", "", (0, 0, 1), freedom="b"),)}, "is moved by 'b'"),
        ({"joints": (Joint("arm", "", (0, 0, 1), (1, 1, 0)),)}, "has length 1.41, not 1"),
        ({"eyes": "head"}, "has no link 'head'"),
        ({"freedoms": (Freedom("a", 1, 2), *WALK)}, "a rests at 0.0, outside 1 … 2"),
    ],
)
def test_inconsistent_lists_are_refused(changes, says):
    with pytest.raises(ConfigError, match=re.escape(says)):
        dataclasses.replace(ONE, **changes)


def test_states_of_another_body_are_refused():
    with pytest.raises(UserError, match=re.escape("give (T, 3) and (T, 25)")):
        HUMANOID.poses(STILL, np.zeros((1, 3)))
