"""Compile a program with the compiler of a chip that is not present.

The program is the real training step of a stage (``compile_stage``) or one of inference
(``compile_inference``). The compilation runs in a process of its own: the compilers read
environment variables and hold gigabytes. The process traces the program from shapes on a described
topology (``topology``), compiles it and reports what the compiler decided. Nothing runs, so times
are bounds from data sheets and not measurements.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pewm_jax.config import AXES, Config, serialize
from pewm_jax.errors import UserError
from pewm_jax.plan import topology
from pewm_jax.train import chips
from pewm_jax.train.chips import Chip

NO_TRITON: dict[str, str | bool] = {"xla_gpu_enable_triton_gemm": False}
"""Options for programs with a matrix product for which no tiles are found without a device."""
NO_TILES = "Couldn't find output tile sizes"
"""Part of the CUDA compiler's message about such a product."""
UNKNOWN = (
    "Nothing runs: the time is a lower bound from data sheets, without waiting or latency.",
    "Without a device there is no autotuning, so kernels on the device may differ.",
    "Memory of the runtime and of other processes is not included.",
)
"""What such a plan cannot know."""

_OOM = re.compile(
    r"(?:total memory required[^()]*\(|Used )([\d.]+)([KMGT]?).*?"
    r"(?:available HBM \(|of )([\d.]+)([KMGT]?)",
    re.DOTALL,
)
_UNITS = {"": 1.0, "K": 2.0**10, "M": 2.0**20, "G": 2.0**30, "T": 2.0**40}


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageReport:
    """What a chip's compiler says about one program; bytes and FLOPs are of one device and step.

    Attributes:
        name: the stage, or the program of inference.
        chip: the kind of device.
        devices: number of devices.
        mesh: devices along each mesh axis.
        compiler: its name and version.
        options: compiler options that differ from the defaults.
        argument_bytes: state and batch.
        temporary_bytes: temporary memory; of a program that does not fit, what it would need.
        output_bytes: results, including those in the memory of arguments.
        alias_bytes: results in the memory of arguments.
        peak_bytes: memory of the program: arguments, temporary memory and new results.
        capacity_bytes: memory that a program may use.
        fits: whether it suffices.
        fits_gb: size of a card in GB → whether the program fits it; of inference only.
        refusal: the compiler's reason if it refused the program.
        flops_needed: FLOPs that the mathematics needs.
        flops_executed: FLOPs with recomputation and padding.
        bytes: bytes read from and written to the device's memory.
        kernels: kind → name of a kernel → launches.
        collectives: kind, mesh axis and bytes that a device sends.
        roofline_s: lower bound of the time of a step.
        bound: what bounds it: flops, bytes or collectives.
        mfu: needed FLOPs over the peak FLOPs in that time.
        flags: flags that select its settings; of ``--fit`` only.
        tries: what was compiled to find them; of ``--fit`` only.
        trace_s: seconds of tracing and lowering.
        compile_s: seconds of compilation.
        compile_cpu_s: processor time of compilation, in seconds, over all threads.
        notes: what is uncertain about the numbers.
    """

    name: str
    chip: str
    devices: int
    mesh: dict[str, int]
    compiler: dict[str, str]
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    argument_bytes: float | None
    temporary_bytes: float | None = None
    output_bytes: float | None = None
    alias_bytes: float | None = None
    peak_bytes: float | None = None
    capacity_bytes: float
    fits: bool = False
    fits_gb: dict[str, bool] = dataclasses.field(default_factory=dict)
    refusal: str = ""
    flops_needed: float
    flops_executed: float
    bytes: float | None = None
    kernels: dict[str, dict[str, int]] = dataclasses.field(default_factory=dict)
    collectives: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    roofline_s: float | None = None
    bound: str = ""
    mfu: float | None = None
    flags: str = ""
    tries: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    trace_s: float = 0.0
    compile_s: float = 0.0
    compile_cpu_s: float = 0.0
    notes: list[str] = dataclasses.field(default_factory=list)


