"""CogVideoX-2b on one NVIDIA GPU at the world model's clip, bf16, beside diffusers with compile.

Run with ``python benchmarks/cogvideox_gpu.py``. A clip is 9 frames of 512×512, which are 3×32×32
video tokens and 226 of text. Every part runs in a process of its own, so that its peak memory is
its own, and its numbers are kept in ``--state``: after an interruption, or the ``--seconds`` of one
command, run the same command again and it goes on. ``--record`` writes the section of RESULTS.md.
``--smoke`` shows on a CPU, with absurdly small networks, that the parts run.

"plan" is what the compiler says of our programs: their memory, and a lower bound of their time from
the data sheet. MFU is against the measured rate of a large bf16 matrix product. FLOPs are those of
the matrix products; a train step counts three forwards.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import record

from pewm_jax.cli import parser as cli
from pewm_jax.config import UserError
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import atomic
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox import vae
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.plan import measure, program
from pewm_jax.train import chips

NAME = "cogvideox_gpu"
OURS = ("ceiling", "forward", "train", "clip", "decode")
PEER = ("forward", "train", "clip", "decode")
HEADER = ("", "ms", "plan: at best", "TFLOP/s", "MFU", "peak memory, GB", "plan", "compile, s")
HEADER += ("batch",)


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is measured."""

    dit: DiTBackbone
    vae: VAECodec
    frames: int
    pixels: int
    batch: int
    steps: int
    repeats: int
    square: int
    dtype: Any

    @property
    def latents(self) -> tuple[int, int, int, int]:
        """(t, h, w, C) of a clip's latents."""
        side = self.pixels // self.vae.spatial
        return vae.latents_of(self.vae, self.frames), side, side, self.dit.in_channels

    @property
    def flops(self) -> float:
        """FLOPs of one clip's forward pass through the transformer, 2 per multiply-add."""
        config, (t, h, w, _) = self.dit, self.latents
        video, width = t * h * w // config.patch**2, config.width
        tokens = video + config.text_length
        block = tokens * width * width * (4 + 2 * config.mlp_ratio) + 2 * tokens**2 * width
        ends = video * width * config.patch**2 * (config.in_channels + config.out_channels)
        ends += config.text_length * config.text_dim * width
        return 2.0 * (config.layers * block + ends)


def full(batch: int, repeats: int) -> Setting:
    """Return the setting that is recorded: the 2b network, one 9-frame 512² clip."""
    return Setting(
        DiTBackbone.published("2b"),
        VAECodec(),
        9,
        512,
        batch,
        50,
        repeats,
        8192,
        jnp.dtype("bfloat16"),
    )


def smoke() -> Setting:
    """Return a setting that a CPU runs in seconds."""
    config = dataclasses.replace(
        DiTBackbone.published("2b"),
        layers=2,
        heads=2,
        head_dim=16,
        text_length=3,
        text_dim=8,
        time_dim=16,
    )
    small = VAECodec(widths=(8, 8, 8, 8), resnets=1, groups=4)
    return Setting(config, small, 9, 32, 1, 2, 1, 64, jnp.dtype("float32"))


