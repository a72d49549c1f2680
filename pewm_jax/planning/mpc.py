"""Model predictive control: plan, execute the first actions, observe, and plan again.

A ``Predictor`` rolls candidates out: a world model that observes every real frame
(``world_predictor``), or a simulator with the ground truth (``simulator_predictor``). The agent
acts through a function ``step(action) -> (frames, done)`` that returns the real frame after an
action, and whether the goal is reached.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError, World
from pewm_jax.io.progress import Meter
from pewm_jax.planning.candidates import CandidateCost, ImaginedRollout, Rollout
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.plan import Plan, plan
from pewm_jax.planning.planners import shifted
from pewm_jax.planning.settings import PlanConfig, Planner
from pewm_jax.types import Array, Frames, Params

_DEPRECATED = {
    "Mind": "Predictor",
    "imagining": "world_predictor",
    "knowing": "simulator_predictor",
}


def __getattr__(name: str) -> Any:
    """Return a class or function by its deprecated name, with a warning."""
    if name not in _DEPRECATED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    now = _DEPRECATED[name]
    warnings.warn(f"{name} is deprecated: use {now}.", DeprecationWarning, stacklevel=2)
    return globals()[now]


Step: TypeAlias = Callable[[Any], tuple[Frames, bool]]
"""``step(action) -> (frames, done)``: one real frame, T = 1, and whether the goal is reached."""


@dataclasses.dataclass(frozen=True)
class Predictor:
    """Predicts the frames of candidates.

    Attributes:
        start: maps the first real frames to a state of any type.
        observe: maps a state and more real frames to the next state.
        rollout: maps a state and a key to a rollout of candidates.
    """

    start: Callable[[Frames], Any]
    observe: Callable[[Any, Frames], Any]
    rollout: Callable[[Any, Array], Rollout]


def world_predictor(
    config: Config | World,
    params: Params,
    *,
    batch: int = 6,
    last: bool = True,
    memory: bool = True,
) -> Predictor:
    """Return a predictor that imagines with a world model and observes the real frames.

    ``batch``, ``last`` and ``memory``: see ``ImaginedRollout``.
    """
    model = worlds.model_of(config)

    def rollout(state: Any, key: Array) -> Rollout:
        return ImaginedRollout(model, params, state, key, batch, last, memory)

    return Predictor(
        functools.partial(worlds.start, model, params),
        functools.partial(worlds.observe, model, params),
        rollout,
    )


def simulator_predictor(rollout_from: Callable[[Frames], Rollout]) -> Predictor:
    """Return a predictor that renders the frames of candidates with a simulator.

    ``rollout_from`` maps the present frame, T = 1, to a rollout.
    """

    def last(frames: Frames) -> Frames:
        return jax.tree.map(lambda x: x[-1:], frames)

    return Predictor(last, lambda _, frames: last(frames), lambda state, _: rollout_from(state))


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """The trajectory of an agent.

    Attributes:
        actions: (n,) discrete or (n, A) continuous actions executed.
        frames: (n,) observed frames, one after each action.
        plans: all plans.
        costs: (p,) predicted cost of each plan.
        reached: whether the goal was reached.
        state: the predictor's final state.
    """

    actions: np.ndarray
    frames: Frames = dataclasses.field(repr=False)
    plans: tuple[Plan, ...] = dataclasses.field(repr=False)
    costs: np.ndarray
    reached: bool
    state: Any = dataclasses.field(repr=False)


def mpc(
    predictor: Predictor,
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

    Each plan but the first starts from the rest of the previous one. The same key in the same
    environment gives the same trajectory.

    Args:
        predictor: see ``world_predictor`` and ``simulator_predictor``.
        step: the environment.
        observed: (S,) real frames; the last one is the present.
        goal: the goal, T = 1.
        cost: see ``planning.costs``.
        planner: see ``planning.settings``.
        config: the size of a plan, and how much of it is executed.
        key: randomness; plan i uses ``fold_in(key, i)``.
        budget: largest number of actions.
        folder: where plans are stored during the search and afterwards. The same call resumes: it
            reads the finished plans, executes them again, and continues the interrupted one. The
            frames must be the same.
        about: with ``folder``: what plans depend on besides settings, key and frames, such as
            hashes of the cost and of the model's weights. Plans with other inputs are an error.
        progress: whether to show progress.

    Raises:
        UserError: the budget allows no action, ``folder`` is set without ``about``, or a plan
            fails; see ``plan.plan``.
    """
    if budget < 1:
        raise UserError(f"budget is {budget}: allow at least one action.")
    if folder is not None and not about:
        raise UserError(
            "plans are stored in a folder: pass about=…, what they depend on, such as the names of "
            "the model and of the cost, so that plans with other inputs are not reused."
        )
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    state, rest = predictor.start(observed), None
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
                CandidateCost(predictor.rollout(state, imagined), cost, goal),
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
            present = _concatenate(seen)
            state = predictor.observe(state, present)
            frames.append(present)
            rest = shifted(config, found.choices)
    costs = np.array([float(found.cost) for found in plans])
    return Trajectory(
        np.stack(actions), _concatenate(frames), tuple(plans), costs, bool(reached), state
    )


def _concatenate(frames: list[Frames]) -> Frames:
    return jax.tree.map(lambda *x: np.concatenate(x), *frames)


def _hash(*frames: Frames) -> str:
    """Return a hash of frames, which identifies a stored plan."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(frames):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
