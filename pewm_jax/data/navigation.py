"""The navigable area of any mesh as a grid, and shortest paths on it.

The grid is computed by casting rays, so scans and procedural houses are treated alike: rays
downward from head height must land on the floor, and rays across cells at several heights must be
free.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from pewm_jax.config import UserError
from pewm_jax.data.scenes import Scene
from pewm_jax.houses.floorplan import largest_region

STEP_M = 0.12
"""Largest height difference on one floor, metres."""
NEAR_M = 0.4
"""Largest distance of a storey's floor from the height that is given for it, metres."""
_HEIGHTS = (0.15, 0.4, 0.7, 1.0)
"""Heights at which obstacles are tested, as fractions of the agent's height."""


@dataclasses.dataclass(frozen=True, eq=False)
class NavGrid:
    """The cells in which an agent's centre may be.

    Attributes:
        free_YX: (Y, X) bool; one connected region.
        origin_xy: (2,) world position of the lower corner of cell [0, 0], metres.
        cell_m: side of a cell.
        floor_z: height of the floor.
    """

    free_YX: np.ndarray
    origin_xy: np.ndarray
    cell_m: float
    floor_z: float

    def cell_of(self, points_N2: np.ndarray) -> np.ndarray:
        """Return (..., 2) integer (row, column) of world points, possibly outside the grid."""
        cells = np.floor((np.asarray(points_N2) - self.origin_xy) / self.cell_m).astype(int)
        return cells[..., ::-1]

    def centre_of(self, cells_N2: np.ndarray) -> np.ndarray:
        """Return (..., 2) world centres of (row, column) cells."""
        return self.origin_xy + (np.asarray(cells_N2)[..., ::-1] + 0.5) * self.cell_m

    @property
    def area(self) -> float:
        """Free area in square metres."""
        return float(self.free_YX.sum() * self.cell_m**2)

    @property
    def centres(self) -> np.ndarray:
        """World centres (Y, X, 2) of all cells."""
        return self.centre_of(np.moveaxis(np.indices(self.free_YX.shape), 0, -1))


def navigable(
    scene: Scene,
    cell_m: float = 0.1,
    agent_radius_m: float = 0.2,
    agent_height_m: float = 1.2,
    near_z: float | None = None,
) -> NavGrid:
    """Return the cells in which an agent can stand.

    Args:
        scene: any mesh, z up.
        cell_m: side of a grid cell, metres.
        agent_radius_m: the agent's radius; free cells keep this distance from obstacles.
        agent_height_m: the agent passes under obstacles above this height.
        near_z: a height near the floor of the wanted storey, metres.

    Returns:
        The largest connected region of free cells, on the wanted storey, by default the lowest with
        much floor.

    Raises:
        UserError: the sizes are not positive, the scene is too wide for the cell, or there is
            no floor or no free cell.
    """
    if min(cell_m, agent_radius_m, agent_height_m) <= 0:
        raise UserError("cell_m, agent_radius_m and agent_height_m must all be above 0 metres.")
    low, high = scene.vertices_V3.min(0), scene.vertices_V3.max(0)
    origin = low[:2] - cell_m
    columns, rows = (int(n) for n in np.ceil((high[:2] + cell_m - origin) / cell_m))
    if rows * columns > 16_000_000:
        raise UserError(
            f"{scene.name} spans {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m, too much for "
            f"cells of {cell_m} m: check that its unit is metres, or use larger cells."
        )
    floor_z = estimate_floor(scene, near_z=near_z)
    x, y = (origin[i] + (np.arange(n) + 0.5) * cell_m for i, n in enumerate((columns, rows)))
    centres = np.stack(np.meshgrid(x, y), -1)
    stand = np.abs(_landing(scene, centres, floor_z + agent_height_m) - floor_z) <= STEP_M
    heights = floor_z + agent_height_m * np.array(_HEIGHTS)
    stand &= ~_obstructed(scene, centres, stand, heights, cell_m)
    away = np.asarray(ndimage.distance_transform_edt(np.pad(stand, 1)))[1:-1, 1:-1]
    region = largest_region((away - 0.5) * cell_m >= agent_radius_m)
    if not region.any():
        raise UserError(
            f"{scene.name} has no place where an agent of radius {agent_radius_m} m can stand "
            f"(floor found at z = {floor_z:.2f} m): check that it is in metres and z is up."
        )
    return NavGrid(region, origin, cell_m, floor_z)


