"""The settings of the environment ``pewm_jax/House-v0``."""

from __future__ import annotations

import dataclasses
import difflib
import math
from pathlib import Path
from typing import Any, Literal

from pewm_jax.config import ActionConfig, ConfigError
from pewm_jax.errors import require


@dataclasses.dataclass(frozen=True)
class HouseConfig:
    """Settings of a house: scene, camera, actions and goals."""

    scene: str | Path = ""
    """A mesh to walk in (GLB, OBJ, PLY, …), in metres; empty: a generated house."""
    up: Literal["auto", "y", "z"] = "auto"
    """Which axis of the mesh points up; `auto`: y for GLB and glTF, z for the others."""
    house: int = 0
    """Seed of the generated house. `pewm-jax data collect` uses 0, 3, 6, … for training, 1, 4, 7, …
    for validation and 2, 5, 8, … for tests."""
    houses: int = 1
    """Number of houses for episodes: `house`, `house` + 3, …, all from one split."""
    height: int = 64
    """Height of the images, pixels."""
    width: int = 64
    """Width of the images, pixels."""
    hfov: float = 90.0
    """Horizontal field of view, degrees."""
    camera_height: float = 1.25
    """Height of the camera above the floor, metres."""
    actions: Literal["discrete", "continuous"] = "discrete"
    """`discrete`: 0 forward, 1 turn left, 2 turn right. `continuous`: (dx, dy, dyaw), metres
    forward, metres left, radians counter-clockwise."""
    step_m: float = 0.25
    """Length of a forward step, metres; continuous: the largest |dx| and |dy|."""
    turn_deg: float = 30.0
    """Angle of a turn, degrees; continuous: the largest |dyaw|."""
    sliding: bool = False
    """Slide along obstacles instead of stopping."""
    task: Literal["point", "image"] = "point"
    """Specification of the goal. `point`: its position relative to the agent. `image`: the image at
    the goal."""
    min_distance_m: float = 1.0
    """Smallest geodesic distance from start to goal, metres."""
    max_distance_m: float = 30.0
    """Largest geodesic distance from start to goal, metres."""
    success_m: float = 0.5
    """Geodesic distance at which the goal counts as reached, metres."""
    success_deg: float = 180.0
    """Largest difference from the goal's heading for success, degrees; 180: any."""
    success_reward: float = 2.5
    """Reward for reaching the goal, in addition to 1 per metre of approach."""
    max_steps: int = 200
    """Steps after which an episode is truncated."""

    def __post_init__(self):
        """Validate."""
        for name in ("height", "width", "houses", "max_steps"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= 1,
                f"House.{name} is {value!r}: use an integer of 1 or more.",
            )
        require(
            isinstance(self.house, int) and self.house >= 0,
            f"House.house is {self.house!r}: use an integer of 0 or more.",
        )
        choices = {
            "up": ("auto", "y", "z"),
            "actions": ("discrete", "continuous"),
            "task": ("point", "image"),
        }
        for name, known in choices.items():
            value = getattr(self, name)
            require(value in known, f"House.{name} is {value!r}: use {' or '.join(known)}.")
        self._check_numbers()

    def _check_numbers(self) -> None:
        numbers = ("hfov", "camera_height", "success_m", "success_deg", "success_reward")
        for name in (*numbers, "min_distance_m", "max_distance_m"):
            value = getattr(self, name)
            require(
                isinstance(value, (int, float)) and math.isfinite(value),
                f"House.{name} is {value!r}: use a number.",
            )
        _ = self.action_config
        require(1 <= self.hfov < 180, f"House.hfov is {self.hfov}: use 1 up to below 180 degrees.")
        require(
            self.camera_height > 0,
            f"House.camera_height is {self.camera_height}: use metres above 0.",
        )
        require(self.success_m > 0, f"House.success_m is {self.success_m}: use metres above 0.")
        require(
            0 < self.success_deg <= 180,
            f"House.success_deg is {self.success_deg}: use degrees above 0, up to 180 (any).",
        )
        require(
            self.success_m < self.min_distance_m <= self.max_distance_m,
            f"House.min_distance_m is {self.min_distance_m} and max_distance_m is "
            f"{self.max_distance_m}: the first must be above success_m ({self.success_m}), so that "
            "no episode begins at its goal, and at most the second.",
        )

    @property
    def action_config(self) -> ActionConfig:
        """Return the motion of one action."""
        return ActionConfig(self.step_m, self.turn_deg)


def settings(values: dict[str, Any]) -> HouseConfig:
    """Return settings from keyword arguments.

    Raises:
        ConfigError: a setting does not exist or has an invalid value.
    """
    known = [field.name for field in dataclasses.fields(HouseConfig)]
    for name in values:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            meant = f" (did you mean {near[0]}?)" if near else ""
            raise ConfigError(f"House has no setting {name!r}{meant}; known: {', '.join(known)}.")
    return HouseConfig(**values)
