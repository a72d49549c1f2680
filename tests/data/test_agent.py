"""Episodes of an articulated agent: its own body in the pictures, exact ids, states as actions."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest

from pewm_jax.bodies.humanoid import HUMANOID, arm_ids
from pewm_jax.config import ConfigError
from pewm_jax.data import checks
from pewm_jax.data.agent import open_agent, shapes
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode, settings_of
from pewm_jax.data.render import render
from pewm_jax.data.simulator import open_house
from pewm_jax.eval.metrics.arms import arms_by_colour, arms_iou

CONFIG = CollectConfig(
    Path("unused"),
    frames=24,
    size=48,
    step_m=0.12,
    turn_deg=10.0,
    turn_around=0.0,
    body="humanoid",
    ids=True,
    test_policy="follow",
)


@functools.cache
def episode(index=0, split="train"):
    return read_episode(make_episode(CONFIG, split, index))


def test_actions_are_the_states_of_the_next_frames_and_lead_to_the_poses():
    found = episode()
    assert found.states.shape == (24, 25)
    np.testing.assert_array_equal(found.actions, found.states[1:])
    assert found.action_ids is None
    assert checks.check_episode(found, "here") == []
    # The poses follow from the first one and the states alone.
    agent = open_agent("humanoid", CONFIG.camera_height)
    pose = agent.body.world_from_camera(np.zeros((1, 3)), found.states[:1], agent.scale)[0]
    base = found.world_from_camera[0] @ np.linalg.inv(pose.astype(np.float64))
    planar = [np.array([base[0, 3], base[1, 3], np.arctan2(base[1, 0], base[0, 0])])]
    for state in found.states[1:].astype(np.float64):
        x, y, yaw = planar[-1]
        planar.append(np.array([x, y, yaw + state[-1]]))
        planar[-1][:2] += state[-2] * np.array([np.cos(yaw), np.sin(yaw)])
    made = agent.body.world_from_camera(
        np.stack(planar), found.states, agent.scale, found.info["floor_z_m"]
    )
    np.testing.assert_allclose(made, found.world_from_camera, atol=1e-4)


def test_pictures_are_those_of_the_house_where_the_body_is_not():
    found = episode()
    ids, first = found.ids(), len(found.info["objects"])
    scene, _ = open_house(0, CONFIG.camera_height)
    house = render(scene, found.camera(), 48, 48)
    frames, body = found.frames(), ids >= first
    assert 0.005 < body.mean() < 0.5
    np.testing.assert_array_equal(frames.rgb_THWC[~body], house.rgb_THWC[~body])
    assert (frames.depth_THW[body] <= house.depth_THW[body] + 1e-3).all()
    assert set(np.unique(ids[body])) <= set(found.info["body"]["ids"].values())


def test_arms_are_found_by_their_colour():
    """In houses of all colours, so that a similar wall in one of them does not decide."""
    config = dataclasses.replace(CONFIG, size=64, frames=8)
    each = []
    for index in range(8):
        found = read_episode(make_episode(config, ("train", "revisit")[index % 2], index))
        true = np.isin(found.ids(), arm_ids(found.info))
        each.append(arms_iou(arms_by_colour(found.frames().rgb_THWC), true))
    assert np.isfinite(each).mean() > 0.5
    assert np.nanmean(each) >= 0.9


def test_every_shape_belongs_to_a_link_and_arms_have_one():
    made = shapes()
    assert set(HUMANOID.arms) <= set(made) <= set(HUMANOID.links)
    assert all(piece.solid() is not None for piece in made.values())


def test_the_body_is_as_tall_as_the_camera_is_high():
    for height in (1.0, 1.25):
        agent = open_agent("humanoid", height)
        pose = agent.camera(np.zeros((1, 3)), np.zeros((1, 25)), np.ones(4), 0.25)
        assert pose.world_from_camera[0, 2, 3] == pytest.approx(height + 0.25)
    assert arm_ids({}) == []


def test_episodes_depend_on_the_settings_alone_and_the_walk_stays_inside():
    assert make_episode(CONFIG, "train", 0) == episode().record
    _, grid = open_house(0, CONFIG.camera_height)
    away = episode().world_from_camera[:, :2, 3]
    cells = grid.cell_of(away)
    near = [grid.free_YX[max(r - 5, 0) : r + 6, max(c - 5, 0) : c + 6].any() for r, c in cells]
    assert all(near)  # the head leans out of the base's cell by less than half a metre
    assert "body" not in settings_of(dataclasses.replace(CONFIG, body=""), "train")
    assert settings_of(CONFIG, "train")["body"] == "humanoid"


def test_doors_and_robots_and_a_body_are_in_one_picture():
    moving = dataclasses.replace(CONFIG, moving=True, frames=6)
    found = read_episode(make_episode(moving, "train", 0))
    assert set(np.unique(found.ids())) & set(found.info["body"]["ids"].values())
    assert found.info["moving"]


@pytest.mark.parametrize("other", [{"continuous": True}, {"handheld": 0.5}])
def test_settings_that_contradict_a_body_are_refused(other):
    with pytest.raises(ConfigError, match="does not go together with --body humanoid"):
        dataclasses.replace(CONFIG, **other)


def test_a_revisit_keeps_its_turning_point():
    config = dataclasses.replace(
        CONFIG, test_policy="revisit", turn_deg=30.0, step_m=0.25, frames=96, size=16
    )
    found = read_episode(make_episode(config, "revisit", 0))
    turned = found.info["return_frame"]
    yaw = np.unwrap(np.cumsum(found.states[:, -1]))
    walk = found.states[: turned + 1]
    assert 0 < turned < 95
    assert walk[-1, -2] != 0 or walk[-1, -1] != 0
    assert np.isfinite(yaw).all()
    assert HUMANOID.name == found.info["body"]["name"]
