"""Houses with moving parts: doors that open for the agent, and robots that patrol rooms.

A moving house is a generated house with parts that have their own poses. The poses at frame t are a
pure function of the house and of the agent's positions up to t, so the images and the voxels of a
frame show the same moment, and frame t never depends on later actions.

* A **door** opens as the agent approaches: it is closed at ``FAR_M`` and open at ``NEAR_M`` from
  the middle of the doorway. Some doors close again behind the agent, the others stay as far open as
  they ever were. A leaf is added only where it has space to open and, when open, blocks no path.
* A **robot** follows a closed path in one room at constant speed.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pewm_jax.data.navigation import NavGrid, navigable, shortest_path
from pewm_jax.data.parts import make_parts, place_parts, render_over
from pewm_jax.data.render import Rendered, render
from pewm_jax.data.scenes import Scene, house
from pewm_jax.houses.fixtures import LEAF_M, ROBOT_RADIUS_M, door_leaf, robot
from pewm_jax.houses.floorplan import largest_region
from pewm_jax.houses.shapes import Piece
from pewm_jax.types import Camera

_STREAM = 0x0D00E5
"""Seed offset that separates the random numbers of moving parts from those of the house, which is
unchanged."""
ROBOT_PROBABILITY = 0.6
"""Probability that a room has a robot, if it has space for a path."""
ROBOT_STEP_M = 0.12
"""Metres that a robot moves from frame to frame."""
ROBOT_DISTANCE_M = 1.4
"""Distance that robots keep from doorways, where leaves swing, metres."""


@dataclasses.dataclass(frozen=True)
class RobotPath:
    """The closed path of a robot.

    Attributes:
        way_N2: (N, 2) corners of the path, the first one repeated at its end, metres.
        start_m: position of the robot along the path at frame 0.
    """

    way_N2: np.ndarray
    start_m: float

    def poses(self, xy_T2: np.ndarray) -> np.ndarray:
        """Return (T, 4, 4) world_from_part; only the number of the agent's positions is used."""
        sides = np.diff(self.way_N2, axis=0)
        ends = np.append(0, np.cumsum(np.linalg.norm(sides, axis=-1)))
        along = (self.start_m + ROBOT_STEP_M * np.arange(len(xy_T2))) % ends[-1]
        place = np.stack([np.interp(along, ends, self.way_N2[:, axis]) for axis in (0, 1)], -1)
        side = sides[np.searchsorted(ends, along, "right").clip(1, len(sides)) - 1]
        return planar_poses(place, np.arctan2(side[:, 1], side[:, 0]))


@dataclasses.dataclass(frozen=True, eq=False)
class MovingHouse:
    """A house with parts that move.

    Attributes:
        scene: the static part of the house.
        grid: the cells where the agent can stand, whether doors are open or closed.
        moves: the door leaves and robot paths, one per part.
        parts: the parts, each in its own frame; ``object_F`` is the number of the part.
    """

    scene: Scene
    grid: NavGrid
    moves: tuple[DoorLeaf | RobotPath, ...]
    parts: Scene | None

    def poses(self, xy_T2: np.ndarray) -> np.ndarray:
        """Return (T, P, 4, 4) world_from_part of the parts for the agent's positions (T, 2), m.

        The poses of frame t depend on the positions up to t.
        """
        if not self.moves:
            return np.zeros((len(xy_T2), 0, 4, 4))
        return np.stack([move.poses(np.asarray(xy_T2, np.float64)) for move in self.moves], 1)


def moving_house(seed: int, agent_height_m: float) -> MovingHouse:
    """Return the generated house of a seed (that of ``scenes.house``) with doors and robots.

    The agent passes under obstacles above ``agent_height_m``.
    """
    scene = house(seed)
    rng = np.random.default_rng([_STREAM, seed])
    moves: list[DoorLeaf | RobotPath] = []
    pieces: list[Piece] = []
    free = navigable(scene, agent_height_m=agent_height_m)
    for *_, x0, y0, x1, y1 in scene.metadata["doorways"]:
        draw = np.random.default_rng(rng.integers(1 << 30))
        leaves, width, free = hang_leaves(scene, free, draw, (x0, y0, x1, y1))
        moves += leaves
        pieces += [door_leaf(draw, width)] * len(leaves)
    opened = place_parts(make_parts(pieces), _open_poses(moves)) if moves else None
    grid = navigable(_concatenate(scene, opened), agent_height_m=agent_height_m)
    for room in scene.metadata["rooms"]:
        way = _robot_path(grid, rng, room, scene.metadata["doorways"])
        if way is not None:
            moves.append(way)
            pieces.append(robot(rng))
    return MovingHouse(scene, grid, tuple(moves), make_parts(pieces) if pieces else None)


