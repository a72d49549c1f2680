"""The benchmark of never-seen views: which views it shows, and what it prints."""

import dataclasses
import re
import sys
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from pewm_jax import config as configs
from pewm_jax.errors import UserError
from pewm_jax.io import weights
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.worlds import world_model
from tests.eval.scene import tiny, write_split

ROOT = Path(__file__).parents[2]


class Squared:
    """In place of LPIPS, which needs larger images."""

    def in_masks(self, one_BTHWC, two_BTHWC, masks_BTKHW):
        error_BT1HW = np.square(one_BTHWC - two_BTHWC).mean(-1)[:, :, None]
        return (error_BT1HW * masks_BTKHW).sum((-2, -1))


@pytest.mark.slow
def test_views_and_distances_of_a_tiny_run(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import unseen

    base = tiny(tmp_path)
    reader = RenderConfig(picture_width=8)
    memory = SurfelConfig(cells=(64, 64, 16), capacity=2048, tokens=16, reader=reader)
    config = dataclasses.replace(base, model=dataclasses.replace(base.model, memory=memory))
    write_split(tmp_path / "data" / "revisit", episodes=2)
    run = tmp_path / "run"
    run.mkdir()
    configs.save(config, run / "config.json")
    params = jax.jit(lambda key: world_model.init(config.model, key))(jax.random.key(0))
    weights.save(run / "weights.safetensors", params)
    monkeypatch.setattr(unseen, "select_lpips", lambda *_: (Squared(), ""))
    unseen.main(
        unseen.Settings(
            str(run), data=tmp_path / "data", clips=4, views=2, share=0.0, seeds=2, out=tmp_path
        )
    )
    said = capsys.readouterr().out
    assert "2 of " in said
    numbers = [float(x) for x in re.findall(r"\d\.\d{3}", said)]
    assert len(numbers) == 3  # "nan" is no number here
    assert numbers[0] > 0
    assert cv2.imread(str(tmp_path / "views.png")).std() > 0
    for name in ("unseen", "record"):
        sys.modules.pop(name, None)


def test_views_of_other_memories_and_no_views_are_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import unseen

    base = tiny(tmp_path)
    configs.save(base, tmp_path / "config.json")
    params = jax.jit(lambda key: world_model.init(base.model, key))(jax.random.key(0))
    weights.save(tmp_path / "weights.safetensors", params)
    settings = unseen.Settings(str(tmp_path), data=tmp_path, out=tmp_path)
    with pytest.raises(UserError, match="no memory of surfels"):
        unseen.views(settings)
    with pytest.raises(UserError, match="--views is 0"):
        unseen.views(dataclasses.replace(settings, views=0))
    image, other = np.zeros((4, 4, 3), np.float32), np.full((4, 4, 3), 0.5, np.float32)
    left = np.arange(4)[None] < np.full((4, 1), 2)
    other[:, 2:] = 0
    assert unseen.distance(Squared(), [(image, other, left)]) == pytest.approx(0.25)
    assert unseen.distance(Squared(), [(image, other, ~left)]) == 0
    for name in ("unseen", "record"):
        sys.modules.pop(name, None)
