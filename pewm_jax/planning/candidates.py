"""Candidates: what would be seen if their actions were carried out, and what that costs.

A *rollout* is any function ``rollout(actions_KN) -> Frames``, (K, N) frames of K candidates, or the
last of each, (K, 1). ``imagination`` makes one of a world model; a simulator, which renders what
will truly be seen, is another. ``judged`` joins one with a cost to what ``plan.plan`` minimises.
"""

from __future__ import annotations

import dataclasses
import functools
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
from pewm_jax.types import Array, Frames, Params, WorldState
from pewm_jax.worlds.checks import check_control

Rollout: TypeAlias = Callable[[Any], Frames]
"""``rollout(actions_KN) -> Frames``, leading shape (K, N) or, of the last ones, (K, 1)."""


WORKERS = 2
"""Batches under way at once: what XLA does on one core (convolutions) would leave others idle."""


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
class Imagination:
    """A rollout through a world model, a batch of candidates at a time; its memory is not written.

    All candidates are imagined from the same noise. Their costs then differ by their actions alone,
    and the same actions have the same cost in every round.

    Attributes:
        config: the model's settings, or an experiment's.
        params: its parameters.
        state: the world so far.
        key: the noise.
        batch: candidates that are imagined together, two batches at a time. It bounds memory and
            changes no result, but for rounding.
        last: give only the last frame of each, which spares decoding the others.
        memory: False ignores what is remembered.
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

        Args:
            actions_KN: (K, N) discrete or (K, N, 3) continuous actions; see ``worlds.imagine``.

        Raises:
            UserError: they have another shape, are unknown, or are not finite.
        """
        actions = np.asarray(check_control(actions_KN, "imagine_many"))
        if actions.ndim not in (2, 3) or 0 in actions.shape:
            raise UserError(
                f"candidates of shape {actions.shape} cannot be imagined: give (K, N) discrete "
                "actions or (K, N, 3) continuous ones."
            )
        # Neighbours with equal beginnings come into one batch, where they share their views.
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
                    if number > WORKERS:  # views of few batches are held at once
                        waiting[number - WORKERS - 1].result()
                    views = self._views and self._views(actions[np.resize(part, self.batch)])
                    waiting.append(pool.submit(imagined, part, views))
                parts = [each.result() for each in waiting]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        back = np.argsort(order)
        # On the host: the number of candidates changes, and would be compiled for anew.
        return jax.tree.map(lambda *x: np.concatenate(x)[back], *parts)


@dataclasses.dataclass(eq=False)
class Judged:
    """Rollout and cost together: the cost of actions, as ``plan.plan`` takes it.

    The costs of discrete actions are kept, and those that were judged before, in this round or an
    earlier one, are not rolled out again. The rollout must therefore be a function of the actions.

    Attributes:
        rollout: from actions to frames.
        cost: from frames and goal to costs.
        goal: the goal, T = 1.
        asked: candidates that were asked for so far.
        rolled_out: of these, how many were rolled out.
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
        """Return the costs of actions, judged as that many, of which the last are repeated."""
        self.rolled_out += len(actions)
        frames, missing = self.rollout(actions), count - len(actions)
        if missing:  # so that a cost is compiled once
            frames = jax.tree.map(lambda x: np.concatenate([x, [x[-1]] * missing]), frames)
        return np.asarray(self.cost(frames, self.goal), np.float32)[: len(actions)]
