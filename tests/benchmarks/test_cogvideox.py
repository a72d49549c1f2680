"""The benchmark for a GPU, where there is none: it refuses in a sentence, and its parts run."""

import dataclasses
import json
from pathlib import Path

import jax
import pytest

from pewm_jax.config import UserError
from pewm_jax.models.cogvideox import model as dit


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import cogvideox_gpu

    return cogvideox_gpu


def test_without_a_gpu_it_refuses_in_a_sentence(gpu, monkeypatch):
    monkeypatch.setattr(gpu, "has_gpu", lambda: False)
    with pytest.raises(UserError, match="no NVIDIA GPU here"):
        gpu.main([])


@pytest.mark.slow
def test_a_train_step_runs_and_is_reported(gpu):
    setting = gpu.smoke()
    done = {
        f"pewm_jax/{name}": gpu.part(f"pewm_jax/{name}", setting) for name in ("ceiling", "train")
    }
    table = gpu.report(done).splitlines()
    assert len(table) == 4
    assert "pewm_jax/train" in table[-1]
    assert "%" in table[-1]


@pytest.mark.slow
def test_it_goes_on_where_it_stopped(gpu, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(gpu, "has_gpu", lambda: True)
    monkeypatch.setattr(gpu, "torch_has_cuda", lambda: False)
    state = tmp_path / "state.json"
    numbers = {"ms": 2.0, "flops": 4e9, "batch": 1}
    state.write_text(json.dumps({f"pewm_jax/{name}": numbers for name in gpu.OURS}))
    monkeypatch.setattr(gpu.subprocess, "run", lambda *_, **__: pytest.fail("nothing was left"))
    gpu.main(["--state", str(state)])
    assert "| pewm_jax/clip | 2.0 |  | 2.0 |" in capsys.readouterr().out


@pytest.mark.slow
def test_the_flop_formula_agrees_with_the_compiler(gpu):
    setting = gpu.smoke()
    config = dataclasses.replace(setting.dit, layers=1, heads=8)
    setting = dataclasses.replace(setting, dit=config)
    params = jax.eval_shape(lambda: dit.init(config, jax.random.key(0)))
    latents, text = gpu.inputs(setting, 1)
    run = jax.jit(lambda p: dit.apply(config, p, latents, text, jax.numpy.array([5])))
    counted = run.lower(params).compile().cost_analysis()["flops"]
    assert 0.9 < setting.flops / counted < 1.02, "the compiler also counts norms and modulation"
