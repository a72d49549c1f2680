"""`--fit`: combinations of settings, their estimates, the search, and the command."""

import dataclasses
import json

import pytest

from pewm_jax import presets
from pewm_jax.config import ConfigError, Launch, UserError
from pewm_jax.plan import fit, plan, target_compiler, topology
from pewm_jax.plan.fit import Choice
from pewm_jax.plan.measure import MeshSizes
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train import chips, runs, sharding

CHIP = chips.named("v5e")
TINY = presets.load("tiny")


def experiment(batch=8):
    stages = {
        "stage1": dataclasses.replace(TINY.train.stage1, batch=batch),
        "stage2": dataclasses.replace(TINY.train.stage2, steps=0),
    }
    return dataclasses.replace(TINY, train=dataclasses.replace(TINY.train, **stages))


@pytest.fixture
def stage():
    (one,) = runs.planned(experiment())
    return one


class Compiler:
    """Stands for a chip's compiler: memory grows with a device's clips and shrinks by remat."""

    def __init__(self, monkeypatch, capacity, failing=()):
        self.capacity, self.failing, self.asked = capacity, failing, []
        monkeypatch.setattr(topology, "require_compiler", lambda chip: None)
        monkeypatch.setattr(topology, "capacity", lambda chip: capacity)
        monkeypatch.setattr(target_compiler, "compile_stage", self)

    def __call__(self, config, stage, chip, devices, slices):
        settings, mesh = getattr(config.train, stage), config.train.mesh
        choice = Choice(
            config.model.backbone.remat, settings.micro_batches, MeshSizes(*mesh.shape(devices))
        )
        self.asked.append(choice)
        if choice.mesh in self.failing:
            raise UserError("The compiler of v5e failed on stage1: INTERNAL: no.")
        clips = settings.batch / choice.mesh.batch / settings.micro_batches
        temporary = clips * (5e6 if choice.remat else 20e6)
        return StageReport(
            name=stage,
            chip=chip.name,
            devices=devices,
            mesh=choice.mesh.sizes,
            compiler={"name": "none", "version": "0"},
            argument_bytes=1e6,
            temporary_bytes=temporary,
            peak_bytes=1e6 + temporary,
            capacity_bytes=self.capacity,
            fits=1e6 + temporary <= self.capacity,
            flops_needed=1e9,
            flops_executed=1e9,
            roofline_s=(1.3 if choice.remat else 1.0) + 0.1 * settings.micro_batches,
            mfu=0.5,
        )


def test_combinations_split_the_batch_evenly_and_are_valid_experiments(stage):
    config = experiment()
    found = list(fit.choices(config, stage, 4))
    assert len(set(found)) == len(found)
    assert {one.remat for one in found} == {False, True}
    assert {one.micro_batches for one in found} >= {1, 2}
    assert {one.mesh.tensor for one in found} >= {1, 2}
    for one in found:
        changed = one.apply(config, stage)
        sharding.require_divisible(changed, stage, one.mesh.abstract)
        assert changed.model.backbone.remat == one.remat
        assert changed.train.mesh.shape(4) == tuple(one.mesh.sizes.values())


@pytest.mark.parametrize("remat", [True, False])
def test_the_flags_of_a_combination_select_it(stage, remat):
    from pewm_jax.cli import main

    choice = Choice(remat, 2, MeshSizes(fsdp=2, tensor=2))
    flags = choice.flags(experiment(), stage).split()
    *_, config = main.read("plan", ["tiny", *flags], "pewm-jax plan")
    expected = choice.apply(TINY, stage)
    assert config.model == expected.model
    assert config.train.mesh == expected.train.mesh
    assert config.train.stage1.micro_batches == 2


def test_rematerialization_is_found_in_every_preset_s_networks():
    for name in presets.names():
        model = presets.load(name).model
        paths = fit.remat_settings(model)
        changed = fit.with_remat(presets.load(name), True).model
        for path in paths:
            value = changed
            for part in path.split("."):
                value = getattr(value, part)
            assert value is True, (name, path)
        if name in ("pewm_2b", "egowm_svd", "egowm_cosmos2b", "egowm_cogvideox"):
            assert paths == ["backbone.remat"]
    assert len(fit.remat_settings(presets.load("persist_xl").model)) >= 2


def test_a_forward_pass_that_is_recomputed_keeps_less(stage):
    estimates = fit.Estimates(experiment(), stage, CHIP)
    assert 0 < estimates.residuals(True) < estimates.residuals(False)