def parts_at(moving: MovingHouse, world_from_part_P44: np.ndarray) -> Scene:
    """Return the parts alone as a scene, at their poses of one frame."""
    assert moving.parts is not None
    return place_parts(moving.parts, world_from_part_P44)


def part_at(moving: MovingHouse, number: int, world_from_part_44: np.ndarray) -> Scene:
    """Return one part alone as a scene, at a pose; the scene must not be rendered."""
    poses = np.broadcast_to(world_from_part_44, (len(moving.moves), 4, 4))
    whole = parts_at(moving, poses)
    fields = ("faces_F3", "normals_F3", "object_F", "albedo_F3")
    mine = whole.object_F == number
    return dataclasses.replace(whole, **{name: getattr(whole, name)[mine] for name in fields})


def render_moving(
    moving: MovingHouse, poses_TP44: np.ndarray, camera: Camera, height: int, width: int
) -> Rendered:
    """Render T frames of a moving house: at each pixel the nearer of the static and moving parts.

    As ``render``, with the (T, P, 4, 4) poses of ``MovingHouse.poses``; the ids of parts follow
    those of the scene's objects.
    """
    seen = render(moving.scene, camera, height, width)
    if moving.parts is None:
        return seen
    render_over(seen, moving.parts, poses_TP44, camera, len(moving.scene.objects))
    return seen


def _open_poses(moves: list[DoorLeaf | RobotPath]) -> np.ndarray:
    """Return the (P, 4, 4) poses of the parts with all doors open."""
    leaves = [move for move in moves if isinstance(move, DoorLeaf)]
    return np.concatenate([leaf.poses(leaf.middle_2[None]) for leaf in leaves])


def _concatenate(scene: Scene, other: Scene | None) -> Scene:
    """Return two scenes as one for casting rays; it must not be rendered."""
    if other is None:
        return scene
    return dataclasses.replace(
        scene,
        vertices_V3=np.concatenate([scene.vertices_V3, other.vertices_V3]),
        faces_F3=np.concatenate([scene.faces_F3, other.faces_F3 + len(scene.vertices_V3)]),
        normals_F3=np.concatenate([scene.normals_F3, other.normals_F3]),
    )


def _robot_path(
    grid: NavGrid, rng: np.random.Generator, room: list[float], doorways: list[list[float]]
) -> RobotPath | None:
    """Return a robot's closed path through three points of a room, or None without a robot."""
    draw = np.random.default_rng(rng.integers(1 << 30))
    if draw.uniform() > ROBOT_PROBABILITY:
        return None
    centres = grid.centres
    inside = ((centres > room[:2]) & (centres < room[2:])).all(-1)
    for *_, x0, y0, x1, y1 in doorways:
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        inside &= np.linalg.norm(centres - middle, axis=-1) > ROBOT_DISTANCE_M
    own = dataclasses.replace(grid, free_YX=grid.free_YX & inside)
    cells = np.argwhere(own.free_YX)
    for _ in range(6):
        if len(cells) < 3:
            return None
        corners = own.centre_of(cells[draw.choice(len(cells), 3, replace=False)])
        ways = [shortest_path(own, corners[k], corners[(k + 1) % 3]) for k in range(3)]
        found = [way for way in ways if way is not None]
        if len(found) == 3:
            closed = np.concatenate([found[0], *(way[1:] for way in found[1:])])
            length = float(np.linalg.norm(np.diff(closed, axis=0), axis=-1).sum())
            if length > 6 * ROBOT_RADIUS_M:
                return RobotPath(closed, float(draw.uniform(0, length)))
    return None


NEAR_M, FAR_M = 1.3, 2.4
"""Distances of the agent at which a door is fully open and at which it begins to open."""
WIDE_M = 1.3
"""Smallest width of doorways with two leaves."""
LEAST_LEFT = 0.9
"""Smallest share of the floor that must stay reachable when one more leaf is open."""


