"""Planners: propose candidates, and update their distribution from costs, without a model.

Three pure functions drive every planner::

    search = init(planner, config)                          # config is a PlanConfig
    choices_KH = propose(planner, config, search, key)      # K candidates of H blocks
    search = update(planner, config, search, choices_KH, costs_K)

``plan.plan`` loops over them. The best candidate of all rounds is stored in ``search.best``.
Candidate 0 is the mode or mean of the distribution; in the first round, the choices that the search
starts from.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.planning.settings import CEM, MPPI, Box, Discrete, PlanConfig, Planner, RandomShooting
from pewm_jax.types import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Normals:
    """Independent normal distributions.

    Attributes:
        mean_HA: (H, A) means.
        std_HA: (H, A) standard deviations.
    """

    mean_HA: Array
    std_HA: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Search:
    """The state of a planner.

    Attributes:
        belief: (H, A) probabilities of discrete actions, or ``Normals``.
        best: (H,) or (H, A) the best choices so far; initially the belief's mode.
        cost: () their cost, inf before the first round.
        kept_EH: (E, H) or (E, H, A) the best distinct choices so far, which also count in the next
            round.
        kept_costs_E: (E,) their costs, inf for unused slots.
    """

    belief: Any
    best: Array
    cost: Array
    kept_EH: Array
    kept_costs_E: Array


def init(planner: Planner, config: PlanConfig, start: Array | None = None) -> Search:
    """Return the initial state of a search.

    ``start`` are (h,) discrete choices or (h, A) continuous ones to start around, such as the rest
    of an earlier plan (``shifted``); h < H leaves the last blocks open. None starts with a uniform
    distribution, or at the middle of the bounds.

    Raises:
        UserError: ``start`` has another shape.
    """
    space, blocks = planner.space, config.horizon
    if isinstance(space, Discrete):
        belief = jnp.full((blocks, space.count), 1 / space.count)
    else:
        low, high = bounds(space)
        std = getattr(planner, "initial_std", 1.0) * (high - low) / 2
        belief = Normals(
            jnp.broadcast_to((low + high) / 2, (blocks, len(low))),
            jnp.broadcast_to(std, (blocks, len(low))),
        )
    if start is not None:
        belief = _belief_around(planner, belief, jnp.asarray(start), blocks)
    best, count = mode(belief), kept(planner, config)
    kept_EH = jnp.zeros((count, *best.shape), best.dtype)
    inf = jnp.asarray(jnp.inf, jnp.float32)
    return Search(belief, best, inf, kept_EH, jnp.full((count,), inf))


def kept(planner: Planner, config: PlanConfig) -> int:
    """Return E, the number of candidates that a planner keeps between rounds."""
    return round(getattr(planner, "keep", 0.0) * config.elites)


START_PROBABILITY = 0.5
"""Initial probability of the discrete choices that a search starts from."""


def _belief_around(planner: Planner, belief: Any, start: Array, blocks: int) -> Any:
    """Return a belief around the start choices."""
    space = planner.space
    wide = () if isinstance(space, Discrete) else (len(space.low),)
    if start.ndim != 1 + len(wide) or len(start) > blocks or start.shape[1:] != wide:
        raise UserError(
            f"a plan cannot start from choices of shape {start.shape}: give at most {blocks} "
            f"blocks of shape {wide}."
        )
    length = len(start)
    if isinstance(space, Discrete):
        sure = jax.nn.one_hot(start, space.count)
        return belief.at[:length].set(
            START_PROBABILITY * sure + (1 - START_PROBABILITY) / space.count
        )
    low, high = bounds(space)
    return Normals(belief.mean_HA.at[:length].set(jnp.clip(start, low, high)), belief.std_HA)


def propose(planner: Planner, config: PlanConfig, search: Search, key: Array) -> Array:
    """Draw (K, H) discrete or (K, H, A) continuous choices; the first is the belief's mode."""
    belief = search.belief
    shape = (config.candidates, config.horizon)
    drawn = _draw(planner, belief, shape, key)
    first = mode(belief)
    if isinstance(planner, RandomShooting):  # its distribution never changes
        first = jnp.where(jnp.isfinite(search.cost), drawn[0], first)
    return drawn.at[0].set(first)


def _draw(planner: Planner, belief: Any, shape: tuple[int, int], key: Array) -> Array:
    """Draw choices from a belief, or uniformly for random shooting."""
    space, uniform = planner.space, isinstance(planner, RandomShooting)
    if isinstance(space, Discrete):
        if uniform:
            return jax.random.randint(key, shape, 0, space.count)
        return jax.random.categorical(key, jnp.log(belief), shape=shape).astype(jnp.int32)
    low, high = bounds(space)
    if uniform:
        return jax.random.uniform(key, (*shape, len(low))) * (high - low) + low
    noise = jax.random.normal(key, (*shape, len(low)))
    return jnp.clip(belief.mean_HA + belief.std_HA * noise, low, high)


