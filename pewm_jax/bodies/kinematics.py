"""Forward kinematics of a body that is given as a list of joints.

The frame of a body has x forward, y to the left and z up; its origin is on the floor. Every joint
moves one link, which has the joint's name. At angle 0 the frames of all links are parallel to that
of the body. A *state* of the body is one number for each of its degrees of freedom: angles of
joints in radians, and last how far the body has moved and turned since the frame before.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError, require

FORWARD, TURN = WALKING = "linear_velocity", "angular_velocity"
"""The degrees of freedom of walking: metres forward and radians counter-clockwise since the frame
before. They are the last two of every body."""
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of a camera (x right, y down, z forward) in a frame with x forward, y left, z up."""


@dataclasses.dataclass(frozen=True)
class Freedom:
    """A degree of freedom.

    Attributes:
        name: its name.
        low: its smallest value.
        high: its largest value.
        rest: its value in the body's resting pose.
        fastest: the largest change from one frame to the next; for those of walking, the largest
            value.
    """

    name: str
    low: float
    high: float
    rest: float = 0.0
    fastest: float = 0.3


@dataclasses.dataclass(frozen=True)
class Joint:
    """A revolute joint and the link that it moves.

    Attributes:
        name: the name of the link.
        parent: the link that it is attached to; "" is the body's own frame.
        origin: its position in the frame of the parent, metres.
        axis: its axis, a unit vector; the angle is counter-clockwise about it.
        freedom: the degree of freedom that moves it; "" if it is fixed.
        gain: its angle is the value of the degree of freedom times this.
    """

    name: str
    parent: str
    origin: tuple[float, float, float]
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    freedom: str = ""
    gain: float = 1.0


