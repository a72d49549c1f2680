"""`--plan`: what it refuses, what it suggests, and that it needs nothing but the settings."""

import dataclasses
import functools
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from pewm_jax import presets as configs
from pewm_jax.config import ConfigError, Launch, LoRAConfig, MeshConfig, UserError
from pewm_jax.data import abstract
from pewm_jax.plan import measure, plan, suggest
from pewm_jax.plan.measure import Compiled, MeshSizes
from pewm_jax.plan.program import Collective, Program
from pewm_jax.plan.suggest import counts
from pewm_jax.train import chips, flops, runs
from pewm_jax.worlds.pewm.world import STAGES
from tests.train import fakes

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


@pytest.mark.slow
def test_a_plan_need_not_be_compiled_and_is_not_where_that_takes_very_long(monkeypatch):
    def refused(*_):
        raise AssertionError("it is compiled")

    monkeypatch.setattr(measure, "compile_traced", refused)
    said = []
    tiny = configs.load("tiny")
    monkeypatch.setattr(plan, "MOST_ARRAYS", 10)
    (first, *_) = plan.show(tiny, launch(1), said.append)
    text = "\n".join(said)
    assert "not compiled, so temporary memory is unknown (it trains more than 10 arrays" in text
    assert "peak, without temporary memory" in text
    assert "compiled program" not in text
    assert first.choice.memory.temporary is None
    monkeypatch.setattr(plan, "MOST_ARRAYS", 1000)
    with pytest.raises(AssertionError, match="it is compiled"):
        plan.show(tiny, launch(1), said.append)
    off = dataclasses.replace(launch(1), compiled="off")
    (one, *_) = plan.show(tiny, off, said.append)
    assert one.compiled is None
    with pytest.raises(ConfigError, match="use auto, on, off"):
        Launch(compiled="no")


def test_the_u_net_of_svd_has_too_many_arrays_to_compile():
    config = configs.load("egowm_svd")
    (stage,) = runs.planned(config)
    assert not plan._should_compile(config, stage, launch())
    assert plan._should_compile(config, stage, dataclasses.replace(launch(), compiled="on"))


def test_what_cannot_be_planned_is_refused_before_anything_is_compiled(monkeypatch):
    monkeypatch.setattr(measure, "trace", None)
    tiny = configs.load("tiny")
    with pytest.raises(ConfigError, match="--chip 'h900' is unknown"):
        plan.show(tiny, launch(chip="h900"))
    with pytest.raises(
        ConfigError, match=r"train\.stage1\.batch is 2, which cannot be split evenly over 8 devices"
    ):
        plan.show(tiny, launch())
    train = dataclasses.replace(tiny.train, mesh=MeshConfig(fsdp=3))
    with pytest.raises(ConfigError, match="choose axes whose product is that number"):
        plan.show(dataclasses.replace(tiny, train=train), launch())


def test_too_few_devices_in_use_already_are_named():
    with pytest.raises(UserError, match="a process in which JAX has not"):
        measure.virtual(len(jax.devices()) + 1)


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
    assert counts(small, stage1)["trained"].count == pytest.approx(1.69e9, rel=0.01)
    assert counts(small, stage2)["trained"].count == pytest.approx(0.94e9, rel=0.01)
    assert counts(large, stage1)["trained"].count == pytest.approx(5.57e9, rel=0.01)
    assert counts(large, stage2)["trained"].count == pytest.approx(2.84e9, rel=0.01)


@functools.cache
def work(name, number):
    """Return a preset's work, as if nothing were recomputed."""
    config, stage = configs.load(name), STAGES[number - 1]
    clip = abstract.clip(config, stage.settings(config).batch, features=stage.memory)
    needed = flops.of_stage(config, stage, clip)
    return measure.StepWork(needed, needed)