def sent_by_axes(sent: Mapping[tuple[str, str], float]) -> list[dict[str, Any]]:
    """Return bytes by (kind, axes of the mesh) in the form of ``StageReport.collectives``."""
    return [{"kind": kind, "axis": axes, "bytes": size} for (kind, axes), size in sent.items()]


def compile_stage(
    config: Config, stage: str, chip: Chip, devices: int, slices: int = 1
) -> StageReport:
    """Compile the training step of the stage of this name in a process of its own.

    ``slices`` is the number of slices of TPUs that ``devices`` are.

    Raises:
        UserError: the compiler is not installed, or it fails for another reason than memory.
    """
    return _ask(config, chip, stage, devices, "stage", slices=slices)


def compile_inference(config: Config, program: str, chip: Chip, quantize: str = "") -> StageReport:
    """Compile a program of ``inference.names`` for one device in a process of its own.

    Raises:
        UserError: as for ``compile_stage``.
    """
    return _ask(config, chip, program, 1, "inference", quantize=quantize)


def _ask(
    config: Config, chip: Chip, name: str, devices: int, kind: str, **more: Any
) -> StageReport:
    """Start the process that compiles, and return its report."""
    topology.require_compiler(chip)
    request = {
        "config": serialize.to_dict(config),
        "plugins": _plugins(config),
        "kind": kind,
        "name": name,
        "chip": chip.name,
        "devices": devices,
        "parent": os.getpid(),
        **more,
    }
    with tempfile.TemporaryDirectory(prefix="pewm-plan-") as folder:
        asked, answered = Path(folder) / "request.json", Path(folder) / "report.json"
        asked.write_text(json.dumps({**request, "folder": folder}))
        here = str(Path(__file__).parents[2])
        path = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH", ""))))
        done = subprocess.run(  # noqa: S603 - this library's own module
            [sys.executable, "-m", "pewm_jax.plan.target_compiler", str(asked), str(answered)],
            env={**os.environ, **topology.ENVIRONMENT, "PYTHONPATH": path, "TMPDIR": folder},
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        if not answered.exists():
            lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            raise UserError(f"The compiler of {chip.name} failed on {name}: {lines[-1]}")
        answer = json.loads(answered.read_text())
    if "error" in answer:
        raise UserError(answer["error"])
    return StageReport(**answer)


def _plugins(config: Any) -> list[tuple[str, str]]:
    """Return name and file of the modules outside the library that define parts of a config."""
    found: dict[str, str] = {}
    queue = [config]
    while queue:
        value = queue.pop()
        name = type(value).__module__
        file = getattr(sys.modules.get(name), "__file__", None)
        if file and not name.startswith("pewm_jax."):
            found[name] = file
        queue += [
            part
            for field in dataclasses.fields(value)
            if dataclasses.is_dataclass(part := getattr(value, field.name))
        ]
    return list(found.items())


def main(asked: str, answered: str) -> None:
    """Answer a request of ``_ask``: read its file and write the report's."""
    request = json.loads(Path(asked).read_text())
    watched = request["parent"], Path(request["folder"])
    threading.Thread(target=_exit_after, args=watched, daemon=True).start()
    try:
        for name, file in request["plugins"]:
            _load(name, file)
        config = serialize.from_dict(Config, request["config"])
        chip = chips.named(request["chip"])
        if request["kind"] == "inference":
            report = _inference(config, request["name"], chip, request["quantize"])
        else:
            report = _stage(config, request["name"], chip, request["devices"], request["slices"])
        answer = dataclasses.asdict(report)
    except UserError as error:
        answer = {"error": str(error)}
    except Exception as error:  # noqa: BLE001 - the process that asked raises it
        traceback.print_exc()
        sentence = f"{type(error).__name__}: {' '.join(str(error).split())[:400]}"
        name, chip = request["name"], request["chip"]
        answer = {"error": f"The plan of {name} for {chip} failed with {sentence}"}
    Path(answered).write_text(json.dumps(answer))


def _exit_after(parent: int, folder: Path) -> None:
    """End this process once its parent has ended, even if it was killed, and remove its folder."""
    while os.getppid() == parent:
        time.sleep(0.5)
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _load(name: str, file: str) -> None:
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])


