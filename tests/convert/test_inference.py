"""A run goes in, a folder that `pewm_jax.load` reads and that describes itself comes out."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets, worlds
from pewm_jax.config import ClipConfig, UserError
from pewm_jax.convert import inference
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import tree, weights
from pewm_jax.io.store import file_hash
from pewm_jax.report.labels import MASK_NAMES, METHOD_NAMES, METRIC_NAMES
from pewm_jax.train import runs
from pewm_jax.worlds import world_model
from tests.helpers import random_frames, tiny_config

CONFIG = tiny_config(
    clip=ClipConfig(frames=5, height=16, width=16), noise=DDPMConfig(sample_steps=1)
)
METRICS = {
    "protocol": {
        "clips": 4,
        "scenes": 2,
        "seeds": [0, 1],
        "sampling_steps": 3,
        "held_out": True,
        "fingerprint": "f" * 64,
    },
    "results": {
        method: {
            mask: {name: {"mean": 12.25, "stderr": None, "n": 4} for name in METRIC_NAMES}
            for mask in MASK_NAMES
        }
        for method in METHOD_NAMES
    },
}


@pytest.fixture(scope="module")
def params():
    like = jax.eval_shape(lambda key: world_model.init(CONFIG.model, key), jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: rng.normal(0, 0.2, x.shape).astype(np.float32), like)


@pytest.fixture
def run(params, tmp_path):
    folder = tmp_path / "runs" / "mine"
    folder.mkdir(parents=True)
    configuration.save(CONFIG, folder / runs.CONFIG)
    runs.publish(folder, worlds.stages(CONFIG.model)[1], 7, params)
    return folder


def export(run, dst):
    said = []
    assert inference.export(run, dst, log=said.append) == dst
    assert any(str(dst) in line for line in said)
    return (dst / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_leaf_is_there_in_bfloat16_and_the_world_rolls_on(run, params, tmp_path):
    card = export(run, tmp_path / "small")
    config, small = pewm_jax.load(tmp_path / "small")
    assert config == CONFIG
    have, want = tree.flatten(small), tree.flatten(params)
    assert have.keys() == want.keys()
    for name, leaf in have.items():
        assert leaf.dtype == jnp.bfloat16, name
        np.testing.assert_array_equal(leaf, want[name].astype(jnp.bfloat16), name)
    half = (run / runs.WEIGHTS).stat().st_size * 0.55
    assert (tmp_path / "small" / runs.WEIGHTS).stat().st_size < half
    metadata = weights.metadata(tmp_path / "small" / runs.WEIGHTS)
    assert metadata == {"stage": "2", "step": "7", "dtype": "bfloat16"}
    assert "| 2 | 7 |" in card
    assert "a memory of kind `voxel`" in card

    frames = random_frames(np.random.default_rng(0), 2, 16, 16)
    state = pewm_jax.start(config, small, frames)
    rollout = jax.jit(pewm_jax.rollout, static_argnums=0)
    after, got = rollout(config, small, state, jnp.zeros((4,), int), jax.random.key(1))
    assert [x.dtype for x in jax.tree.leaves(after)] == [x.dtype for x in jax.tree.leaves(state)]
    assert got.rgb_THWC.dtype == jnp.float32
    assert np.isfinite(got.rgb_THWC).all()
    assert np.isfinite(got.depth_THW).all()


def test_kernels_in_8_bits_are_read_in_full_precision(run, params, tmp_path):
    inference.export(run, tmp_path / "eight", "int8", log=lambda _: None)
    file = tmp_path / "eight" / runs.WEIGHTS
    small, lazy = pewm_jax.load(tmp_path / "eight")[1], weights.lazy(file)
    have, want = tree.flatten(small), tree.flatten(params)
    assert have.keys() == want.keys()
    jax.tree.map(np.testing.assert_array_equal, small, lazy)
    kernels = [name for name in want if name.endswith("kernel") and want[name].ndim > 1]
    assert len(kernels) > 10
    for name, leaf in have.items():
        stacked = "/blocks/" in name
        if name.endswith("kernel") and leaf.ndim - stacked > 1:
            assert leaf.dtype == np.float32
            axes = tuple(range(int(stacked), leaf.ndim - 1))
            largest = np.abs(want[name]).max(axes, keepdims=True)
            assert (np.abs(leaf - want[name]) <= largest / 254 * 1.001).all()
        else:
            np.testing.assert_array_equal(leaf, want[name].astype(np.float16), name)
    assert file.stat().st_size < (run / runs.WEIGHTS).stat().st_size * 0.35
    assert (
        "kernels rounded to 8 bits and all else" in (tmp_path / "eight" / "README.md").read_text()
    )
    branch = weights.load(file, "backbone")
    jax.tree.map(np.testing.assert_array_equal, branch, small["backbone"])


def test_scales_without_a_kernel_are_refused(tmp_path):
    weights.save(tmp_path / "odd.safetensors", {"a": {"kernel#scale": np.ones(2, np.float32)}})
    with pytest.raises(UserError, match="no kernel a/kernel"):
        weights.load(tmp_path / "odd.safetensors")


def test_the_card_tells_base_licence_data_and_scores(run, tmp_path):
    card = export(run, tmp_path / "plain")
    assert "have no report" in card
    assert "chooses a licence" in card
    assert not (tmp_path / "plain" / runs.BASE).exists()

    record = {"name": "CogVideoX-5b", "licence": "cogvideox (https://example.org)"}
    (run / runs.BASE).write_text(json.dumps(record))
    (run / "report").mkdir()
    metrics = json.loads(json.dumps(METRICS))
    metrics["protocol"]["weights_sha256"] = file_hash(run / runs.WEIGHTS)
    metrics["voxels"] = {
        "unseen": {"iou": 0.3, "prior": 0.12, "extended": 0.19, "places": 24, "houses": 16},
        "known": {"psnr": 22.5},
        "long": None,
        "rows": {"as trained": {"iou": 0.3}},
    }
    (run / "report" / "metrics.json").write_text(json.dumps(metrics))
    card = export(run, tmp_path / "full")
    assert "PSNR of rendering a known grid: 22.50 dB." in card  # of a world of voxels
    assert "Made from `CogVideoX-5b`, whose licence is: cogvideox (https://example.org)." in card
    assert json.loads((tmp_path / "full" / runs.BASE).read_text()) == record
    assert "| seen before | with its map | 12.25 |" in card
    assert "4 clips in 2 scenes, none of which" in card

    metrics["protocol"]["weights_sha256"] = "of other weights"
    (run / "report" / "metrics.json").write_text(json.dumps(metrics))
    assert "have no report" in export(run, tmp_path / "stale")


def test_converted_weights_have_neither_data_nor_training(run, params, tmp_path):
    weights.save(run / runs.WEIGHTS, params, {"stage": "0"})
    card = export(run, tmp_path / "converted")
    assert "None: these are converted weights" in card
    assert "see the data of the original" in card
    assert "`demo`" not in card


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(run, tmp_path):
    dst = tmp_path / "there"
    dst.mkdir()
    cases = [(run, dst, "exists already"), (tmp_path / "none", tmp_path / "x", "not a folder")]
    (run / runs.WEIGHTS).rename(run / "away")
    cases.append((run, tmp_path / "x", "does not exist"))
    for source, target, sentence in cases:
        with pytest.raises(UserError, match=sentence):
            inference.export(source, target, log=lambda _: None)
    (run / runs.WEIGHTS).write_bytes((run / "away").read_bytes()[:-5])
    with pytest.raises(UserError, match="truncated"):
        inference.export(run, tmp_path / "x", log=lambda _: None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["runs", "there"]


def test_the_card_of_a_body_says_how_it_is_steered_and_how_well():
    def entry(mean):
        return {"mean": mean, "low": None, "high": None}

    lead = {"true": entry(18.0), "true - shuffled": entry(2.5)}
    arms = {"name": "IoU of the arms", "all": {"true": entry(0.6), "shuffled": entry(0.2)}}
    steering = {"clips": 48, "forward": 0.4, "all": lead, "scores": {"arms": arms}}
    facts = inference.CardFacts(
        name="body",
        dtype="float16",
        version="0",
        config=presets.load("egowm_humanoid"),
        params={},
        stage="2",
        step="5",
        base=None,
        metrics={**METRICS, "steering": steering},
    )
    card = inference.write_card(facts)
    assert "state, control, jax.random.key(0)" in card
    assert "(n, 25) actions of the body `humanoid`, (25,) state of the agent" in card
    assert "given an RGB-D frame and an agent's actions" in card
    assert "with no memory, codec `pixel`." in card
    assert "1 to 1 actions a frame." in card  # no earlier frames
    assert "With other actions (48 clips, 40 % of whose steps go forward):" in card
    assert "- IoU of the arms, true actions / another clip's: 3.00." in card
    walks = dataclasses.replace(facts, config=presets.load("egowm"), metrics=METRICS)
    assert "state, [0] * 8, jax.random.key(0)" in inference.write_card(walks)