def test_the_search_compiles_the_fastest_first_and_ends_when_enough_fit(monkeypatch, stage):
    compiler, said = Compiler(monkeypatch, capacity=1e12), []
    found = fit.search(experiment(), stage, CHIP, 4, 6, said.append)
    assert len(found.tries) == len(compiler.asked) == fit.ENOUGH
    assert found.best.choice.remat is False, "recomputation costs time"
    assert found.best.choice.micro_batches == 1
    assert found.best.report.flags == found.best.flags
    estimates = [one.estimate.step_s for one in found.tries]
    assert float(f"{estimates[0]:.2g}") <= float(f"{estimates[1]:.2g}")
    assert sum("fits" in line for line in said) == fit.ENOUGH


def test_what_does_not_fit_corrects_the_estimates_until_something_fits(monkeypatch, stage):
    compiler = Compiler(monkeypatch, capacity=12e6)
    found = fit.search(experiment(), stage, CHIP, 4, 8, lambda _: None)
    assert not found.tries[0].fits
    assert found.best.fits
    assert found.best.choice.remat is True
    assert len(compiler.asked) <= 8
    assert len(set(compiler.asked)) == len(compiler.asked), "nothing is compiled twice"


@pytest.mark.slow
def test_if_nothing_fits_the_smallest_is_named(monkeypatch, stage):
    Compiler(monkeypatch, capacity=1e6)
    found = fit.search(experiment(), stage, CHIP, 2, 3, lambda _: None)
    assert len(found.tries) == 3
    peaks = [one.report.peak_bytes for one in found.tries]
    assert found.best.report.peak_bytes == min(peaks)
    assert any("none fits; the smallest" in line for line in fit.lines(found))


@pytest.mark.slow
def test_a_combination_on_which_the_compiler_fails_is_left_out(monkeypatch, stage):
    config = experiment()
    first = MeshSizes(data=2)
    compiler = Compiler(monkeypatch, 1e12, failing=[first])
    found = fit.search(config, stage, CHIP, 2, 8, lambda _: None)
    assert found.best.choice.mesh != first
    failed = [one for one in found.tries if one.report is None]
    assert all("INTERNAL: no" in one.summary["error"] for one in failed)
    compiler.failing = {one.mesh for one in fit.choices(config, stage, 2)}
    with pytest.raises(UserError, match="INTERNAL: no"):
        fit.search(config, stage, CHIP, 2, 2, lambda _: None)


def test_devices_that_cannot_share_the_batch_are_refused(stage):
    with pytest.raises(UserError, match=r"no mesh of them can split train\.stage1\.batch 8"):
        fit.search(experiment(), stage, CHIP, 7, 2, lambda _: None)


def test_the_command_prints_and_writes_the_best_and_every_try(monkeypatch, tmp_path):
    Compiler(monkeypatch, capacity=45e6)
    file, said = tmp_path / "plan.json", []
    launch = Launch(
        plan=True, devices=4, chip="v5e", compiler="target", fit=True, tries=5, json=str(file)
    )
    plan.show(experiment(), launch, said.append)
    (one,) = json.loads(file.read_text())["stages"]
    report = StageReport(**one)
    assert report.fits
    assert report.flags in "\n".join(said)
    assert 1 <= len(report.tries) <= 5
    best = min((t for t in report.tries if t["fits"]), key=lambda t: t["roofline_s"])
    assert (best["flags"], best["mesh"]) == (report.flags, report.mesh)
    for each in report.tries:
        assert each["estimated_bytes"] > 0
        assert each["estimated_s"] > 0
        assert each["compile_s"] is not None


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ({"fit": True}, "--fit compiles for the chip: add --compiler target"),
        ({"inference": True}, "--inference compiles for the chip: add --compiler target"),
        ({"fit": True, "inference": True, "compiler": "target"}, "give one of them"),
        ({"tries": 0}, "--tries is 0"),
    ],
)
def test_flags_that_do_not_go_together_are_refused(flags, sentence):
    with pytest.raises(ConfigError, match=sentence):
        Launch(**flags)


def test_the_real_compiler_finds_settings_that_fit(tmp_path, stage):
    try:
        topology.require_compiler(CHIP)
    except UserError as error:
        pytest.skip(str(error))
    config = experiment(4).with_model(dtype="bfloat16")
    found = fit.search(config, stage, CHIP, 4, 2, lambda _: None)
    assert found.best.fits
    for one in found.tries:
        assert one.report.peak_bytes > 0
        assert one.report.devices == 4
