"""The report of a world that is three-dimensional itself: the same command, the same pages."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.config import Config, DataConfig, EvalConfig
from pewm_jax.data.collect import collect
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.data.voxels import VoxelsConfig
from pewm_jax.eval import evaluate as report
from pewm_jax.eval import voxel_report
from pewm_jax.io import weights
from pewm_jax.io.store import ResultCache
from pewm_jax.report import labels
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.worlds.persist.tiny_persist import MASKED, MODEL


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("persist")
    voxels = VoxelsConfig(
        record=True, cell=0.5, side=12, kinds="groups", colours=1, pictures="cells"
    )
    data = CollectConfig(
        folder / "data", train=0, validation=1, test=2, frames=34, size=16, moving=True,
        voxels=voxels, workers=1,
    )  # fmt: skip
    collect(data, lambda _: None)
    config = Config(
        model=MODEL,
        data=DataConfig(path=str(folder / "data"), context=4, stride_max=1),
        train=PersistTrainConfig(run=str(folder / "run")),
        evaluate=EvalConfig(clips=2, seeds=(0,), videos=1, video_clips=2, batch=1),
    )
    weights.save(folder / "run" / "weights.safetensors", random_weights(MODEL))
    configuration.save(config, folder / "run" / "config.json")
    return folder / "run"


def random_weights(model):
    shapes = jax.eval_shape(lambda: worlds.init(model, jax.random.key(0)))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(0.2 * rng.normal(size=x.shape), x.dtype), shapes)


@pytest.mark.slow
def test_a_world_of_voxels_has_the_report_that_every_world_has(run):
    page = Path(report.evaluate(run, log=lambda _: None))
    assert page.exists()
    metrics = json.loads((page.parent / "metrics.json").read_text())
    assert {"memory", "empty", "reproject"} <= set(metrics["results"])
    assert metrics["coverage"] is None  # its cells are no tokens
    assert metrics["steering"]["all"]
    values = [row["all"]["psnr"]["mean"] for row in metrics["results"].values()]
    assert np.isfinite(values).all()
    grown = metrics["long"]["growth"]
    assert grown["capacity"] == 24 * 24 * 8
    assert "4608 cells" in metrics["protocol"]["map"]
    assert "read per clip" not in metrics["protocol"]["map"]


@pytest.mark.slow
def test_the_voxels_are_scored_on_long_walks(run, tmp_path):
    config = configuration.load(run / "config.json")
    chosen = dataclasses.replace(config.evaluate, long=config.data.path, long_frames=24, batch=2)
    config = dataclasses.replace(config, model=MASKED, evaluate=chosen)
    episodes = EpisodeSource(f"{config.data.path}/revisit")
    cache, params = ResultCache(tmp_path), random_weights(MASKED)
    facts = voxel_report.score(config, params, episodes, cache, print)
    assert facts is not None
    assert 0 <= facts["unseen"]["iou"] <= 1
    assert 0 <= facts["unseen"]["prior"] < 1
    assert np.isfinite(facts["known"]["psnr"])
    long, own = facts["long"], facts["rows"]["as trained"]
    assert (long["walks"], long["frames"], long["ends"]) == (2, 24, [8, 16, 24])
    assert np.isfinite([*own["psnr"], *own["seen"]]).all()
    np.testing.assert_allclose(own["lost"], own["seen"][0] - own["seen"][1])
    opened, passed = own["doorways"]
    assert 0 <= passed <= opened
    lines = labels.format_voxels({"voxels": facts})
    assert any("of the mean layout" in line for line in lines)
