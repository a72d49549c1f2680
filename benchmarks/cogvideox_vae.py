"""The autoencoder of CogVideoX beside diffusers on torch: seconds on a CPU, and its memory.

Run with ``python benchmarks/cogvideox_vae.py``. Published widths, float32, the same random weights
and video for both, in one process, one after the other in turn; warm. Torch runs with two threads.
The seconds are medians; the ratio is the median over turns of ours over theirs, so that a busy
moment of the machine hits both. *CPU seconds* add up both cores and hardly feel other programs.

``--memory`` instead compiles the decoding of a clip (49 × 480 × 720 unless told) without running
it, and prints what the compiler will allocate beside parameters, latents and video.
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from record import machine, record, table

from pewm_jax.io import tree
from pewm_jax.models.cogvideox import vae
from pewm_jax.models.cogvideox.convert import VAE
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.nn import target

NAME = "cogvideox_vae"
GOAL = 0.8
"""Our seconds over theirs, at most."""
HEADER = (
    "",
    "pewm_jax, ms",
    "diffusers, ms",
    "ratio",
    "largest difference",
    "ratio of CPU seconds",
)


def pair() -> tuple[Any, VAECodec, dict[str, Any]]:
    """Return the reference with random weights, our settings and the same weights."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from diffusers import AutoencoderKLCogVideoX

    torch.set_num_threads(2)
    torch.manual_seed(0)
    network = AutoencoderKLCogVideoX().eval().requires_grad_(requires_grad=False)
    config = VAE.read_config(dict(network.config))
    tensors = network.state_dict()
    leaves = {
        entry.path: jnp.asarray(
            np.ascontiguousarray(entry.transform.read(tensors[entry.name].numpy()))
        )
        for entry in VAE.entries(config)
    }
    return network, config, tree.unflatten(leaves)


def clock(job: Callable[[], Any]) -> tuple[float, float]:
    """Return wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(job())
    return time.perf_counter() - wall, time.process_time() - cpu


def compare(ours: Callable, theirs: Callable, turns: int) -> tuple[list[float], float, float]:
    """Return median seconds of both, and the median ratios of wall and of CPU seconds."""
    jobs = (ours, theirs)
    for job in jobs:
        clock(job)
    times = np.array([[clock(job) for job in jobs] for _ in range(turns)])
    wall, cpu = (statistics.median(times[:, 0, k] / times[:, 1, k]) for k in (0, 1))
    return list(np.median(times[:, :, 0], 0)), wall, cpu


def vae_rows(turns: int = 5, frames: int = 9, size: int = 96) -> list[tuple[str, ...]]:
    """Compare encoding and decoding; return the rows under ``HEADER`` but for its last column."""
    return [row[:5] for row in all_rows(turns, frames, size)]


def all_rows(turns: int, frames: int, size: int) -> list[tuple[str, ...]]:
    """Compare encoding and decoding; return the rows under ``HEADER``."""
    import torch

    network, config, params = pair()
    video = torch.rand(1, 3, frames, size, size) * 2 - 1
    posterior = network.encode(video).latent_dist
    latents = posterior.mean
    ours_in, ours_mid = (
        jnp.asarray(x.permute(0, 2, 3, 4, 1).numpy().copy()) for x in (video, latents)
    )
    jobs = {
        "encode": (
            lambda: vae.encode(config, params, ours_in)[0],
            lambda: network.encode(video).latent_dist.mean,
        ),
        "decode": (
            lambda: vae.decode(config, params, ours_mid),
            lambda: network.decode(latents).sample,
        ),
    }
    rows = []
    for what, (ours, theirs) in jobs.items():
        wanted = theirs().permute(0, 2, 3, 4, 1).numpy()
        error = np.abs(np.asarray(ours()) - wanted).max() / np.abs(wanted).max()
        seconds, wall, cpu = compare(ours, theirs, turns)
        label = f"VAE {what}, {frames}×{size}×{size}"
        milliseconds = [f"{second * 1e3:.0f}" for second in seconds]
        rows.append((label, *milliseconds, f"{wall:.2f}", f"{error:.0e}", f"{cpu:.2f}"))
    return rows


def decode_memory(
    frames: int, height: int, width: int, dtype: jnp.dtype, *, tiling: bool
) -> tuple[float, float]:
    """Return GiB of temporaries and of output that decoding a clip needs, from the compiler."""
    config = VAECodec(tiling=tiling)
    params = jax.eval_shape(partial(vae.init, config), jax.random.key(0))
    side = config.spatial
    shape = (1, vae.latents_of(config, frames), height // side, width // side)
    latents = jax.ShapeDtypeStruct((*shape, config.latent_channels), dtype)
    decode = jax.jit(partial(vae.decode, config))
    memory = decode.lower(params, latents).compile().memory_analysis()
    return memory.temp_size_in_bytes / 2**30, memory.output_size_in_bytes / 2**30


def main() -> None:
    """Print the table; with ``--record``, keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=9, help="frames, 8N + 1")
    parser.add_argument("--size", type=int, default=96, help="height and width in pixels")
    parser.add_argument("--turns", type=int, default=5, help="timed turns of each")
    parser.add_argument("--memory", action="store_true", help="print the memory of decoding")
    parser.add_argument(
        "--clip", type=int, nargs=3, default=(49, 480, 720), help="frames, height, width"
    )
    parser.add_argument("--dtype", default="float32", help="float32 or bfloat16, with --memory")
    parser.add_argument("--tiling", action="store_true", help="decode in tiles, with --memory")
    parser.add_argument("--record", action="store_true", help="write benchmarks/RESULTS.md")
    args = parser.parse_args()
    if args.memory:
        start = time.perf_counter()
        spare, out = decode_memory(*args.clip, jnp.dtype(args.dtype), tiling=args.tiling)
        clip = " × ".join(map(str, args.clip))
        print(
            f"decoding {clip} in {args.dtype}{' in tiles' * args.tiling}: {spare:.1f} GiB of "
            f"temporaries and {out:.2f} GiB of video on {target.current().platform} "
            f"(compiled in {time.perf_counter() - start:.0f} s)"
        )
        return
    rows = all_rows(args.turns, args.frames, args.size)
    where = machine("jax", "torch", "diffusers")
    words = f"Published widths, warm, median of {args.turns} turns; torch with 2 threads; "
    goal = f"goal: at most {GOAL} of its time. {where}."
    text = f"## CogVideoX's autoencoder, float32\n\n{words}{goal}\n\n{table(HEADER, rows)}"
    print(text)
    if args.record:
        record(NAME, text)


if __name__ == "__main__":
    main()
