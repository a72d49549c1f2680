"""Steering of an agent with a body: clips of any posture, its own state, its arms in the score."""

import dataclasses
import functools
import types
from pathlib import Path

import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.config import ClipConfig, UserError
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode
from pewm_jax.eval import clips, evaluate, steering
from pewm_jax.eval.metrics.structure import Consistency, follow_by_flow
from pewm_jax.eval.walks import choose_walks
from pewm_jax.report import evaluation_page
from pewm_jax.report.labels import format_steering
from pewm_jax.report.page import render
from pewm_jax.types import Control

SIZE, IMAGINED = 32, 4


@functools.cache
def config():
    loaded = presets.load("egowm_humanoid")
    assert loaded.model.observed == "warped"
    model = dataclasses.replace(
        loaded.model, clip=ClipConfig(frames=IMAGINED + 1, height=SIZE, width=SIZE)
    )
    evaluate = dataclasses.replace(loaded.evaluate, chain=2, batch=2, clips=3)
    data = dataclasses.replace(loaded.data, context=2)
    return dataclasses.replace(loaded, model=model, evaluate=evaluate, data=data)


@functools.cache
def episodes():
    collected = CollectConfig(
        Path("unused"),
        frames=28,
        size=SIZE,
        step_m=0.12,
        turn_deg=10.0,
        turn_around=0.0,
        body="humanoid",
        ids=True,
        test_policy="follow",
    )
    return [read_episode(make_episode(collected, "revisit", k)) for k in range(3)]


@pytest.fixture
def told(monkeypatch):
    """A world that imagines what truly followed the actions it is given, wherever it is."""
    seen = []

    def imagined(config, params, context, control, seed, numbers):
        seen.append(control)
        made = []
        for actions in control.actions_TA:
            made += [
                episode.frames(range(start + 1, start + 9)).rgb_THWC
                for episode in episodes()
                for start in range(episode.length - 8)
                if np.array_equal(episode.actions[start : start + 8], actions)
            ]
        if not params["control"]["kernel"].any():
            made = [np.zeros_like(x) for x in made]
        return np.stack(made).astype(np.float32) / 127.5 - 1

    class Jax:
        jit = staticmethod(lambda function, **_: function)
        tree, lax = steering.jax.tree, steering.jax.lax

    monkeypatch.setattr(steering, "_imagined", imagined)
    monkeypatch.setattr(steering, "jax", Jax)
    return seen


def test_clips_need_not_walk_and_partners_move_differently():
    walks = choose_walks(config(), episodes(), 6, 2)
    assert walks.recorded
    assert len(walks.choices) == 6
    assert walks.different_C.min() >= 0.5
    for one, other in zip(walks.choices, walks.others, strict=True):
        assert one.scene != other.scene
        assert len(one.targets_N) == 2 * IMAGINED
    assert walks.about.startswith("6 clips in 3 houses")


def test_the_control_has_the_state_of_the_present_frame():
    choice = clips.choose(config(), episodes(), 3, 2)[1]
    control = clips.load_clip(config(), episodes(), choice)[2]
    episode = episodes()[choice.episode]
    np.testing.assert_array_equal(control.state_A, episode.states[choice.start])
    batch = clips.stack([control, control], 2)
    later = clips.later_control(batch, IMAGINED, IMAGINED)
    np.testing.assert_array_equal(later.state_A[0], episode.states[choice.start + IMAGINED])
    np.testing.assert_array_equal(later.actions_TA, batch.actions_TA[:, IMAGINED:])
    first = clips.later_control(batch, 0, IMAGINED)
    np.testing.assert_array_equal(first.state_A, batch.state_A)


