"""True actions against another house's and none, paired by clip, with a world that obeys."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import Config, EgoWMConfig, EgoWMTrainConfig, UserError
from pewm_jax.evaluation import page_tables, steering
from pewm_jax.evaluation.partial import Partials
from pewm_jax.evaluation.words import ACTIONS_NAMES, followed
from tests.helpers import tiny_config

CONFIG = Config(model=EgoWMConfig(), train=EgoWMTrainConfig())
PARAMS = {"control": {"kernel": np.ones(())}}


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
        return np.zeros(1), types.SimpleNamespace(rgb_THWC=rgb), actions

    def stack(trees, size):
        trees = trees + [trees[-1]] * (size - len(trees))
        if hasattr(trees[0], "rgb_THWC"):
            return types.SimpleNamespace(rgb_THWC=np.stack([t.rgb_THWC for t in trees]))
        return np.stack(trees)

    def use(scenes):
        choices = [types.SimpleNamespace(start=k, scene=s) for k, s in enumerate(scenes)]
        monkeypatch.setattr(steering, "choose", lambda *_: choices)

    monkeypatch.setattr(steering, "_imagined", imagined)
    monkeypatch.setattr(steering, "load_clip", load_clip)
    monkeypatch.setattr(steering, "stack", stack)
    return use


def test_true_actions_are_compared_with_those_of_another_house_and_with_none(obeying):
    obeying("aabbc")
    config = dataclasses.replace(CONFIG, evaluate=dataclasses.replace(CONFIG.evaluate, batch=2))
    found = steering.measure(config, PARAMS, [], 5)
    true = -10 * np.log10((0.01 / 2) ** 2)
    np.testing.assert_allclose(found.psnr["true"], true, atol=0.1)
    other = np.array([2, 2, 4, 4, 0])  # the next clip of another house
    apart = 6 * (np.arange(5) - other) / 60 + 0.01
    np.testing.assert_allclose(found.psnr["shuffled"], -20 * np.log10(abs(apart) / 2), atol=0.1)
    alone = 6 * np.arange(5) / 60 + 0.01
    np.testing.assert_allclose(found.psnr["none"], -20 * np.log10(alone / 2), atol=0.1)
    table = found.table()
    assert table["true - shuffled"]["houses"] == 3
    assert table["true - shuffled"]["low"] > 0
    assert len(found.lines()) == 6


def test_a_report_keeps_its_pieces_and_says_what_came_out(obeying, monkeypatch, tmp_path):
    obeying("aabbc")
    config = dataclasses.replace(CONFIG, evaluate=dataclasses.replace(CONFIG.evaluate, batch=2))
    choices, partials = steering.choose(), Partials(tmp_path, "weights", "fingerprint")
    said = []
    found = steering.score(config, PARAMS, [], choices, partials, said.append)
    whole = steering.measure(config, PARAMS, [], 5)
    for name, errors in whole.errors.items():
        np.testing.assert_array_equal(found.errors[name], errors)
    monkeypatch.setattr(steering, "load_clip", None)  # nothing is imagined again
    again = steering.score(config, PARAMS, [], choices, partials, said.append)
    np.testing.assert_array_equal(again.errors["none"], found.errors["none"])
    assert len(said) == 1
    metrics = {"steering": {"all": found.table(), "per_frame": found.per_frame()}}
    page = page_tables.steering(metrics)
    assert page.count("<tr") == 1 + len(ACTIONS_NAMES)
    assert f"{found.psnr['true'].mean():.2f} [" in page
    (sentence,) = followed(metrics)
    assert "its lead over another clip's actions: +" in sentence
    assert followed({"steering": None}) == []
    assert page_tables.steering({"steering": None}) == ""
    obeying("aa")
    assert steering.score(config, PARAMS, [], steering.choose(), partials, said.append) is None
    obeying("ab")
    assert steering.score(tiny_config(), {}, [], steering.choose(), partials, said.append) is None


def test_what_cannot_be_asked_is_left_out_or_refused(obeying):
    obeying("ab")
    assert set(steering.measure(tiny_config(), {}, [], 2).psnr) == {"true", "shuffled"}
    obeying("aa")
    with pytest.raises(UserError, match="all clips are of one house"):
        steering.measure(CONFIG, PARAMS, [], 2)
