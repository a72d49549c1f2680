"""Controls: what steers a clip."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Literal

from pewm_jax.config.parts import Conditioner
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class CameraConfig(Conditioner):
    """Control by cameras (the paper): their Plücker rays are concatenated to the input."""

    def channels(self, model: Any) -> int:
        """Return six Plücker coordinates for each frame of a latent frame."""
        return 6 * model.codec.temporal


@dataclasses.dataclass(frozen=True)
class ModulationConfig(Conditioner):
    """Control by actions that are added to the time embedding of each latent frame (EgoWM).

    The defaults are the paper's for three numbers: metres forward and left in units of the data's
    waypoint spacing, and radians counter-clockwise (arXiv 2601.15284, Eqs. 5 and 6).
    """

    MODULATES: ClassVar[bool] = True

    actions: int = 3  # type: ignore[assignment]
    """Numbers of an action."""
    units: tuple[float, ...] = (1.0, 1.0, 1.0)
    """What each number is first divided by: the data's waypoint spacing in metres, twice, and 1."""
    low: tuple[float, ...] = (-2.5, -4.0, -1.0)
    """The value of each number, in its unit, that becomes −1."""
    high: tuple[float, ...] = (5.0, 4.0, 1.0)
    """The value of each number, in its unit, that becomes 1."""
    angles: tuple[int, ...] = (2,)
    """Which numbers are angles in radians: they are brought into (−π, π] at first."""
    projection: Literal["sinusoid", "convolution"] = "sinusoid"
    """`sinusoid`: cosines and sines of each number, then two layers (the paper's on Stable Video
    Diffusion). `convolution`: two layers, then two convolutions over time, down to the latent rate
    (the paper's on Cosmos)."""
    features: int = 32
    """Cosines and sines of each number, with `sinusoid`; even."""
    state: int = 0  # type: ignore[assignment]
    """Numbers of the agent's state at the first frame, which is added to every frame (Eq. 6): as
    many as those of an action, which then says which state it leads to; 0 for none."""
    rays: bool = False
    """Also join the cameras' Plücker rays to the input, as the control `camera` does."""
    rate: float = 10.0  # type: ignore[assignment]
    """Factor of the learning rate of these layers, which are new where a model was trained."""

    def channels(self, model: Any) -> int:
        """Return the rays' channels, if they are joined."""
        return 6 * model.codec.temporal if self.rays else 0

    def __post_init__(self):
        """Validate."""
        require_positive(self, "control", "actions", "features", "rate")
        for name in ("units", "low", "high"):
            require(
                len(getattr(self, name)) == self.actions,
                f"control.{name} has {len(getattr(self, name))} values and control.actions is "
                f"{self.actions}: give one for each number of an action.",
            )
        require(
            all(a < b for a, b in zip(self.low, self.high, strict=True)),
            f"control.low {self.low} and control.high {self.high}: each low must be below its "
            "high.",
        )
        require(
            all(unit > 0 and math.isfinite(unit) for unit in self.units),
            f"control.units is {self.units}: use positive numbers, 1 where nothing is divided.",
        )
        require(
            all(0 <= index < self.actions for index in self.angles),
            f"control.angles is {self.angles}: name numbers of an action, from 0 to "
            f"{self.actions - 1}.",
        )
        require(
            self.features % 2 == 0,
            f"control.features is {self.features}: use an even number, cosines and sines.",
        )
        require(
            self.state in (0, self.actions),
            f"control.state is {self.state}: use 0 for none, or control.actions ({self.actions}).",
        )
