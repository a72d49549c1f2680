"""Ranking: which of a policy's proposals leads nearest to the goal, as the model imagines it.

The paper's Table 2: 8 or 16 trajectories of a policy, imagined, in the order of LPIPS between the
last frame and the goal.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pewm_jax.config import Config, World
from pewm_jax.planning.candidates import Imagination, Rollout
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.plan import checked
from pewm_jax.types import Array, Frames, Params, WorldState


@dataclasses.dataclass(frozen=True)
class Ranking:
    """Proposals in order.

    Attributes:
        order_K: (K,) their numbers, the best first; of equal ones the first given.
        costs_K: (K,) their costs, in the order given.
        frames: what was rolled out of each, leading axis K, in the order given.
    """

    order_K: np.ndarray
    costs_K: np.ndarray
    frames: Frames = dataclasses.field(repr=False)


def rank(
    config: Config | World,
    params: Params,
    state: WorldState,
    proposals_KN: Any,
    cost: FrameCost,
    goal: Frames,
    key: Array,
    *,
    batch: int = 6,
    last: bool = True,
) -> Ranking:
    """Imagine proposals and put them in order.

    Args:
        config: the model's settings, or an experiment's.
        params: its parameters.
        state: the world so far.
        proposals_KN: (K, N) discrete or (K, N, 3) continuous actions of any policy.
        cost: see ``planning.costs``.
        goal: the goal, T = 1.
        key: the noise, the same for all.
        batch: see ``Imagination``.
        last: imagine only the last frame of each; False for costs that look at all.

    Raises:
        UserError: a cost is no number; see ``plan.checked``.
    """
    return rank_by(Imagination(config, params, state, key, batch, last), proposals_KN, cost, goal)


def rank_by(rollout: Rollout, proposals_KN: Any, cost: FrameCost, goal: Frames) -> Ranking:
    """Put proposals in order by any rollout, such as a simulator's; see ``rank``."""
    frames = rollout(proposals_KN)
    costs = checked(cost(frames, goal), len(proposals_KN))
    return Ranking(np.argsort(costs, kind="stable"), costs, frames)
