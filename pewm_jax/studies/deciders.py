"""How Table 2 decides: a policy alone, its proposals ranked, and plans, each by some mind.

A mind says what would be seen: the model with an ``empty`` memory, the model with its ``memory``,
or the ``truth``, the renderer itself, which bounds what any model can reach.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import ActionConfig, Config, NomadConfig, UserError
from pewm_jax.planning import nomad_policy
from pewm_jax.planning.candidates import Imagination, Judged, Rollout
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.plan import plan
from pewm_jax.planning.ranking import rank_by
from pewm_jax.planning.settings import CEM, PlanConfig
from pewm_jax.studies.goals import Asked, Goal, wander
from pewm_jax.types import Params

MINDS = ("empty", "memory", "truth")
Policy: TypeAlias = Callable[[Asked, int], np.ndarray]
"""``policy(asked, count) -> (count, N)`` discrete actions: proposals, the policy's own choice
first."""


@dataclasses.dataclass(frozen=True)
class Decision:
    """What a method chose for a task.

    Attributes:
        actions_N: the actions.
        foreseen: what it expected to pay, None for a policy alone.
        found: after so many samples of a plan, the best actions so far; empty for others.
    """

    actions_N: np.ndarray
    foreseen: float | None = None
    found: Mapping[int, np.ndarray] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, eq=False)
class Minds:
    """The model under test, and the truth.

    Attributes:
        config: of the model.
        params: its weights.
        batch: candidates imagined at once.
    """

    config: Config
    params: Params = dataclasses.field(repr=False)
    batch: int = 6

    def rollout(self, mind: str, goal: Goal) -> Rollout:
        """Return what a mind rolls candidates out with."""
        if mind == "truth":
            return goal.seen
        state = worlds.start(worlds.model_of(self.config), self.params, goal.context)
        key = jax.random.key(goal.number)
        memory = mind == "memory"
        return Imagination(self.config, self.params, state, key, self.batch, memory=memory)


def names(proposals: tuple[int, ...]) -> tuple[str, ...]:
    """Return the methods of the table.

    Args:
        proposals: numbers of proposals that are ranked.
    """
    ranked = (f"rank{count}-{mind}" for count in proposals for mind in MINDS)
    return ("policy", *ranked, *(f"mpc-{mind}" for mind in MINDS))


def decide(
    name: str, goal: Goal, minds: Minds, policy: Policy, cost: FrameCost, config: PlanConfig
) -> Decision:
    """Choose actions for a task.

    Args:
        name: of ``names``.
        goal: the task.
        minds: what would be seen.
        policy: makes proposals.
        cost: how far that is from the goal.
        config: of plans.

    Raises:
        UserError: a cost is no number.
    """
    what, _, mind = name.partition("-")
    if what == "policy":
        return Decision(proposed(policy, goal, 1)[0])
    rollout = minds.rollout(mind, goal)
    if what.startswith("rank"):
        proposals = proposed(policy, goal, int(what.removeprefix("rank")))
        ranking = rank_by(rollout, proposals, cost, goal.frame)
        best = ranking.order_K[0]
        return Decision(proposals[best], float(ranking.costs_K[best]))
    watched = _Watched(Judged(rollout, cost, goal.frame))
    found = plan(CEM(), config, watched, jax.random.key(goal.number), progress=False)
    return Decision(np.asarray(found.actions), float(found.cost), watched.found)


class _Watched:
    """A cost that remembers the best actions after each round."""

    def __init__(self, cost: Callable[..., Any]):
        self.cost, self.found = cost, dict[int, np.ndarray]()
        self._least, self._asked, self._best = np.inf, 0, np.zeros(0)

    def __call__(self, actions_KN: Any, key: Any = None) -> np.ndarray:
        costs = self.cost(actions_KN, key)
        self._asked += len(costs)
        if float(costs.min()) < self._least:
            self._least = float(costs.min())
            self._best = np.asarray(actions_KN)[int(costs.argmin())]
        self.found[self._asked] = self._best
        return costs


def proposed(policy: Policy, goal: Goal, count: int) -> np.ndarray:
    """Return a policy's proposals for a task, (count, N).

    Raises:
        UserError: they have another shape, or are no discrete actions.
    """
    asked = goal.asked
    proposals = np.asarray(policy(asked, count))
    known = proposals.dtype.kind in "iu" and proposals.shape == (count, asked.actions)
    if not known or not ((proposals >= 0) & (proposals < len(goal.table_A3))).all():
        raise UserError(
            f"the policy proposed {proposals.dtype} of shape {proposals.shape} for {goal.house}: "
            f"give ({count}, {asked.actions}) whole numbers below {len(goal.table_A3)}."
        )
    return proposals


def wanderer(asked: Asked, count: int, *, seed: int = 0) -> np.ndarray:
    """Propose walks that know nothing; see ``goals.wander``. A ``Policy``."""
    rng = np.random.default_rng((seed, asked.number))
    return np.stack([wander(rng, asked.actions) for _ in range(count)])


def nomad(config: NomadConfig, params: Params, motion: ActionConfig) -> Policy:
    """Return NoMaD as a ``Policy``: its waypoints as the actions that come nearest to them.

    Args:
        config: the policy.
        params: its parameters.
        motion: what an action does.
    """

    def propose(asked: Asked, count: int) -> np.ndarray:
        if asked.actions > config.waypoints:
            raise UserError(
                f"NoMaD proposes {config.waypoints} waypoints, and {asked.actions} actions are "
                "asked for: use a shorter --horizon."
            )
        seen = nomad_policy.history(config, np.asarray(asked.context.rgb_THWC))
        key = jax.random.key(asked.number)
        goal = np.asarray(asked.frame.rgb_THWC)[0]
        ways = nomad_policy.propose(config, params, seen, goal, key, count)
        return nomad_policy.discrete(motion, np.asarray(ways)[:, : asked.actions])

    return propose


POLICIES: Mapping[str, Policy] = {"wander": functools.partial(wanderer)}
"""Policies by name; another is named MODULE:FUNCTION, or by the folder of a trained NoMaD."""
