"""Export a run as programs that run without this library: StableHLO, serialised by ``jax.export``.

::

    DST/start.jaxexport       frames → the state of a world          (with what = rollout)
        rollout.jaxexport     state, actions, key → state, frames    (with what = rollout)
        denoise.jaxexport     one evaluation of the denoiser         (with what = denoise)
        NAME.cuda.jaxexport   the same for platforms with other kernels
        weights.safetensors   the run's weights, unchanged
        signature.json        names, shapes and dtypes of all inputs and outputs
        run.py, README.md     how to call them, with jax and three small packages

Weights are arguments, not constants: the programs stay small, all share one weights file, and
weights that are trained further fit the same programs. State, frames and cameras are flat named
arrays, so no class of this library is needed.

Kernels are chosen for each platform (``nn.target``): convolutions differ, and TPUs get splash
attention. Platforms with the same operations share a file; another one has a file of its own, such
as ``rollout.tpu.jaxexport``. NVIDIA GPUs get attention in its plain form: the custom calls of
cuDNN's kernel are not stable.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from pewm_jax import __version__, worlds
from pewm_jax import registry as kinds
from pewm_jax.config import Config, UserError
from pewm_jax.convert import pipeline, standalone
from pewm_jax.data import abstract
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.io import tree
from pewm_jax.io import weights as io_weights
from pewm_jax.memory import interface as memories
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.nn import target
from pewm_jax.train import runs
from pewm_jax.types import Array, Camera, Control, MemoryReadout, Params
from pewm_jax.worlds import lora, rollouts, world_model

Arrays: TypeAlias = dict[str, Array]
"""Name → array, or anything with a shape and a dtype."""
PLATFORMS = ("cpu", "cuda", "tpu")
"""The platforms for which a program is lowered, if possible."""
ADDRESS = re.compile(r"0x[0-9a-f]+")
"""A place in memory in the text of a jaxpr, which differs from trace to trace."""
SIGNATURE, SCRIPT = "signature.json", "run.py"
TOLERANCE = {"float32": 1e-3, "bfloat16": 3e-2}
"""Largest difference from the library, relative to the largest value, by model.dtype."""


@dataclasses.dataclass(frozen=True)
class Program:
    """One function to be exported.

    Attributes:
        meaning: a one-line description.
        function: ``(weights, inputs) -> outputs``, all flat named arrays.
        inputs: the inputs' shapes and dtypes.
    """

    meaning: str
    function: Callable[[Arrays, Arrays], Arrays]
    inputs: Arrays


def rollout_programs(config: Config, params: Params, frames: int, clips: int) -> dict[str, Program]:
    """Return ``start``, from ``frames`` observed frames, and ``rollout``, of ``clips`` clips.

    See ``pewm_jax.worlds``. Of the parameters only paths and shapes are used.
    """
    clip = config.model.clip
    observed = abstract.frames(frames, height=clip.height, width=clip.width)
    state = jax.eval_shape(lambda p, f: worlds.start(config, p, f), params, observed)

    def start(weights: Arrays, inputs: Arrays) -> Arrays:
        (packed,) = _pack({"frames": observed}, inputs)
        return _name(state=worlds.start(config, tree.unflatten(weights), packed))

    def rollout(weights: Arrays, inputs: Arrays) -> Arrays:
        (packed,) = _pack({"state": state}, inputs)
        key = jax.random.wrap_key_data(inputs["key"], impl="threefry2x32")
        world = tree.unflatten(weights)
        after, imagined = worlds.imagine(config, world, packed, inputs["actions"], key)
        return _name(state=after, imagined=imagined)

    moves = jax.ShapeDtypeStruct((clips * (clip.frames - 1), 3), jnp.float32)
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    return {
        "start": Program(
            "starts a world from posed RGB-D frames, the last of which is the present one",
            start,
            _name(frames=observed),
        ),
        "rollout": Program(
            "imagines what follows: actions are (dx, dy, dyaw) in metres forward, metres left "
            "and radians to the left; colours come out in [-1, 1], depth in metres",
            rollout,
            {**_name(state=state), "actions": moves, "key": key},
        ),
    }


def denoise_program(config: Config, params: Params, batch: int = 1) -> Program:
    """Return one evaluation of the denoiser (``world_model.apply``) for ``batch`` clips.

    Of the parameters only paths and shapes are used.

    Raises:
        UserError: the model has a draft, which a single evaluation would have to be given.
    """
    model = config.model
    clip = model.clip
    if model.draft.PREDICTS:
        raise UserError(
            "One step of a model with a draft (model.draft) cannot be exported alone: export its "
            "rollout, with --what rollout."
        )

    def like(shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    camera = abstract.camera(batch, clip.frames)
    observed = abstract.frames(batch, 1, height=clip.height, width=clip.width, colours=jnp.float32)
    conditioning = jax.eval_shape(
        lambda p, observed, camera: world_model.condition(model, p, observed, Control(camera)),
        params,
        observed,
        camera,
    )
    parts = {"conditioning": conditioning}
    if "memory" in params:

        def read(p: Params, c: Camera) -> Any:
            return memories.readout(model, model.memory.empty(model, jnp.zeros(3)), c, params=p)

        readout = jax.eval_shape(jax.vmap(read, (None, 0)), params, camera)
        shown = {"tokens": readout.tokens, "view": readout.view, "encoded": readout.encoded}
        parts |= {name: part for name, part in shown.items() if part is not None}
    noisy = like((*model.latent_shape, model.codec.channels))

    def denoise(weights: Arrays, inputs: Arrays) -> Arrays:
        packed = dict(zip(parts, _pack(parts, inputs), strict=True))
        conditioning = packed.pop("conditioning")
        readout = MemoryReadout(**packed) if packed else None
        noisy, times = inputs["noisy_BthwC"], inputs["timesteps_B"]
        world = tree.unflatten(weights)
        out = world_model.apply(model, world, noisy, conditioning, times, readout)
        return {"prediction_BthwC": out}

    noise, time = model.noise, like(())
    meaning = f"noise {kinds.of(noise).name}, see `pewm_jax.diffusion`"
    if isinstance(noise, DDPMConfig):
        time = like((), jnp.int32)
        meaning = f"the prediction is {noise.target} at levels 0 to {noise.train_steps - 1}"
    return Program(
        f"one evaluation of the denoiser: {meaning}",
        denoise,
        {"noisy_BthwC": noisy, "timesteps_B": time, **_name(**parts)},
    )


def lower(
    program: Program, weights: Arrays, platforms: Sequence[str]
) -> tuple[jax.export.Exported, ...]:
    """Lower a program for every one of the platforms that supports it.

    Returns:
        One or more programs. Platforms for which the operations are the same share one.

    Raises:
        UserError: it cannot be lowered for any platform.
    """
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), x.dtype), weights)
    groups: dict[str, list[str]] = {}
    for name in platforms:
        with target.use(target.Target(name)):
            traced = jax.jit(program.function).trace(like, program.inputs)
        operations = ADDRESS.sub("", str(traced.jaxpr))
        groups.setdefault(operations, []).append(name)
    found, failed = [], ""
    for names in groups.values():
        exported, reason = _lower_together(program, like, names)
        found += exported
        failed = failed or reason
    if not found:
        raise UserError(
            f"This model cannot be lowered for {', '.join(platforms)} ({failed}); choose other "
            "platforms."
        )
    return tuple(found)


def _lower_together(
    program: Program, weights: Arrays, platforms: Sequence[str]
) -> tuple[list[jax.export.Exported], str]:
    """Lower a program with the same operations for those of some platforms that support it.

    Returns:
        One program, or none and the reason.
    """
    function = jax.jit(program.function)

    def attempt(names: Sequence[str]) -> jax.export.Exported:
        with target.use(target.Target(names[0])):
            return jax.export.export(function, platforms=names)(weights, program.inputs)

    try:
        return [attempt(platforms)], ""
    except (NotImplementedError, ValueError) as error:
        reason = str(error).splitlines()[0]
    possible = []
    for name in platforms:
        with contextlib.suppress(NotImplementedError, ValueError):
            attempt([name])
            possible.append(name)
    return ([attempt(possible)] if possible else []), reason


def _name(**parts: Any) -> Arrays:
    """Flatten pytrees into named arrays: ``frames/camera/intrinsics_4``."""
    return tree.flatten(parts)


def _pack(parts: dict[str, Any], arrays: Arrays) -> list[Any]:
    """Build pytrees like the given ones from named arrays, the inverse of ``_name``."""
    return [
        jax.tree.unflatten(jax.tree.structure(like), [arrays[n] for n in _name(**{part: like})])
        for part, like in parts.items()
    ]


def export(
    run: Path,
    dst: Path,
    *,
    what: Literal["rollout", "denoise"] = "rollout",
    clips: int = 1,
    frames: int | None = None,
    platforms: Sequence[str] = PLATFORMS,
    check: bool = True,
    log: Callable[[str], Any] = print,
) -> Path:
    """Write programs that run without this library into a new folder.

    Args:
        run: a run's folder with ``weights.safetensors``, or a folder of ``export inference``, which
            has smaller weights.
        what: ``rollout``, which also includes the start of a world from frames; or ``denoise``, one
            evaluation of the denoiser.
        clips: number of clips imagined per call of the rollout.
        frames: number of observed frames from which a world starts; by default ``data.context``.
        platforms: from ``PLATFORMS``; those for which a program cannot be lowered are skipped.
        check: whether to run the programs on the CPU, in a fresh process in which this library
            cannot be imported, and compare with the library. For a large model this takes long.

    Returns:
        ``dst``.

    Raises:
        UserError: ``dst`` exists; the run is missing or damaged; a count or platform is invalid; or
            the check fails.
    """
    _check_arguments(run, clips, frames, platforms)
    lora.require_whole(run)
    with pipeline.new_folder(dst) as folder:
        log(f"reading {run} …")
        config, params = rollouts.load_finished(run)
        backbone = getattr(config.model, "backbone", None)
        if isinstance(backbone, DiTBackbone):
            anywhere = dataclasses.replace(backbone, attention="auto")
            config = config.with_model(backbone=anywhere)
        if what == "rollout":
            programs = rollout_programs(config, params, frames or config.data.context, clips)
        else:
            programs = {"denoise": denoise_program(config, params)}
        weights = tree.flatten(params)
        entries = {}
        for name, program in programs.items():
            log(f"lowering {name} for {', '.join(platforms)} …")
            exported = lower(program, weights, platforms)
            entries[name] = _entry(name, program, exported)
            skipped = [p for p in platforms if p not in entries[name]["platforms"]]
            if skipped:
                log(f"{name} cannot be lowered for {', '.join(skipped)}: skipped.")
            for one in exported:
                file = entries[name]["files"][one.platforms[0]]
                (folder / file).write_bytes(_serialize(one))
        # Not a copy: kernels may be stored in 8 bits, and the programs take them as they are read.
        io_weights.save(folder / runs.WEIGHTS, params, io_weights.metadata(run / runs.WEIGHTS))
        signature = {
            "made_by": f"pewm_jax {__version__}, jax {jax.__version__}",
            "weights": runs.WEIGHTS,
            "programs": entries,
            "discrete_actions": _actions(config),
        }
        (folder / SIGNATURE).write_text(json.dumps(signature, indent=1) + "\n", encoding="utf-8")
        shutil.copyfile(Path(standalone.__file__), folder / SCRIPT)
        (folder / "README.md").write_text(_readme(dst.name, signature), encoding="utf-8")
        if check and "cpu" in platforms:
            log("checking in a fresh process, without this library …")
            worst = verify(folder, programs, params, TOLERANCE[config.model.dtype])
            log(f"largest difference from the library, of the largest value: {worst:.1e}")
    log(f"{dst} is ready: python {dst / SCRIPT}")
    return dst


def verify(folder: Path, programs: dict[str, Program], params: Params, tolerance: float) -> float:
    """Run ``run.py`` in a fresh process without this library and compare with the library.

    Both run on the CPU, with the random inputs of ``run.py``.

    Returns:
        The largest difference, relative to the largest value of its array.

    Raises:
        UserError: the process fails, or differs by more than the tolerance.
    """
    alone = (
        "import runpy, sys; sys.modules['pewm_jax'] = None; sys.argv = ['run.py', *sys.argv[1:]]; "
        "runpy.run_path('run.py', run_name='__main__')"
    )
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out.npz"
        done = subprocess.run(  # noqa: S603 - this interpreter and the script above
            [sys.executable, "-c", alone, "--out", str(out)],
            cwd=folder,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no output"])[-1]
            raise UserError(f"The exported programs do not run in a fresh process: {last}")
        got = dict(np.load(out))
    signature = json.loads((folder / SIGNATURE).read_text("utf-8"))
    values: Arrays = standalone.example(signature)
    with jax.default_device(jax.devices("cpu")[0]):
        for program in programs.values():
            inputs = {name: values[name] for name in program.inputs}
            values |= jax.jit(program.function)(tree.flatten(params), inputs)
    worst = max(difference(got[name], np.asarray(values[name])) for name in got)
    if not worst <= tolerance:
        raise UserError(
            f"The exported programs differ from the library by {worst:.1e} of the largest value, "
            f"more than {tolerance:.0e}; export again on another machine or report it."
        )
    return worst


def difference(got: np.ndarray, want: np.ndarray) -> float:
    """Return max |got − want| / max |want|, over the values that are finite in ``want``.

    Infinite values must be equal; returns infinity if they or the shapes differ.
    """
    if got.shape != want.shape or got.dtype != want.dtype:
        return float("inf")
    finite = np.isfinite(want.astype(np.float64))
    if not np.array_equal(got[~finite], want[~finite], equal_nan=True):
        return float("inf")
    got, want = got[finite].astype(np.float64), want[finite].astype(np.float64)
    if not want.size:
        return 0.0
    return float(np.abs(got - want).max() / max(np.abs(want).max(), 1e-12))


def _serialize(exported: jax.export.Exported) -> bytes:
    try:
        return bytes(exported.serialize())
    except ImportError:
        raise UserError(
            "jax.export cannot write programs without flatbuffers; run pip install flatbuffers."
        ) from None


def _entry(name: str, program: Program, exported: Sequence[jax.export.Exported]) -> dict[str, Any]:
    """Describe a program for ``signature.json``; ``file`` is that of the first platform."""
    first, *others = exported
    files = dict.fromkeys(first.platforms, f"{name}.jaxexport")
    for one in others:
        files |= dict.fromkeys(one.platforms, f"{name}.{one.platforms[0]}.jaxexport")
    outputs = jax.tree.unflatten(first.out_tree, first.out_avals)
    return {
        "file": f"{name}.jaxexport",
        "files": files,
        "meaning": program.meaning,
        "platforms": list(files),
        "inputs": _describe_arrays(program.inputs),
        "outputs": _describe_arrays(outputs),
    }


def _describe_arrays(arrays: Arrays) -> list[dict[str, Any]]:
    return [
        {"name": name, "shape": list(x.shape), "dtype": np.dtype(x.dtype).name}
        for name, x in arrays.items()
    ]


def _actions(config: Config) -> dict[str, list[float]]:
    """Return name → (dx, dy, dyaw) of the discrete actions."""
    table = np.asarray(action_geometry.discrete_table(config.model.actions))
    return {name: table[i].tolist() for i, name in enumerate(action_geometry.NAMES)}


def _check_arguments(run: Path, clips: int, frames: int | None, platforms: Sequence[str]) -> None:
    if not run.is_dir():
        raise UserError(f"{run} is not a folder; give a run made by train.py.")
    for name, count in (("clips", clips), ("frames", 1 if frames is None else frames)):
        if count < 1:
            raise UserError(f"{name} is {count}: use at least 1.")
    unknown = [name for name in platforms if name not in PLATFORMS]
    if unknown or not platforms:
        raise UserError(
            f"There is no platform {', '.join(unknown) or 'given'}; choose from "
            f"{', '.join(PLATFORMS)}."
        )


def _files_text(entry: dict[str, Any]) -> str:
    """Return a program's files with their platforms."""
    files: dict[str, list[str]] = {}
    for platform, file in entry["files"].items():
        files.setdefault(file, []).append(platform)
    return ", ".join(f"`{file}` ({', '.join(names)})" for file, names in files.items())


