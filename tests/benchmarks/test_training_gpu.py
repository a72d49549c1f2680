"""The benchmark of training for a GPU, where there is none: it refuses, measures, goes on."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from pewm_jax import presets as configs
from pewm_jax.config import UserError
from pewm_jax.worlds.pewm import world as pewm
from tests.plan.test_target_compiler import report
from tests.train import fakes


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import training_gpu

    yield training_gpu
    for name in ("training_gpu", "record"):
        sys.modules.pop(name, None)


def test_without_a_gpu_it_refuses_in_a_sentence(gpu, monkeypatch):
    monkeypatch.setattr(gpu, "has_gpu", lambda: False)
    with pytest.raises(UserError, match="no NVIDIA GPU here"):
        gpu.main([])


@pytest.mark.slow
def test_the_real_step_is_measured_beside_what_was_predicted(gpu, fake_model, monkeypatch):
    guess = {"predicted_s": 0.1, "predicted_mfu": 0.5, "held_gb": 1.0}
    monkeypatch.setattr(gpu, "predicted", lambda *_: guess)
    monkeypatch.setattr(configs, "load", lambda _: fakes.config())
    found = {f"{number}, 4": gpu.measure("any", number, 4, 2) for number in (1, 2)}
    for one in found.values():
        assert one["batch"] == 4
        assert all(value > 0 for name, value in one.items() if name != "peak_gb")
    table = gpu.report(found).splitlines()
    assert len(table) == 4
    assert table[2].startswith("| 1, 4 | ")


def test_batches_grow_until_the_memory_ends_and_no_part_is_done_twice(
    gpu, monkeypatch, tmp_path, capsys
):
    numbers = {"s": 0.1, "predicted_s": 0.2, "mfu": 0.5, "predicted_mfu": 0.25}
    numbers |= {"peak_gb": 50.0, "held_gb": 51.0, "compile_s": 60.0}
    numbers |= {"plan_s": 0.05, "plan_gb": 48.0}
    asked = []

    def run(command, **_options):
        number, batch = map(int, command[command.index("--part") + 1 :][:2])
        asked.append((number, batch))
        if batch == 4:
            return subprocess.CompletedProcess(command, 1, "", "RESOURCE_EXHAUSTED: Out of memory")
        return subprocess.CompletedProcess(
            command, 0, f"noise\n{json.dumps({**numbers, 'batch': batch})}\n"
        )

    monkeypatch.setattr(gpu, "has_gpu", lambda: True)
    monkeypatch.setattr(gpu, "predicted", lambda *_: {"held_gb": 99.0})
    monkeypatch.setattr(gpu.subprocess, "run", run)
    state = ["--state", str(tmp_path / "state.json")]
    gpu.main([*state, "--seconds", "-1"])
    assert asked == []
    assert "run the same command to go on" in capsys.readouterr().out
    gpu.main(state)
    assert asked == [(number, batch) for batch in (1, 2, 4) for number in (1, 2)]
    out = capsys.readouterr().out
    assert "| 2, 2 | 100 | 200 | 50 | 20.00 | 50.0% | 25.0% | 50.0 | 48.0 | 51.0 | 60 |" in out
    assert "| 1, 4 | out of memory |  |  |  |  |  |  |  | 99.0 |  |" in out
    gpu.main(state)
    assert len(asked) == 6


def test_the_plan_of_the_compiler_is_beside_what_is_measured(gpu, monkeypatch, capsys):
    chip, asked = gpu.chips.named("h100"), []

    def compiled(config, name, chip, devices):
        asked.append((name, chip.name, devices))
        if name == "stage2":
            raise UserError("--compiler target for h100 needs jax-cuda12-plugin.")
        return report(peak_bytes=30e9, roofline_s=0.5)

    monkeypatch.setattr(gpu.target_compiler, "compile_stage", compiled)
    config = gpu.setting("tiny", pewm.STAGES[0], 1)
    assert gpu.planned(config, pewm.STAGES[0], chip) == {"plan_gb": 30.0, "plan_s": 0.5}
    assert gpu.planned(config, pewm.STAGES[1], chip) == {}
    assert asked == [("stage1", "h100", 1), ("stage2", "h100", 1)]
    assert "no plan of the compiler: --compiler target" in capsys.readouterr().err


@pytest.mark.slow
def test_the_preset_fits_one_device_by_the_sums(gpu):
    for stage in pewm.STAGES[:2]:
        config = gpu.setting("pewm_2b", stage, 1)
        assert stage.settings(config).batch == 1
        found = gpu.predicted(config, stage, gpu.chips.named("h200"))
        assert 10 < found["held_gb"] < 141
        assert 0 < found["predicted_mfu"] < 0.65
