"""Run an exported world model without any model code.

Requires ``pip install jax numpy safetensors flatbuffers``::

    python run.py                                   # random frames: shows that it runs
    python run.py --inputs mine.npz --out out.npz   # arrays by the names in signature.json

From Python::

    import run

    model = run.Model(".")
    values = model({"frames/rgb_THWC": …, …, "actions": …, "key": run.key(0)})

Programs are called in the order of signature.json; the outputs of one are inputs of the next. To
continue from the end of a rollout, call ``model.programs["rollout"]`` with the returned
``state/…``.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.export
import numpy as np
from safetensors.flax import load_file


class Model:
    """The programs of a folder, each compiled on its first call.

    Attributes:
        signature: the content of signature.json.
        weights: name → array.
        programs: name → function from named arrays to named arrays.
    """

    def __init__(self, folder: str | Path):
        folder = Path(folder)
        self.signature = json.loads((folder / "signature.json").read_text("utf-8"))
        self.weights = load_file(folder / self.signature["weights"])
        self.programs = {
            name: self._program(folder / _file(name, entry), entry)
            for name, entry in self.signature["programs"].items()
        }

    def __call__(self, values):
        """Call every program in order and return all their outputs."""
        returned = {}
        for program in self.programs.values():
            returned.update(program({**values, **returned}))
        return returned

    def _program(self, file, entry):
        call = jax.jit(jax.export.deserialize(bytearray(file.read_bytes())).call)

        def program(values):
            inputs = {}
            for item in entry["inputs"]:
                name, shape = item["name"], tuple(item["shape"])
                if name not in values:
                    raise SystemExit(f"error: {name} {shape} {item['dtype']} is missing.")
                inputs[name] = np.asarray(values[name], item["dtype"])
                if inputs[name].shape != shape:
                    got = inputs[name].shape
                    raise SystemExit(f"error: {name} has the shape {got}; it must be {shape}.")
            return call(self.weights, inputs)

        return program


def _file(name, entry):
    platform = jax.devices()[0].platform
    platform = {"gpu": "cuda"}.get(platform, platform)
    if platform not in entry["files"]:
        known = ", ".join(entry["files"])
        raise SystemExit(f"error: {name} was written for {known} and not for {platform}.")
    return entry["files"][platform]


def key(seed):
    """Return the PRNG key of a seed, for sampling."""
    return np.array([0, seed], np.uint32)


def example(signature, seed=0):
    """Return synthetic inputs: noise images, walls two metres away, a camera at the origin."""
    rng = np.random.default_rng(seed)
    values, returned = {}, set()
    for entry in signature["programs"].values():
        for item in entry["inputs"]:
            if item["name"] not in returned:
                values[item["name"]] = _random_input(rng, item)
        returned |= {item["name"] for item in entry["outputs"]}
    return values


def _random_input(rng, item):
    name, shape, dtype = item["name"].split("/")[-1], tuple(item["shape"]), item["dtype"]
    level = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]]
    known = {"key": key(0), "intrinsics_4": [8, 8, 8, 8], "world_from_camera": level}
    if name in known:
        made = np.broadcast_to(known[name], shape)
    elif name == "depth_THW":
        made = rng.uniform(1.5, 2.5, shape)
    elif dtype == "bool":
        made = np.ones(shape)
    elif np.issubdtype(dtype, np.integer):
        made = rng.integers(0, 256, shape)
    else:
        made = rng.normal(size=shape) * (0.1 if name == "actions" else 1.0)
    return np.array(made, dtype)


def main():
    """Run the programs on given or synthetic inputs."""
    parser = argparse.ArgumentParser(description="Run an exported world model.")
    parser.add_argument("--inputs", help="npz file of inputs, by the names in signature.json")
    parser.add_argument("--out", help="npz file for the outputs of the programs")
    arguments = parser.parse_args()
    model = Model(Path(__file__).parent)
    for name, entry in model.signature["programs"].items():
        print(f"{name}: {entry['meaning']}")
        for way in ("inputs", "outputs"):
            for item in entry[way]:
                print(f"  {way[:-1]:<7} {item['name']} {item['dtype']} {tuple(item['shape'])}")
    values = dict(np.load(arguments.inputs)) if arguments.inputs else example(model.signature)
    began = time.perf_counter()
    returned = {name: np.asarray(value) for name, value in model(values).items()}
    print(f"ran in {time.perf_counter() - began:.1f} s, compiling included, {jax.devices()[0]}")
    for name, value in returned.items():
        if np.issubdtype(value.dtype, np.floating) and value.size:
            print(f"  {name}: {value.min():.4g} to {value.max():.4g}")
    if arguments.out:
        with Path(arguments.out).open("wb") as file:
            np.savez(file, allow_pickle=False, **returned)
        print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
