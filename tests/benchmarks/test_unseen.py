"""The benchmark of never-seen views: which views it shows, and what it prints."""

import dataclasses
import sys
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from pewm_jax import config as configs
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
    assert "2 of " in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "views.png")).std() > 0
    for name in ("unseen", "record"):
        sys.modules.pop(name, None)
