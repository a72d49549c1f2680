"""The methods of Table 2: a policy alone, its proposals ranked, one plan, and closed-loop planning.

All but the first need a predictor of future observations:

* ``empty``: the model with an empty memory;
* ``none``: a model trained without memory (optional);
* ``reproject``: no network, observed pixels reprojected to the future camera;
* ``memory``: the model with its memory;
* ``truth``: the renderer itself, an upper bound of any model.

``mpc-…`` is one plan that is executed completely (open loop; decisions stored by earlier versions
have this name). ``loop-…`` is model predictive control: after each clip's actions the agent
observes the real frames, adds them to its memory, and plans the remaining actions again.
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
"""Settings of ``reproject``: those that ``pewm-jax evaluate small`` chose on the validation split
of its data."""
AT_ONCE = 16
"""Reprojections are computed for multiples of so many candidates."""
Policy: TypeAlias = Callable[[TaskInput, int], np.ndarray]
"""``policy(task, count) -> (count, N)`` discrete actions: proposals, with the policy's own choice
first."""


@dataclasses.dataclass(frozen=True)
class Decision:
    """The decision of a method for a task.

    Attributes:
        foreseen: the predicted cost; None for a policy alone.
        found: number of samples of a plan → the best actions so far; empty for other methods.
    """

    actions_N: np.ndarray
    foreseen: float | None = None
    found: Mapping[int, np.ndarray] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, eq=False)
class Predictors:
    """The predictors: the evaluated model, baselines and ground truth.

    ``none`` is a model trained without memory; ``batch`` the number of candidates imagined at once.
    """

    config: Config
    params: Params = dataclasses.field(repr=False)
    batch: int = 6
    none: tuple[Config, Params] | None = dataclasses.field(default=None, repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the predictors, in the expected order from worst to best."""
        return (PREDICTORS[0], NONE, *PREDICTORS[1:]) if self.none else PREDICTORS

    def rollout(self, predictor: str, goal: Goal) -> Rollout:
        """Return a predictor's rollout of candidates from a task's start."""
        return self.rollout_from(predictor, self.begin(predictor, goal), goal, goal.walk_T3[0])

    def begin(self, predictor: str, goal: Goal) -> Any:
        """Return a predictor's state after observing a task's context."""
        if predictor in ("truth", "reproject"):
            return goal.context
        return worlds.start(*self._model(predictor), goal.context)

    def observe(self, predictor: str, state: Any, frames: Frames) -> Any:
        """Return a predictor's state after observing more real frames."""
        if predictor in ("truth", "reproject"):
            return jax.tree.map(lambda *x: np.concatenate(x), state, frames)
        return worlds.observe(*self._model(predictor), state, frames)

    def rollout_from(self, predictor: str, state: Any, goal: Goal, planar_3: np.ndarray) -> Rollout:
        """Return a predictor's rollout of candidates from a state and pose."""
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
    """A rollout without a network: observed pixels, reprojected to each candidate's final pose.

    The last one of the (S,) observed frames is the present.
    """

    motion: ActionConfig
    settings: ReprojectSettings
    observed: Frames

    def __call__(self, actions_KN: Any) -> Frames:
        """Return the frame after each candidate's last action, (K, 1) frames."""
        moves = continuous(self.motion, np.asarray(actions_KN))
        count = len(moves)  # it varies, and every other one would be compiled
        filled = np.resize(moves, (-(-count // AT_ONCE) * AT_ONCE, *moves.shape[1:]))
        made = _reproject(self.settings, self.observed, filled)
        return jax.tree.map(lambda x: x[:count], jax.device_get(made))


@functools.partial(jax.jit, static_argnums=0)
def _reproject(settings: ReprojectSettings, observed: Frames, moves_KN3: Any) -> Frames:
    present = jax.tree.map(lambda x: jnp.asarray(x)[-1], observed.camera)

    def one(moves_N3: Any) -> Frames:
        pose = integrate(present.world_from_camera, moves_N3)[-1:]
        return reproject(settings, observed, Camera(present.intrinsics_4[None], pose))

    return jax.lax.map(one, moves_KN3)


def method_names(
    proposals: tuple[int, ...], predictors: tuple[str, ...] = PREDICTORS
) -> tuple[str, ...]:
    """Return the methods of the table, for numbers of ranked proposals and predictors."""
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
    """Choose actions for a task by one of ``method_names``; ``cost`` is the distance from the goal.

    Raises:
        UserError: a cost is not finite.
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
    """Plan, execute one clip's actions, observe, and plan the remaining actions again.

    The horizon shrinks with the remaining actions of the task. When they are used up, the agent may
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
    """A cost that stores the best actions after each round."""

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
        UserError: they have another shape, or are not discrete actions.
    """
    task = goal.input
    proposals = np.asarray(policy(task, count))
    known = proposals.dtype.kind in "iu" and proposals.shape == (count, task.actions)
    if not known or not ((proposals >= 0) & (proposals < len(goal.table_A3))).all():
        raise UserError(
            f"the policy proposed {proposals.dtype} of shape {proposals.shape} for {goal.house}: "
            f"give ({count}, {task.actions}) integers below {len(goal.table_A3)}."
        )
    return proposals


def wanderer(task: TaskInput, count: int, *, seed: int = 0) -> np.ndarray:
    """Propose random walks; see ``goals.wander``. A ``Policy``."""
    rng = np.random.default_rng((seed, task.number))
    return np.stack([wander(rng, task.actions) for _ in range(count)])


def nomad(config: NomadConfig, params: Params, motion: ActionConfig) -> Policy:
    """Return NoMaD as a ``Policy``: its waypoints, converted to the nearest discrete actions."""

    def propose(task: TaskInput, count: int) -> np.ndarray:
        if task.actions > config.waypoints:
            raise UserError(
                f"NoMaD proposes {config.waypoints} waypoints, but {task.actions} actions are "
                "requested: use a shorter --horizon."
            )
        seen = nomad_policy.history(config, np.asarray(task.context.rgb_THWC))
        key = jax.random.key(task.number)
        goal = np.asarray(task.frame.rgb_THWC)[0]
        ways = nomad_policy.propose(config, params, seen, goal, key, count)
        return nomad_policy.discrete(motion, np.asarray(ways)[:, : task.actions])

    return propose


POLICIES: Mapping[str, Policy] = {"wander": functools.partial(wanderer)}
"""Policies by name; others are selected by MODULE:FUNCTION, or by the folder of a trained NoMaD."""


SETTINGS = "config.json"


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedPolicy:
    """A trained NoMaD; ``digest`` is the hash of weights and settings, see ``model_digest``."""

    folder: Path
    config: Config
    weights: Params = dataclasses.field(repr=False)
    digest: str

    @property
    def motion(self) -> ActionConfig:
        """Return the motion of an action of its walks."""
        return self.config.model.actions


def model_digest(weights_hash: str, config: Config) -> str:
    """Return a hash of all that a model's output depends on: its weights and its settings."""
    settings = json.dumps(configuration.to_dict(config.model), sort_keys=True)
    return hashlib.sha256((weights_hash + settings).encode()).hexdigest()


def is_run(name: str | Path) -> bool:
    """Return whether a name is the folder of a run."""
    return (Path(name) / SETTINGS).is_file()


def open_policy(name: str | Path) -> LoadedPolicy:
    """Load the run of a NoMaD.

    Raises:
        UserError: there is no such run, it is damaged or unfinished, or it contains another kind of
            model.
    """
    folder = Path(name)
    if not is_run(folder):
        raise UserError(f"{folder} contains no run: train a policy first (pewm-jax train nomad).")
    config, params = load_finished(folder)
    if not isinstance(config.model, NomadTask):
        raise UserError(f"{folder} contains no policy: give the run of one (pewm-jax train nomad).")
    return LoadedPolicy(
        folder, config, params["policy"], model_digest(file_hash(folder / WEIGHTS), config)
    )
