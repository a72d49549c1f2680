"""Model predictive control: plan, carry out the first actions, look, plan anew.

What plans is a ``Mind``: a world model, which takes in every real frame that it is shown
(``imagining``), or a simulator that knows the truth (``knowing``). What it acts in is a function
``step(action) -> (frames, done)`` that gives the one real frame seen after an action, and whether
the goal is reached.
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
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError, World
from pewm_jax.io.progress import Meter
from pewm_jax.planning.candidates import Imagination, Judged, Rollout
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.plan import Plan, plan
from pewm_jax.planning.planners import shifted
from pewm_jax.planning.settings import PlanConfig, Planner
from pewm_jax.types import Array, Frames, Params

Step: TypeAlias = Callable[[Any], tuple[Frames, bool]]
"""``step(action) -> (frames, done)``: one real frame, T = 1, and whether the goal is reached."""


@dataclasses.dataclass(frozen=True)
class Mind:
    """What an agent plans with.

    Attributes:
        start: from the first real frames to a state of any kind.
        observe: from a state and more real frames to the state after them.
        rollout: from a state and a key to a rollout of candidates.
    """

    start: Callable[[Frames], Any]
    observe: Callable[[Any, Frames], Any]
    rollout: Callable[[Any, Array], Rollout]


def imagining(
    config: Config | World,
    params: Params,
    *,
    batch: int = 6,
    last: bool = True,
    memory: bool = True,
) -> Mind:
    """Return a mind that imagines with a world model and remembers what it really sees.

    Args:
        config: the model's settings, or an experiment's.
        params: its parameters.
        batch: see ``Imagination``.
        last: imagine only the last frame of each candidate; False for costs that look at all.
        memory: False ignores what is remembered.
    """
    model = worlds.model_of(config)

    def rollout(state: Any, key: Array) -> Rollout:
        return Imagination(model, params, state, key, batch, last, memory)

    return Mind(
        functools.partial(worlds.start, model, params),
        functools.partial(worlds.observe, model, params),
        rollout,
    )


def knowing(rollout_from: Callable[[Frames], Rollout]) -> Mind:
    """Return a mind that needs to imagine nothing: a simulator tells what will be seen.

    Args:
        rollout_from: from the present frame, T = 1, to a rollout.
    """

    def last(frames: Frames) -> Frames:
        return jax.tree.map(lambda x: x[-1:], frames)

    return Mind(last, lambda _, frames: last(frames), lambda state, _: rollout_from(state))


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """What an agent did.

    Attributes:
        actions: (n,) discrete or (n, A) continuous actions that it carried out.
        frames: (n,) what it saw after each.
        plans: every plan that it made.
        costs: (p,) the cost of each plan, as it was foreseen.
        reached: whether the goal was reached.
        state: the mind's state at the end.
    """

    actions: np.ndarray
    frames: Frames = dataclasses.field(repr=False)
    plans: tuple[Plan, ...] = dataclasses.field(repr=False)
    costs: np.ndarray
    reached: bool
    state: Any = dataclasses.field(repr=False)


def mpc(
    mind: Mind,
    step: Step,
    observed: Frames,
    goal: Frames,
    cost: FrameCost,
    planner: Planner,
    config: PlanConfig,
    key: Array,
    *,
    budget: int,
    folder: Path | None = None,
    about: str = "",
    progress: bool = True,
) -> Trajectory:
    """Act until the goal is reached or the budget is spent.

    Each plan but the first is searched for around what is left of the one before. The same key in
    the same surroundings gives the same trajectory.

    Args:
        mind: see ``imagining`` and ``knowing``.
        step: the surroundings.
        observed: (S,) real frames; the last one is the present.
        goal: the goal, T = 1.
        cost: see ``planning.costs``.
        planner: see ``planning.settings``.
        config: the size of a plan, and how much of it is carried out.
        key: randomness; plan i uses ``fold_in(key, i)``.
        budget: actions at most.
        folder: where plans are kept while they are searched for and afterwards. The same call again
            then reads them, acts anew by them, and goes on with the plan that was interrupted; what
            was seen must be the same.
        about: with ``folder``: what plans depend on beside settings, key and what is seen, such as
            hashes of the cost and of the model's weights. Plans of something else are refused.
        progress: show it.

    Raises:
        UserError: the budget allows no action, there is a folder and not what its plans are about,
            or a plan is refused; see ``plan.plan``.
    """
    if budget < 1:
        raise UserError(f"budget is {budget}: allow at least one action.")
    if folder is not None and not about:
        raise UserError(
            "plans are kept in a folder: say by about=… what they depend on, such as the names of "
            "the model and of the cost, so that plans of another are not taken for them."
        )
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    state, rest = mind.start(observed), None
    actions: list[Any] = []
    frames: list[Frames] = []
    plans: list[Plan] = []
    reached, present = False, observed
    meter = Meter("mpc", budget, "actions") if progress else None
    with meter or contextlib.nullcontext():
        while not reached and len(actions) < budget:
            searched, imagined = jax.random.split(jax.random.fold_in(key, len(plans)))
            found = plan(
                planner,
                config,
                Judged(mind.rollout(state, imagined), cost, goal),
                searched,
                rest,
                checkpoint=folder and folder / f"plan_{len(plans):04d}.npz",
                about=f"{about} {_hash(present, goal)}" if folder else "",
                progress=False,
            )
            plans.append(found)
            seen: list[Frames] = []
            for action in np.asarray(found.actions)[: config.carried_out][: budget - len(actions)]:
                frame, reached = step(action)
                actions.append(action)
                seen.append(frame)
                if meter is not None:
                    meter.advance(1)
                if reached:
                    break
            present = _joined(seen)
            state = mind.observe(state, present)
            frames.append(present)
            rest = shifted(config, found.choices)
    costs = np.array([float(found.cost) for found in plans])
    return Trajectory(np.stack(actions), _joined(frames), tuple(plans), costs, bool(reached), state)


def _joined(frames: list[Frames]) -> Frames:
    return jax.tree.map(lambda *x: np.concatenate(x), *frames)


def _hash(*frames: Frames) -> str:
    """Return a hash of frames, by which a kept plan is recognised."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(frames):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