def _stage(config: Config, name: str, chip: Chip, count: int, slices: int) -> StageReport:
    """Trace and compile a stage, in the process for it."""
    import jax  # noqa: PLC0415 - only this process uses JAX

    from pewm_jax.data import abstract  # noqa: PLC0415
    from pewm_jax.plan import measure, suggest  # noqa: PLC0415
    from pewm_jax.train import runs, sharding, step  # noqa: PLC0415

    (stage,) = (one for one in runs.planned(config) if one.name == name)
    mesh = sharding.make_mesh(topology.devices(chip, count, slices), config.train.mesh)
    chip = topology.of_slices(chip, count, slices)
    sizes = measure.MeshSizes(**{name: mesh.shape[name] for name in AXES})
    clip = abstract.clip(config, stage.settings(config).batch, features=stage.memory)
    given = stage.extra_weights(config.model, config.train) if stage.extra_weights else None
    given = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), given)
    began = time.monotonic()
    traced = step.trace_step(config, stage, mesh, clip, given)
    lowered = traced.lower()
    trace_s = time.monotonic() - began
    work = measure.work_of(config, stage, traced, chip)
    report = StageReport(
        name=name,
        chip=chip.name,
        devices=count,
        mesh=sizes.sizes,
        compiler=topology.compiler(chip),
        argument_bytes=suggest.memory_of(config, stage, sizes).state,
        capacity_bytes=topology.capacity(chip),
        flops_needed=work.needed.total / count,
        flops_executed=sum(work.on_device(sizes).values()),
        trace_s=trace_s,
        notes=list(UNKNOWN),
    )
    return _compiled(report, lowered, config, chip)


def _inference(config: Config, name: str, chip: Chip, quantize: str) -> StageReport:
    """Trace and compile a program of inference, in the process for it."""
    from pewm_jax.plan import inference, measure  # noqa: PLC0415
    from pewm_jax.train import flops  # noqa: PLC0415

    program = inference.program(config, name, quantize)
    began = time.monotonic()
    traced = inference.trace(program, topology.one_device(chip))
    lowered = traced.lower()
    trace_s = time.monotonic() - began
    report = StageReport(
        name=name,
        chip=chip.name,
        devices=1,
        mesh=measure.MeshSizes().sizes,
        compiler=topology.compiler(chip),
        argument_bytes=program.argument_bytes,
        capacity_bytes=topology.capacity(chip),
        flops_needed=inference.needed(program).total,
        flops_executed=flops.executed(traced.jaxpr, chip.platform).total,
        trace_s=trace_s,
        notes=[*UNKNOWN, inference.ALL_WEIGHTS],
    )
    report = _compiled(report, lowered, config, chip)
    return dataclasses.replace(report, fits_gb=inference.fits_gb(report.peak_bytes))


