"""An articulated agent in a scene: its cameras, its motions, and its own body in the pictures.

Arms and hands have one saturated hue that houses hardly contain, so that they can be found in a
picture without a network (``eval.metrics.arms``).
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from pewm_jax.bodies import motions
from pewm_jax.bodies.humanoid import ARM_LINKS, BODIES, HUMANOID
from pewm_jax.bodies.kinematics import Body
from pewm_jax.data.parts import make_parts, render_over
from pewm_jax.data.render import Rendered
from pewm_jax.data.scenes import Scene
from pewm_jax.data.trajectories import Trajectory
from pewm_jax.errors import ConfigError
from pewm_jax.houses.shapes import Piece
from pewm_jax.types import Camera

SLEEVE, HAND = (0.55, 0.0, 0.55), (0.95, 0.06, 0.95)
"""Colours of the arms and of the hands: hue 300 degrees."""
_TORSO, _PANEL, _DARK = (0.36, 0.39, 0.43), (0.72, 0.73, 0.72), (0.14, 0.14, 0.15)


@dataclasses.dataclass(frozen=True, eq=False)
class Agent:
    """A body of some size.

    Attributes:
        body: its joints.
        scale: its size; 1 is that of its list of joints.
        parts: the shapes of its links, each in the frame of its link.
        links_P: the link of each part.
    """

    body: Body
    scale: float
    parts: Scene
    links_P: tuple[int, ...]

    def camera(
        self, planar_T3: np.ndarray, state_TA: np.ndarray, intrinsics_4: np.ndarray, floor_z: float
    ) -> Camera:
        """Return the cameras on its head, poses (T, 4, 4), at planar poses (T, 3) and states."""
        pose = self.body.world_from_camera(planar_T3, state_TA, self.scale, floor_z)
        return Camera(intrinsics_4, pose)

    def render_over(
        self,
        seen: Rendered,
        planar_T3: np.ndarray,
        state_TA: np.ndarray,
        camera: Camera,
        floor_z: float,
        first_id: int,
    ) -> None:
        """Render the body into the T frames of a scene, which are changed.

        ``first_id`` is the id of its first part; see ``ids``.
        """
        poses = self.body.poses(planar_T3, state_TA, self.scale)[:, list(self.links_P)]
        poses[..., 2, 3] += floor_z
        render_over(seen, self.parts, poses, camera, first_id)

    def ids(self, first_id: int) -> dict[str, int]:
        """Return the instance id of each part, by the name of its link."""
        return {self.body.links[link]: first_id + k for k, link in enumerate(self.links_P)}

    def frames(self, count: int) -> int:
        """Return how many of the frames of an episode belong to the walk, not to pauses."""
        return motions.walked(count)

    def act(
        self, walk: Trajectory, frames: int, rng: np.random.Generator
    ) -> tuple[Trajectory, np.ndarray]:
        """Return a walk with pauses, and (T, A) states along it.

        The actions of the walk are the states of the next frames.
        """
        planar, source = motions.with_pauses(walk.planar_T3, frames, rng)
        state = motions.motion(self.body, planar, rng)
        back = walk.return_frame
        back = None if back is None else int(np.flatnonzero(source == back)[0])
        return Trajectory(planar, state[1:], None, back), state


@functools.lru_cache(maxsize=2)
def open_agent(name: str, camera_height: float) -> Agent:
    """Return the agent of a body's name, whose eyes are at this height when it stands upright.

    Raises:
        ConfigError: there is no such body.
    """
    if name not in BODIES:
        raise ConfigError(f"there is no body {name!r}: use {' or '.join(BODIES)}.")
    body = BODIES[name]
    scale, pieces = camera_height / body.eye_m, shapes(body)
    parts = make_parts(list(pieces.values()))
    parts = dataclasses.replace(parts, vertices_V3=scale * parts.vertices_V3)
    return Agent(body, scale, parts, tuple(body.links.index(link) for link in pieces))


def shapes(body: Body = HUMANOID) -> dict[str, Piece]:
    """Return the shapes of the links that have one, each in the frame of its link.

    The head has none: it would only be in the way of its own camera.
    """
    made = {name: Piece(name, (1.0, 1.0, 1.0)) for name in ("base", "shank", "thigh", "torso")}
    made["base"].prism((0, 0), (0.0, 0.09), (0.24, 0.2), _DARK, 12)
    made["shank"].prism((0, 0), (0.0, 0.38), (0.07, 0.06), _PANEL, 8)
    made["thigh"].prism((0, 0), (0.0, 0.38), (0.075, 0.085), _TORSO, 8)
    torso = made["torso"]
    torso.box((-0.11, 0.11), (-0.16, 0.16), (-0.06, 0.2), _PANEL)
    torso.box((-0.12, 0.14), (-0.18, 0.18), (0.2, 0.44), _TORSO)
    torso.box((0.14, 0.15), (-0.08, 0.08), (0.26, 0.4), _DARK)
    torso.prism((0.02, 0), (0.44, 0.5), (0.06, 0.05), _DARK, 8)
    for side in ("left", "right"):
        for link in ARM_LINKS:
            piece = made[f"{side}_{link}"] = Piece(f"{side}_{link}", (1.0, 1.0, 1.0))
            _shape_arm(piece, link)
    return {name: made[name] for name in body.links if name in made}


def _shape_arm(piece: Piece, link: str) -> None:
    """Add the shapes of one link of an arm, which hangs down, its palm towards the body."""
    if link == "upper_arm":
        piece.ball((0, 0, 0), (0.085, 0.085, 0.085), SLEEVE)
        piece.prism((0, 0), (-0.27, 0.0), (0.064, 0.075), SLEEVE, 8)
    elif link == "forearm":
        piece.ball((0, 0, 0), (0.07, 0.07, 0.07), SLEEVE)
        piece.prism((0, 0), (-0.25, 0.0), (0.05, 0.066), SLEEVE, 8)
    elif link == "hand":
        piece.box((-0.055, 0.055), (-0.026, 0.026), (-0.1, 0.01), HAND)
    elif link == "fingers":
        for k in range(4):
            x = -0.055 + 0.0285 * k
            piece.box((x, x + 0.025), (-0.015, 0.015), (-0.09, 0.0), HAND)
    else:
        piece.box((0.0, 0.07), (-0.015, 0.015), (-0.028, 0.004), HAND)
