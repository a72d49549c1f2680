"""CogVideoX on a CPU beside diffusers on torch: the same weights, in turns, float32.

Run with ``python benchmarks/cogvideox.py``; ``--record`` writes the section of RESULTS.md. The
transformer is a published one with fewer and narrower layers, at the clip of the world model: 768
video tokens and 226 of text. A row is the median over the turns, and its ratio the median of the
turns' ratios; below 1 the library is faster. Compiling is timed at full size, where nothing is
allocated. The autoencoder's rows are those of ``cogvideox_vae.py``.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import record
import torch

from pewm_jax.convert import pipeline
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.convert import TRANSFORMER

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from diffusers import CogVideoXTransformer3DModel

NAME = "cogvideox"
HEADER = ("", "pewm_jax, ms", "diffusers, ms", "ratio", "largest difference")
SHAPE = (3, 32, 32)
"""Latent frames, rows and columns."""

Row = tuple[str, ...]


def narrow(width: int, layers: int) -> DiTBackbone:
    """Return CogVideoX-5b with fewer, narrower layers; heads keep their 64 channels."""
    return dataclasses.replace(DiTBackbone.published("5b"), layers=layers, heads=width // 64)


def same_weights(config: DiTBackbone) -> tuple[Any, CogVideoXTransformer3DModel]:
    """Return random parameters, and the reference network with the same ones."""
    like = jax.eval_shape(lambda: dit.init(config, jax.random.key(0)))
    rng = np.random.default_rng(0)

    def draw(path: Any, leaf: Any) -> np.ndarray:
        one = path[-1].key == "scale"
        spread = leaf.shape[-2] ** -0.5 if path[-1].key == "kernel" else 0.1
        return np.asarray(one + rng.normal(0, spread, leaf.shape), np.float32)

    params = jax.tree_util.tree_map_with_path(draw, like)
    values = TRANSFORMER.write_config(config)
    network = CogVideoXTransformer3DModel(**{k: v for k, v in values.items() if k[0] != "_"})
    tensors = pipeline.write_tensors(TRANSFORMER.entries(config), params)
    network.load_state_dict({name: torch.tensor(np.array(x)) for name, x in tensors})
    return jax.tree.map(jnp.asarray, params), network


def turns(
    ours: Callable[[], Any], theirs: Callable[[], Any], count: int
) -> tuple[float, float, float]:
    """Return median milliseconds of both, and the median ratio, of ``count`` turns."""
    ours(), theirs()
    seconds = []
    for turn in range(count):
        pair = {}
        for job in (ours, theirs) if turn % 2 else (theirs, ours):
            start = time.perf_counter()
            job()
            pair[job] = time.perf_counter() - start
        seconds.append((pair[ours], pair[theirs]))
    mine, peer = zip(*seconds, strict=True)
    ratio = statistics.median(a / b for a, b in seconds)
    return statistics.median(mine) * 1e3, statistics.median(peer) * 1e3, ratio


def distance(got: Any, want: Any) -> float:
    want = np.asarray(want)
    return float(np.abs(np.asarray(got) - want).max() / np.abs(want).max())


def dit_rows(config: DiTBackbone, shape: tuple[int, int, int], count: int) -> list[Row]:
    """Time the transformer, forward and with the gradient of every parameter."""
    params, network = same_weights(config)
    rng = np.random.default_rng(1)
    latents = rng.normal(size=(1, *shape, config.in_channels)).astype(np.float32)
    text = rng.normal(size=(1, config.text_length, config.text_dim)).astype(np.float32)
    times = np.array([500])
    grid = positions.token_grid(config, latents.shape)
    angles = positions.joint_angles(config, grid, 0)
    rotary = tuple(torch.tensor(f(angles).repeat(2, -1)) for f in (np.cos, np.sin))
    given = torch.tensor(latents).permute(0, 1, 4, 2, 3).contiguous(), torch.tensor(text)

    def peer() -> torch.Tensor:
        out = network(*given, torch.tensor(times), image_rotary_emb=rotary, return_dict=False)[0]
        return out.permute(0, 1, 3, 4, 2)

    def peer_forward() -> torch.Tensor:
        with torch.no_grad():
            return peer()

    def peer_gradient() -> torch.Tensor:
        network.zero_grad()
        peer().square().mean().backward()
        return network.proj_out.weight.grad.T

    forward = jax.jit(lambda p: dit.apply(config, p, latents, text, times))
    gradient = jax.jit(jax.grad(lambda p: jnp.square(forward(p)).mean()))

    def slope_of_output() -> Any:
        return jax.block_until_ready(gradient(params))["proj_out"]["kernel"]

    pairs = {
        "forward": (lambda: jax.block_until_ready(forward(params)), peer_forward),
        "forward + backward": (slope_of_output, peer_gradient),
    }
    tokens = int(np.prod(grid)) + config.text_length
    what = f"DiT, width {config.width}, {config.layers} layers, {tokens} tokens"
    rows = []
    for name, (mine, other) in pairs.items():
        off = distance(mine(), other())
        a, b, ratio = turns(mine, other, count)
        rows.append((f"{what}: {name}", f"{a:.0f}", f"{b:.0f}", f"{ratio:.2f}", f"{off:.0e}"))
    return rows


def compile_seconds(config: DiTBackbone, shape: tuple[int, int, int], *, gradient: bool) -> float:
    """Return the seconds to trace and compile at full size, on abstract weights."""
    params = jax.eval_shape(lambda: dit.init(config, jax.random.key(0)))
    latents = jax.ShapeDtypeStruct((1, *shape, config.in_channels), jnp.float32)
    text = jax.ShapeDtypeStruct((1, config.text_length, config.text_dim), jnp.float32)

    def run(params: Any, latents: Any, text: Any) -> Any:
        return dit.apply(config, params, latents, text, jnp.array([500]))

    def slope(params: Any, latents: Any, text: Any) -> Any:
        return jax.grad(lambda p: jnp.square(run(p, latents, text)).mean())(params)

    start = time.perf_counter()
    jax.jit(slope if gradient else run).lower(params, latents, text).compile()
    return time.perf_counter() - start


def compile_table(config: DiTBackbone, depths: tuple[int, int], shape: tuple[int, int, int]) -> str:
    """Return the seconds of compiling two depths of the same network."""
    rows = []
    for depth in depths:
        deep = dataclasses.replace(config, layers=depth)
        seconds = [compile_seconds(deep, shape, gradient=gradient) for gradient in (False, True)]
        rows.append((f"{depth} layers of width {config.width}", *(f"{s:.1f}" for s in seconds)))
    return record.table(("compile", "forward, s", "forward + backward, s"), rows)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=7, help="turns per row (at least 5)")
    parser.add_argument("--width", type=int, default=512, help="width of the transformer")
    parser.add_argument("--layers", type=int, default=4, help="its layers")
    parser.add_argument("--only", choices=("dit", "vae"), help="half of it")
    parser.add_argument("--smoke", action="store_true", help="tiny and quick: shows that it runs")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    options = parser.parse_args()
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    count = 1 if options.smoke else max(5, options.turns)
    rows, compiled = [], ""
    if options.only != "vae":
        config, shape = narrow(options.width, options.layers), SHAPE
        deep, depths = DiTBackbone.published("5b"), (4, 42)
        if options.smoke:
            config, shape = dataclasses.replace(narrow(64, 2), text_dim=32), (1, 4, 4)
            deep, depths = config, (1, 2)
        rows += dit_rows(config, shape, count)
        compiled = compile_table(deep, depths, shape)
    if options.only != "dit" and not options.smoke:
        from cogvideox_vae import vae_rows

        rows += vae_rows(count)
    width = max(len(row) for row in rows)
    text = record.table(HEADER[:width], [(*row, *[""] * (width - len(row))) for row in rows])
    where = record.machine("jax", "torch", "diffusers")
    text = f"## CogVideoX, float32, {torch.get_num_threads()} threads\n\n{where}\n\n{text}\n"
    text += f"\n{compiled}\n" if compiled else ""
    print(text)
    if options.record:
        record.record(NAME, text)


if __name__ == "__main__":
    main()