@dataclasses.dataclass(frozen=True)
class Body:
    """An articulated body.

    Attributes:
        name: its name in settings.
        freedoms: its degrees of freedom, in the order of a state; the last two are those of
            walking.
        joints: its joints, parents first.
        eyes: the link that carries the camera, at its origin, looking along x.
        arms: the links that are arms or hands.
        bones: groups of pairs of links; a bone goes from the origin of the one to that of the
            other.

    Raises:
        ConfigError: the list is inconsistent.
    """

    name: str
    freedoms: tuple[Freedom, ...]
    joints: tuple[Joint, ...]
    eyes: str
    arms: tuple[str, ...] = ()
    bones: tuple[tuple[tuple[str, str], ...], ...] = ()

    def __post_init__(self):
        """Validate."""
        names = [joint.name for joint in self.joints]
        known = [one.name for one in self.freedoms]
        for kind, listed in (("links", names), ("degrees of freedom", known)):
            require(
                len(set(listed)) == len(listed), f"body {self.name} has two {kind} of one name."
            )
        require(
            known[-2:] == [FORWARD, TURN],
            f"body {self.name}: the last two degrees of freedom must be {FORWARD} and {TURN}.",
        )
        for place, joint in enumerate(self.joints):
            require(
                joint.parent in ("", *names[:place]),
                f"body {self.name}: joint {joint.name} comes before its parent {joint.parent!r}.",
            )
            require(
                joint.freedom in ("", *known[:-2]),
                f"body {self.name}: joint {joint.name} is moved by {joint.freedom!r}, which is not "
                "one of the degrees of freedom.",
            )
            length = float(np.linalg.norm(joint.axis))
            require(
                abs(length - 1) < 1e-6,
                f"body {self.name}: the axis of joint {joint.name} has length {length:.3g}, not 1.",
            )
        ends = [link for group in self.bones for bone in group for link in bone]
        for link in (self.eyes, *self.arms, *ends):
            require(link in names, f"body {self.name} has no link {link!r}.")
        for one in self.freedoms:
            require(
                one.low <= one.rest <= one.high and one.low < one.high and one.fastest > 0,
                f"body {self.name}: {one.name} rests at {one.rest}, outside {one.low} … {one.high},"
                " or cannot move.",
            )

    @property
    def size(self) -> int:
        """A, the number of degrees of freedom."""
        return len(self.freedoms)

    @property
    def links(self) -> tuple[str, ...]:
        """The names of the links."""
        return tuple(joint.name for joint in self.joints)

    @functools.cached_property
    def low(self) -> np.ndarray:
        """The smallest value of each degree of freedom."""
        return np.array([one.low for one in self.freedoms])

    @functools.cached_property
    def high(self) -> np.ndarray:
        """The largest value of each degree of freedom."""
        return np.array([one.high for one in self.freedoms])

    @functools.cached_property
    def rest(self) -> np.ndarray:
        """The state of the resting pose, standing still."""
        return np.array([one.rest for one in self.freedoms])

    @functools.cached_property
    def fastest(self) -> np.ndarray:
        """The largest change of each degree of freedom from one frame to the next."""
        return np.array([one.fastest for one in self.freedoms])

    def index(self, name: str) -> int:
        """Return the place of a degree of freedom in a state."""
        return [one.name for one in self.freedoms].index(name)

    def poses(self, planar_T3: np.ndarray, state_TA: np.ndarray, scale: float = 1.0) -> np.ndarray:
        """Return (T, L, 4, 4) float64 world_from_link.

        Args:
            planar_T3: x, y, yaw of the body in the world, metres and radians.
            state_TA: the states.
            scale: size of the body; shapes of links have to be scaled by it, too.

        Raises:
            UserError: the numbers of frames or degrees of freedom differ.
        """
        planar, state = np.asarray(planar_T3, np.float64), np.asarray(state_TA, np.float64)
        if planar.ndim != 2 or planar.shape[1] != 3 or state.shape != (len(planar), self.size):
            raise UserError(
                f"body {self.name} got positions of shape {planar.shape} and states of shape "
                f"{state.shape}: give (T, 3) and (T, {self.size})."
            )
        turns, places = self._chain(state)
        made = np.tile(np.eye(4), (len(planar), len(self.joints), 1, 1))
        base = _turn((0.0, 0.0, 1.0), planar[:, 2])[:, None]
        made[..., :3, :3] = base @ turns
        made[..., :3, 3] = (base @ (scale * places)[..., None])[..., 0]
        made[..., :2, 3] += planar[:, None, :2]
        return made

    def seen_places(self, state_BA: jax.Array) -> jax.Array:
        """Return (..., L, 3) the origins of all links in the frame of the camera, metres; jittable.

        x is right, y down and z forward; the body has a scale of 1.
        """
        turns, places = self._chain(jnp.asarray(state_BA))
        eye = self.links.index(self.eyes)
        off = places - places[..., eye : eye + 1, :]
        return jnp.einsum("...li,...ij->...lj", off, turns[..., eye, :, :] @ OPTICAL[:3, :3])

    def _chain(self, state: Any) -> tuple[Any, Any]:
        """Return rotations (..., L, 3, 3) and origins (..., L, 3) of links in the body's frame.

        NumPy arrays give NumPy arrays.
        """
        xp = np if isinstance(state, np.ndarray) else jnp
        found: dict[str, tuple[Any, Any]] = {"": (np.eye(3), np.zeros(3))}
        still = xp.zeros(state.shape[:-1])
        for joint in self.joints:
            turn, place = found[joint.parent]
            angle = joint.gain * state[..., self.index(joint.freedom)] if joint.freedom else still
            place = place + turn @ np.array(joint.origin)
            found[joint.name] = turn @ _turn(joint.axis, angle), place
        turns, places = zip(*[found[name] for name in self.links], strict=True)
        places = [xp.broadcast_to(place, (*state.shape[:-1], 3)) for place in places]
        return xp.stack(turns, -3), xp.stack(places, -2)

    def world_from_camera(
        self,
        planar_T3: np.ndarray,
        state_TA: np.ndarray,
        scale: float = 1.0,
        floor_z: float = 0.0,
    ) -> np.ndarray:
        """Return the (T, 4, 4) float32 poses of the camera; arguments as for ``poses``."""
        place = self.links.index(self.eyes)
        pose = self.poses(planar_T3, state_TA, scale)[:, place] @ OPTICAL
        pose[:, 2, 3] += floor_z
        return pose.astype(np.float32)

    def planar_of(
        self, world_from_camera: np.ndarray, state_A: np.ndarray, scale: float = 1.0
    ) -> np.ndarray:
        """Return x, y, yaw of the body whose camera has a (4, 4) pose in a state."""
        own = self.world_from_camera(np.zeros((1, 3)), np.asarray(state_A)[None], scale)[0]
        base = np.asarray(world_from_camera, np.float64) @ np.linalg.inv(own.astype(np.float64))
        return np.array([base[0, 3], base[1, 3], np.arctan2(base[1, 0], base[0, 0])])

    def cameras_along(
        self,
        world_from_camera: np.ndarray,
        state_A: np.ndarray,
        actions_TA: np.ndarray,
        scale: float = 1.0,
    ) -> np.ndarray:
        """Return the (T, 4, 4) float32 poses of the camera after each of T actions.

        Args:
            world_from_camera: (4, 4) pose of the camera before them.
            state_A: the state then.
            actions_TA: the states that follow.
            scale: size of the body.
        """
        places = [self.planar_of(world_from_camera, state_A, scale)]
        for action_A in np.asarray(actions_TA):
            places.append(advance(places[-1], action_A))
        states = np.concatenate([np.asarray(state_A)[None], actions_TA])
        poses = self.world_from_camera(np.stack(places), states, scale)
        poses[:, 2, 3] += world_from_camera[2, 3] - poses[0, 2, 3]
        return poses[1:]

    def toward(self, state_A: np.ndarray, wished_A: np.ndarray) -> np.ndarray:
        """Return the state one frame later on the way to another, standing still.

        No joint moves by more than its fastest change.
        """
        wished = np.clip(wished_A, self.low, self.high)
        step = np.clip(wished - state_A, -self.fastest, self.fastest)
        after = np.asarray(state_A, np.float64) + step
        after[-2:] = 0
        return after

    def frames_to(self, state_A: np.ndarray, wished_A: np.ndarray) -> int:
        """Return the number of frames until ``toward`` reaches a state."""
        wished = np.clip(wished_A, self.low, self.high)
        away = np.abs(wished - state_A)[:-2] / self.fastest[:-2]
        return int(np.ceil(away.max(initial=0.0) - 1e-6))

    @functools.cached_property
    def eye_m(self) -> float:
        """Height of the camera above the floor with all joints at 0, metres."""
        pose = self.world_from_camera(np.zeros((1, 3)), np.zeros((1, self.size)))
        return float(pose[0, 2, 3])


