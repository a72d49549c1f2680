"""`--compiler target`: described devices, reading the chip's program, refusals and the command."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from pewm_jax import presets
from pewm_jax.config import ConfigError, Launch, MeshConfig, UserError, serialize
from pewm_jax.nn import attention, target
from pewm_jax.nn.target import Target
from pewm_jax.plan import plan, program, target_compiler, topology
from pewm_jax.plan.measure import MeshSizes
from pewm_jax.plan.program import Collective
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train import chips, flops

ROOT = Path(__file__).parents[2]
SMALL = ("--train.stage1.batch", "4", "--train.stage2.steps", "0", "--model.dtype", "bfloat16")


def installed(name):
    """Return the chip of this name; skip the test if its compiler is not installed."""
    chip = chips.named(name)
    try:
        topology.require_compiler(chip)
    except UserError as error:
        pytest.skip(str(error))
    return chip


@pytest.mark.parametrize(
    ("chip", "count", "name"),
    [
        ("v4", 8, "v4:2x2x2"),
        ("v5e", 1, "v5e:1x1"),
        ("v5e", 8, "v5e:2x4"),
        ("v5e", 256, "v5e:16x16"),
        ("v5p", 4, "v5p:2x2x1"),
        ("v5p", 64, "v5p:4x4x4"),
        ("v6e", 16, "v6e:4x4"),
        ("tpu7x", 8, "tpu7x:2x2x1"),
        ("tpu7x", 16, "tpu7x:2x2x2"),
    ],
)
def test_tpus_are_described_by_the_topology_closest_to_a_cube(chip, count, name):
    assert topology.tpu_topology(chips.named(chip), count) == name


def test_numbers_of_devices_that_no_topology_has_are_refused():
    for chip, count in (("v5p", 7), ("tpu7x", 9), ("v6e", 6)):
        with pytest.raises(UserError, match="no topology of that many"):
            topology.tpu_topology(chips.named(chip), count)


def test_only_tpus_have_slices_and_slices_are_equal():
    launch = Launch(plan=True, chip="h100", devices=16, slices=2, compiler="target")
    with pytest.raises(UserError, match="--slices is 2: h100 has none"):
        plan.show(presets.load("tiny"), launch)
    with pytest.raises(ConfigError, match="--slices is 3: use a divisor of --devices 8"):
        Launch(slices=3, compiler="target")
    with pytest.raises(ConfigError, match=r"--slices 2 describes .* add --compiler target"):
        Launch(slices=2)
    chip = chips.named("v5p")
    assert topology.of_slices(chip, 64, 4).island == 16
    assert topology.of_slices(chip, 64, 1) is chip


def test_every_chip_has_a_capacity_near_its_memory_and_gpus_a_description():
    for chip in chips.CHIPS:
        assert topology.capacity(chip) == pytest.approx(chip.memory, rel=0.1)
    assert {chip.name for chip in chips.CHIPS if chip.platform == "cuda"} == set(topology.GPUS)
    text = topology.target_config(topology.GPUS["h100"])
    assert "core_count: 132 " in text
    assert "cuda_compute_capability { major: 9 }" in text
    assert 'device_description_str: "NVIDIA H100 80GB HBM3"' in text


@pytest.mark.parametrize(("chip", "extra"), [("v5e", "plan-tpu"), ("b200", "plan-cuda")])
def test_without_its_compiler_a_chip_is_refused_in_one_sentence(monkeypatch, capsys, chip, extra):
    from pewm_jax.cli import main

    monkeypatch.setattr(topology, "_versions", lambda _: {})
    assert main.main(["plan", "tiny", "--chip", chip, "--compiler", "target"]) == 2
    error = capsys.readouterr().err
    assert f"'pewm-jax[{extra}]'" in error
    assert len(error.strip().splitlines()) == 1


def test_an_unknown_compiler_is_refused():
    with pytest.raises(ConfigError, match="--compiler is gcc: use cpu, target"):
        Launch(compiler="gcc")


def test_a_plan_without_the_chip_s_compiler_writes_its_estimates_in_the_same_form():
    launch = Launch(plan=True, devices=1, chip="v5e", compiled="off")
    plans = plan.show(presets.load("tiny"), launch, lambda _: None)
    estimates = [plan.estimate(one) for one in plans]
    assert [one.name for one in estimates] == ["stage1", "stage2"]
    for one in estimates:
        assert one.temporary_bytes is None, "not compiled"
        assert 0 < one.argument_bytes < one.capacity_bytes
        assert one.flops_executed > 0.99 * one.flops_needed > 0
        json.dumps(dataclasses.asdict(one))


def test_the_products_of_splash_attention_are_counted_with_their_padding():
    shape = jax.ShapeDtypeStruct((2, 3, 500, 64), jnp.bfloat16)

    def total(q, k, v):
        return attention.attention(q, k, v).astype(jnp.float32).sum()

    with target.use(Target("tpu")):
        traced = jax.jit(jax.grad(total, (0, 1, 2))).trace(shape, shape, shape)
    products = 2 + 3 + 4  # forward, queries, keys and values
    expected = products * 2 * (2 * 3 * 512 * 512 * 128)
    found = flops.executed(traced.jaxpr, "tpu").flops
    assert found == {"attention": pytest.approx(expected, rel=1e-3)}


REFUSALS = {
    "RESOURCE_EXHAUSTED: E1000: CompileTimeHbmOom: Ran out of memory on HBM, the total memory "
    "required for HLO temporaries (117.50G) exceeds available HBM (95.73G).": (117.50, 95.73),
    "RESOURCE_EXHAUSTED: Ran out of memory in memory space hbm. Used 20.00G of 15.75G hbm. "
    "Exceeded hbm capacity by 4.25G.": (20.0, 15.75),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_a_refusal_for_memory_is_an_answer_with_its_numbers(message):
    needed, available = (number * 2**30 for number in REFUSALS[message])
    assert target_compiler.parse_refusal(message) == (needed, available)
    refused = target_compiler._refused(report(), message, (3.0, 2.0), {})
    assert not refused.fits
    arguments = report().argument_bytes if "temporaries" in message else 0.0
    assert (refused.peak_bytes, refused.capacity_bytes) == (needed + arguments, available)
    with pytest.raises(UserError, match=r"failed on stage1: INTERNAL: something"):
        target_compiler._refused(report(), "INTERNAL: something", (3.0, 2.0), {})


def report(**changes):
    values = {
        "name": "stage1",
        "chip": "v5p",
        "devices": 8,
        "mesh": {"data": 1, "fsdp": 8, "tensor": 1, "context": 1},
        "compiler": {"name": "libtpu", "version": "0.0.51"},
        "options": {},
        "argument_bytes": 4 * 2.0**30,
        "temporary_bytes": 30 * 2.0**30,
        "output_bytes": 4 * 2.0**30,
        "alias_bytes": 4 * 2.0**30,
        "peak_bytes": 34 * 2.0**30,
        "capacity_bytes": 95 * 2.0**30,
        "fits": True,
        "refusal": "",
        "flops_needed": 3e15,
        "flops_executed": 4e15,
        "bytes": 1e12,
        "kernels": {"attention": {"splash_mha_fwd": 30}},
        "collectives": [{"kind": "all-gather", "axis": "fsdp", "bytes": 1e10}],
        "roofline_s": 8.7,
        "bound": "flops",
        "mfu": 0.75,
        "trace_s": 10.0,
        "compile_s": 200.0,
        "notes": ["Nothing runs."],
    }
    return StageReport(**{**values, **changes})


def test_the_plan_prints_every_stage_and_writes_the_numbers(monkeypatch, tmp_path):
    asked = []

    def compile_stage(config, stage, chip, devices, slices):
        asked.append((stage, chip.name, devices))
        return report(name=stage)

    monkeypatch.setattr(topology, "require_compiler", lambda chip: None)
    monkeypatch.setattr(target_compiler, "compile_stage", compile_stage)
    file, said = tmp_path / "plan.json", []
    launch = Launch(plan=True, devices=2, chip="v5p", compiler="target", json=str(file))
    plan.show(presets.load("tiny"), launch, said.append)
    assert asked == [("stage1", "v5p", 2), ("stage2", "v5p", 2)]
    text = "\n".join(said)
    for words in ("34.00 GiB", "fits: 34.00 GiB of 95.00 GiB", "splash_mha_fwd × 30", "MFU 75.0%"):
        assert words in text
    stages = json.loads(file.read_text())["stages"]
    assert [StageReport(**stage) for stage in stages] == [
        report(name="stage1"),
        report(name="stage2"),
    ]


@pytest.mark.parametrize("compiler", ["cpu", "target"])
@pytest.mark.parametrize("file", ["none/plan.json", "", "file/plan.json"])
def test_a_file_that_cannot_be_written_is_refused_before_compiling(
    monkeypatch, capsys, tmp_path, compiler, file
):
    from pewm_jax.cli import main

    def compiled(*_, **__):
        raise AssertionError("it is compiled")

    monkeypatch.setattr(topology, "require_compiler", lambda chip: None)
    monkeypatch.setattr(target_compiler, "compile_stage", compiled)
    monkeypatch.setattr(plan, "plan_stage", compiled)
    (tmp_path / "file").touch()
    flags = ("--devices", "1", "--compiler", compiler, "--json", str(tmp_path / file))
    assert main.main(["plan", "tiny", *flags]) == 2
    error = capsys.readouterr().err
    assert f"--json {tmp_path / file}" in error
    assert len(error.strip().splitlines()) == 1


def test_what_does_not_fit_is_printed_with_the_compiler_s_reason():
    refused = report(
        fits=False, peak_bytes=None, temporary_bytes=None, roofline_s=None, mfu=None, refusal="No."
    )
    text = "\n".join(plan.report_lines(refused, "stage 1", 256))
    assert "does not fit: more of 95.00 GiB" in text
    assert "the compiler refused it: No." in text


PROGRAM = (Path(__file__).parent / "program.hlo").read_text()


def test_a_chip_s_program_is_read_with_its_loops_slices_and_memories():
    found = program.read(PROGRAM, for_chip=True)
    assert found.kernels == {
        "attention": {"splash_mha_fwd": 1},
        "gemm": {"XLA fusion": 5},
    }
    assert found.unknown == []
    row = 8 * 4 * 4
    in_loop = (8 * 16 * 4 + row) + (row + 4 + row) + (row + 4 + row)
    kernel = 4 * 2 * 128 * 128 * 2
    gather = 2 * 128 * 128 * 2  # its result is in on-chip memory
    assert found.bytes == 5 * in_loop + kernel + gather
    assert [item.kind for item in found.collectives] == ["all-gather"], "continuations are none"


def test_communication_between_slices_is_read_from_what_the_hosts_send():
    target = '_xla_megascale_target="{1,2,3}x{0:3}",_xla_megascale_transfer_type="ALL_REDUCE"'
    text = f"""ENTRY main {{
  p = f32[6,8]{{1,0}} parameter(0)
  token = token[] after-all()
  ROOT send = (f32[6,8]{{1,0}}, u32[], token[]) send(p, token), frontend_attributes={{{target}}}
}}"""
    found = program.read(text, for_chip=True).collectives
    assert found == [Collective("all-reduce", (0, 4, 8), 2 * 6 * 8 * 4 * 2 / 3)]
    assert MeshSizes(data=3, fsdp=4).axes_of(found[0].group) == "data"
    assert not program.read(text.replace("mega", "other"), for_chip=True).collectives


def test_communication_is_named_by_the_axes_of_the_mesh():
    items = [
        Collective("all-gather", (0, 2), 1.0),
        Collective("all-gather", (2, 0), 2.0),
        Collective("all-reduce", (0, 2, 4, 6), 4.0),
        Collective("all-reduce", tuple(range(8)), 8.0),
        Collective("all-reduce", (0, 1, 2), 16.0),
        Collective("collective-permute", (3, 2), 32.0),
    ]
    assert MeshSizes(data=2, fsdp=2, context=2).sent(items) == {
        ("all-gather", "fsdp"): 3.0,
        ("all-reduce", "data+fsdp"): 4.0,
        ("all-reduce", "data+fsdp+context"): 8.0,
        ("all-reduce", "fsdp+context"): 16.0,
        ("collective-permute", "context"): 32.0,
    }


INDEPENDENT = '''
import functools, sys
import jax, numpy as np
from jax.experimental import topologies
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec as P
from pewm_jax import config, presets
from pewm_jax.data import abstract
from pewm_jax.nn import target
from pewm_jax.train import step
from pewm_jax.worlds.pewm.world import STAGES
import dataclasses

settings = presets.load("tiny")
settings = dataclasses.replace(
    settings.with_model(dtype="bfloat16"),
    train=dataclasses.replace(
        settings.train,
        stage1=dataclasses.replace(settings.train.stage1, batch=4),
        stage2=dataclasses.replace(settings.train.stage2, steps=0),
    ),
)
H100 = """
gpu_device_info {
  core_count: 132 fpus_per_core: 128 shared_memory_per_core: 233472
  shared_memory_per_block_optin: 232448 memory_bandwidth: 3352320000000 l2_cache_size: 52428800
  clock_rate_ghz: 1.98 device_memory_size: 84942979072 cuda_compute_capability { major: 9 }
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  threads_per_core_limit: 2048 block_dim_limit_x: 2147483647 block_dim_limit_y: 65535
  block_dim_limit_z: 65535 registers_per_core_limit: 65536 registers_per_block_limit: 65536
}
runtime_version { major: 12 minor: 8 patch: 0 } platform_name: "CUDA"
dnn_version_info { major: 9 minor: 7 } device_description_str: "NVIDIA H100 80GB HBM3"
"""
if sys.argv[1] == "v5e":
    described = topologies.get_topology_desc(platform="tpu", topology_name="v5e:2x2")
    kind = target.Target("tpu")
else:
    described = topologies.get_topology_desc(
        "h100", platform="cuda", target_config=H100, topology="1x1x4"
    )
    kind = target.Target("cuda", (9, 0))
devices = described.devices
mesh = Mesh(
    np.array(devices).reshape(4, 1, 1, 1), config.AXES, axis_types=(AxisType.Auto,) * 4
)
everywhere, split = NamedSharding(mesh, P()), NamedSharding(mesh, P(("data", "fsdp")))
stage, key = STAGES[0], jax.random.key(0)
state = jax.eval_shape(functools.partial(step.create, settings, stage), key)
clip = abstract.clip(settings, 4)
place = lambda tree, where: jax.tree.map(
    lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where), tree
)
with jax.set_mesh(mesh), target.use(kind):
    function = jax.jit(
        functools.partial(step.train_step, settings, stage),
        out_shardings=(jax.tree.map(lambda _: everywhere, state), everywhere),
        donate_argnums=0,
    )
    lowered = function.lower(place(state, everywhere), place(clip, split), place(key, everywhere))
found = lowered.compile().memory_analysis()
new = found.output_size_in_bytes - found.alias_size_in_bytes
print(found.argument_size_in_bytes + found.temp_size_in_bytes + new)
'''


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v5e", "h100"])
def test_the_peak_is_that_of_a_script_that_calls_the_compiler_itself(name):
    chip = installed(name)
    config = presets.load("tiny").with_model(dtype="bfloat16")
    stages = {
        "stage1": dataclasses.replace(config.train.stage1, batch=4),
        "stage2": dataclasses.replace(config.train.stage2, steps=0),
    }
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, **stages))
    stage = target_compiler.compile_stage(config, "stage1", chip, 4)
    done = subprocess.run(
        [sys.executable, "-c", INDEPENDENT, name],
        env={**os.environ, **topology.ENVIRONMENT, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert stage.peak_bytes == pytest.approx(float(done.stdout.split()[-1]), rel=0.01)


@pytest.mark.parametrize("chip", ["v5e", "h100"])
def test_a_tiny_step_is_compiled_for_a_chip_that_is_not_there(tmp_path, chip):
    installed(chip)
    file = tmp_path / "plan.json"
    flags = ("--chip", chip, "--devices", "4", "--compiler", "target", "--json", str(file))
    done = subprocess.run(
        [sys.executable, "-m", "pewm_jax", "plan", "tiny", *flags, *SMALL],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (stage,) = (StageReport(**one) for one in json.loads(file.read_text())["stages"])
    assert stage.fits
    assert 0 < stage.peak_bytes < stage.capacity_bytes
    new = stage.output_bytes - stage.alias_bytes
    assert stage.peak_bytes == stage.argument_bytes + stage.temporary_bytes + new
    assert stage.flops_executed > 0.99 * stage.flops_needed > 0
    assert stage.kernels["gemm"]
    assert ("attention" in stage.kernels) == (chip == "h100"), "few tokens need none on a TPU"
    assert {item["axis"] for item in stage.collectives} == {"data"}
    assert "fits: " in done.stdout
    assert dataclasses.asdict(stage)["compiler"]["version"]


@pytest.mark.slow
def test_slices_are_joined_along_data_by_the_slower_network():
    chip = installed("v5e")
    config = presets.load("tiny").with_model(dtype="bfloat16")
    train = dataclasses.replace(
        config.train,
        mesh=MeshConfig(data=2, fsdp=4),
        stage1=dataclasses.replace(config.train.stage1, batch=8),
    )
    config = dataclasses.replace(config, train=train)
    together, apart = (
        target_compiler.compile_stage(config, "stage1", chip, 8, slices) for slices in (1, 2)
    )
    assert apart.fits
    assert {"data", "fsdp"} <= {item["axis"] for item in apart.collectives}
    assert apart.bound == "collectives"
    assert apart.roofline_s > together.roofline_s
    wide = dataclasses.replace(config, train=dataclasses.replace(train, mesh=MeshConfig(fsdp=8)))
    with pytest.raises(UserError, match=r"train\.mesh\.data is 1: use a multiple of .* slices, 2"):
        target_compiler.compile_stage(wide, "stage1", chip, 8, 2)


def test_a_compilation_ends_with_the_process_that_asked_for_it_and_leaves_no_files(tmp_path):
    folder = tmp_path / "plan"
    folder.mkdir()
    (folder / "dump.txt").write_text("a program")
    code = (
        "import os, pathlib\n"
        "from pewm_jax.plan import target_compiler\n"
        f"target_compiler._exit_after({os.getpid() + 1}, pathlib.Path({str(folder)!r}))\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], timeout=120, check=False)
    assert ended.returncode == 1
    assert not folder.exists()


def test_a_failure_of_the_process_is_reported_with_its_reason(tmp_path):
    asked, answered = tmp_path / "request.json", tmp_path / "report.json"
    config = serialize.to_dict(presets.load("tiny"))
    request = {"plugins": [], "config": config, "kind": "stage", "name": "stage9", "chip": "v5e"}
    more = {"devices": 1, "slices": 1, "parent": os.getpid(), "folder": str(tmp_path)}
    asked.write_text(json.dumps({**request, **more}))
    command = [sys.executable, "-m", "pewm_jax.plan.target_compiler", str(asked), str(answered)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    error = json.loads(answered.read_text())["error"]
    assert error.startswith("The plan of stage9 for v5e failed with ValueError: not enough values")
    assert "Traceback" in done.stderr
