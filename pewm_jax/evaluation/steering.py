"""Do actions steer? The same clips imagined with the true actions, with another's, and with none.

A world that follows its actions is nearest to the truth with the true ones. *Shuffled* actions are
those of a clip in another house. *None* are embeddings of zero, which observed frames have: only a
model whose control modulates can be asked for that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
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
from pewm_jax.evaluation.partial import Partials
from pewm_jax.evaluation.protocol import ClipChoice, choose, load_clip, stack
from pewm_jax.evaluation.shares import gathered, share
from pewm_jax.types import Array, Frames, Params

TRUE, SHUFFLED, NONE = "true", "shuffled", "none"


@dataclasses.dataclass(frozen=True)
class Steered:
    """What was measured.

    Attributes:
        errors: by kind of actions, (C, N) mean squared errors of each imagined frame's colours.
        houses_C: (C,) the number of each clip's house.
    """

    errors: Mapping[str, np.ndarray]
    houses_C: np.ndarray

    @property
    def psnr(self) -> dict[str, np.ndarray]:
        """PSNR of each clip, by kind of actions, dB."""
        return {name: np.asarray(psnr(each.mean(1))) for name, each in self.errors.items()}

    def table(self) -> dict[str, dict[str, Any]]:
        """Return means over houses with intervals, and how much better the true actions are."""
        return self._entries(self.psnr)

    def per_frame(self) -> dict[str, dict[str, Any]]:
        """Return the same with a list over imagined frames in the place of each number."""
        return self._entries({name: np.asarray(psnr(x)) for name, x in self.errors.items()})

    def _entries(self, values: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
        each = {name: intervals.entry(found, self.houses_C) for name, found in values.items()}
        more = {
            f"{TRUE} - {name}": intervals.entry(values[TRUE] - found, self.houses_C)
            for name, found in values.items()
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
    config: Config, params: Params, episodes: Sequence[Episode], clips: int, *, seed: int = 0
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
    pieces = _Pieces(config, params, episodes, choices, seed)
    with Meter("steering", len(pieces.keys) * pieces.size, "clips") as meter:
        found = {}
        for key in pieces.keys:
            found[key] = pieces.errors(*key)
            meter.advance(pieces.size)
    return pieces.joined(found)


def score(
    config: Config,
    params: Params,
    episodes: Sequence[Episode],
    choices: Sequence[ClipChoice],
    partials: Partials,
    say: Callable[[str], Any],
) -> Steered | None:
    """Measure it for a report: of its clips, shared among processes, kept with its partial results.

    Returns:
        None where the model is not steered by actions, or all clips are of one house.
    """
    if not config.model.control.MODULATES or len({choice.scene for choice in choices}) < 2:
        return None
    pieces = _Pieces(config, params, episodes, choices, config.evaluate.seeds[0])
    names = {key: f"steering-{key[0]}-clip{key[1]:04d}" for key in pieces.keys}
    known = {key: piece for key in pieces.keys if (piece := partials.get(names[key])) is not None}
    todo = [key for key in share(pieces.keys) if key not in known]
    if todo:
        say("imagining with true, shuffled and no actions …")
    for key in todo:
        known[key] = partials.put(names[key], errors=pieces.errors(*key))
    found = gathered(partials, names, known, "steering")
    return pieces.joined({key: piece["errors"] for key, piece in found.items()})


class _Pieces:
    """The work in pieces: a kind of actions and a batch of clips, by its first one."""

    def __init__(
        self,
        config: Config,
        params: Params,
        episodes: Sequence[Episode],
        choices: Sequence[ClipChoice],
        seed: int,
    ):
        self.config, self.params, self.seed = config, params, seed
        self.episodes, self.choices = episodes, choices
        self.size = min(config.evaluate.batch, len(choices))
        self._other = _others(choices)
        self._silent = _silenced(config, params)
        self._imagine = jax.jit(_imagined, static_argnums=0)
        kinds = (TRUE, SHUFFLED, *([NONE] if self._silent is not None else []))
        starts = range(0, len(choices), self.size)
        self.keys = [(kind, first) for kind in kinds for first in starts]

    def errors(self, kind: str, first: int) -> np.ndarray:
        """Return (clips, N) squared errors of a batch."""
        numbers = range(len(self.choices))[first : first + self.size]
        parts = [load_clip(self.config, self.episodes, self.choices[n]) for n in numbers]
        actions = [np.asarray(part[2]) for part in parts]
        if kind == SHUFFLED:
            others = [self.choices[self._other[n]] for n in numbers]
            actions = [np.asarray(load_clip(self.config, self.episodes, o)[2]) for o in others]
        weights = self._silent if kind == NONE else self.params
        context = stack([part[0] for part in parts], self.size)
        truth = stack([part[1] for part in parts], self.size)
        filled = np.arange(first, first + self.size)
        given = stack(actions, self.size)
        rgb = self._imagine(self.config, weights, context, given, self.seed, filled)
        off = jnp.square(unit_colours(rgb) - unit_colours(truth.rgb_THWC))
        return np.asarray(off.mean((2, 3, 4)))[: len(parts)]

    def joined(self, found: Mapping[tuple[str, int], np.ndarray]) -> Steered:
        """Put the errors of all pieces together."""
        kinds = dict.fromkeys(kind for kind, _ in self.keys)
        errors = {
            k: np.concatenate([found[key] for key in self.keys if key[0] == k]) for k in kinds
        }
        scenes = [choice.scene for choice in self.choices]
        return Steered(errors, np.unique(scenes, return_inverse=True)[1])


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