def test_arms_and_objects_are_scored_by_kind_of_actions(told):
    params = {"control": {"kernel": np.ones(1, np.float32)}}
    measures = steering.Measures(None, Consistency(follow_by_flow, "flow"), arms=True)
    assert steering.shows_arms(episodes())
    found = steering.measure(config(), params, episodes(), 3, measures=measures)
    assert all(isinstance(control, Control) for control in told)
    np.testing.assert_allclose(told[0].state_A, told[1].state_A)  # the own state stays
    assert np.abs(told[0].actions_TA - told[1].actions_TA).max() > 0.1
    walks = choose_walks(config(), episodes(), 3, 2)
    own, other = (episodes()[x[0].episode] for x in (walks.choices, walks.others))
    targets = list(walks.choices[0].targets_N)
    np.testing.assert_allclose(
        told[0].camera.world_from_camera[0], own.world_from_camera[targets], atol=1e-6
    )
    moved = told[1].camera.world_from_camera[0]  # to where the other's actions lead
    assert np.abs(moved - told[0].camera.world_from_camera[0]).max() > 0.05
    here = own.world_from_camera[walks.choices[0].start]
    there = other.world_from_camera[[walks.others[0].start, *walks.others[0].targets_N]]
    heights = there[1:, 2, 3] - there[0, 2, 3]
    np.testing.assert_allclose(np.diff(moved[:, 2, 3]), np.diff(heights), atol=1e-4)
    assert abs(moved[0, 2, 3] - here[2, 3]) < 0.2
    facts = found.facts()
    arms, scs = (facts["scores"][name]["all"] for name in ("arms", "scs"))
    assert arms["true"]["mean"] == pytest.approx(arms["truth"]["mean"])
    assert arms["true"]["mean"] > 0.8
    assert arms["shuffled"]["mean"] < 0.5 * arms["true"]["mean"]
    assert "none" not in arms  # the warped frame follows the actions
    assert "unembedded" in arms
    assert arms["warp"]["mean"] < arms["paint"]["mean"] < arms["true"]["mean"]
    assert scs["true"]["mean"] == pytest.approx(scs["truth"]["mean"])
    assert scs["true"]["mean"] > scs["shuffled"]["mean"]
    assert facts["all"]["true"]["mean"] > 60
    assert "truth" not in facts["all"]
    assert len(facts["scores"]["arms"]["per_frame"]["true"]["mean"]) == 8
    page = render("", [], [evaluation_page.steering({"steering": facts, "protocol": {}})])
    assert "IoU of the arms" in page
    assert "frame 8" in page
    sentences = format_steering({"steering": facts, "protocol": {}})
    assert any(one.startswith("IoU of the arms, true actions / another") for one in sentences)
    lines = found.lines()
    assert "frame 8" in lines[1]
    number = f"{arms['true']['mean']:.3f}"
    assert any(number in line for line in lines[lines.index("IoU of the arms") :])


def test_without_a_known_body_it_is_unknown_where_other_actions_lead():
    choice = clips.choose(config(), episodes(), 3, 2)[1]
    control = clips.load_clip(config(), episodes(), choice)[2]
    actions = np.zeros_like(control.actions_TA)
    episode = dataclasses.replace(episodes()[choice.episode], info={})
    with pytest.raises(UserError, match="known for a known body alone"):
        steering.with_actions(config(), episode, choice.start, control, actions)
    plain = [dataclasses.replace(one, info={}) for one in episodes()]
    choices = clips.choose(config(), plain, 3, 2)
    steered, reason = steering.score(config(), {}, plain, choices, None, print)
    assert steered is None
    assert reason.startswith("Steering is not measured: this world sees the cameras")
    model = dataclasses.replace(config().model, observed="every")
    unseen = dataclasses.replace(config(), model=model)
    found = steering.with_actions(unseen, episode, choice.start, control, actions)
    assert found.camera is control.camera
    assert not np.any(found.actions_TA)


def test_a_report_measures_steering_although_the_camera_on_the_head_moves_freely(monkeypatch):
    choices = clips.choose(config(), episodes(), 3, 2)
    assert clips.needs_cameras(episodes(), choices)
    for name in ("score_table", "roll_long", "mirror_test"):
        monkeypatch.setattr(evaluate, name, lambda *_, **__: None)
    monkeypatch.setattr(evaluate, "way_out", lambda *_: (None, None))
    monkeypatch.setattr(evaluate.voxel_report, "score", lambda *_: None)
    asked = []
    monkeypatch.setattr(
        evaluate.steering, "score", lambda *given: asked.append(given[-1]) or ("scores", "clips")
    )
    metrics = types.SimpleNamespace(lpips=None, i3d=None, structure=None, visits={})
    loaded = types.SimpleNamespace(params={})
    job = types.SimpleNamespace(
        config=config(), episodes=episodes(), metrics=metrics, loaded=loaded
    )
    methods = types.SimpleNamespace(remembers=False, model=types.SimpleNamespace(cameras=True))
    measured = evaluate._measure(job, methods, None, choices, [], print)
    assert measured.steered == "scores"
    assert asked == [steering.Measures(arms=True)]


def test_episodes_without_a_body_have_no_arms():
    plain = dataclasses.replace(episodes()[0], info={})
    assert not steering.shows_arms([plain])
    assert not steering.shows_arms([])
