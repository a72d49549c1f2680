"""Exported programs run in a process that has no model code, and do what the library does."""

import importlib.util
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.config import ClipConfig, UserError
from pewm_jax.convert import inference, stablehlo
from pewm_jax.convert import stablehlo as stablehlo_programs
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import tree
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.nn import attention
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.train import runs
from pewm_jax.worlds import world_model
from tests.helpers import random_frames, tiny_config

CONFIG = tiny_config(
    clip=ClipConfig(frames=5, height=16, width=16),
    memory=VoxelConfig(
        cells=(16, 16, 8), capacity=128, tokens=8, reader=AttentionConfig(heads=4, head_dim=8)
    ),
    noise=DDPMConfig(sample_steps=1, sampler="dpm"),
)
ALONE = (
    "import runpy, sys; sys.modules.update(pewm_jax=None, flax=None); "
    "runpy.run_path(sys.argv[0], run_name='__main__')"
)

serialises = pytest.mark.skipif(
    importlib.util.find_spec("flatbuffers") is None, reason="flatbuffers is not installed"
)


@pytest.fixture(scope="module")
def params():
    like = jax.eval_shape(lambda key: world_model.init(CONFIG.model, key), jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: rng.normal(0, 0.2, x.shape).astype(np.float32), like)


@pytest.fixture(scope="module")
def run(params, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "mine"
    folder.mkdir()
    configuration.save(CONFIG, folder / runs.CONFIG)
    runs.publish(folder, worlds.stages(CONFIG.model)[1], 7, params)
    return folder


def alone(folder, *flags):
    """Run a folder's run.py where neither this library nor flax can be imported."""
    code = f"import sys; sys.argv = sys.argv[1:]; {ALONE}"
    return subprocess.run(
        [sys.executable, "-c", code, str(folder / "run.py"), *map(str, flags)],
        cwd=folder.parent,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@serialises
def test_a_rollout_runs_without_the_library_and_equals_it(run, params, tmp_path):
    dst, said = tmp_path / "program", []
    stablehlo.export(run, dst, clips=2, frames=3, check=False, log=said.append)
    assert not any("skipped" in line for line in said)
    signature = json.loads((dst / "signature.json").read_text())
    for entry in signature["programs"].values():
        assert entry["platforms"] == ["cpu", "cuda", "tpu"]
    assert signature["discrete_actions"]["forward"] == [CONFIG.model.actions.step_m, 0.0, 0.0]

    frames = random_frames(np.random.default_rng(0), 3, 16, 16)
    moves = np.random.default_rng(1).normal(0, 0.1, (8, 3)).astype(np.float32)
    inputs = {**tree.flatten({"frames": frames}), "actions": moves, "key": np.uint32([0, 5])}
    np.savez(tmp_path / "in.npz", **inputs)
    done = alone(dst, "--inputs", tmp_path / "in.npz", "--out", tmp_path / "out.npz")
    assert done.returncode == 0, done.stderr
    got = dict(np.load(tmp_path / "out.npz"))

    start = jax.jit(pewm_jax.start, static_argnums=0)
    rollout = jax.jit(pewm_jax.rollout, static_argnums=0)
    state = start(CONFIG, params, frames)
    after, imagined = rollout(CONFIG, params, state, moves, jax.random.key(5))
    want = tree.flatten({"state": after, "imagined": imagined})
    assert got.keys() == want.keys()
    for name, value in want.items():
        assert stablehlo.difference(got[name], np.asarray(value)) <= 1e-3, name
    for entry in signature["programs"]["rollout"]["outputs"]:
        assert got[entry["name"]].shape == tuple(entry["shape"])
        assert got[entry["name"]].dtype == entry["dtype"]

    refused = alone(dst, "--inputs", tmp_path / "out.npz")
    assert "frames/rgb_THWC (3, 16, 16, 3) uint8 is missing" in refused.stderr
    with pytest.raises(UserError, match="exists already"):
        stablehlo.export(run, dst, log=said.append)


@pytest.mark.slow
@serialises
def test_a_denoise_step_is_checked_in_a_fresh_process(run, params, tmp_path):
    said = []
    stablehlo.export(run, tmp_path / "step", what="denoise", platforms=["cpu"], log=said.append)
    assert any("largest difference" in line for line in said)
    program = stablehlo_programs.denoise_program(CONFIG, params)
    assert {"noisy_BthwC", "timesteps_B", "tokens/valid_M"} <= program.inputs.keys()
    bare = stablehlo_programs.denoise_program(CONFIG, {"backbone": params["backbone"]})
    assert not any(name.startswith("tokens") for name in bare.inputs)

    other = jax.tree.map(lambda x: x * 1.5, params)
    with pytest.raises(UserError, match="differ from the library by"):
        stablehlo.verify(tmp_path / "step", {"denoise": program}, other, 1e-3)
    (tmp_path / "step" / "denoise.jaxexport").write_bytes(b"nothing")
    with pytest.raises(UserError, match="do not run in a fresh process"):
        stablehlo.verify(tmp_path / "step", {"denoise": program}, params, 1e-3)


@pytest.mark.slow
@serialises
def test_weights_in_8_bits_are_exported_as_they_are_read(run, tmp_path):
    inference.export(run, tmp_path / "eight", "int8", log=lambda _: None)
    said = []
    dst = tmp_path / "step"
    stablehlo.export(
        tmp_path / "eight", dst, what="denoise", platforms=["cpu"], log=said.append
    )  # compares in a fresh process
    assert any("largest difference" in line for line in said)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"clips": 0}, "clips is 0: use at least 1"),
        ({"frames": 0}, "frames is 0: use at least 1"),
        ({"platforms": ["rocket"]}, "no platform rocket; choose from cpu, cuda, tpu"),
        ({"platforms": []}, "no platform given"),
    ],
)
def test_what_cannot_be_exported_is_refused_and_leaves_nothing(run, tmp_path, options, sentence):
    with pytest.raises(UserError, match=sentence):
        stablehlo.export(run, tmp_path / "x", **options, log=lambda _: None)
    with pytest.raises(UserError, match="not a folder"):
        stablehlo.export(tmp_path / "none", tmp_path / "x", log=lambda _: None)
    assert list(tmp_path.iterdir()) == []