def timed(job: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Return milliseconds (median) of a job, and the seconds of its first, compiling, call."""
    start = time.perf_counter()
    jax.block_until_ready(job())
    first = time.perf_counter() - start
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(job())
        seconds.append(time.perf_counter() - start)
    return {"ms": statistics.median(seconds) * 1e3, "compile_s": first}


def planned(run: Any, *arguments: Any, flops: float = 0.0) -> dict[str, float]:
    """Return the memory of a compiled program, and a lower bound of its time on a known chip."""
    compiled = run.lower(*arguments).compile()  # by now it is compiled, and kept by JAX
    found = {"plan_gb": sum(measure.device_memory(compiled)) / 1e9}
    chip = chips.find(jax.local_devices()[0].device_kind)
    if chip is not None:
        work = program.read(compiled.as_text(), for_chip=True)
        seconds = max(flops, work.flops) / chip.flops, work.bytes / chip.bandwidth
        found["plan_ms"] = max(seconds) * 1e3
    return found


def draw(shapes: Any, dtype: Any) -> Any:
    """Return random parameters of these shapes, the same million numbers again and again."""
    numbers = 0.02 * np.random.default_rng(0).normal(size=2**20).astype(np.float32)
    return jax.tree.map(lambda x: jnp.asarray(np.resize(numbers, x.shape), dtype), shapes)


def inputs(setting: Setting, batch: int) -> tuple[Any, Any]:
    """Return random latents and text."""
    rng, config = np.random.default_rng(0), setting.dit
    latents = rng.normal(size=(batch, *setting.latents))
    text = rng.normal(size=(batch, config.text_length, config.text_dim))
    return jnp.asarray(latents, setting.dtype), jnp.asarray(text, setting.dtype)


def measure_ceiling(setting: Setting) -> dict[str, float]:
    """Time the matrix product that MFU is measured against."""
    side = setting.square
    a = draw(jax.ShapeDtypeStruct((side, side), jnp.float32), setting.dtype)
    product = jax.jit(lambda a: a @ a)
    return {**timed(lambda: product(a), max(10, setting.repeats)), "flops": 2.0 * side**3}


def backbone(setting: Setting, dtype: Any) -> Any:
    """Return random parameters of the transformer."""
    return draw(jax.eval_shape(lambda: dit.init(setting.dit, jax.random.key(0))), dtype)


def measure_forward(setting: Setting) -> dict[str, float]:
    """Time the transformer on one batch."""
    latents, text = inputs(setting, setting.batch)
    params = backbone(setting, setting.dtype)
    run = jax.jit(lambda p, x, y: dit.apply(setting.dit, p, x, y, jnp.full(x.shape[0], 500)))
    found = timed(lambda: run(params, latents, text), setting.repeats)
    flops = setting.batch * setting.flops
    found |= planned(run, params, latents, text, flops=flops)
    return {**found, "flops": flops, "batch": setting.batch}


def measure_train(setting: Setting) -> dict[str, float]:
    """Time one step of AdamW on float32 weights, computing in 16 bits."""
    latents, text = inputs(setting, setting.batch)
    params = backbone(setting, jnp.float32)
    adam = optax.adamw(1e-5)
    times = jnp.full(setting.batch, 500)

    def loss(params: Any) -> Any:
        out = dit.apply(setting.dit, params, latents, text, times).astype(jnp.float32)
        return jnp.square(out - latents).mean()

    def step(state: tuple[Any, Any]) -> tuple[Any, Any]:
        params, moments = state
        updates, moments = adam.update(jax.grad(loss)(params), moments, params)
        return optax.apply_updates(params, updates), moments

    jitted = jax.jit(step, donate_argnums=0)
    held = [(params, jax.jit(adam.init)(params))]
    del params

    def job() -> Any:
        held[0] = jitted(held[0])
        return held[0][0]["proj_out"]["bias"]

    flops = 3 * setting.batch * setting.flops
    found = timed(job, setting.repeats)
    found |= planned(jitted, held[0], flops=flops)
    return {**found, "flops": flops, "batch": setting.batch}


def autoencoder(setting: Setting) -> Any:
    """Return random parameters of the autoencoder."""
    shapes = jax.eval_shape(lambda: vae.init(setting.vae, jax.random.key(0)))
    return draw(shapes, setting.dtype)


def measure_clip(setting: Setting) -> dict[str, float]:
    """Time one clip: encode its first frame, sample without guidance, decode; one program."""
    config = DDPMConfig(sample_steps=setting.steps, target="v", snr_shift=3.0)
    noise, text = inputs(setting, 1)
    params, codec = backbone(setting, setting.dtype), autoencoder(setting)
    frame = jnp.zeros((1, 1, setting.pixels, setting.pixels, 3), setting.dtype)

    def clip(params: Any, codec: Any, frame: Any, noise: Any, text: Any) -> Any:
        first, _ = vae.encode(setting.vae, codec, frame)

        def denoise(x: Any, times: Any) -> Any:
            out = dit.apply(setting.dit, params, x.astype(setting.dtype), text, times)
            return config.to_x0(out.astype(jnp.float32), x, times)

        x0 = config.ddim(denoise, noise.astype(jnp.float32).at[:, :1].add(first))
        return vae.decode(setting.vae, codec, x0.astype(setting.dtype))

    run = jax.jit(clip)
    given, flops = (params, codec, frame, noise, text), setting.steps * setting.flops
    found = timed(lambda: run(*given), max(1, setting.repeats // 3))
    found |= planned(run, *given, flops=flops)
    return {**found, "flops": flops, "batch": 1}


def measure_decode(setting: Setting) -> dict[str, float]:
    """Time the decoding of one clip."""
    latents, _ = inputs(setting, 1)
    codec = autoencoder(setting)
    run = jax.jit(lambda p, x: vae.decode(setting.vae, p, x))
    found = timed(lambda: run(codec, latents), setting.repeats)
    return {**found, **planned(run, codec, latents), "batch": 1}


MEASURES = {
    "ceiling": measure_ceiling,
    "forward": measure_forward,
    "train": measure_train,
    "clip": measure_clip,
    "decode": measure_decode,
}


def part(name: str, setting: Setting) -> dict[str, float]:
    """Run one part in this process; ``diffusers/…`` are the peer's."""
    if name.startswith("diffusers/"):
        import cogvideox_gpu_peer

        return cogvideox_gpu_peer.measure(name.removeprefix("diffusers/"), setting)
    found = MEASURES[name.removeprefix("pewm_jax/")](setting)
    peak = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    return {**found, "peak_gb": peak / 1e9}


def report(done: dict[str, dict[str, float]]) -> str:
    """Return the table of what is known so far."""
    ceiling = done.get("pewm_jax/ceiling")
    best = ceiling["flops"] / ceiling["ms"] / 1e9 if ceiling else 0.0
    rows = []
    for name, found in done.items():
        rate = found.get("flops", 0.0) / found["ms"] / 1e9
        share = f"{rate / best:.0%}" if best and rate else ""
        best, plan_gb = (f"{found[k]:.1f}" if k in found else "" for k in ("plan_ms", "plan_gb"))
        cells = (name, f"{found['ms']:.1f}", best, f"{rate:.1f}" if rate else "", share)
        memory, compiling = (f"{found.get(k, 0):.1f}" for k in ("peak_gb", "compile_s"))
        rows.append((*cells, memory, plan_gb, compiling, f"{found.get('batch', 1):.0f}"))
    return record.table(HEADER, rows)


def torch_has_cuda() -> bool:
    """Whether the peer can run."""
    if not (importlib.util.find_spec("torch") and importlib.util.find_spec("diffusers")):
        return False
    code = "import sys, torch; sys.exit(not torch.cuda.is_available())"
    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def has_gpu() -> bool:
    """Whether JAX sees an NVIDIA GPU; asked in another process, which takes no memory of it."""
    code = (
        "import sys; from pewm_jax.nn import target; sys.exit(target.current().platform != 'cuda')"
    )
    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=4, help="clips of forward and train step")
    parser.add_argument("--repeats", type=int, default=10, help="repeats per number")
    parser.add_argument("--seconds", type=float, default=540, help="start no part after this long")
    parser.add_argument("--state", type=Path, default=Path("cogvideox_gpu.json"))
    parser.add_argument("--part", help="run this part alone and print its numbers")
    parser.add_argument("--smoke", action="store_true", help="tiny, on a CPU, nothing is kept")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> int | None:
    """Measure what is not measured yet, and print."""
    options = arguments(argv)
    if options.smoke:
        print(report({f"pewm_jax/{name}": part(name, smoke()) for name in OURS}))
        return None
    if options.part:
        print(json.dumps(part(options.part, full(options.batch, options.repeats))))
        return None
    if not has_gpu():
        raise UserError(
            "JAX sees no NVIDIA GPU here: run this on a machine with one and "
            "`pip install 'pewm-jax[cuda]'`, or add --smoke to see that it runs."
        )
    start = time.perf_counter()
    wanted = [f"pewm_jax/{name}" for name in OURS]
    wanted += [f"diffusers/{name}" for name in PEER] if torch_has_cuda() else []
    done = json.loads(options.state.read_text()) if options.state.exists() else {}
    for name in (n for n in wanted if n not in done):
        if time.perf_counter() - start > options.seconds:
            print(f"{len(done)} of {len(wanted)} parts are done; run the same command to go on.")
            return None
        print(f"{name} …", flush=True)
        sizes = ["--batch", str(options.batch), "--repeats", str(options.repeats)]
        command = [sys.executable, __file__, "--part", name, *sizes]
        run = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True)
        if run.returncode:
            print(f"{name} failed; the messages are above, and the other parts go on.")
            continue
        done[name] = json.loads(run.stdout.splitlines()[-1])
        atomic.write_text(options.state, json.dumps(done, indent=2))
    text = f"## CogVideoX-2b, bf16, one clip of 9 × 512 × 512\n\n{record.machine('jax')}\n\n"
    text += report(done)
    print(text)
    if options.record:
        record.record(NAME, text)
    return None


if __name__ == "__main__":
    sys.exit(cli.run(main))
