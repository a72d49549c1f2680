"""Settings of planning: horizon, candidates, action space and planner."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeAlias

from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class PlanConfig:
    """The size of a plan and of its search; the defaults are the paper's.

    A plan is a sequence of blocks. Each is one choice, executed ``action_block`` times.
    """

    horizon: int = 8
    """Number of blocks in a plan."""
    receding_horizon: int = 0
    """Number of blocks executed before the next plan; 0 for all."""
    action_block: int = 1
    """Number of repetitions of a choice in a block."""
    candidates: int = 60
    """K, number of candidates per round."""
    elites: int = 18
    """Number of best candidates to which the next round's distribution is fitted."""
    rounds: int = 12
    """Number of rounds."""

    @property
    def actions(self) -> int:
        """Return N, the number of actions in a plan."""
        return self.horizon * self.action_block

    @property
    def carried_out(self) -> int:
        """Return the number of actions executed before the next plan."""
        return (self.receding_horizon or self.horizon) * self.action_block

    def __post_init__(self):
        """Validate."""
        names = {field.name for field in dataclasses.fields(self)} - {"receding_horizon"}
        require_positive(self, "plan", *sorted(names))
        require(
            0 <= self.receding_horizon <= self.horizon,
            f"plan.receding_horizon is {self.receding_horizon}, but a plan has {self.horizon} "
            "blocks (plan.horizon): execute at most as many as are planned, or 0 for all.",
        )
        require(
            self.elites <= self.candidates,
            f"plan.elites is {self.elites}, more than the {self.candidates} candidates of a round "
            "(plan.candidates): keep fewer or draw more.",
        )


@dataclasses.dataclass(frozen=True)
class Discrete:
    """Actions 0 … count − 1; by default 0 forward, 1 turn left, 2 turn right."""

    count: int = 3
    """Number of actions."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "space", "count")


@dataclasses.dataclass(frozen=True)
class Box:
    """Continuous actions between bounds, by default (dx, dy, dyaw) of at most a discrete step.

    An entry whose bounds are equal is fixed.
    """

    low: tuple[float, ...] = (0.0, 0.0, -math.pi / 6)
    """Lower bound of each entry: metres forward, metres left, radians counter-clockwise."""
    high: tuple[float, ...] = (0.25, 0.0, math.pi / 6)
    """Upper bound of each entry."""

    def __post_init__(self):
        """Validate."""
        require(
            len(self.low) == len(self.high) > 0,
            f"space.low has {len(self.low)} entries and space.high {len(self.high)}: give both for "
            "every entry of an action.",
        )
        ordered = zip(self.low, self.high, strict=True)
        require(
            all(math.isfinite(a) and math.isfinite(b) and a <= b for a, b in ordered),
            f"space.low {self.low} and space.high {self.high}: give finite bounds, the low one "
            "first.",
        )


Space: TypeAlias = Discrete | Box


@dataclasses.dataclass(frozen=True)
class Refined:
    """Settings of planners that update a distribution over actions in every round.

    For discrete actions it is one distribution per block; for continuous ones a mean and a standard
    deviation per block and entry.
    """

    space: Space = Discrete()
    """The actions to choose from."""
    momentum: float = 0.0
    """Share of the previous distribution that is kept: new = momentum · old + (1 − momentum) ·
    fitted."""
    keep: float = 1.0
    """Number of candidates kept for the next round, relative to the elites (Pinneri et al. 2020);
    use 0 for costs that change from round to round."""
    smoothing: float = 0.2
    """Share of the uniform distribution mixed into the fitted one, so that no discrete action gets
    probability 0."""
    initial_std: float = 0.5
    """Standard deviation of continuous actions in the first round, relative to half the width of
    their bounds."""
    min_std: float = 0.05
    """Smallest standard deviation, relative to half the width of the bounds."""

    def __post_init__(self):
        """Validate."""
        require(
            0 <= self.momentum < 1,
            f"planner.momentum is {self.momentum}: use a share from 0 to below 1.",
        )
        require(
            0 <= self.keep <= 1,
            f"planner.keep is {self.keep}: use a share of the elites from 0 to 1.",
        )
        require(
            0 <= self.smoothing <= 1,
            f"planner.smoothing is {self.smoothing}: use a share from 0 to 1.",
        )
        require(
            0 <= self.min_std <= self.initial_std and self.initial_std > 0,
            f"planner.min_std is {self.min_std} and planner.initial_std {self.initial_std}: use "
            "0 ≤ min_std ≤ initial_std, above 0.",
        )


@dataclasses.dataclass(frozen=True)
class CEM(Refined):
    """The cross-entropy method: the distribution is fitted to the elites (Rubinstein 1999)."""


@dataclasses.dataclass(frozen=True)
class MPPI(Refined):
    """Model predictive path integral (Williams et al. 2017): candidates are weighted by cost.

    A candidate of cost c has the weight exp(−(c − min) / (temperature · std)), with the minimum and
    the standard deviation of the round's costs, so that costs may have any unit. The spread is
    fitted with the same weights.
    """

    temperature: float = 0.3
    """Lower values give the best candidates more weight."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.temperature > 0,
            f"planner.temperature is {self.temperature}: use a number above 0.",
        )


@dataclasses.dataclass(frozen=True)
class RandomShooting:
    """Candidates of all rounds are drawn uniformly; the best is chosen."""

    space: Space = Discrete()
    """The actions to choose from."""


Planner: TypeAlias = CEM | MPPI | RandomShooting
