"""Planning loop: sample candidates, compute their costs, update the planner, and repeat.

``search`` is pure and jitted as a whole, for costs that JAX can trace. ``plan`` is the same loop on
the host, for any cost: it shows progress, raises an error for costs that are NaN or −inf, and
resumes an interrupted search. Both derive a round's randomness only from the key and the round's
number: the same key gives the same plan.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import ProgressFile
from pewm_jax.planning import planners
from pewm_jax.planning.planners import Search
from pewm_jax.planning.settings import PlanConfig, Planner
from pewm_jax.types import Array

Cost: TypeAlias = Callable[[Array, Array], Array]
"""``(actions_KN, key) -> costs_K``, lower is better; continuous actions are (K, N, A)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rounds:
    """Statistics of every round.

    Attributes:
        least_R: (R,) the lowest cost of the round.
        mean_R: (R,) the mean of its finite costs.
        best_R: (R,) the lowest cost so far.
        spread_R: (R,) spread of the planner's distribution after the round: its entropy relative to
            the uniform distribution's, or the mean standard deviation.
    """

    least_R: Array
    mean_R: Array
    best_R: Array
    spread_R: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """The best candidate of all rounds.

    Attributes:
        actions: (N,) discrete or (N, A) continuous actions.
        choices: (H,) or (H, A) the choice of each block.
        cost: () its cost.
        rounds: statistics of every round.
    """

    actions: Array
    choices: Array
    cost: Array
    rounds: Rounds


def _keys(key: Array, number: Array | int) -> tuple[Array, Array]:
    """Return a round's keys: for the proposals and for the costs."""
    drawn, judged = jax.random.split(jax.random.fold_in(key, number))
    return drawn, judged


def _learn(
    planner: Planner, config: PlanConfig, search: Search, choices: Array, costs: Array
) -> tuple[Search, Rounds]:
    """Update the search and return it with the round's statistics."""
    after = planners.update(planner, config, search, choices, costs)
    finite = jnp.isfinite(costs)
    mean = jnp.where(finite, costs, 0).sum() / jnp.maximum(finite.sum(), 1)
    least = jnp.where(finite, costs, jnp.inf).min()
    mean = jnp.where(finite.any(), mean, jnp.inf)
    undecided = planners.spread(planner.space, after.belief)
    return after, Rounds(least, mean, after.cost, undecided)


def search(
    planner: Planner,
    config: PlanConfig,
    cost_of_actions: Cost,
    key: Array,
    start: Array | None = None,
) -> Plan:
    """Plan with a cost that JAX can trace; pure: jit it, vmap it over keys and goals.

    NaN costs count as worst; ``plan`` raises an error for them. ``start``: see ``planners.init``.
    """

    def step(search: Search, number: Array) -> tuple[Search, Rounds]:
        drawn, judged = _keys(key, number)
        choices = planners.propose(planner, config, search, drawn)
        costs = cost_of_actions(planners.actions_of(config, choices), judged)
        return _learn(planner, config, search, choices, costs)

    begun = planners.init(planner, config, start)
    found, rounds = jax.lax.scan(step, begun, jnp.arange(config.rounds))
    return _to_plan(config, found, rounds)


def _to_plan(config: PlanConfig, found: Search, rounds: Rounds) -> Plan:
    actions = planners.actions_of(config, found.best[None])[0]
    return Plan(actions, found.best, found.cost, rounds)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _proposed(
    planner: Planner, config: PlanConfig, search: Search, key: Array, number: Array
) -> tuple[Array, Array, Array]:
    """Return a round's choices, their actions, and the key of their costs."""
    drawn, judged = _keys(key, number)
    choices = planners.propose(planner, config, search, drawn)
    return choices, planners.actions_of(config, choices), judged


_learned = jax.jit(_learn, static_argnums=(0, 1))


