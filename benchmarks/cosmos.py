"""Cosmos-Predict2 on a CPU beside diffusers on torch: the same weights, in turns, float32.

Run with ``python benchmarks/cosmos.py``; ``--record`` writes the section of RESULTS.md. The
transformer has the published width of 2B and a seventh of its blocks, so that both copies fit into
memory, and a time for each latent frame, as the pipeline gives it; the autoencoder has the
published widths. A row is the median over the turns, and its ratio the median of the turns'
ratios; below 1 the library is faster. *CPU seconds* add up the cores and hardly feel other
programs.
"""

from __future__ import annotations

import argparse
import os
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import record
import torch
from cogvideox_vae import compare
from svd import HEADER, Row, same_weights

from pewm_jax.io import tree
from pewm_jax.models.cosmos import model as transformer_model
from pewm_jax.models.cosmos.convert import TRANSFORMER
from pewm_jax.models.wan import vae as vae_model
from pewm_jax.models.wan.convert import VAE
from pewm_jax.types import Params

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from diffusers import AutoencoderKLWan, CosmosTransformer3DModel

NAME = "cosmos"
GOALS = "goals: at most 1.1 of its time for the transformer, 1.0 for decoding"


def stacked(network: torch.nn.Module, config: transformer_model.CosmosConfig) -> Params:
    """Return the reference's weights as our tree, blocks stacked."""
    tensors = network.state_dict()
    leaves = {
        path: np.empty(shape, np.float32)
        for path, shape in transformer_model.layout(config).items()
    }
    for entry in TRANSFORMER.entries(config):
        place = leaves[entry.path] if entry.layer is None else leaves[entry.path][entry.layer]
        place[...] = entry.transform.read(tensors[entry.name].numpy())
    return jax.tree.map(jnp.asarray, tree.unflatten(leaves))


def row(label: str, ours, theirs, turns: int) -> Row:
    """Time both and compare what they return, ours with channels last."""
    wanted = np.moveaxis(theirs().numpy(), 1, -1)
    error = np.abs(np.asarray(ours()) - wanted).max() / np.abs(wanted).max()
    seconds, wall, cpu = compare(ours, theirs, turns)
    milliseconds = [f"{second * 1e3:.0f}" for second in seconds]
    return (label, *milliseconds, f"{wall:.2f}", f"{error:.0e}", f"{cpu:.2f}")


def transformer_row(heads: int, blocks: int, shape: tuple[int, int, int], turns: int) -> Row:
    """Compare a step of the transformer on (frames, height, width) latents."""
    torch.manual_seed(0)
    network = CosmosTransformer3DModel(
        in_channels=17,
        num_attention_heads=heads,
        num_layers=blocks,
        rope_scale=(1.0, 3.0, 3.0),
        extra_pos_embed_type=None,
        concat_padding_mask=False,  # the reference needs torchvision for it
    )
    network = network.eval().requires_grad_(requires_grad=False)
    config = TRANSFORMER.read_config(dict(network.config))
    params = stacked(network, config)
    frames, height, width = shape
    latents, mask = torch.randn(1, 16, *shape), torch.zeros(1, 1, *shape)
    times = torch.rand(1, 1, frames, 1, 1)
    text = torch.randn(1, 64, config.text_dim)
    mine = (
        jnp.asarray(latents.movedim(1, -1).numpy()),
        jnp.asarray(times.flatten().numpy()[None]),
        jnp.asarray(text.numpy()),
        jnp.asarray(mask.movedim(1, -1).numpy()),
    )
    step = jax.jit(transformer_model.apply, static_argnums=0)
    label = f"{blocks} blocks of width {config.width}, {frames}×{height}×{width} latents"
    return row(
        label,
        lambda: step(config, params, *mine, fps=16),
        lambda: network(latents, times, text, condition_mask=mask, fps=16, return_dict=False)[0],
        turns,
    )


def vae_rows(base: int, frames: int, size: int, turns: int) -> list[Row]:
    """Compare encoding and decoding."""
    torch.manual_seed(0)
    network = AutoencoderKLWan(base_dim=base).eval().requires_grad_(requires_grad=False)
    config = VAE.read_config(dict(network.config))
    params = same_weights(network, VAE.entries(config))
    video = torch.rand(1, 3, frames, size, size) * 2 - 1

    def encoded() -> torch.Tensor:
        return network.encode(video, return_dict=False)[0].mode()

    latents = encoded()
    pixels, codes = (jnp.asarray(x.movedim(1, -1).numpy()) for x in (video, latents))
    where = f"{frames}×{size}×{size}"
    return [
        row(
            f"VAE encode, {where}",
            lambda: vae_model.encode(config, params, pixels)[0],
            encoded,
            turns,
        ),
        row(
            f"VAE decode, {where}",
            lambda: vae_model.decode(config, params, codes),
            lambda: network.decode(latents, return_dict=False)[0],
            turns,
        ),
    ]


def main() -> None:
    """Measure, print, and record if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=5, help="timed turns of each (at least 5)")
    parser.add_argument("--only", choices=("transformer", "vae"), help="one of the two networks")
    parser.add_argument("--smoke", action="store_true", help="tiny and quick: shows that it runs")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    options = parser.parse_args()
    torch.set_num_threads(min(2, os.cpu_count() or 1))
    turns = 1 if options.smoke else max(5, options.turns)
    heads, blocks, shape, base, clip = 16, 4, (3, 24, 32), 96, (9, 96)
    if options.smoke:
        heads, blocks, shape, base, clip = 1, 1, (2, 8, 8), 8, (5, 16)
    rows: list[Row] = []
    if options.only != "vae":
        rows.append(transformer_row(heads, blocks, shape, turns))
    if options.only != "transformer":
        rows += vae_rows(base, *clip, turns)
    where = record.machine("jax", "torch", "diffusers")
    threads = torch.get_num_threads()
    words = f"Warm, median of {turns} turns; torch with {threads} threads; {GOALS}. {where}."
    text = f"## Cosmos-Predict2, float32\n\n{words}\n\n{record.table(HEADER, rows)}"
    print(text)
    if options.record:
        record.record(NAME, text)


if __name__ == "__main__":
    main()