def update(
    planner: Planner, config: PlanConfig, search: Search, choices_KH: Array, costs_K: Array
) -> Search:
    """Update the search with the (K, H) or (K, H, A) choices of a round and their costs.

    Lower costs are better; NaN and inf count as worst. Duplicate choices count once.
    """
    costs = jnp.where(jnp.isfinite(costs_K), costs_K, jnp.inf).astype(jnp.float32)
    least = jnp.argmin(costs)
    better = costs[least] < search.cost
    best = jnp.where(better, choices_KH[least], search.best)
    cost = jnp.where(better, costs[least], search.cost)
    if isinstance(planner, RandomShooting):
        return dataclasses.replace(search, best=best, cost=cost)
    choices = jnp.concatenate([choices_KH, search.kept_EH])
    costs = jnp.concatenate([costs, search.kept_costs_E])
    costs = jnp.where(repeated(choices), jnp.inf, costs)
    weights = importance(planner, config, costs)
    belief = _fit(planner, search.belief, choices, weights)
    some = jnp.isfinite(costs).any()  # otherwise nothing was learned
    belief = jax.tree.map(lambda new, old: jnp.where(some, new, old), belief, search.belief)
    stays = jnp.argsort(costs, stable=True)[: kept(planner, config)]
    return Search(belief, best, cost, choices[stays], costs[stays])


def repeated(choices: Array) -> Array:
    """Return which of (n, …) choices duplicate an earlier one, (n,) bool."""
    flat = choices.reshape(len(choices), -1)
    return jnp.tril((flat[:, None] == flat[None]).all(-1), -1).any(1)


def _fit(planner: CEM | MPPI, belief: Any, choices_KH: Array, weights_K: Array) -> Any:
    """Return the belief fitted to weighted choices, with momentum."""
    stays, learned = planner.momentum, 1 - planner.momentum
    if isinstance(planner.space, Discrete):
        count = planner.space.count
        fitted = jnp.einsum("k,kha->ha", weights_K, jax.nn.one_hot(choices_KH, count))
        fitted = (1 - planner.smoothing) * fitted + planner.smoothing / count
        return stays * belief + learned * fitted
    low, high = bounds(planner.space)
    mean = jnp.einsum("k,kha->ha", weights_K, choices_KH)
    std = jnp.sqrt(jnp.einsum("k,kha->ha", weights_K, jnp.square(choices_KH - mean)))
    std = jnp.maximum(stays * belief.std_HA + learned * std, planner.min_std * (high - low) / 2)
    return Normals(stays * belief.mean_HA + learned * mean, std)


def importance(planner: Planner, config: PlanConfig, costs_K: Array) -> Array:
    """Return the (K,) weights of candidates, which sum to 1; 0 for infinite costs."""
    finite = jnp.isfinite(costs_K)
    if isinstance(planner, MPPI):
        count = jnp.maximum(finite.sum(), 1)
        usable = jnp.where(finite, costs_K, 0)
        mean = usable.sum() / count
        std = jnp.sqrt(jnp.where(finite, jnp.square(usable - mean), 0).sum() / count)
        above = jnp.where(finite, usable - jnp.min(costs_K), jnp.inf)
        weights = jnp.exp(-above / jnp.maximum(planner.temperature * std, 1e-12))
        weights = jnp.where(finite, weights, 0)
    else:
        rank = jnp.argsort(jnp.argsort(costs_K, stable=True), stable=True)
        weights = ((rank < config.elites) & finite).astype(jnp.float32)
    return weights / jnp.maximum(weights.sum(), 1e-12)


def mode(belief: Any) -> Array:
    """Return the most probable choices, (H,) or (H, A)."""
    if isinstance(belief, Normals):
        return belief.mean_HA
    return jnp.argmax(belief, -1).astype(jnp.int32)


def spread(space: Discrete | Box, belief: Any) -> Array:
    """Return a belief's spread: entropy relative to the uniform one's, or mean std."""
    if isinstance(belief, Normals):
        return belief.std_HA.mean()
    assert isinstance(space, Discrete)
    entropy = -jnp.where(belief > 0, belief * jnp.log(jnp.maximum(belief, 1e-30)), 0).sum(-1).mean()
    return entropy / np.log(max(space.count, 2))


def actions_of(config: PlanConfig, choices: Array) -> Array:
    """Return the actions (K, N, …) of choices (K, H, …): each block's is repeated."""
    return jnp.repeat(choices, config.action_block, axis=1)


def shifted(config: PlanConfig, choices_H: Array) -> Array:
    """Return the blocks of a plan that remain after its first ones were executed, or none."""
    return choices_H[config.receding_horizon or config.horizon :]


def bounds(space: Box) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds as arrays."""
    return np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