def plan(
    planner: Planner,
    config: PlanConfig,
    cost_of_actions: Cost,
    key: Array,
    start: Array | None = None,
    *,
    checkpoint: Path | None = None,
    about: str = "",
    progress: bool = True,
) -> Plan:
    """Plan with any cost, on the host.

    It may be interrupted at any time; the same arguments give the same plan.

    Args:
        planner: the planner.
        config: the size of the search.
        cost_of_actions: see ``Cost``; it is called once per round and need not be pure. inf
            excludes a candidate.
        key: randomness.
        start: see ``planners.init``.
        checkpoint: a file that is rewritten after every round. The same call resumes from it, or
            returns the finished plan. A file of a search with other settings, key, start or
            ``about`` is an error.
        about: what the cost depends on, for the checkpoint, such as a hash of state and goal.
        progress: whether to show progress.

    Raises:
        UserError: costs are NaN or −inf or of another shape, no candidate has a finite cost, or the
            checkpoint is damaged or of another search.
    """
    begun = planners.init(planner, config, start)
    made: list[Rounds] = []
    file = None
    if checkpoint is not None:
        file = ProgressFile(checkpoint, _identity(planner, config, key, begun, about), "a search")
        begun, made = _restore(file.read(), begun)
    meter = Meter("plan", config.rounds * config.candidates, "candidates") if progress else None
    found = begun
    with meter or contextlib.nullcontext():
        if meter is not None:
            meter.advance(len(made) * config.candidates)
        for number in range(len(made), config.rounds):
            choices, actions, judged = _proposed(planner, config, found, key, number)
            costs = checked(cost_of_actions(actions, judged), config.candidates, number)
            found, statistics = _learned(planner, config, found, choices, costs)
            made.append(jax.tree.map(np.asarray, statistics))
            if file is not None:
                file.write(_arrays_of(found, made))
            if meter is not None:
                meter.advance(config.candidates)
    if not np.isfinite(float(found.cost)):
        raise UserError(
            f"no candidate of {config.rounds} rounds has a finite cost, so no plan can be chosen: "
            "check the cost, or allow other actions."
        )
    return _to_plan(config, found, jax.tree.map(lambda *x: jnp.stack(x), *made))


def _identity(planner: Planner, config: PlanConfig, key: Array, begun: Search, about: str) -> str:
    """Return a hash of everything that a search depends on."""
    digest = hashlib.sha256(repr((planner, config, about)).encode())
    for leaf in [jax.random.key_data(key), *jax.tree.leaves(begun)]:
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _arrays_of(search: Search, rounds: list[Rounds]) -> dict[str, np.ndarray]:
    """Return the state of a search and the statistics of its rounds as named arrays."""
    arrays = {f"search_{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(search))}
    columns = zip(*(jax.tree.leaves(x) for x in rounds), strict=True)
    return arrays | {f"rounds_{i}": np.stack(column) for i, column in enumerate(columns)}


def _restore(arrays: dict[str, np.ndarray] | None, begun: Search) -> tuple[Search, list[Rounds]]:
    """Return the state and the rounds from ``_arrays_of``; for None, those of a new search."""
    if arrays is None:
        return begun, []
    leaves, tree = jax.tree.flatten(begun)
    saved = [arrays[f"search_{i}"] for i in range(len(leaves))]
    columns = [arrays[name] for name in sorted(arrays) if name.startswith("rounds_")]
    return jax.tree.unflatten(tree, saved), [Rounds(*row) for row in zip(*columns, strict=True)]


def checked(costs: Any, count: int, number: int | None = None) -> np.ndarray:
    """Return the costs of K = ``count`` candidates as (K,) float32 numbers.

    ``number`` is the round, for the message, if there are rounds.

    Raises:
        UserError: they are of another shape, NaN, or −inf.
    """
    values = np.asarray(costs, np.float32)
    where = "" if number is None else f"in round {number} "
    if values.shape != (count,):
        raise UserError(
            f"{where}the cost of {count} candidates has shape {values.shape}: return one number "
            "per candidate."
        )
    wrong = np.flatnonzero(np.isnan(values) | (values == -np.inf))
    if len(wrong):
        named = ", ".join(map(str, wrong[:8])) + (" …" if len(wrong) > 8 else "")
        raise UserError(
            f"{where}the cost of {len(wrong)} of {count} candidates ({named}) is NaN or −inf: the "
            "model imagined, or the cost computed, values that are not finite; check the frames "
            "from pewm_jax.imagine for these actions, and the cost of one frame."
        )
    return values
