"""Where a reader's attention goes: to what the map holds at a picture's place, or anywhere?

`python benchmarks/where_readers_look.py runs/table1/seed0/voxel-attend …` imagines held-out clips
with trained rows of Table 1 and adds up, over layers, heads and sampling steps, how much of a
patch's attention goes to map tokens that project into that patch or next to it. Chance is what a
reader would give them that looks at all tokens alike. ``fresh`` is the same reader before training,
``trained / fresh`` says what training has made of it. Patches that no token projects to do not
count, and attention to nothing (the sink) is left out. ``--record`` writes the table into
RESULTS.md; ``--smoke`` takes one clip.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from record import machine, record, table

import pewm_jax
from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval.clips import choose, load_clip
from pewm_jax.geometry.cameras import project
from pewm_jax.readers import memory_block
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.geometry import NEAREST_M, patch_pixels
from pewm_jax.types import Array, Params
from pewm_jax.worlds import world_model
from pewm_jax.worlds.rollouts import load_finished

REACH = 1.0
"""A token is in place if it projects at most so many patches from a patch's centre, each way."""
SAYS = ("mass", "chance")


@contextmanager
def watched(found: dict[str, list[float]]) -> Iterator[None]:
    """Add to ``found`` where attention goes, wherever a reader is traced and then run."""
    apply, attend = AttentionConfig.prepare, memory_block.masked_attention
    held: dict[str, Array] = {}

    def add(mass: Array, chance: Array) -> None:
        found["mass"].append(float(mass))
        found["chance"].append(float(chance))

    def prepare(
        reader: AttentionConfig, model: Any, params: Params, readout: Any, camera: Any, rays: Array
    ) -> Any:
        patch = patch_pixels(model)
        rows, columns = model.clip.height // patch, model.clip.width // patch
        v, u = np.meshgrid(np.arange(rows) + 0.5, np.arange(columns) + 0.5, indexing="ij")
        centres = patch * np.stack([u.ravel(), v.ravel()], -1)
        tokens = readout.tokens
        uv, z = project(tokens.points_world_M3[:, None], camera)
        near = jnp.abs(uv[:, :, None] - centres[:, None]).max(-1) <= REACH * patch  # (B, T, n, M)
        seen = (z > NEAREST_M) & tokens.valid_M[:, None]
        held["near"] = near & seen[:, :, None]
        held["valid"] = tokens.valid_M
        return apply(reader, model, params, readout, camera, rays)

    def read_seen(q: Array, k: Array, v: Array, views: Any, turns: Array, learned: Any) -> Array:
        held["index"] = views[0]
        return read(q, k, v, views, turns, learned)

    def attention(logits: Array, mask: Array, sink: Array, values: Array) -> Array:
        kept = jnp.where(mask, logits, -jnp.inf)
        weights = jax.nn.softmax(kept, -1)
        near, valid = held["near"], held["valid"]
        chance = near.sum(-1) / jnp.maximum(valid.sum(-1), 1)[:, None, None]  # (B, T, n)
        some = near.any(-1)
        if weights.ndim == 4:  # (B, K, N, M): every patch of every frame, all tokens
            place = near.reshape(len(near), 1, -1, near.shape[-1])
            mass = (weights * place).sum(-1).mean(1).reshape(some.shape)
        else:  # (B, t, K, n, J): the tokens in view of each frame
            index = held["index"]
            picked = jnp.take_along_axis(near[:, :, None], index[:, :, :, None], -1)
            mass = jnp.where(jnp.isfinite(weights), weights * picked, 0).sum(-1).mean(2)
        count = jnp.maximum(some.sum(), 1)
        numbers = [jnp.where(some, x, 0).sum() / count for x in (mass, chance)]
        jax.debug.callback(add, *numbers)
        return attend(logits, mask, sink, values)

    read = memory_block._read_seen
    with (
        mock.patch.object(AttentionConfig, "prepare", prepare),
        mock.patch.object(memory_block, "masked_attention", attention),
        mock.patch.object(memory_block, "_read_seen", read_seen),
    ):
        yield


def looked(
    config: Config, many: Sequence[Params], data: Path, clips: int
) -> list[dict[str, float]]:
    """Return for each set of weights the mean share of attention in place, and chance's."""
    episodes = EpisodeSource(data)
    found: dict[str, list[float]] = {name: [] for name in SAYS}
    rollout = jax.jit(lambda *given: pewm_jax.rollout(config, *given))
    means = []
    with watched(found):
        for params in many:
            for number, choice in enumerate(choose(config, episodes, clips, 1)):
                context, _, control = load_clip(config, episodes, choice)
                state = pewm_jax.start(config, params, context)
                jax.block_until_ready(rollout(params, state, control, jax.random.key(number)))
            jax.effects_barrier()
            means.append({name: float(np.mean(values)) for name, values in found.items()})
            for values in found.values():
                values.clear()
    return means


def main() -> None:
    """Measure, print, and record if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("runs", nargs="+", type=Path, help="trained rows that read by attention")
    parser.add_argument("--data", type=Path, default=Path("data/demo/revisit"))
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--smoke", action="store_true", help="one clip; nothing is kept")
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    options = parser.parse_args()
    clips, rows = 1 if options.smoke else options.clips, []
    for run in options.runs:
        config, params = load_finished(run)
        if type(config.model.memory.reader) is not AttentionConfig:
            raise UserError(f"{run} does not read by attention: name rows that do.")
        fresh = params | {
            "memory": world_model.init(config.model, jax.random.key(0))["memory"],
        }
        before, after = looked(config, [fresh, params], options.data, clips)
        shares = [
            f"{100 * share:.1f} %" for share in (after["chance"], before["mass"], after["mass"])
        ]
        rows.append([run.name, *shares, f"{after['mass'] / before['mass']:.2f}"])
    head = ["row", "chance", "fresh", "trained", "trained / fresh"]
    text = table(head, rows)
    print(text)
    if options.record and not options.smoke:
        how = (
            "`python benchmarks/where_readers_look.py … --record`: the share of attention that "
            f"goes to tokens in place, {clips} held-out clips. {machine('jax')}."
        )
        record("where_readers_look", f"## Where readers of the map look\n\n{how}\n\n{text}")


if __name__ == "__main__":
    main()