def _readme(name: str, signature: dict[str, Any]) -> str:
    programs = "\n".join(
        f"- {_files_text(entry)}: {entry['meaning']}." for entry in signature["programs"].values()
    )
    moves = "\n".join(
        f"- {action}: `{[round(x, 4) for x in move]}`"
        for action, move in signature["discrete_actions"].items()
    )
    return f"""# {name}

A world model as StableHLO programs, written by {signature["made_by"]}. It needs
`pip install jax numpy safetensors flatbuffers`, but not the library that wrote it:

```
python run.py
```

{programs}

`run.py` takes the file of the platform of its devices.
`signature.json` lists every input and output with shape and dtype; weights are arguments of the
programs, in `{signature["weights"]}`. `run.py` is short and meant to be read. By hand:

```python
import jax, jax.export
from safetensors.flax import load_file

with open("{next(iter(signature["programs"]))}.jaxexport", "rb") as file:
    program = jax.export.deserialize(bytearray(file.read()))
outputs = jax.jit(program.call)(load_file("{signature["weights"]}"), inputs)  # name -> array
```

Cameras: OpenCV axes, `world_from_camera` 4 × 4 in metres, intrinsics (fx, fy, cx, cy) in pixels
with pixel centres at +0.5; depth along z in metres, 0 = not measured; z of the world points up. The
actions of the training data as (dx, dy, dyaw):

{moves}

The files are readable by the jax that wrote them and newer ones, for as long as `jax.export`
promises (half a year at least); export again for later ones.
"""
