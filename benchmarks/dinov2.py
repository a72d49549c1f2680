"""Images per second of DINOv2 ViT-S/14 at 518², beside transformers on torch, the same weights.

Run with ``python benchmarks/dinov2.py``; ``--record`` writes the section of RESULTS.md. Both
compute in float32 on the same cores, in turns; a row is the median over the turns, and its ratio
the median of the turns' ratios. What the two return is compared too.
"""

from __future__ import annotations

import argparse
import re
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import record
import torch
from transformers import Dinov2Config, Dinov2Model

from pewm_jax.convert import pipeline
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import published
from pewm_jax.models.dinov2.convert import entries

SIZE = 518
BATCHES = (1, 4)
CONFIG = published("small")


def same_weights() -> tuple[dict, Dinov2Model]:
    """Return random parameters, and the reference network with the same ones."""
    like = jax.eval_shape(lambda: dinov2.init(CONFIG, jax.random.key(0)))
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        one = path[-1].key == "scale"
        fan = leaf.shape[-2] if leaf.ndim >= 2 else 25
        return np.asarray(one + rng.normal(0, fan**-0.5, leaf.shape), np.float32)

    params = jax.tree_util.tree_map_with_path(draw, like)
    settings = Dinov2Config(
        hidden_size=CONFIG.width,
        num_hidden_layers=CONFIG.layers,
        num_attention_heads=CONFIG.heads,
        image_size=CONFIG.pretrained_size,
    )
    network = Dinov2Model(settings).eval()
    known = network.state_dict().keys()
    tensors = {
        name if name in known else in_memory(name): torch.tensor(tensor)
        for name, tensor in pipeline.write_tensors(entries(CONFIG), params)
    }
    missing, unexpected = network.load_state_dict(tensors, strict=False)
    assert (missing, unexpected) == (["embeddings.mask_token"], [])
    return jax.tree.map(jnp.asarray, params), network


def in_memory(name: str) -> str:
    """Return how the network calls in memory (transformers 5) what its files call ``name``."""
    name = re.sub(r"attention\.attention\.(\w)\w+", r"attention.\1_proj", name)
    return name.replace("attention.output.dense", "attention.o_proj")


def seconds(job: Callable[[], object]) -> float:
    """Return how long a job takes."""
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def row(params: dict, network: Dinov2Model, batch: int, repeats: int) -> list[str]:
    """Measure one batch size."""
    images = np.random.default_rng(1).normal(size=(batch, SIZE, SIZE, 3)).astype(np.float32)
    pixels = torch.tensor(images).permute(0, 3, 1, 2).contiguous()
    on_device = jnp.asarray(images)
    start = time.perf_counter()
    compute = jax.jit(lambda p, x: dinov2.apply(CONFIG, p, x)).lower(params, on_device).compile()
    compiling = time.perf_counter() - start

    def ours():
        return compute(params, on_device).block_until_ready()

    def theirs():
        with torch.no_grad():
            return network(pixels).last_hidden_state

    got, want = np.asarray(ours()), theirs()[:, 1:].numpy().reshape(batch, 37, 37, -1)
    apart = np.abs(got - want).max() / np.abs(want).max()
    pairs = [(seconds(ours), seconds(theirs)) for _ in range(repeats)]
    mine, other = (statistics.median(times) for times in zip(*pairs, strict=True))
    ratio = statistics.median(b / a for a, b in pairs)
    return [
        str(batch),
        f"{batch / mine:.2f}",
        f"{batch / other:.2f}",
        f"{ratio:.2f}×",
        f"{apart:.1e}",
        f"{compiling:.1f} s",
    ]


def main() -> None:
    """Measure, print, and record if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7, help="turns per row (at least 5)")
    parser.add_argument("--threads", type=int, default=2, help="threads that torch uses")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    params, network = same_weights()
    rows = [row(params, network, batch, max(5, options.repeats)) for batch in BATCHES]
    header = ["batch", "pewm_jax, images/s", "torch, images/s", "pewm_jax/torch (goal ≥ 1.0)"]
    header += ["largest difference", "compiling"]
    words = (
        "`python benchmarks/dinov2.py` beside transformers' Dinov2Model on "
        f"{options.threads} threads, median of {max(5, options.repeats)} turns."
    )
    machine = record.machine("jax", "torch", "transformers")
    title = "## DINOv2 ViT-S/14 at 518², float32"
    text = "\n\n".join((title, words, machine, record.table(header, rows)))
    print(text)
    if options.record:
        record.record("dinov2", text)


if __name__ == "__main__":
    main()