def compiled(mesh, temporary):
    return Compiled(Program(), 0.0, temporary, mesh, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("devices", [8, 64, 256])
@pytest.mark.parametrize(
    ("name", "temporary"), [("pewm_2b", (67e9, 101e9)), ("pewm_5b", (120e9, 173e9))]
)
def test_the_presets_fit_on_h200_in_both_stages(name, temporary, devices):
    """With the temporary memory of the steps compiled for 8 devices (docs/scaling.md)."""
    config = configs.load(name)
    eight, mesh = (MeshSizes(*config.train.mesh.shape(n)) for n in (8, devices))
    for stage, held in zip(STAGES[:2], temporary, strict=True):
        found = work(name, stage.number)
        choice = suggest.Job(config, stage, H200, found, compiled(eight, held)).assess(mesh)
        assert choice.fits, (stage.number, choice.memory)
        assert 0.2 < choice.time.mfu < 0.65


def test_every_suggestion_uses_all_devices_and_shares_batch_and_heads():
    config = configs.load("pewm_2b")
    stage, mesh = STAGES[1], MeshSizes(fsdp=64)
    job = suggest.Job(config, stage, H200, work("pewm_2b", 2), compiled(mesh, 12e9))
    ranked = job.rank(mesh.devices)
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
    for program in (None, compiled(few, 120e9)):
        held = [suggest.memory_of(config, stage, m, program).peak for m in (few, many)]
        assert held[1] < held[0] / 2
    done = [sum(work("pewm_5b", 1).on_device(m).values()) for m in (few, many)]
    assert done[1] == pytest.approx(done[0] / 8)


def test_tensor_splits_the_layers_and_repeats_the_encoders():
    found = work("pewm_2b", 1)
    one, two = (found.on_device(MeshSizes(fsdp=8 // n, tensor=n)) for n in (1, 2))
    assert two["convolution"] == pytest.approx(2 * one["convolution"])
    assert two["attention"] == pytest.approx(one["attention"])
    assert two["linear"] == pytest.approx(one["linear"], rel=0.01)


def test_temporary_memory_follows_the_share_of_the_clips_in_the_chip_s_precision():
    config, stage, mesh = configs.load("pewm_2b"), STAGES[0], MeshSizes(fsdp=8)
    gradients = 4 * counts(config, stage)["trained"].on(mesh)
    program = compiled(mesh, gradients + 40e9)
    for other, share in ((mesh, 1), (MeshSizes(fsdp=16), 2), (MeshSizes(fsdp=8, tensor=2), 2)):
        found = suggest.memory_of(config, stage, other, program)
        assert found.temporary == pytest.approx(40e9 / 2 / share)
    wide = config.with_model(dtype="float32")
    assert suggest.memory_of(wide, stage, mesh, program).temporary == pytest.approx(40e9)


def test_what_is_sent_along_an_axis_is_found_by_its_groups():
    mesh = MeshSizes(data=2, context=2)
    sent = [("all-gather", (0, 1), 5.0), ("all-gather", (0, 2), 7.0), ("all-reduce", (2, 3), 1.0)]
    items = [Collective(*item) for item in sent]
    program = Compiled(Program(collectives=items), 0.0, 0.0, mesh, 0.0)
    assert program.sent_along("context") == {"all-gather": 5.0, "all-reduce": 1.0}
    assert program.sent_along("data") == {"all-gather": 7.0}


def test_numbers_are_written_as_people_do():
    assert plan.flop(4.146e16) == "41.5 PFLOP"
    assert plan.flop(8.07e14) == "807 TFLOP"
    assert plan.size(1.4e12) == "1.4 TB"
    assert [plan.rate(x) for x in (1040.3, 948.2, 9.2)] == ["1,040", "948", "9.2"]


def test_links_beyond_an_island_are_shared_by_those_who_use_them():
    assert suggest.rate((0, 1, 2, 3), H200) == H200.link
    assert suggest.rate((0, 8, 16, 24), H200) == H200.network
    assert suggest.rate(tuple(range(16)), H200) == min(H200.link, 8 * H200.network)


def test_a_plan_counts_adapters_and_their_optimizer_state():
    config = configs.load("tiny")
    lora = LoRAConfig(rank=3)
    train = dataclasses.replace(config.train, lora=lora)
    (stage, _), plain = runs.all_stages(dataclasses.replace(config, train=train)), config
    adapted = dataclasses.replace(config, train=train)
    trained = 2 * 4 * 3 * (32 + 32)  # layers × projections × rank × (in + out)
    assert counts(adapted, stage)["trained"].count == trained
    memory = suggest.memory_of(adapted, stage, MeshSizes())
    assert memory.trained == memory.average == memory.gradients == 4 * trained
    assert memory.moments == pytest.approx(8 * trained, rel=0.01)
    whole = suggest.memory_of(plain, runs.all_stages(plain)[0], MeshSizes())
    assert memory.frozen == whole.trained + whole.frozen
    assert f"rank 3: {trained:,} of" in plan.adapters(adapted, stage)
