"""The report of a world that is three-dimensional itself: the same command, the same pages."""

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
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.data.voxels import VoxelsConfig
from pewm_jax.eval import evaluate as report
from pewm_jax.io import weights
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.worlds.persist.tiny_persist import MODEL


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
    shapes = jax.eval_shape(lambda: worlds.init(MODEL, jax.random.key(0)))
    rng = np.random.default_rng(0)
    drawn = jax.tree.map(lambda x: jnp.asarray(0.2 * rng.normal(size=x.shape), x.dtype), shapes)
    weights.save(folder / "run" / "weights.safetensors", drawn)
    configuration.save(config, folder / "run" / "config.json")
    return folder / "run"


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