def test_platforms_that_a_program_cannot_be_lowered_for_are_left_out():
    def only_cpu(weights, inputs):
        del weights
        return {"y": jax.lax.platform_dependent(inputs["x"], cpu=jnp.sin)}

    shape = {"x": jax.ShapeDtypeStruct((2,), jnp.float32)}
    program = stablehlo_programs.Program("", only_cpu, shape)
    (lowered,) = stablehlo_programs.lower(program, {}, ["cpu", "tpu"])
    assert lowered.platforms == ("cpu",)
    with pytest.raises(UserError, match="cannot be lowered for tpu"):
        stablehlo_programs.lower(program, {}, ["tpu"])


def test_platforms_with_other_kernels_have_programs_of_their_own():
    def attend(weights, inputs):
        del weights
        return {"y": attention.attention(inputs["x"], inputs["x"], inputs["x"], "auto")}

    program = stablehlo_programs.Program(
        "", attend, {"x": jax.ShapeDtypeStruct((1, 2, 512, 64), jnp.bfloat16)}
    )
    common, tpu = stablehlo_programs.lower(program, {}, stablehlo.PLATFORMS)
    assert (common.platforms, tpu.platforms) == (("cpu", "cuda"), ("tpu",))
    assert "tpu_custom_call" in tpu.mlir_module()
    assert "custom_call" not in common.mlir_module()
    entry = stablehlo._entry("attend", program, (common, tpu))
    both = dict.fromkeys(("cpu", "cuda"), "attend.jaxexport")
    assert entry["files"] == {**both, "tpu": "attend.tpu.jaxexport"}
    assert entry["platforms"] == list(stablehlo.PLATFORMS)
    assert "`attend.tpu.jaxexport` (tpu)" in stablehlo._files_text(entry)
    assert "`attend.jaxexport` (cpu, cuda)" in stablehlo._files_text(entry)


def test_a_tiny_model_is_lowered_for_every_platform(params):
    denoise = stablehlo.denoise_program(CONFIG, params)
    rollout = stablehlo.rollout_programs(CONFIG, params, 2, 1)
    for program in (denoise, *rollout.values()):
        found = stablehlo.lower(program, tree.flatten(params), stablehlo.PLATFORMS)
        assert {name for one in found for name in one.platforms} == set(stablehlo.PLATFORMS)


@pytest.mark.parametrize(
    ("got", "want", "difference"),
    [
        ([1.0, 2.0], [1.0, 2.0], 0.0),
        ([1.0, 2.1], [1.0, 2.0], 0.05),
        ([1.0, -np.inf], [1.0, -np.inf], 0.0),
        ([1.0, 2.0], [1.0, -np.inf], np.inf),
        ([1.0], [1.0, 1.0], np.inf),
        ([np.nan, 1.0], [1.0, 1.0], np.nan),
    ],
)
def test_differences_are_of_the_largest_value_and_infinities_must_agree(got, want, difference):
    found = stablehlo.difference(np.array(got), np.array(want))
    np.testing.assert_allclose(found, difference)
