"""True actions against another house's and none on walks, paired by clip; a world that obeys."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import Config, UserError
from pewm_jax.eval import steering
from pewm_jax.eval.clips import choose
from pewm_jax.eval.walks import Walks, choose_walks, different_steps, forward_steps
from pewm_jax.geometry.actions import FORWARD, TURN_LEFT, TURN_RIGHT, discrete_table, integrate
from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.io.store import ResultCache
from pewm_jax.report import evaluation_page
from pewm_jax.report.labels import ACTIONS_NAMES, format_steering
from pewm_jax.report.page import render
from pewm_jax.types import Camera, Frames
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from tests.helpers import tiny_config

CONFIG = Config(model=EgoWM(), train=EgoWMTrainConfig())
PARAMS = {"control": {"kernel": np.ones(())}}
UNITS, IMAGINED = CONFIG.model.actions, CONFIG.model.clip.frames - 1


@pytest.fixture
def obeying(monkeypatch):
    """A world whose colour is the sum of its actions, times a weight of its control."""

    def imagined(config, params, context, actions, seed, numbers):
        weight = params.get("control", {"kernel": 1.0})["kernel"]
        colour = weight * jnp.asarray(actions).sum((1, 2))
        return jnp.broadcast_to(colour[:, None, None, None, None], (len(colour), 2, 4, 4, 3))

    def load_clip(config, episodes, choice):
        actions = np.full((2, 3), choice.start / 60, np.float32)
        rgb = np.full((2, 4, 4, 3), actions.sum() + 0.01, np.float32)
        present = Frames(np.zeros((1, 4, 4, 3), np.float32), np.zeros(()), np.zeros(()))
        return present, dataclasses.replace(present, rgb_THWC=rgb), actions

    def use(scenes, others):
        clips = [types.SimpleNamespace(start=k, scene=s, episode=k) for k, s in enumerate(scenes)]
        share = np.full(len(clips), 0.75)
        walks = Walks(clips, [clips[k] for k in others], share, share)
        monkeypatch.setattr(steering, "choose_walks", lambda *_: walks)
        return clips

    monkeypatch.setattr(steering, "_imagined", imagined)
    monkeypatch.setattr(steering, "load_clip", load_clip)
    return use


def test_true_actions_are_compared_with_those_of_another_house_with_none_and_with_a_copy(obeying):
    other = [2, 2, 4, 4, 0]
    obeying("aabbc", other)
    config = dataclasses.replace(CONFIG, evaluate=dataclasses.replace(CONFIG.evaluate, batch=2))
    found = steering.measure(config, PARAMS, [], 5)
    true = -10 * np.log10((0.01 / 2) ** 2)
    np.testing.assert_allclose(found.psnr["true"], true, atol=0.1)
    apart = 6 * (np.arange(5) - np.array(other)) / 60 + 0.01
    np.testing.assert_allclose(found.psnr["shuffled"], -20 * np.log10(abs(apart) / 2), atol=0.1)
    alone = 6 * np.arange(5) / 60 + 0.01
    for name in ("none", "copy"):  # the observed frame is as grey as what no action imagines
        np.testing.assert_allclose(found.psnr[name], -20 * np.log10(alone / 2), atol=0.1)
    table = found.table()
    assert table["true - shuffled"]["houses"] == 3
    assert table["true - shuffled"]["low"] > 0
    assert len(found.lines()) == 3 + len(ACTIONS_NAMES) - 6  # nothing is warped or painted
    assert "75.0 % of the steps go forward" in found.lines()[0]


def test_a_report_keeps_its_pieces_and_says_what_came_out(obeying, monkeypatch, tmp_path):
    choices = obeying("aabbc", [2, 2, 4, 4, 0])
    config = dataclasses.replace(CONFIG, evaluate=dataclasses.replace(CONFIG.evaluate, batch=2))
    partials = ResultCache.for_weights(tmp_path, "weights", "fingerprint")
    said = []
    found, about = steering.score(config, PARAMS, [], choices, partials, said.append)
    whole = steering.measure(config, PARAMS, [], 5)
    for name, errors in whole.errors.items():
        np.testing.assert_array_equal(found.errors[name], errors)
    monkeypatch.setattr(steering, "load_clip", None)  # nothing is imagined again
    again, _ = steering.score(config, PARAMS, [], choices, partials, said.append)
    np.testing.assert_array_equal(again.errors["none"], found.errors["none"])
    assert len(said) == 1
    other = dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, seeds=(3,)))
    with pytest.raises(TypeError):  # another seed is imagined anew
        steering.score(other, PARAMS, [], choices, partials, said.append)
    metrics = {"steering": found.facts(), "protocol": {"steering": about}}
    page = render("", [], [evaluation_page.steering(metrics)])
    assert page.count("<tr") == 2 + len(ACTIONS_NAMES) - 6
    assert f"{found.psnr['true'].mean():.2f} [" in page
    assert "75 % of their steps go forward" in page
    (sentence,) = format_steering(metrics)
    assert "its lead over another clip's actions: +" in sentence


def test_what_was_not_measured_is_said(obeying, monkeypatch, tmp_path):
    choices, said = obeying("ab", [1, 0]), []
    partials = ResultCache.for_weights(tmp_path, "weights", "fingerprint")
    unsteered = steering.score(tiny_config(), {}, [], choices, partials, said.append)
    assert unsteered == (None, None)
    monkeypatch.setattr(steering, "choose_walks", choose_walks)
    found, about = steering.score(CONFIG, PARAMS, [], [], partials, said.append)
    assert found is None
    assert said == []
    metrics = {"steering": None, "protocol": {"steering": about}}
    assert evaluation_page.steering(metrics) is None
    assert format_steering(metrics) == [about]
    assert about.startswith("Steering is not measured: no episode of")
    assert format_steering({"steering": None, "protocol": {"steering": None}}) == []


def test_a_world_that_warps_its_observed_frame_is_compared_with_warping_alone(monkeypatch):
    """A wall seen by one camera, which steps and turns: warping shows it where the truth does."""
    clip = dataclasses.replace(CONFIG.model.clip, height=16, width=16)
    model = dataclasses.replace(CONFIG.model, clip=clip, observed="warped")
    config = dataclasses.replace(CONFIG, model=model)
    move = np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]], np.float32)  # half a metre to the left
    intrinsics = np.full((1, 4), 8.0, np.float32)

    def load_clip(config, episodes, choice):
        poses = np.asarray(integrate(pose_from_yaw(np.zeros(3), 0.0), move))
        stripes = np.tile(np.arange(16, dtype=np.float32)[None, :, None] / 16, (16, 1, 3))
        depth = np.full((1, 16, 16), 2.0, np.float32)
        present = Frames(stripes[None], depth, Camera(intrinsics, poses[:1]))
        moved = stripes[:, (np.arange(16) - 2).clip(0)]  # by 8 pixels · 0.5 m / 2 m
        truth = dataclasses.replace(present, rgb_THWC=np.stack([stripes, moved]))
        return present, truth, move

    def imagined(config, params, context, control, seed, numbers):
        return jnp.full((len(control), 2, 16, 16, 3), 0.5)

    monkeypatch.setattr(steering, "load_clip", load_clip)
    monkeypatch.setattr(steering, "_imagined", imagined)
    clips = [types.SimpleNamespace(start=k, scene=s, episode=k) for k, s in enumerate("ab")]
    walks = Walks(clips, clips[::-1], np.full(2, 0.75), np.full(2, 0.75))
    monkeypatch.setattr(steering, "choose_walks", lambda *_: walks)
    found = steering.measure(config, PARAMS, [], 2)
    assert set(found.psnr) == {"true", "shuffled", "unembedded", "copy", "warp"}
    np.testing.assert_allclose(found.errors["copy"][:, 0], 0, atol=1e-6)
    assert (found.errors["copy"][:, 1] > 0.003).all()
    np.testing.assert_allclose(found.errors["warp"], 0, atol=1e-4)


def test_a_world_without_embeddings_of_actions_is_not_asked_for_none(obeying):
    obeying("ab", [1, 0])
    found = steering.measure(tiny_config(), {}, [], 2)
    assert set(found.psnr) == {"true", "shuffled", "copy"}


def episode(ids, scene, **info):
    """An episode of discrete actions, without pictures."""
    start = pose_from_yaw(np.array([0.3, -0.2, 1.25]), 0.7)
    poses = np.asarray(integrate(start, discrete_table(UNITS)[np.asarray(ids)]))
    return types.SimpleNamespace(
        world_from_camera=poses, length=len(poses), name=f"{scene}/walk", scene=scene, info=info
    )


def recorded(episodes, choice):
    """Return the discrete actions of a clip, from the poses, one by one."""
    poses = episodes[choice.episode].world_from_camera
    found = []
    for before, after in zip((choice.start, *choice.targets_N), choice.targets_N, strict=False):
        step = np.linalg.inv(poses[before]) @ poses[after]
        if np.linalg.norm(step[:3, 3]) > 0.5 * UNITS.step_m:
            found.append(FORWARD)
        else:
            found.append(TURN_LEFT if step[0, 2] < 0 else TURN_RIGHT)
    return np.array(found)


@pytest.mark.parametrize("seed", range(4))
def test_every_clip_is_a_walk_and_its_other_actions_differ_in_half_of_the_steps(seed):
    rng = np.random.default_rng(seed)
    share = rng.uniform(0.3, 0.9, 6)
    episodes = [
        episode(rng.choice(3, 63, p=[p, (1 - p) / 2, (1 - p) / 2]), f"house-{k // 2}")
        for k, p in enumerate(share)
    ]
    walks = choose_walks(CONFIG, episodes, 12)
    assert 6 <= len(walks.choices) <= 12
    assert len({(c.episode, c.start) for c in walks.choices}) == len(walks.choices)
    facts = zip(walks.choices, walks.others, walks.forward_C, walks.different_C, strict=True)
    for choice, other, forward, different in facts:
        true, shuffled = recorded(episodes, choice), recorded(episodes, other)
        assert len(true) == len(shuffled) == IMAGINED
        assert forward == (true == FORWARD).mean() >= 0.5
        assert different == (true != shuffled).mean() >= 0.5
        assert choice.scene != other.scene
        assert choice.start >= episodes[choice.episode].length // 2
    again = choose_walks(CONFIG, episodes, 12)
    assert (again.choices, again.others) == (walks.choices, walks.others)
    assert set(range(6)) >= {
        c.episode for c in choose_walks(CONFIG, episodes, 12, 1, [2, 5]).choices
    }


def test_spins_are_skipped_and_refused_where_there_is_nothing_else():
    spin = [TURN_LEFT] * 63
    walk = [FORWARD, FORWARD, TURN_LEFT, FORWARD, FORWARD, TURN_RIGHT] * 10
    spins = [episode(spin, "a"), episode(spin, "b")]
    assert choose(CONFIG, spins, 4, 1)  # a report scores them
    with pytest.raises(UserError, match="fewer than half of the steps go forward"):
        choose_walks(CONFIG, spins, 4)
    mixed = [episode(spin, "a"), episode(walk, "b"), episode(spin, "c")]
    walks = choose_walks(CONFIG, mixed, 6)
    assert {choice.scene for choice in walks.choices} == {"b"}
    assert {other.scene for other in walks.others} <= {"a", "c"}
    with pytest.raises(UserError, match="has a partner with different actions"):
        choose_walks(CONFIG, [episode(walk, "b")] * 2, 4)  # of one house
    straight = [episode([FORWARD] * 63, scene) for scene in "ab"]
    with pytest.raises(UserError, match="has a partner with different actions"):
        choose_walks(CONFIG, straight, 4)  # all go the same way
    with pytest.raises(UserError, match="long enough for 9 frames"):
        choose_walks(CONFIG, [episode(walk[:5], "a")], 4)


def test_clips_that_cannot_show_steering_are_no_walks():
    a, b = (types.SimpleNamespace(scene=scene) for scene in "ab")
    half = np.array([0.5])
    assert "1 walks in 1 houses" in Walks([a], [b], half, half).about
    for pair in ((half - 0.1, half), (half, half - 0.1)):
        with pytest.raises(ValueError, match="40%"):
            Walks([a], [b], *pair)
    with pytest.raises(ValueError, match="its own house"):
        Walks([a], [a], half, half)


def test_continuous_motion_is_told_apart_in_steps_and_turns():
    step, turn = UNITS.step_m, np.radians(UNITS.turn_deg)
    motion = np.array([[step, 0, 0], [0.9 * step, 0, 0.5 * turn], [0, 0, turn], [0, 0, 0]])
    assert forward_steps(UNITS, motion).tolist() == [True, True, False, False]
    assert not different_steps(UNITS, motion, motion).any()
    noisy = motion + np.array([0.2 * step, 0.1 * step, 0.2 * turn])
    assert not different_steps(UNITS, motion, noisy).any()
    assert different_steps(UNITS, motion[:3], motion[[2, 3, 0]]).all()
    around = np.array([0, 0, np.pi - 0.01]), np.array([0, 0, -np.pi + 0.01])
    assert not different_steps(UNITS, *around)