@dataclasses.dataclass(frozen=True)
class DoorLeaf:
    """A leaf of a door.

    Attributes:
        hinge_2: position of the hinge, metres.
        yaw: direction of the closed leaf, from the hinge to its end, radians.
        swing: angle between closed and open, ± a right angle.
        middle_2: middle of the doorway.
        stays: whether it stays open.
    """

    hinge_2: np.ndarray
    yaw: float
    swing: float
    middle_2: np.ndarray
    stays: bool

    def poses(self, xy_T2: np.ndarray) -> np.ndarray:
        """Return (T, 4, 4) world_from_part for an agent that passes these positions in order."""
        away = np.linalg.norm(np.asarray(xy_T2) - self.middle_2, axis=-1)
        opened = np.clip((FAR_M - away) / (FAR_M - NEAR_M), 0, 1)
        if self.stays:
            opened = np.maximum.accumulate(opened)
        angle = self.yaw + self.swing * opened
        return planar_poses(np.broadcast_to(self.hinge_2, (len(angle), 2)), angle)


def hang_leaves(
    scene: Scene,
    grid: NavGrid,
    rng: np.random.Generator,
    rect: tuple[float, float, float, float],
) -> tuple[list[DoorLeaf], float, NavGrid]:
    """Place the door leaves of a doorway.

    Returns:
        The leaves (none where they lack space to open or would block a path), their width, and the
        cells that remain reachable for the agent.
    """
    x0, y0, x1, y1 = rect
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    axis = np.array([1.0, 0.0]) if x1 - x0 > y1 - y0 else np.array([0.0, 1.0])
    across = np.array([-axis[1], axis[0]])
    opening, wall = max(x1 - x0, y1 - y0), min(x1 - x0, y1 - y0)
    double = opening >= WIDE_M
    width = opening / 2 if double else opening
    stays = bool(rng.uniform() < 0.5)

    def leaf(end: int, side: int) -> DoorLeaf:
        """Return the leaf at one end of the opening that opens to one side."""
        # The hinge lies in the wall's surface, so that the open leaf stands beside the opening.
        hinge = middle + end * opening / 2 * axis + side * (wall / 2 - LEAF_M / 2) * across
        closed = float(np.arctan2(-end * axis[1], -end * axis[0]))
        return DoorLeaf(hinge, closed, -end * side * np.pi / 2, middle, stays)

    choices = [(end, side) for end in (-1, 1) for side in (-1, 1)]
    for k in rng.permutation(4):
        end, side = choices[k]
        leaves = [leaf(e, side) for e in ((-1, 1) if double else (end,))]
        left = _clear_of(grid, leaves, width)
        if left.area >= LEAST_LEFT * grid.area and all(
            _has_room(scene, one, width) for one in leaves
        ):
            return leaves, width, left
    return [], width, grid


def _clear_of(grid: NavGrid, leaves: list[DoorLeaf], width: float) -> NavGrid:
    """Return the largest free region outside the open leaves."""
    centres, free = grid.centres, grid.free_YX.copy()
    for leaf in leaves:
        way = np.array([np.cos(leaf.yaw + leaf.swing), np.sin(leaf.yaw + leaf.swing)])
        along = np.clip((centres - leaf.hinge_2) @ way, 0, width)
        near = leaf.hinge_2 + along[..., None] * way
        free &= np.linalg.norm(centres - near, axis=-1) > 0.3
    return dataclasses.replace(grid, free_YX=largest_region(free))


def _has_room(scene: Scene, leaf: DoorLeaf, width: float) -> bool:
    """Return whether a leaf can open without hitting obstacles."""
    angles = leaf.yaw + leaf.swing * np.linspace(0.25, 1, 10)
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(10)], -1)
    heights = scene.metadata.get("floor", 0.0) + np.linspace(0.05, 2.0, 14)
    starts = np.concatenate([np.broadcast_to(leaf.hinge_2, (len(heights), 2)), heights[:, None]], 1)
    origins = np.repeat(starts, len(ways), 0) + 0.12 * np.tile(ways, (len(heights), 1))
    rays = np.tile(ways, (len(heights), 1)).astype(np.float32)
    reach = np.full(len(rays), width - 0.12, np.float32)
    origins = (origins - scene.centre_3).astype(np.float32)
    return not (scene.tracer.run(origins, rays, dists=reach, query="OCCLUDED") >= 0).any()


def planar_poses(place_T2: np.ndarray, yaw_T: np.ndarray) -> np.ndarray:
    """Return (T, 4, 4) poses on the ground from positions and yaws."""
    pose = np.tile(np.eye(4), (len(yaw_T), 1, 1))
    cos, sin = np.cos(yaw_T), np.sin(yaw_T)
    pose[:, :2, :2] = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    pose[:, :2, 3] = place_T2
    return pose