def _compiled(report: StageReport, lowered: Any, config: Config, chip: Chip) -> StageReport:
    """Compile a program, and return the report with what the compiler says."""
    import jax  # noqa: PLC0415 - only this process uses JAX

    from pewm_jax.plan import measure, program, suggest  # noqa: PLC0415

    sizes = measure.MeshSizes(**report.mesh)
    began, cpu_began = time.monotonic(), _processor_time()
    with tempfile.TemporaryDirectory(prefix="pewm-hlo-") as folder:
        # A TPU's compiled program cannot always be printed; what its compiler writes can be read.
        written: dict[str, str | bool] = (
            {"xla_dump_to": folder, "xla_dump_hlo_as_text": True} if chip.platform == "tpu" else {}
        )
        options: dict[str, str | bool] = {}
        try:
            try:
                compiled = lowered.compile(compiler_options=written)
            except jax.errors.JaxRuntimeError as error:
                if NO_TILES not in str(error):
                    raise
                options = NO_TRITON
                compiled = lowered.compile(compiler_options={**written, **options})
        except jax.errors.JaxRuntimeError as error:
            seconds = time.monotonic() - began, _processor_time() - cpu_began
            return _refused(report, str(error), seconds, options)
        seconds = time.monotonic() - began, _processor_time() - cpu_began
        text = _text(compiled, Path(folder))
    memory: Any = compiled.memory_analysis()
    arguments, temporary = measure.device_memory(compiled)
    report = dataclasses.replace(
        report,
        options=dict(options),
        argument_bytes=arguments,
        temporary_bytes=float(memory.temp_size_in_bytes),
        output_bytes=float(memory.output_size_in_bytes),
        alias_bytes=float(memory.alias_size_in_bytes),
        peak_bytes=arguments + temporary,
        fits=arguments + temporary <= report.capacity_bytes,
        compile_s=seconds[0],
        compile_cpu_s=seconds[1],
    )
    if not text:
        report.notes.append("The compiler does not print this program: its kernels are unknown.")
        return _timed(report, config, chip, 0.0)
    found = program.read(text, for_chip=True)
    if found.unknown:
        loops = ", ".join(found.unknown)
        report.notes.append(f"Loops of unknown length count as one run: {loops}.")
    if options:
        report.notes.append(
            "Compiled without Triton's matrix products, which need a device for one."
        )
    report = dataclasses.replace(
        report,
        bytes=found.bytes,
        kernels=found.kernels,
        collectives=sent_by_axes(sizes.sent(found.collectives)),
    )
    sent = (item for item in found.collectives if len(item.group) > 1)
    link_s = math.fsum(item.sent / suggest.rate(item.group, chip) for item in sent)
    return _timed(report, config, chip, link_s)


def _processor_time() -> float:
    """Return the processor time of this process and of the assemblers that it started."""
    return math.fsum(os.times()[:4])


def _text(compiled: Any, folder: Path) -> str:
    """Return the text of a compiled program, or nothing if it is not available."""
    from jax.errors import JaxRuntimeError  # noqa: PLC0415 - only this process uses JAX

    try:
        return compiled.as_text() or ""
    except JaxRuntimeError:
        for name in ("after_codegen", "after_optimizations"):
            files = sorted(folder.glob(f"*.{name}.txt"), key=lambda file: file.stat().st_size)
            if files:  # the largest: a program may bring small ones, such as of a constant
                return files[-1].read_text()
    return ""


def _refused(
    report: StageReport, message: str, seconds: tuple[float, float], options: dict[str, Any]
) -> StageReport:
    """Return the report of a program that the compiler refuses for its memory.

    ``seconds`` are those of compilation and of the processor.

    Raises:
        UserError: it refuses for another reason.
    """
    sentence = " ".join(message.split())
    if "RESOURCE_EXHAUSTED" not in message:
        raise UserError(f"The compiler of {report.chip} failed on {report.name}: {sentence[:400]}")
    needed, available = parse_refusal(message)
    peak = needed
    if needed is not None and "temporaries" in message:  # without the state and the batch
        peak = needed + (report.argument_bytes or 0.0)
    return dataclasses.replace(
        report,
        options=dict(options),
        fits=False,
        temporary_bytes=needed,
        peak_bytes=peak,
        capacity_bytes=available or report.capacity_bytes,
        refusal=sentence[:400],
        compile_s=seconds[0],
        compile_cpu_s=seconds[1],
    )


def parse_refusal(message: str) -> tuple[float | None, float | None]:
    """Return the bytes that a refused program needs, and those that there are, if it says so."""
    found = _OOM.search(message)
    if found is None:
        return None, None
    needed, available = (float(found[k]) * _UNITS[found[k + 1]] for k in (1, 3))
    return needed, available


def _timed(report: StageReport, config: Config, chip: Chip, link_s: float) -> StageReport:
    """Add the bound of the time."""
    peak = chip.flops if config.model.dtype == "bfloat16" else chip.flops / 2
    seconds = {
        "flops": report.flops_executed / peak,
        "bytes": (report.bytes or 0.0) / chip.bandwidth,
        "collectives": link_s,
    }
    bound = max(seconds, key=lambda name: seconds[name])
    return dataclasses.replace(
        report,
        roofline_s=seconds[bound],
        bound=bound,
        mfu=report.flops_needed / (seconds[bound] * chip.flops),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
