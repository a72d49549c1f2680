"""Export a run as programs that run without this library: StableHLO, serialised by ``jax.export``.

::

    DST/start.jaxexport       frames → the state of a world          (with what = rollout)
        rollout.jaxexport     state, actions, key → state, frames    (with what = rollout)
        denoise.jaxexport     one evaluation of the denoiser         (with what = denoise)
        weights.safetensors   the run's weights, unchanged
        signature.json        names, shapes and dtypes of all inputs and outputs
        run.py, README.md     how to call them, with jax and three small packages

Weights are arguments, not constants: the programs stay small, all share one weights file, and
weights that are trained further fit the same programs. Attention is lowered in its plain form,
which runs on every platform; cuDNN's kernel exists on one platform and its custom calls are not
stable. State, frames and cameras are flat named arrays, so no class of this library is needed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.export
import numpy as np

from pewm_jax import __version__
from pewm_jax.config import Config, UserError
from pewm_jax.convert import output, standalone
from pewm_jax.convert.stablehlo_programs import (
    Arrays,
    Program,
    denoise_program,
    lower,
    rollout_programs,
)
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.io import tree
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.train import runs
from pewm_jax.types import Params
from pewm_jax.worlds import rollouts

PLATFORMS = ("cpu", "cuda", "tpu")
"""The platforms for which a program is lowered, if possible."""
SIGNATURE, SCRIPT = "signature.json", "run.py"
TOLERANCE = {"float32": 1e-3, "bfloat16": 3e-2}
"""Largest difference from the library, relative to the largest value, by model.dtype."""


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
        dst: the folder to create.
        what: ``rollout``, which also includes the start of a world from frames; or ``denoise``, one
            evaluation of the denoiser.
        clips: number of clips imagined per call of the rollout.
        frames: number of observed frames from which a world starts; by default ``data.context``.
        platforms: from ``PLATFORMS``; those for which a program cannot be lowered are skipped.
        check: whether to run the programs on the CPU, in a fresh process in which this library
            cannot be imported, and compare with the library. For a large model this takes long.
        log: called with a line per step.

    Returns:
        ``dst``.

    Raises:
        UserError: ``dst`` exists; the run is missing or damaged; a count or platform is invalid; or
            the check fails.
    """
    _check_arguments(run, clips, frames, platforms)
    with output.new_folder(dst) as folder:
        log(f"reading {run} …")
        config, params = rollouts.load_finished(run)
        backbone = getattr(config.model, "backbone", None)
        if isinstance(backbone, DiTBackbone):
            anywhere = dataclasses.replace(backbone, attention="xla")
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
            skipped = [p for p in platforms if p not in exported.platforms]
            if skipped:
                log(f"{name} cannot be lowered for {', '.join(skipped)}: skipped.")
            (folder / f"{name}.jaxexport").write_bytes(_serialize(exported))
            entries[name] = _entry(name, program, exported)
        shutil.copyfile(run / runs.WEIGHTS, folder / runs.WEIGHTS)
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


def _entry(name: str, program: Program, exported: jax.export.Exported) -> dict[str, Any]:
    """Describe a program for ``signature.json``."""
    outputs = jax.tree.unflatten(exported.out_tree, exported.out_avals)
    return {
        "file": f"{name}.jaxexport",
        "meaning": program.meaning,
        "platforms": list(exported.platforms),
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


def _readme(name: str, signature: dict[str, Any]) -> str:
    programs = "\n".join(
        f"- `{entry['file']}` ({', '.join(entry['platforms'])}): {entry['meaning']}."
        for entry in signature["programs"].values()
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
