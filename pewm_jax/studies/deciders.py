"""The methods of Table 2: a policy alone, its proposals ranked, one plan, and closed-loop planning.

All but the first need a predictor of future observations:

* ``empty``: the model with an empty memory;
* ``none``: a model that was trained without memory, if there is one;
* ``reproject``: no network, observed pixels moved to the future camera;
* ``memory``: the model with its memory;
* ``truth``: the renderer itself, an upper bound of any model.

``mpc-…`` is one plan that is executed completely (open loop; decisions stored by earlier versions
have this name). ``loop-…`` is model predictive control: after each clip's actions the agent
observes the real frames, adds them to its memory, and plans the rest anew.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.config import ActionConfig, Config, UserError
from pewm_jax.eval.reproject import ReprojectSettings, reproject
from pewm_jax.geometry.actions import continuous, integrate
from pewm_jax.io.store import file_hash
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.planning import nomad_policy
from pewm_jax.planning.candidates import CandidateCost, ImaginedRollout, Rollout, rank_by
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.plan import plan
from pewm_jax.planning.settings import CEM, PlanConfig
from pewm_jax.studies.goals import Goal, TaskInput, wander
from pewm_jax.train.runs import WEIGHTS
from pewm_jax.types import Camera, Frames, Params
from pewm_jax.worlds.nomad import NomadTask
from pewm_jax.worlds.rollouts import load_finished

PREDICTORS = ("empty", "reproject", "memory", "truth")
NONE = "none"
REPROJECTION = ReprojectSettings(footprint=2)
"""How ``reproject`` draws: what ``pewm-jax evaluate small`` chose on the validation split of its
data."""
Policy: TypeAlias = Callable[[TaskInput, int], np.ndarray]
"""``policy(task, count) -> (count, N)`` discrete actions: proposals, the policy's own choice
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
class Predictors:
    """The model under test, and the truth.

    Attributes:
        config: of the model.
        params: its weights.
        batch: candidates imagined at once.
    """

    config: Config
    params: Params = dataclasses.field(repr=False)
    batch: int = 6
    none: tuple[Config, Params] | None = dataclasses.field(default=None, repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        """The predictors, worst first as one would expect."""
        return (PREDICTORS[0], NONE, *PREDICTORS[1:]) if self.none else PREDICTORS

    def rollout(self, predictor: str, goal: Goal) -> Rollout:
        """Return what a predictor rolls candidates out with, from a task's start."""
        return self.rollout_from(predictor, self.begin(predictor, goal), goal, goal.walk_T3[0])

    def begin(self, predictor: str, goal: Goal) -> Any:
        """Return a predictor's state after a task's context was observed."""
        if predictor in ("truth", "reproject"):
            return goal.context
        return worlds.start(*self._model(predictor), goal.context)

    def observe(self, predictor: str, state: Any, frames: Frames) -> Any:
        """Return a predictor's state after more real frames."""
        if predictor in ("truth", "reproject"):
            return jax.tree.map(lambda *x: np.concatenate(x), state, frames)
        return worlds.observe(*self._model(predictor), state, frames)

    def rollout_from(self, predictor: str, state: Any, goal: Goal, planar_3: np.ndarray) -> Rollout:
        """Return what a predictor rolls candidates out with, from a place."""
        if predictor == "truth":
            return functools.partial(goal.seen, start_3=planar_3)
        if predictor == "reproject":
            return Reprojection(self.config.model.actions, REPROJECTION, state)
        config, params = self._model(predictor)
        key = jax.random.key(goal.number)
        return ImaginedRollout(config, params, state, key, self.batch, memory=predictor == "memory")

    def _model(self, predictor: str) -> tuple[Config, Params]:
        if predictor != NONE:
            return self.config, self.params
        assert self.none is not None
        return self.none


@dataclasses.dataclass(frozen=True, eq=False)
class Reprojection:
    """A rollout without a network: observed pixels, drawn where each candidate's walk ends.

    Attributes:
        motion: what an action does.
        settings: how pixels are drawn.
        observed: (S,) observed frames; the last one is the present.
    """

    motion: ActionConfig
    settings: ReprojectSettings
    observed: Frames

    def __call__(self, actions_KN: Any) -> Frames:
        """Return what is seen after each candidate's last action, (K, 1) frames."""
        moves = continuous(self.motion, np.asarray(actions_KN))
        return jax.device_get(_reprojected(self.settings, self.observed, moves))


@functools.partial(jax.jit, static_argnums=0)
def _reprojected(settings: ReprojectSettings, observed: Frames, moves_KN3: Any) -> Frames:
    present = jax.tree.map(lambda x: jnp.asarray(x)[-1], observed.camera)

    def one(moves_N3: Any) -> Frames:
        pose = integrate(present.world_from_camera, moves_N3)[-1:]
        return reproject(settings, observed, Camera(present.intrinsics_4[None], pose))

    return jax.lax.map(one, moves_KN3)


def method_names(
    proposals: tuple[int, ...], predictors: tuple[str, ...] = PREDICTORS
) -> tuple[str, ...]:
    """Return the methods of the table.

    Args:
        proposals: numbers of proposals that are ranked.
        predictors: the predictors.
    """
    ranked = (f"rank{count}-{predictor}" for count in proposals for predictor in predictors)
    plans = (f"{what}-{predictor}" for what in ("mpc", "loop") for predictor in predictors)
    return ("policy", *ranked, *plans)


def decide(
    name: str,
    goal: Goal,
    predictors: Predictors,
    policy: Policy,
    cost: FrameCost,
    config: PlanConfig,
) -> Decision:
    """Choose actions for a task.

    Args:
        name: of ``method_names``.
        goal: the task.
        predictors: what would be seen.
        policy: makes proposals.
        cost: how far that is from the goal.
        config: of plans.

    Raises:
        UserError: a cost is no number.
    """
    what, _, predictor = name.partition("-")
    if what == "policy":
        return Decision(proposed(policy, goal, 1)[0])
    if what == "loop":
        return _closed_loop(predictor, goal, predictors, cost, config)
    rollout = predictors.rollout(predictor, goal)
    if what.startswith("rank"):
        proposals = proposed(policy, goal, int(what.removeprefix("rank")))
        ranking = rank_by(rollout, proposals, cost, goal.frame)
        best = ranking.order_K[0]
        return Decision(proposals[best], float(ranking.costs_K[best]))
    watched = _Watched(CandidateCost(rollout, cost, goal.frame))
    found = plan(CEM(), config, watched, jax.random.key(goal.number), progress=False)
    return Decision(np.asarray(found.actions), float(found.cost), watched.found)


def _closed_loop(
    predictor: str, goal: Goal, predictors: Predictors, cost: FrameCost, config: PlanConfig
) -> Decision:
    """Plan, carry out one clip's actions, observe, and plan the rest anew.

    The horizon shrinks with the remaining actions of the task. When they are spent, the agent may
    execute one more clip if its predicted cost is lower than the present cost. The agent does not
    know whether it is at the goal.
    """
    clip = predictors.config.model.clip.frames - 1
    state, planar = predictors.begin(predictor, goal), goal.walk_T3[0]
    total, done, foreseen = len(goal.expert_N), list[int](), float("nan")
    present = jax.tree.map(lambda x: x[-1:], goal.context)
    while len(done) < total + clip:
        here = float(np.asarray(cost(jax.tree.map(lambda x: x[None], present), goal.frame))[0])
        horizon = max(total - len(done), clip)
        judged = CandidateCost(
            predictors.rollout_from(predictor, state, goal, planar), cost, goal.frame
        )
        key = jax.random.fold_in(jax.random.key(goal.number), len(done))
        found = plan(
            CEM(),
            dataclasses.replace(config, horizon=horizon, action_block=1),
            judged,
            key,
            progress=False,
        )
        if len(done) >= total and float(found.cost) >= here:
            break
        foreseen = float(found.cost)
        chosen = np.asarray(found.actions)[:clip]
        walk = goal.walked(chosen, planar)
        seen = goal.simulator.frames(walk[1:])
        state, planar = predictors.observe(predictor, state, seen), walk[-1]
        present = jax.tree.map(lambda x: x[-1:], seen)
        done += [int(action) for action in chosen]
    return Decision(np.array(done), foreseen)


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
    task = goal.input
    proposals = np.asarray(policy(task, count))
    known = proposals.dtype.kind in "iu" and proposals.shape == (count, task.actions)
    if not known or not ((proposals >= 0) & (proposals < len(goal.table_A3))).all():
        raise UserError(
            f"the policy proposed {proposals.dtype} of shape {proposals.shape} for {goal.house}: "
            f"give ({count}, {task.actions}) whole numbers below {len(goal.table_A3)}."
        )
    return proposals


def wanderer(task: TaskInput, count: int, *, seed: int = 0) -> np.ndarray:
    """Propose walks that know nothing; see ``goals.wander``. A ``Policy``."""
    rng = np.random.default_rng((seed, task.number))
    return np.stack([wander(rng, task.actions) for _ in range(count)])


def nomad(config: NomadConfig, params: Params, motion: ActionConfig) -> Policy:
    """Return NoMaD as a ``Policy``: its waypoints as the actions that come nearest to them.

    Args:
        config: the policy.
        params: its parameters.
        motion: what an action does.
    """

    def propose(task: TaskInput, count: int) -> np.ndarray:
        if task.actions > config.waypoints:
            raise UserError(
                f"NoMaD proposes {config.waypoints} waypoints, and {task.actions} actions are "
                "asked for: use a shorter --horizon."
            )
        seen = nomad_policy.history(config, np.asarray(task.context.rgb_THWC))
        key = jax.random.key(task.number)
        goal = np.asarray(task.frame.rgb_THWC)[0]
        ways = nomad_policy.propose(config, params, seen, goal, key, count)
        return nomad_policy.discrete(motion, np.asarray(ways)[:, : task.actions])

    return propose


POLICIES: Mapping[str, Policy] = {"wander": functools.partial(wanderer)}
"""Policies by name; another is named MODULE:FUNCTION, or by the folder of a trained NoMaD."""


SETTINGS = "config.json"


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedPolicy:
    """A trained NoMaD.

    Attributes:
        folder: of its run.
        config: of its training.
        weights: the policy's parameters.
        digest: of weights and settings, see ``model_digest``.
    """

    folder: Path
    config: Config
    weights: Params = dataclasses.field(repr=False)
    digest: str

    @property
    def motion(self) -> ActionConfig:
        """What an action of its walks does."""
        return self.config.model.actions


def model_digest(weights_hash: str, config: Config) -> str:
    """Return a hash of all that what a model does depends on: its weights and its settings."""
    settings = json.dumps(configuration.to_dict(config.model), sort_keys=True)
    return hashlib.sha256((weights_hash + settings).encode()).hexdigest()


def is_run(name: str | Path) -> bool:
    """Tell whether a name is a folder with settings of a training."""
    return (Path(name) / SETTINGS).is_file()


def open_policy(name: str | Path) -> LoadedPolicy:
    """Open the run of a NoMaD.

    Raises:
        UserError: there is no such run, it is damaged or not finished, or it trained another kind
            of model.
    """
    folder = Path(name)
    if not is_run(folder):
        raise UserError(f"{folder} holds no run: train a policy first (pewm-jax train nomad).")
    config, params = load_finished(folder)
    if not isinstance(config.model, NomadTask):
        raise UserError(f"{folder} trained no policy: name the run of one (pewm-jax train nomad).")
    return LoadedPolicy(
        folder, config, params["policy"], model_digest(file_hash(folder / WEIGHTS), config)
    )
