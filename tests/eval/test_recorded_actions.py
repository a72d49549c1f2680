"""Worlds whose actions are not planar are previewed, evaluated and shown along recorded actions."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig, UserError
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.importer import ImportConfig, import_recording
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.eval import clips, compare, preview
from pewm_jax.eval import evaluate as report
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.runner import ModelRunner
from pewm_jax.io import weights
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.train import loop
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from tests.data import layouts
from tests.helpers import randomise

pytest.importorskip("pyarrow", reason="pyarrow is not installed")
A, FRAMES, SIZE = 6, 12, 16
MODEL = EgoWM(
    clip=ClipConfig(frames=5, height=SIZE, width=SIZE, depth=False),
    codec=PixelConfig(temporal=1),
    backbone=DiTBackbone(layers=1, heads=1, head_dim=16, text_length=1, text_dim=8, time_dim=16),
    control=ModulationConfig(
        actions=A, units=(1.0,) * A, low=(-1.0,) * A, high=(1.0,) * A, angles=()
    ),
    noise=DDPMConfig(sample_steps=1),
)


def arms(folder, actions, width=A):
    """Import two episodes of an arm without depth and poses into all splits."""
    walks = [layouts.hand_held(FRAMES, SIZE, SIZE) for _ in range(2)]
    moves = [actions[e][:, :width] for e in range(2)]
    src = layouts.lerobot(folder / "src", walks, depth=False, pose=False, actions=moves)
    for split in ("train", "validation"):
        options = ImportConfig(src, folder / "data", format="lerobot", split=split)
        import_recording(options, lambda _: None)
    return folder / "data"


@pytest.fixture(scope="module")
def actions():
    return np.random.default_rng(0).uniform(-1, 1, (2, FRAMES, A)).astype(np.float32)


@pytest.fixture(scope="module")
def config(tmp_path_factory, actions):
    folder = tmp_path_factory.mktemp("arm")
    return Config(
        model=MODEL,
        data=DataConfig(path=str(arms(folder, actions)), context=2, stride_max=1),
        train=EgoWMTrainConfig(
            run=str(folder / "run"), adapt=StageConfig(steps=2, batch=2, warmup=0), preview_every=0
        ),
        evaluate=EvalConfig(
            split="validation", clips=2, chain=1, seeds=(0,), video_clips=2, videos=1, lpips="off"
        ),
    )


@pytest.fixture(scope="module")
def run(config):
    """Two steps of training; then random weights, since the control begins without effect."""
    previews = preview.make_preview(config, Path(config.train.run))
    assert previews is not None
    loop.train(config, log=lambda _: None)
    file = Path(config.train.run) / "weights.safetensors"
    weights.save(file, randomise(weights.load(file)), weights.metadata(file))
    return Path(config.train.run)


def measured(run, out, **changes):
    said = []
    page = report.evaluate(run, out=out, log=said.append, **changes)
    found = json.loads((page.parent / "metrics.json").read_text())
    return found, page.read_text(), "\n".join(said)


def mean_psnr(run, config, sign):
    """The PSNR of the report's clips, imagined with the recorded actions times a sign."""
    episodes = EpisodeSource(config.data.path + "/validation")
    choices = clips.choose(config, episodes, 2, 1)
    context, true, control = (
        clips.stack(list(part), 2)
        for part in zip(*(clips.load_clip(config, episodes, one) for one in choices), strict=True)
    )
    control = dataclasses.replace(control, actions_TA=sign * control.actions_TA)
    params = weights.load(run / "weights.safetensors")
    model = ModelRunner(config, params, 2, config.data.context, lambda _: None)
    made = model.run(context, control, np.array([[0, 0], [0, 1]]), memory=False)[2]
    off = unit_colours(made.rgb_THWC) - unit_colours(true.rgb_THWC)
    return float(psnr((off**2).mean((1, 2, 3, 4))).mean())


@pytest.mark.slow
def test_a_report_follows_the_recorded_actions(run, config, tmp_path):
    found, page, said = measured(run, tmp_path / "one")
    results = found["results"]
    assert set(results) == {"model", "copy"}
    assert np.isfinite(results["model"]["all"]["psnr"]["mean"])
    assert results["model"]["seen"]["psnr"]["mean"] is None
    assert found["protocol"]["motion"] == "the recorded actions of 6 numbers"
    reason = "The data lack depth or camera poses, so there is no reprojection"
    assert reason in said
    assert reason in page
    assert "mirror test is skipped: actions of 6 numbers" in said
    assert "Steering is not measured" in said
    assert compare.compare(tmp_path / "one", tmp_path / "one", out=tmp_path / "both").is_file()
    reported = results["model"]["all"]["psnr"]["mean"]
    assert mean_psnr(run, config, 1) == pytest.approx(reported, abs=2e-3)
    assert abs(mean_psnr(run, config, -1) - reported) > 5e-3


@pytest.mark.slow
def test_previews_and_videos_follow_them_too(run, config, tmp_path, monkeypatch):
    monkeypatch.setattr(preview, "CLIPS", 2)
    draw = preview.make_preview(config, tmp_path)
    params = weights.load(run / "weights.safetensors")
    made = draw(params, config.model.stages()[-1], 2)
    assert np.isfinite(made.psnr["model"])
    video = tmp_path / "v.mp4"
    flags = ["--video", str(video), "--context", "2", "--frames", "6"]
    assert program.main(["show", str(run), *flags]) == 0
    assert video.stat().st_size


def test_the_control_of_a_clip_is_the_recorded_one(config, actions):
    episodes = EpisodeSource(config.data.path + "/validation")
    choice = clips.choose(config, episodes, 1, 1)[0]
    control = clips.load_clip(config, episodes, choice)[2]
    there = slice(choice.start, choice.start + 4)
    np.testing.assert_array_equal(control.actions_TA, actions[choice.episode, there])
    assert control.camera.world_from_camera.shape == (4, 4, 4)
    twice = dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, stride=2))
    choice = clips.choose(twice, episodes, 1, 1)[0]
    with pytest.raises(UserError, match="actions of 12 numbers over 2 frames"):
        clips.load_clip(twice, episodes, choice)


def test_planar_actions_without_poses_are_used_as_recorded(config, actions, tmp_path):
    episodes = EpisodeSource(arms(tmp_path, actions, 3) / "validation")
    planar = dataclasses.replace(
        config, model=dataclasses.replace(MODEL, control=ModulationConfig())
    )
    choice = clips.choose(planar, episodes, 1, 1)[0]
    control = clips.load_clip(planar, episodes, choice)[2]
    there = slice(choice.start, choice.start + 4)
    np.testing.assert_allclose(control, actions[choice.episode, there, :3], atol=1e-6)