def estimate_floor(scene: Scene, bin_m: float = 0.1, near_z: float | None = None) -> float:
    """Return the height of the lowest level that has much upward-facing area, metres.

    With ``near_z``, only levels within ``NEAR_M`` of it are considered.
    """
    corners = scene.vertices_V3[scene.faces_F3]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = scene.normals_F3[:, 2] > 0.9
    if not flat.any():
        flat = np.abs(scene.normals_F3[:, 2]) > 0.9
    if not flat.any():
        raise UserError(f"{scene.name} has no level surface to stand on: check that z is up.")
    if near_z is not None:
        flat &= np.abs(corners.mean(1)[:, 2] - near_z) <= NEAR_M
        if not flat.any():
            raise UserError(f"{scene.name} has no floor near the height {near_z:.2f} m.")
    z = corners[flat].mean(1)[:, 2]
    area = np.linalg.norm(cross[flat], axis=-1)
    index = np.round((z - z.min()) / bin_m).astype(int)
    level = np.bincount(index, area)
    spread = np.convolve(level, np.ones(3), "same")
    floor = int(np.argmax(spread >= 0.5 * spread.max()))
    near = np.abs(index - floor) <= 1
    best = int(np.argmax(np.where(np.abs(np.arange(len(level)) - floor) <= 1, level, -1)))
    chosen = near & (index == best)
    return float(np.average(z[chosen], weights=area[chosen]))


def _landing(scene: Scene, centres_YX2: np.ndarray, start_z: float) -> np.ndarray:
    """Return the (Y, X) height that a downward ray from ``start_z`` hits, −inf for none."""
    points = centres_YX2.reshape(-1, 2)
    origins = np.concatenate([points, np.full((len(points), 1), start_z)], 1) - scene.centre_3
    down = np.tile(np.array([[0, 0, -1]], np.float32), (len(points), 1))
    hits = scene.tracer.run(origins.astype(np.float32), down, output=1)
    height = np.where(hits["primID"] < 0, -np.inf, start_z - hits["tfar"])
    return height.reshape(centres_YX2.shape[:2])


def _obstructed(
    scene: Scene, centres_YX2: np.ndarray, stand_YX: np.ndarray, z: np.ndarray, cell_m: float
) -> np.ndarray:
    """Return the (Y, X) cells in which a short ray along +x or +y at some height hits something."""
    points = centres_YX2[stand_YX]
    blocked = np.zeros(len(points), bool)
    for axis in (0, 1):
        starts = np.column_stack([np.repeat(points, len(z), 0), np.tile(z, len(points))])
        # Rays of neighbours overlap a little, so a wall on the border of two cells is hit.
        starts[:, axis] -= 0.52 * cell_m
        starts = (starts - scene.centre_3).astype(np.float32)
        reach = np.full(len(starts), 1.04 * cell_m, np.float32)
        rays = np.tile(np.eye(3, dtype=np.float32)[axis], (len(starts), 1))
        hit = scene.tracer.run(starts, rays, dists=reach, query="OCCLUDED") >= 0
        blocked |= hit.reshape(-1, len(z)).any(1)
    result = np.zeros_like(stand_YX)
    result[stand_YX] = blocked
    return result


def is_free(grid: NavGrid, points_N2: np.ndarray) -> np.ndarray:
    """Return (...) bool: whether world points (..., 2) lie in free cells."""
    cells = grid.cell_of(points_N2)
    shape = np.array(grid.free_YX.shape)
    inside = ((cells >= 0) & (cells < shape)).all(-1)
    safe = np.clip(cells, 0, shape - 1)
    return inside & grid.free_YX[safe[..., 0], safe[..., 1]]


