"""`--plan`: what it refuses, what it suggests, and that it needs nothing but the settings."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import training_fakes as fakes

from pewm_jax import presets as configs
from pewm_jax.config import ConfigError, Launch, MeshConfig, UserError
from pewm_jax.data import abstract
from pewm_jax.nn.costs import SPLIT, Share
from pewm_jax.plan import plan, predict, suggest
from pewm_jax.plan import text as plan_text
from pewm_jax.plan.footprint import MeshSizes, counts, footprint
from pewm_jax.train import chips
from pewm_jax.worlds import costs
from pewm_jax.worlds.pewm.world import STAGES

ROOT = Path(__file__).parents[2]
H200 = chips.named("h200")


def launch(devices=8, chip="h200"):
    return Launch(plan=True, devices=devices, chip=chip)


def run(cwd, *argv):
    return subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *argv, "--plan"],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_command_plans_from_settings_alone_and_writes_nothing(tmp_path):
    stage1 = ("--train.stage2.steps", "0", "--train.stage1.batch", "4")
    done = run(tmp_path, "tiny", "--devices", "4", "--chip", "TPU v5p", *stage1)
    assert done.returncode == 0, done.stderr
    words = ("Stage 1 on 4 × v5p", "peak", " fits:", "FLOP (compiled", "all-reduce", "MFU")
    for word in words:
        assert word in done.stdout, word
    assert "--train.mesh.data" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_plan_need_not_be_compiled_and_is_not_where_that_takes_very_long(monkeypatch):
    monkeypatch.setattr(plan, "virtual", lambda count: [None] * count)
    monkeypatch.setattr(plan, "compile_stage", None)
    said = []
    plan.show(configs.load("egowm_svd"), launch(), said.append)
    text = "\n".join(said)
    assert "not compiled, all numbers are the formulas' (it trains more than 1000 arrays" in text
    assert "which no compiled program confirms here" in text
    assert "compiled CPU program" not in text
    with pytest.raises(TypeError):  # what would compile
        plan.show(configs.load("tiny"), launch(1), said.append)
    off = dataclasses.replace(launch(1), compiled="off")
    (one, *_) = plan.show(configs.load("tiny"), off, said.append)
    assert one.raised == 1
    with pytest.raises(ConfigError, match="use auto, on, off"):
        Launch(compiled="no")


def test_what_cannot_be_planned_is_refused_before_anything_is_compiled(monkeypatch):
    monkeypatch.setattr(plan, "compile_stage", None)
    tiny = configs.load("tiny")
    with pytest.raises(ConfigError, match="--chip 'h900' is not known"):
        plan.show(tiny, launch(chip="h900"))
    with pytest.raises(ConfigError, match=r"train\.stage1\.batch is 2, which 8 devices cannot"):
        plan.show(tiny, launch())
    train = dataclasses.replace(tiny.train, mesh=MeshConfig(fsdp=3))
    with pytest.raises(ConfigError, match="choose axes whose product is that number"):
        plan.show(dataclasses.replace(tiny, train=train), launch())


def test_too_few_devices_in_use_already_are_named():
    with pytest.raises(UserError, match="a process of its own"):
        plan.virtual(len(jax.devices()) + 1)


@pytest.mark.parametrize("stage", STAGES)
def test_an_abstract_batch_is_like_a_real_one(stage):
    tiny = configs.load("tiny")
    real = fakes.clip(tiny, stage.settings(tiny).batch, 0)
    like = abstract.clip(tiny, stage.settings(tiny).batch, features=stage.memory)
    assert jax.tree.structure(like) == jax.tree.structure(real)
    for a, b in zip(jax.tree.leaves(like), jax.tree.leaves(real), strict=True):
        assert (a.shape, a.dtype) == (np.shape(b), np.asarray(b).dtype)


def test_the_presets_have_the_parameters_that_they_state():
    small, large = (configs.load(name) for name in ("pewm_2b", "pewm_5b"))
    stage1, stage2 = STAGES[:2]
    assert counts(small, stage1).trained.count == pytest.approx(1.69e9, rel=0.01)
    assert counts(small, stage2).trained.count == pytest.approx(0.94e9, rel=0.01)
    assert counts(large, stage1).trained.count == pytest.approx(5.57e9, rel=0.01)
    assert counts(large, stage2).trained.count == pytest.approx(2.84e9, rel=0.01)


@pytest.mark.parametrize("devices", [8, 64, 256])
@pytest.mark.parametrize("name", ["pewm_2b", "pewm_5b"])
def test_the_presets_fit_on_h200_in_both_stages(name, devices):
    config = configs.load(name)
    mesh = MeshSizes(*config.train.mesh.shape(devices))
    for stage in STAGES[:2]:
        choice = suggest.assess(config, stage, mesh, H200)
        assert choice.fits, (stage.number, choice.footprint)
        assert 0.2 < choice.time.mfu < 0.65


def test_every_suggestion_uses_all_devices_and_shares_batch_and_heads():
    config = configs.load("pewm_2b")
    stage = STAGES[1]
    ranked = suggest.rank(config, stage, 64, H200)
    assert len(ranked) == len({choice.mesh for choice in ranked}) > 10
    for choice in ranked:
        mesh = choice.mesh
        assert mesh.devices == 64
        assert config.train.stage2.batch % mesh.batch == 0
        assert config.model.backbone.heads % mesh.tensor == 0
    fits = [choice.fits for choice in ranked]
    assert fits == sorted(fits, reverse=True)


def test_more_devices_need_less_memory_each_and_do_less_work_each():
    config, stage = configs.load("pewm_5b"), STAGES[0]
    few, many = (MeshSizes(fsdp=n) for n in (8, 64))
    for wide in (2, 4):
        held = [
            footprint(config, stage, m, activation_bytes=wide, flash=True).peak for m in (few, many)
        ]
        assert held[1] < held[0] / 2
    products = costs.products(config, stage)
    work = [sum(costs.flops_of_device(p, m.sizes, 256) for p in products) for m in (few, many)]
    assert work[1] == pytest.approx(work[0] / 8)


def test_the_vae_holds_a_chunk_of_a_long_clip():
    config, stage, mesh = configs.load("pewm_5b"), STAGES[0], MeshSizes(fsdp=256)
    nine, long = (
        footprint(
            config.with_model(clip=dataclasses.replace(config.model.clip, frames=frames)),
            stage,
            mesh,
            activation_bytes=2,
            flash=True,
        ).encoders
        for frames in (9, 49)
    )
    assert long < 2 * nine


def test_the_vae_works_clip_by_clip_and_streams_all_clips_in_their_precision():
    model = configs.load("pewm_2b").model
    one = model.codec.costs(model, Share(clips=1, activation_bytes=2))
    four, wide = (
        model.codec.costs(model, Share(clips=n, activation_bytes=w)) for n, w in ((4, 2), (1, 4))
    )
    assert (four.held, four.streamed) == (one.held, 4 * one.streamed)
    assert (wide.held, wide.streamed) == (2 * one.held, 2 * one.streamed)
    assert one.products == four.products == wide.products
    pixels = 9 * 512 * 512 * 128  # the widest array of a clip
    assert one.streamed > 2 * 2 * pixels
    assert one.held > 2 * 2 * pixels


def test_numbers_are_written_as_people_do():
    assert plan_text.work(4.146e16) == "41.5 PFLOP"
    assert plan_text.work(8.07e14) == "807 TFLOP"
    assert plan_text.size(1.4e12) == "1.4 TB"
    assert [plan_text.rate(x) for x in (1040.3, 948.2, 9.2)] == ["1,040", "948", "9.2"]


def test_links_beyond_an_island_are_shared_by_those_who_use_them():
    assert predict.rate((0, 1, 2, 3), H200) == H200.link
    assert predict.rate((0, 8, 16, 24), H200) == H200.network
    assert predict.rate(tuple(range(16)), H200) == min(H200.link, 8 * H200.network)


def test_training_flops_count_gradients_only_where_they_are_needed():
    config = configs.load("tiny")
    first, second, joint = (costs.products(config, stage) for stage in STAGES[:3])
    blocks = (p for one in (first, second, joint) for p in one if p.part == "backbone")
    linear = [p for p in blocks if p.kind == "linear" and p.axes == SPLIT]
    assert [p.backward for p in linear] == [2.0, 1.0, 2.0]
    assert all(p.part == "backbone" for p in first)
    assert {p.part for p in second} == {p.part for p in joint} == {"backbone", "memory"}
