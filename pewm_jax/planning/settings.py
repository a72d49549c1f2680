"""Settings of planning: how far, how many candidates, from which actions, by which planner."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeAlias

from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class PlanConfig:
    """How far a plan reaches and how long it is searched for; the defaults are the paper's.

    A plan is a sequence of blocks. Each is one choice, carried out ``action_block`` times.
    """

    horizon: int = 8
    """Blocks of a plan."""
    receding_horizon: int = 0
    """Blocks that are carried out before the next plan; 0 for all."""
    action_block: int = 1
    """Equal actions that make a block."""
    candidates: int = 60
    """K, candidates of a round."""
    elites: int = 18
    """The best of them, from which the next round's distribution is made."""
    rounds: int = 12
    """How often candidates are drawn."""

    @property
    def actions(self) -> int:
        """N, the actions of a plan."""
        return self.horizon * self.action_block

    @property
    def carried_out(self) -> int:
        """Number of actions that are carried out before the next plan."""
        return (self.receding_horizon or self.horizon) * self.action_block

    def __post_init__(self):
        """Validate."""
        names = {field.name for field in dataclasses.fields(self)} - {"receding_horizon"}
        require_positive(self, "plan", *sorted(names))
        require(
            0 <= self.receding_horizon <= self.horizon,
            f"plan.receding_horizon is {self.receding_horizon}, and a plan has {self.horizon} "
            "blocks (plan.horizon): carry out at most as many as are planned, or 0 for all.",
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
    """How many there are."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "space", "count")


@dataclasses.dataclass(frozen=True)
class Box:
    """Continuous actions between bounds, by default (dx, dy, dyaw) of at most a discrete step.

    An entry whose bounds are equal is fixed.
    """

    low: tuple[float, ...] = (0.0, 0.0, -math.pi / 6)
    """The least value of each entry: metres forward, metres left, radians counter-clockwise."""
    high: tuple[float, ...] = (0.25, 0.0, math.pi / 6)
    """The greatest."""

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
    """What all planners have that move a distribution over actions from round to round.

    Of discrete actions it is one distribution for each block; of continuous ones a mean and a
    standard deviation for each block and entry.
    """

    space: Space = Discrete()
    """The actions to choose from."""
    momentum: float = 0.0
    """Share of the last round's distribution that stays: new = momentum · old + (1 − momentum) ·
    fitted."""
    keep: float = 1.0
    """Candidates that are kept and count in the next round, too, over the elites (Pinneri et al.
    2020); 0 forgets them, which costs that change from round to round need."""
    smoothing: float = 0.2
    """Share of the uniform distribution that is mixed into a fitted one, so that no discrete action
    dies out."""
    initial_std: float = 0.5
    """Standard deviation of the first round's continuous actions over half the width of their
    bounds."""
    min_std: float = 0.05
    """The least standard deviation, over half the width of the bounds."""

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
    """Path integrals (Williams et al. 2017): all candidates count, the better the more.

    A candidate of cost c weighs exp(−(c − min) / (temperature · std)), with the least cost and the
    standard deviation of the round's, so that costs may have any unit. The spread is fitted with
    the same weights.
    """

    temperature: float = 0.3
    """The lower, the more the best count."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.temperature > 0,
            f"planner.temperature is {self.temperature}: use a number above 0.",
        )


@dataclasses.dataclass(frozen=True)
class RandomShooting:
    """Candidates of all rounds are drawn uniformly; the best is taken."""

    space: Space = Discrete()
    """The actions to choose from."""


Planner: TypeAlias = CEM | MPPI | RandomShooting