def sample_free(grid: NavGrid, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return (count, 2) world points, uniform over the free area."""
    cells = np.argwhere(grid.free_YX)
    chosen = cells[rng.integers(len(cells), size=count)]
    jitter = rng.uniform(-0.5, 0.5, (count, 2)) * grid.cell_m * 0.999
    return grid.centre_of(chosen) + jitter


def nearest_free(grid: NavGrid, point_2: np.ndarray) -> np.ndarray:
    """Return the world centre of the free cell closest to a point (itself if free)."""
    if bool(is_free(grid, point_2)):
        return np.asarray(point_2, float)
    centres = grid.centre_of(np.argwhere(grid.free_YX))
    return centres[np.linalg.norm(centres - np.asarray(point_2), axis=-1).argmin()]


def distance_field(grid: NavGrid, source_xy: np.ndarray) -> np.ndarray:
    """Return (Y, X) geodesic distances in metres to the free cell nearest to a point.

    Moves go to the eight neighbours, diagonals only between free cells; blocked cells are +inf.
    """
    return _dijkstra(grid, source_xy)[0]


def shortest_path(grid: NavGrid, start_xy: np.ndarray, goal_xy: np.ndarray) -> np.ndarray | None:
    """Return (N, 2) world points from start to goal around obstacles; see ``PathsToGoal.path``."""
    return PathsToGoal(grid, goal_xy).path(start_xy)


class PathsToGoal:
    """The shortest paths from all cells to one goal (2,); computed once, then looked up.

    ``distance_YX`` are metres to the goal from cell to cell, as ``distance_field``.
    """

    def __init__(self, grid: NavGrid, goal_xy: np.ndarray):
        self.grid, self.goal_xy = grid, np.asarray(goal_xy, float)
        self.distance_YX, self._previous = _dijkstra(grid, self.goal_xy)

    def path(self, start_xy: np.ndarray) -> np.ndarray | None:
        """Return (N, 2) world points from a start to the goal around obstacles.

        Corners of the path are pulled tight wherever the straight line is free. None if start or
        goal is not in a free cell.
        """
        grid, ends = self.grid, np.stack([np.asarray(start_xy, float), self.goal_xy])
        if not is_free(grid, ends).all():
            return None
        width = grid.free_YX.shape[1]
        row, column = grid.cell_of(ends[0])
        node, nodes = int(row * width + column), []
        while node >= 0:
            nodes.append(node)
            node = int(self._previous[node])
        cells = np.stack(np.divmod(np.array(nodes), width), -1)
        points = np.concatenate([ends[:1], grid.centre_of(cells[1:-1]), ends[1:]])
        return _pull_tight(grid, points)

    def length(self, start_xy: np.ndarray) -> float:
        """Return the length of ``path``, metres; infinite if there is none."""
        path = self.path(start_xy)
        if path is None:
            return float("inf")
        return float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())


def line_is_free(grid: NavGrid, start_xy: np.ndarray, end_xy: np.ndarray) -> bool:
    """Return whether the straight line between two points stays in free cells."""
    length = float(np.linalg.norm(np.asarray(end_xy) - np.asarray(start_xy)))
    steps = np.linspace(0, 1, max(2, int(np.ceil(length / (0.25 * grid.cell_m))) + 1))[:, None]
    return bool(is_free(grid, np.asarray(start_xy) + steps * (end_xy - start_xy)).all())


def _dijkstra(grid: NavGrid, source_xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (Y, X) to a source and, per flat cell, the next cell towards it."""
    row, column = grid.cell_of(nearest_free(grid, source_xy))
    source = int(row * grid.free_YX.shape[1] + column)
    graph = _graph(grid)
    distance, previous = dijkstra(graph, directed=False, indices=source, return_predecessors=True)
    return distance.reshape(grid.free_YX.shape), previous


def _graph(grid: NavGrid) -> csr_matrix:
    """Return the weighted 8-neighbour graph over all cells."""
    free = grid.free_YX
    index = np.arange(free.size).reshape(free.shape)
    starts, ends, weights = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, free.shape[0] - dy), slice(max(0, -dx), free.shape[1] - max(0, dx)))
        b = (slice(dy, None), slice(max(0, dx), free.shape[1] + min(0, dx)))
        open_ = free[a] & free[b]
        if dy and dx:  # diagonal moves must not cut corners
            open_ &= free[a[0], b[1]] & free[b[0], a[1]]
        starts.append(index[a][open_])
        ends.append(index[b][open_])
        weights.append(np.full(int(open_.sum()), grid.cell_m * np.hypot(dy, dx)))
    pairs = (np.concatenate(starts), np.concatenate(ends))
    return csr_matrix((np.concatenate(weights), pairs), shape=(free.size, free.size))


def _pull_tight(grid: NavGrid, points_N2: np.ndarray) -> np.ndarray:
    """Drop the waypoints between points that a straight line through free cells can join."""
    kept, at, last = [points_N2[0]], 0, len(points_N2) - 1
    while at < last:
        reach = 1
        while at + reach < last and line_is_free(
            grid, points_N2[at], points_N2[min(last, at + 2 * reach)]
        ):
            reach *= 2
        ahead = min(last, at + 2 * reach)
        while ahead > at + 1 and not line_is_free(grid, points_N2[at], points_N2[ahead]):
            ahead -= 1
        at = ahead
        kept.append(points_N2[at])
    return np.stack(kept)
