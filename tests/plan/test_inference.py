"""`plan --inference`: the programs of a trained model, from shapes alone."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets, worlds
from pewm_jax.config import ConfigError, Launch, UserError, World
from pewm_jax.nn import target
from pewm_jax.nn.target import Target
from pewm_jax.plan import inference, plan, target_compiler, topology
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train import chips
from pewm_jax.worlds import quantized
from tests.plan.test_target_compiler import report

TINY = presets.load("tiny")


def test_programs_depend_on_what_the_world_can_do():
    assert inference.names(presets.load("pewm_2b")) == (
        "start",
        "clip-50",
        "clip-4",
        "update",
        "imagine_many",
    )
    svd = inference.names(presets.load("egowm_svd"))
    assert "update" not in svd
    assert "clip-4" in svd
    with pytest.raises(UserError, match="a plan of inference got a run that"):
        inference.names(presets.load("nomad"))


def test_titles_name_the_sizes():
    config = presets.load("pewm_2b")
    titles = [inference.title(config, name) for name in inference.names(config)]
    assert titles[1] == "a clip of 8 actions, 50 sampling steps"
    assert "16 candidates of 8 actions, 50 sampling steps" in titles[-1]


def test_weights_are_those_of_an_export():
    shapes = inference.abstract_weights(TINY.model)
    real = jax.eval_shape(lambda: worlds.init(TINY.model, jax.random.key(0)))
    assert jax.tree.structure(shapes) == jax.tree.structure(real)
    for one, other in zip(jax.tree.leaves(shapes), jax.tree.leaves(real), strict=True):
        assert one.shape == other.shape
        assert one.dtype == (jnp.bfloat16 if other.dtype == jnp.float32 else other.dtype)


@pytest.mark.parametrize("name", inference.names(TINY))
def test_every_program_can_be_traced_and_its_work_counted(name):
    program = inference.program(TINY, name)
    traced = inference.trace(program, jax.devices()[0])
    weights = sum(leaf.size * 2 for leaf in jax.tree.leaves(program.arguments[0]))
    assert program.argument_bytes > weights
    work = inference.needed(program)
    assert work.total > 0 or name in ("start", "update"), "tiny has no encoder with products"
    assert not work.unknown
    if name.startswith("clip"):
        other = inference.needed(inference.program(TINY, "clip-4")).total
        assert np.sign(work.total - other) == (0 if name == "clip-4" else 1)
    lines = traced.lower().as_text().splitlines()
    main = next(line for line in lines if "func.func public @main" in line)
    assert main.count("%arg") == len(jax.tree.leaves(program.arguments)), "no weight is dropped"


@pytest.mark.slow(but=("tiny-h100", "egowm_tiny-h100"))
@pytest.mark.parametrize("chip", ["h100", "v5e"])
@pytest.mark.parametrize(
    "preset", [name for name in presets.names() if isinstance(presets.load(name).model, World)]
)
def test_programs_of_every_world_are_traced_for_chips(has_cudnn, preset, chip):
    config = presets.load(preset).with_model(dtype="bfloat16")
    platform = chips.named(chip).platform
    where = Target(platform, (9, 0) if platform == "cuda" else (0, 0))
    for name in inference.names(config):
        program = inference.program(config, name)
        with target.use(where):
            jax.make_jaxpr(program.function)(*program.arguments)


@pytest.mark.slow
def test_weights_in_8_bits_take_half_and_compute_as_much():
    whole, eight = (inference.program(TINY, "clip-4", precision) for precision in ("", "int8"))
    assert eight.argument_bytes < whole.argument_bytes
    assert inference.needed(eight).total == inference.needed(whole).total
    real = worlds.init(TINY.model, jax.random.key(0))
    real = jax.tree.map(lambda x: x.astype(jnp.bfloat16), real)
    real = jax.tree.leaves(quantized.quantize(TINY.model, real, "int8"))
    shapes = jax.tree.leaves(eight.arguments[0])
    assert [(x.shape, x.dtype) for x in shapes] == [(x.shape, x.dtype) for x in real]
    assert inference.title(TINY, "start", "int8").endswith("weights in int8")
    with pytest.raises(ConfigError, match="--quantize int8 is for inference: add --inference"):
        Launch(quantize="int8")


def test_cards_are_compared_in_gigabytes():
    assert inference.fits_gb(16e9) == {"16": True, "24": True, "80": True}
    assert inference.fits_gb(16e9 + 1) == {"16": False, "24": True, "80": True}
    assert inference.fits_gb(None) == {"16": False, "24": False, "80": False}


def test_the_command_prints_and_writes_every_program(monkeypatch, tmp_path):
    asked = []

    def compiled(config, name, chip, quantize):
        asked.append((name, chip.name))
        return report(name=name, devices=1, fits_gb=inference.fits_gb(20e9))

    monkeypatch.setattr(topology, "require_compiler", lambda chip: None)
    monkeypatch.setattr(target_compiler, "compile_inference", compiled)
    file, said = tmp_path / "plan.json", []
    launch = Launch(plan=True, chip="h100", compiler="target", inference=True, json=str(file))
    plan.show(TINY, launch, said.append)
    assert asked == [(name, "h100") for name in inference.names(TINY)]
    stages = [StageReport(**one) for one in json.loads(file.read_text())["stages"]]
    assert [one.name for one in stages] == list(inference.names(TINY))
    text = "\n".join(said)
    assert "fits a card of: 16 GB no, 24 GB yes, 80 GB yes" in text
    assert "imagine_many: 16 candidates" in text
    assert "clips/s" not in text


@pytest.mark.parametrize("chip", ["v5e", "h100"])
def test_a_tiny_clip_is_compiled_for_a_chip_that_is_not_there(chip):
    chip = chips.named(chip)
    try:
        topology.require_compiler(chip)
    except UserError as error:
        pytest.skip(str(error))
    config = TINY.with_model(dtype="bfloat16")
    found = target_compiler.compile_inference(config, "clip-4", chip)
    assert (found.name, found.devices) == ("clip-4", 1)
    assert found.fits
    assert found.fits_gb == {"16": True, "24": True, "80": True}
    # A TPU pads small arrays.
    assert found.argument_bytes >= 0.99 * inference.program(config, "clip-4").argument_bytes
    assert found.flops_executed >= 0.99 * found.flops_needed > 0
    assert found.roofline_s > 0
    assert dataclasses.asdict(found)["collectives"] == []
