"""The page runs as it is written, only shorter."""

import re
from pathlib import Path

import numpy as np

from pewm_jax.data.collect import CollectConfig, collect

PAGE = Path(__file__).parents[2] / "docs" / "planning_planners.md"


def test_twenty_lines_plan_with_the_model_that_ships(tmp_path, monkeypatch):
    first = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert first
    code = first[1]
    assert len(code.splitlines()) <= 22
    collect(CollectConfig(tmp_path / "data" / "small", train=0, validation=0, test=1, frames=72))
    monkeypatch.chdir(tmp_path)
    smaller = code.replace(
        "candidates=60, elites=18, rounds=12", "candidates=3, elites=1, rounds=2"
    )
    assert smaller != code
    names = {}
    exec(compile(smaller, str(PAGE), "exec"), names)
    found = names["found"]
    assert found.actions.shape == (8,)
    assert np.isfinite(float(found.cost))
