"""Do actions steer? The same clips imagined with the true actions, with another's, and with none.

A world that follows its actions is nearest to the truth with the true ones. *Shuffled* actions are
those of a clip in another house. *None* are embeddings of zero, which observed frames have: only a
model whose control modulates can be asked for that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.data.progress import Meter
from pewm_jax.evaluation import intervals
from pewm_jax.evaluation.images import psnr, unit_colours
from pewm_jax.evaluation.protocol import ClipChoice, choose, load_clip, stack
from pewm_jax.types import Array, Frames, Params

TRUE, SHUFFLED, NONE = "true", "shuffled", "none"


@dataclasses.dataclass(frozen=True)
class Steered:
    """What was measured.

    Attributes:
        psnr: by kind of actions, (C,) PSNR of each clip's colours in decibels.
        houses_C: (C,) the number of each clip's house.
    """

    psnr: Mapping[str, np.ndarray]
    houses_C: np.ndarray

    def table(self) -> dict[str, dict[str, Any]]:
        """Return means over houses with intervals, and how much better the true actions are."""
        each = {name: intervals.entry(values, self.houses_C) for name, values in self.psnr.items()}
        more = {
            f"{TRUE} - {name}": intervals.entry(self.psnr[TRUE] - values, self.houses_C)
            for name, values in self.psnr.items()
            if name != TRUE
        }
        return {**each, **more}

    def lines(self) -> list[str]:
        """Return the table as text."""
        out = [f"PSNR in dB of {len(self.houses_C)} clips, means over houses"]
        for name, found in self.table().items():
            low, high = found["low"], found["high"]
            span = "" if low is None else f"  [{low:.2f}, {high:.2f}]"
            out.append(f"  {name:<16} {found['mean']:6.2f}{span}")
        return out


def measure(
    config: Config,
    params: Params,
    episodes: Sequence[Episode],
    clips: int,
    *,
    seed: int = 0,
) -> Steered:
    """Imagine clips with true, shuffled and no actions, all with the same noise.

    Args:
        config: an experiment whose model is steered by actions.
        params: its weights.
        episodes: held-out episodes with actions.
        clips: the most clips to imagine; they are chosen as a report chooses them.
        seed: of the sampling noise.

    Raises:
        UserError: the episodes are too short, or all of one house.
    """
    choices = choose(config, episodes, clips, 1)
    parts = [load_clip(config, episodes, choice) for choice in choices]
    actions = [np.asarray(part[2]) for part in parts]
    others = [actions[k] for k in _others(choices)]
    silent = _silenced(config, params)
    asked = {TRUE: (params, actions), SHUFFLED: (params, others)}
    if silent is not None:
        asked[NONE] = (silent, actions)
    imagine = jax.jit(_imagined, static_argnums=0)
    size = min(config.evaluate.batch, len(parts))
    found: dict[str, np.ndarray] = {}
    with Meter("steering", len(asked) * len(parts), "clips") as meter:
        for name, (weights, given) in asked.items():
            errors = []
            for first in range(0, len(parts), size):
                here = slice(first, first + size)
                context = stack([part[0] for part in parts[here]], size)
                truth = stack([part[1] for part in parts[here]], size)
                numbers = np.arange(first, first + size)
                rgb = imagine(config, weights, context, stack(given[here], size), seed, numbers)
                off = jnp.square(unit_colours(rgb) - unit_colours(truth.rgb_THWC))
                errors.append(np.asarray(off.mean((1, 2, 3, 4)))[: len(parts[here])])
                meter.advance(len(errors[-1]))
            found[name] = np.asarray(psnr(np.concatenate(errors)))
    scenes = [choice.scene for choice in choices]
    return Steered(found, np.unique(scenes, return_inverse=True)[1])


def _imagined(
    config: Config, params: Params, context: Frames, actions: Array, seed: int, numbers_B: Array
) -> Array:
    """Return (B, N, H, W, 3) imagined colours."""

    def one(context: Frames, moves: Array, number: Array) -> Array:
        state = worlds.start(config, params, context)
        key = jax.random.fold_in(jax.random.key(seed), number)
        return worlds.imagine(config, params, state, moves, key)[1].rgb_THWC

    return jax.vmap(one)(context, actions, numbers_B)


def _others(choices: Sequence[ClipChoice]) -> list[int]:
    """Return for each clip the number of the next one that is in another house."""
    count, found = len(choices), []
    for here, choice in enumerate(choices):
        later = ((here + k) % count for k in range(1, count))
        other = next((k for k in later if choices[k].scene != choice.scene), None)
        if other is None:
            raise UserError(
                "all clips are of one house, and shuffled actions come from another: score a split "
                "with several (evaluate.split)."
            )
        found.append(other)
    return found


def _silenced(config: Config, params: Params) -> Params | None:
    """Return weights whose control embeds every action as zero, or None if it does not modulate."""
    if not config.model.control.MODULATES or "control" not in params:
        return None
    return {**params, "control": jax.tree.map(jnp.zeros_like, params["control"])}
