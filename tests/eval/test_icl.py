"""The ICL-NUIM living room, recorded by hand in six degrees of freedom, is driven by cameras."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configs
from pewm_jax import worlds
from pewm_jax.cli import main as program
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval import evaluate as report
from pewm_jax.io import weights
from tests.eval.scene import tiny

RECORDING = Path(__file__).parents[3] / "shared" / "data" / "icl_livingroom"
FLAGS = ["--intrinsics", "525", "525", "319.5", "239.5", "--stride", "8", "--size", "16", "16"]
pytestmark = pytest.mark.skipif(
    not RECORDING.is_dir(), reason="the ICL-NUIM living room is not at ../shared/data"
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("icl")
    assert program.main(["data", "import", str(RECORDING), str(out), *FLAGS]) == 0
    return out


@pytest.mark.slow
def test_its_cameras_steer_the_world_model(data, tmp_path):
    config = tiny(tmp_path)
    params = worlds.init(config.model, jax.random.key(0))
    episode = EpisodeSource(data / "train")[0]
    state = pewm_jax.start(config, params, episode.frames(range(6)))
    cameras = episode.frames(range(6, 12)).camera
    after, frames = pewm_jax.imagine(config, params, state, cameras, jax.random.key(0))
    assert frames.rgb_THWC.shape == (6, 16, 16, 3)
    np.testing.assert_array_equal(frames.camera.world_from_camera, cameras.world_from_camera)
    np.testing.assert_array_equal(
        after.frame.camera.world_from_camera[0], cameras.world_from_camera[-1]
    )
    real = pewm_jax.observe(config, params, after, episode.frames(range(6, 12)))
    assert int(real.map.occupied) >= int(state.map.occupied)


@pytest.mark.slow
def test_it_is_scored_along_its_own_cameras(data, tmp_path):
    config = tiny(tmp_path, clips=2, seeds=(0,), videos=1, video_clips=1)
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, path=str(data)))
    run = tmp_path / "run"
    run.mkdir()
    configs.save(config, run / "config.json")
    weights.save(run / "weights.safetensors", worlds.init(config.model, jax.random.key(0)))
    page = report.evaluate(run, log=lambda _line: None, split="train")
    assert "six degrees of freedom" in page.read_text()
