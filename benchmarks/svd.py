"""Stable Video Diffusion on a CPU beside diffusers on torch: the same weights, in turns, float32.

Run with ``python benchmarks/svd.py``; ``--record`` writes the section of RESULTS.md. The U-Net has
the published levels, two fifths as wide, so that both copies fit into memory; the autoencoder has
the published widths. A row is the median over the turns, and its ratio the median of the turns'
ratios; below 1 the library is faster. *CPU seconds* add up the cores and hardly feel other
programs.
"""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import record
import torch
from cogvideox_vae import compare

from pewm_jax.io import tree
from pewm_jax.io.published import Entry
from pewm_jax.models.svd import unet as unet_model
from pewm_jax.models.svd import vae as vae_model
from pewm_jax.models.svd.convert import BLOCK, UNET, VAE

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from diffusers import AutoencoderKLTemporalDecoder, UNetSpatioTemporalConditionModel

NAME = "svd"
HEADER = (
    "",
    "pewm_jax, ms",
    "diffusers, ms",
    "ratio",
    "largest difference",
    "ratio of CPU seconds",
)
GOALS = "goals: at most 1.1 of its time for the U-Net, 1.0 for decoding"
Row = tuple[str, ...]


def same_weights(network: torch.nn.Module, entries: Sequence[Entry]) -> Any:
    """Return the reference's weights as our tree."""
    tensors = network.state_dict()
    return tree.unflatten(
        {
            entry.path: jnp.asarray(
                np.ascontiguousarray(entry.transform.read(tensors[entry.name].numpy()))
            )
            for entry in entries
        }
    )


def row(label: str, ours: Any, theirs: Any, turns: int) -> Row:
    """Time both and compare what they return, ours with channels last."""
    wanted = np.moveaxis(theirs().numpy(), -3, -1)
    error = np.abs(np.asarray(ours()).reshape(wanted.shape) - wanted).max() / np.abs(wanted).max()
    seconds, wall, cpu = compare(ours, theirs, turns)
    milliseconds = [f"{second * 1e3:.0f}" for second in seconds]
    return (label, *milliseconds, f"{wall:.2f}", f"{error:.0e}", f"{cpu:.2f}")


def unet_row(
    widths: tuple[int, ...], heads: tuple[int, ...], shape: tuple[int, int, int], turns: int
) -> Row:
    """Compare a step of the U-Net on (frames, height, width) latents."""
    torch.manual_seed(0)
    network = UNetSpatioTemporalConditionModel(block_out_channels=widths, num_attention_heads=heads)
    network = network.eval().requires_grad_(requires_grad=False)
    config = UNET.read_config(dict(network.config))
    params = same_weights(network, UNET.entries(config))
    frames, height, width = shape
    latents = torch.randn(1, frames, config.in_channels, height, width)
    rest = (torch.tensor([0.4]), torch.randn(1, 1, config.image_dim), torch.tensor([[6, 127, 0.1]]))
    mine = [jnp.asarray(x.numpy()) for x in (latents.movedim(2, -1), *rest)]
    step = jax.jit(unet_model.apply, static_argnums=0)
    label = f"U-Net of width {widths[0]}, {frames}×{height}×{width} latents"
    return row(
        label,
        lambda: step(config, params, *mine),
        lambda: network(latents, *rest, return_dict=False)[0],
        turns,
    )


def vae_rows(widths: tuple[int, ...], frames: int, size: int, turns: int) -> list[Row]:
    """Compare encoding and decoding."""
    torch.manual_seed(0)
    network = AutoencoderKLTemporalDecoder(
        block_out_channels=widths,
        down_block_types=[BLOCK] * len(widths),
        layers_per_block=2,
    )
    network = network.eval().requires_grad_(requires_grad=False)
    config = VAE.read_config(dict(network.config))
    params = same_weights(network, VAE.entries(config))
    video = torch.rand(frames, 3, size, size) * 2 - 1

    def encoded() -> torch.Tensor:
        return network.encode(video, return_dict=False)[0].mode()

    latents = encoded()
    pixels, codes = (jnp.asarray(x.movedim(1, -1).numpy()[None]) for x in (video, latents))
    where = f"{frames}×{size}×{size}"
    return [
        row(
            f"VAE encode, {where}",
            lambda: vae_model.encode(config, params, pixels),
            encoded,
            turns,
        ),
        row(
            f"VAE decode, {where}",
            lambda: vae_model.decode(config, params, codes),
            lambda: network.decode(latents, num_frames=frames, return_dict=False)[0],
            turns,
        ),
    ]


def main() -> None:
    """Measure, print, and record if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=5, help="timed turns of each (at least 5)")
    parser.add_argument("--only", choices=("unet", "vae"), help="one of the two networks")
    parser.add_argument("--smoke", action="store_true", help="tiny and quick: shows that it runs")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    options = parser.parse_args()
    torch.set_num_threads(min(2, os.cpu_count() or 1))
    turns = 1 if options.smoke else max(5, options.turns)
    widths, heads, shape = (128, 256, 512, 512), (2, 4, 8, 8), (4, 24, 24)
    codec, clip = (128, 256, 512, 512), (4, 96)
    if options.smoke:
        widths, heads, shape = (64, 64, 64, 64), (1, 1, 1, 1), (2, 16, 16)
        codec, clip = (32, 32, 32, 32), (2, 16)
    rows: list[Row] = []
    if options.only != "vae":
        rows.append(unet_row(widths, heads, shape, turns))
    if options.only != "unet":
        rows += vae_rows(codec, *clip, turns)
    where = record.machine("jax", "torch", "diffusers")
    threads = torch.get_num_threads()
    words = f"Warm, median of {turns} turns; torch with {threads} threads; {GOALS}. {where}."
    text = f"## Stable Video Diffusion, float32\n\n{words}\n\n{record.table(HEADER, rows)}"
    print(text)
    if options.record:
        record.record(NAME, text)


if __name__ == "__main__":
    main()
