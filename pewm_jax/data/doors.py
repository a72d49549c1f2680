"""Doors of made houses: leaves that open as the agent comes near.

A leaf is hung where it has room to open and where, open, it shuts off no place.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage

from pewm_jax.data.navigation import NavGrid
from pewm_jax.data.scenes import Scene
from pewm_jax.houses.moving_pieces import LEAF_M

NEAR_M, FAR_M = 1.3, 2.4
"""Distances of the agent at which a door is open, and at which it begins to open."""
WIDE_M = 1.3
"""Doorways from this width on have two leaves."""
LEAST_LEFT = 0.9
"""Share of the floor that must still be within reach when one more leaf is open."""


@dataclasses.dataclass(frozen=True)
class Leaf:
    """A leaf of a door.

    Attributes:
        hinge_2: (2,) where it turns, metres.
        yaw: of the closed leaf, from the hinge to its end, radians.
        swing: angle between closed and open, ± a right angle.
        middle_2: (2,) of the doorway.
        stays: whether it stays open.
    """

    hinge_2: np.ndarray
    yaw: float
    swing: float
    middle_2: np.ndarray
    stays: bool

    def poses(self, xy_T2: np.ndarray) -> np.ndarray:
        """Return (T, 4, 4) world_from_part for an agent that was at these places, in order."""
        away = np.linalg.norm(np.asarray(xy_T2) - self.middle_2, axis=-1)
        opened = np.clip((FAR_M - away) / (FAR_M - NEAR_M), 0, 1)
        if self.stays:
            opened = np.maximum.accumulate(opened)
        angle = self.yaw + self.swing * opened
        return planar_poses(np.broadcast_to(self.hinge_2, (len(angle), 2)), angle)


def hang(
    scene: Scene,
    grid: NavGrid,
    rng: np.random.Generator,
    rect: tuple[float, float, float, float],
) -> tuple[list[Leaf], float, NavGrid]:
    """Hang a doorway's leaves.

    Returns:
        The leaves, none where they have no room to open or would shut off a place; their width; and
        what the agent can reach beside them.
    """
    x0, y0, x1, y1 = rect
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    axis = np.array([1.0, 0.0]) if x1 - x0 > y1 - y0 else np.array([0.0, 1.0])
    across = np.array([-axis[1], axis[0]])
    opening, wall = max(x1 - x0, y1 - y0), min(x1 - x0, y1 - y0)
    double = opening >= WIDE_M
    width = opening / 2 if double else opening
    stays = bool(rng.uniform() < 0.5)

    def leaf(end: int, side: int) -> Leaf:
        """Return the leaf that hangs at one end of the opening and opens to one side."""
        # It turns at the wall's surface, so that the open leaf stands beside the opening.
        hinge = middle + end * opening / 2 * axis + side * (wall / 2 - LEAF_M / 2) * across
        closed = float(np.arctan2(-end * axis[1], -end * axis[0]))
        return Leaf(hinge, closed, -end * side * np.pi / 2, middle, stays)

    choices = [(end, side) for end in (-1, 1) for side in (-1, 1)]
    for k in rng.permutation(4):
        end, side = choices[k]
        leaves = [leaf(e, side) for e in ((-1, 1) if double else (end,))]
        left = _beside(grid, leaves, width)
        if left.area >= LEAST_LEFT * grid.area and all(
            _has_room(scene, one, width) for one in leaves
        ):
            return leaves, width, left
    return [], width, grid


def _beside(grid: NavGrid, leaves: list[Leaf], width: float) -> NavGrid:
    """Return the largest free region that keeps away from open leaves."""
    rows, columns = np.indices(grid.free_YX.shape)
    centres = grid.centre_of(np.stack([rows, columns], -1))
    free = grid.free_YX.copy()
    for leaf in leaves:
        way = np.array([np.cos(leaf.yaw + leaf.swing), np.sin(leaf.yaw + leaf.swing)])
        along = np.clip((centres - leaf.hinge_2) @ way, 0, width)
        near = leaf.hinge_2 + along[..., None] * way
        free &= np.linalg.norm(centres - near, axis=-1) > 0.3
    labels = np.zeros(free.shape, np.int32)
    ndimage.label(free, output=labels)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return dataclasses.replace(grid, free_YX=(labels == sizes.argmax()) & free)


def _has_room(scene: Scene, leaf: Leaf, width: float) -> bool:
    """Tell whether nothing is in the way of a leaf while it opens."""
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
    """Return (T, 4, 4) poses on the ground."""
    pose = np.tile(np.eye(4), (len(yaw_T), 1, 1))
    cos, sin = np.cos(yaw_T), np.sin(yaw_T)
    pose[:, :2, :2] = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    pose[:, :2, 3] = place_T2
    return pose
