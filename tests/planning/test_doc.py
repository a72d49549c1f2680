"""The page runs as it is written, only shorter, and with a smaller model."""

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import presets
from pewm_jax.data.collect import CollectConfig, collect
from tests.helpers import init_world
from tests.planning.page import blocks


@pytest.mark.slow
def test_twenty_lines_plan(tmp_path, monkeypatch):
    code = blocks("Plan with a world model", "python")
    assert len(code.splitlines()) <= 22
    assert 'pewm_jax.load("small")' in code
    config = presets.load("tiny")
    loaded = config, init_world(config, jax.random.key(0))
    monkeypatch.setattr(pewm_jax, "load", lambda name: loaded, raising=False)
    data = tmp_path / "data" / "small"
    collect(CollectConfig(data, train=0, validation=0, test=1, frames=40, size=16))
    monkeypatch.chdir(tmp_path)
    size = "horizon=8, candidates=60, elites=18, rounds=12"
    assert size in code
    smaller = code.replace(size, "horizon=3, candidates=3, elites=1, rounds=2")
    names = {}
    exec(compile(smaller, "docs/planning.md", "exec"), names)
    found = names["found"]
    assert found.actions.shape == (3,)
    assert np.isfinite(float(found.cost))
