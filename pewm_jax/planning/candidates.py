"""Candidates: the frames that follow from their actions, their costs, and their ranking.

A *rollout* is any function ``rollout(actions_KN) -> Frames`` that returns the (K, N) frames of K
candidates, or the last frame of each, (K, 1). ``ImaginedRollout`` imagines them with a world model;
a simulator renders the ground truth. ``CandidateCost`` combines a rollout and a cost into the
function that ``plan.plan`` minimizes. ``rank`` sorts the proposals of any policy, such as the 8 or
16 of the paper's Table 2.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError, World
from pewm_jax.errors import require
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.plan import checked
from pewm_jax.types import Array, Frames, Params, WorldState
from pewm_jax.worlds.checks import check_control

_DEPRECATED = {"Imagination": "ImaginedRollout", "Judged": "CandidateCost"}


def __getattr__(name: str) -> Any:
    """Return a class by its deprecated name, with a warning."""
    if name not in _DEPRECATED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    now = _DEPRECATED[name]
    warnings.warn(f"{name} is deprecated: use {now}.", DeprecationWarning, stacklevel=2)
    return globals()[now]


Rollout: TypeAlias = Callable[[Any], Frames]
"""``rollout(actions_KN) -> Frames`` with leading shape (K, N), or (K, 1) for the last frames
only."""


WORKERS = 2
"""Number of batches computed concurrently; operations that XLA runs on one core would leave others
idle."""


@functools.partial(jax.jit, static_argnums=0, static_argnames=("memory", "last"))
def _imagined(
    model: World,
    params: Params,
    state: WorldState,
    actions_KN: Array,
    keys: Array,
    views: Any,
    *,
    memory: bool,
    last: bool,
) -> Frames:
    """Imagine one batch."""
    return worlds.imagine_many(
        model, params, state, actions_KN, keys, memory=memory, last=last, views=views
    )[1]


@dataclasses.dataclass(frozen=True, eq=False)
class ImaginedRollout:
    """A rollout of a world model, one batch of candidates at a time; the memory is not updated.

    All candidates are imagined from the same noise. Their costs then differ only because of their
    actions, and the same actions have the same cost in every round.

    Attributes:
        config: the model's settings, or an experiment's.
        params: its parameters.
        state: the world's state.
        key: PRNG key of the noise.
        batch: number of candidates imagined together, two batches at a time. It bounds memory use
            and changes results only by rounding.
        last: return only the last frame of each candidate; the others are not decoded or, with
            ``model.asked_alone``, not imagined.
        memory: if False, the world's memory is not used.
    """

    config: Config | World
    params: Params = dataclasses.field(repr=False)
    state: WorldState = dataclasses.field(repr=False)
    key: Array
    batch: int = 6
    last: bool = True
    memory: bool = True
    _views: Callable[[Any], Any] | None = dataclasses.field(init=False, repr=False)

    def __post_init__(self):
        """Validate."""
        require(
            self.batch >= 1, f"batch is {self.batch}: imagine at least one candidate at a time."
        )
        object.__setattr__(self, "state", worlds.to_compare(self.config, self.state))
        views = worlds.views(self.config, self.params, self.state) if self.memory else None
        object.__setattr__(self, "_views", views)

    def __call__(self, actions_KN: Any) -> Frames:
        """Return the frames of K candidates, (K, N) or (K, 1).

        They are (K, N) discrete or (K, N, 3) continuous actions; see ``worlds.imagine``.

        Raises:
            UserError: they have another shape, are unknown, or are not finite.
        """
        actions = np.asarray(check_control(actions_KN, "imagine_many"))
        if actions.ndim not in (2, 3) or 0 in actions.shape:
            raise UserError(
                f"candidates of shape {actions.shape} are not supported: give (K, N) discrete "
                "actions or (K, N, 3) continuous ones."
            )
        # Candidates with equal prefixes are put into one batch, where they share their views.
        order = np.lexsort(actions.reshape(len(actions), -1).T[::-1])
        model, keys = worlds.model_of(self.config), jnp.stack([self.key] * self.batch)
        batches = [order[first : first + self.batch] for first in range(0, len(order), self.batch)]
        options = {"memory": self.memory, "last": self.last}

        def imagined(part: np.ndarray, views: Any) -> Frames:
            filled = actions[np.resize(part, self.batch)]
            run = _imagined(model, self.params, self.state, filled, keys, views, **options)
            return jax.tree.map(lambda x: x[: len(part)], jax.device_get(run))

        waiting = []
        with ThreadPoolExecutor(WORKERS) as pool:
            try:
                for number, part in enumerate(batches):
                    if number > WORKERS:  # limit the views held at once
                        waiting[number - WORKERS - 1].result()
                    views = self._views and self._views(actions[np.resize(part, self.batch)])
                    waiting.append(pool.submit(imagined, part, views))
                parts = [each.result() for each in waiting]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        back = np.argsort(order)
        # On the host: the number of candidates varies, and would trigger recompilation.
        return jax.tree.map(lambda *x: np.concatenate(x)[back], *parts)


@dataclasses.dataclass(eq=False)
class CandidateCost:
    """The cost of candidates, for ``plan.plan``: a rollout and a cost of its frames.

    The costs of discrete actions are cached: candidates of an earlier round, or of this one, are
    not rolled out again. The rollout must therefore be a function of the actions.

    Attributes:
        rollout: from actions to frames.
        cost: from frames and goal to costs.
        goal: the goal, T = 1.
        asked: number of candidates evaluated so far, including cached ones.
        rolled_out: number of these that were rolled out.
    """

    rollout: Rollout
    cost: FrameCost
    goal: Frames
    asked: int = 0
    rolled_out: int = 0

    def __post_init__(self):
        self._known: dict[bytes, float] = {}

    def __call__(self, actions_KN: Array, key: Array | None = None) -> np.ndarray:
        """Return (K,) costs; the key is not used."""
        del key
        actions = np.asarray(actions_KN)
        self.asked += len(actions)
        if not np.issubdtype(actions.dtype, np.integer):
            return self._costs(actions, len(actions))
        names = [row.tobytes() for row in actions]
        new = {name: k for k, name in enumerate(names) if name not in self._known}
        if new:
            costs = self._costs(actions[list(new.values())], len(actions))
            self._known |= dict(zip(new, costs.tolist(), strict=True))
        return np.array([self._known[name] for name in names], np.float32)

    def _costs(self, actions: np.ndarray, count: int) -> np.ndarray:
        """Return the costs of actions; the last frames are repeated up to ``count`` candidates."""
        self.rolled_out += len(actions)
        frames, missing = self.rollout(actions), count - len(actions)
        if missing:  # pad, so that the cost is compiled once
            frames = jax.tree.map(lambda x: np.concatenate([x, [x[-1]] * missing]), frames)
        return np.asarray(self.cost(frames, self.goal), np.float32)[: len(actions)]


@dataclasses.dataclass(frozen=True)
class Ranking:
    """Sorted proposals.

    Attributes:
        order_K: (K,) indices of the proposals, best first; ties in the given order.
        costs_K: (K,) their costs, in the given order.
        frames: the frames rolled out for each, leading axis K, in the given order.
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
    """Imagine the (K, N) or (K, N, 3) proposals of any policy and sort them by cost.

    The other arguments are those of ``ImaginedRollout``, a cost of ``planning.costs`` and the goal,
    T = 1. With ``last=False`` all frames are imagined, for costs of all.

    Raises:
        UserError: a cost is not a finite number; see ``plan.checked``.
    """
    return rank_by(
        ImaginedRollout(config, params, state, key, batch, last), proposals_KN, cost, goal
    )


def rank_by(rollout: Rollout, proposals_KN: Any, cost: FrameCost, goal: Frames) -> Ranking:
    """Sort proposals by the cost of any rollout, such as a simulator's; see ``rank``."""
    frames = rollout(proposals_KN)
    costs = checked(cost(frames, goal), len(proposals_KN))
    return Ranking(np.argsort(costs, kind="stable"), costs, frames)