def _turn(axis: Sequence[float], angle_T: Any) -> Any:
    """Return (..., 3, 3) rotations about a unit axis (Rodrigues)."""
    xp = np if isinstance(angle_T, np.ndarray | np.floating) else jnp
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sin, cos = xp.sin(angle_T)[..., None, None], xp.cos(angle_T)[..., None, None]
    return np.eye(3) + sin * cross + (1 - cos) * (cross @ cross)


def advance(planar_3: np.ndarray, state_A: np.ndarray) -> np.ndarray:
    """Return the pose x, y, yaw after an action of any body: first move, then turn."""
    x, y, yaw = np.asarray(planar_3, np.float64)
    forward, turn = np.asarray(state_A, np.float64)[-2:]
    return np.array([x + forward * np.cos(yaw), y + forward * np.sin(yaw), yaw + turn])


def walking(planar_T3: np.ndarray) -> np.ndarray:
    """Return (T, 2) the degrees of freedom of walking of a walk that never steps aside.

    Those of frame 0 are 0.
    """
    planar = np.asarray(planar_T3, np.float64)
    delta, yaw = np.diff(planar[:, :2], axis=0), planar[:-1, 2]
    forward = delta[:, 0] * np.cos(yaw) + delta[:, 1] * np.sin(yaw)
    turn = (np.diff(planar[:, 2]) + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([np.zeros((1, 2)), np.stack([forward, turn], 1)])
