"""Scores of a voxel world: unseen walls, a known grid, and what long walks do to what was seen.

* **Unseen walls**: after some observed frames, the cells of the window that none of them shows are
  compared with the recorded grid: the intersection over union of walls. The baselines are the
  prior, which is the mean layout of other houses' windows, and the observed walls, extended along
  their lines by some cells; the threshold and the number of cells are the best for them here.
* **A known grid**: PSNR of the renderer given the recorded voxels and cameras.
* **Long walks**: PSNR over the walk, FVD of all its windows of 16 frames. After it the camera is
  sent back to the observed frames: all pixels there were seen before, and the PSNR lost is that
  against the same at the beginning of the walk, both without the images before. Doorways in the
  window that the observed frames showed open must still be passable in the world's grid.

Rows with one mechanism of the world switched off show what each contributes.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.data.episodes import Episode
from pewm_jax.eval import horizon, statistics
from pewm_jax.eval.horizon import RecordedWalk
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.metrics.videos import VideoDistance
from pewm_jax.houses.kinds import GROUPS
from pewm_jax.io.progress import Meter
from pewm_jax.memory import class_grid
from pewm_jax.memory.class_grid import UNKNOWN, ClassGrid
from pewm_jax.models.persist import voxel_renderer
from pewm_jax.types import Array, Camera, Control, Frames, Params, WorldState
from pewm_jax.worlds.persist import state as windows
from pewm_jax.worlds.persist import voxel_frames

AS_TRAINED = "as trained"
MECHANISMS: dict[str, dict[str, Any]] = {
    AS_TRAINED: {},
    "persistence_logit": {
        "persistence_logit": 0.0,
        "shown_logit": -1.0,
        "guess_logit": -1.0,
        "sampled": "always",
    },
    "empty_prior": {"empty_prior": 0.0},
    "observation_logit": {"observation_logit": 0.0},
    "guesses": {"shown_logit": -1.0, "guess_logit": -1.0},
    "body": {"body_m": 0.0},
    "moving": {"moving": ()},
    "colour_reach_m": {"colour_reach_m": 0.0},
    "sampled": {"sampled": "always"},
    "sample_steps": {"voxel_noise": {"sample_steps": 1}},
}
"""Rows: the settings of the world, and of its parts, that switch a mechanism off. Without revision
of guesses all known cells persist as observed ones do. Without ``persistence_logit`` all voxels of
every frame are sampled, since cells that are not sampled persist too."""
KNOWN_FRAMES = 32
"""Most frames of a walk that are rendered from a known grid."""
PRIOR_HOUSES = 256
"""Most windows of other houses from which the mean layout is computed."""
THRESHOLDS = np.linspace(0.02, 0.98, 49)
EXTENSIONS = (0, 1, 2, 4, 8, 16, 32)
"""Cells by which observed walls are extended at both ends, for a baseline."""
LINE = 4
"""Cells of an observed wall along x or y from which on it is extended."""
LANE = 2
"""Cells of the width that a way through a doorway needs."""
SILL_CELLS, BELOW_HEAD_M = 1.25, 1.35
"""A way through a doorway must be free from this height on, in cells, up to that one, metres: sills
fill the lowest cells."""
ACROSS_M = 0.25
"""Distance before and behind a doorway that must be free, too, metres."""
SEEN_SHARE = 0.5
"""Share of each lane of a way through a doorway that observed frames must show empty."""


def variant(config: Config, mechanism: str) -> Config:
    """Return the configuration with a mechanism of its world switched off; see ``MECHANISMS``."""
    model = config.model
    return config.with_model(
        **{
            name: dataclasses.replace(getattr(model, name), **value)
            if isinstance(value, dict)
            else value
            for name, value in MECHANISMS[mechanism].items()
        }
    )


def mechanisms(config: Config) -> list[str]:
    """Return the rows of a world: as trained, and without each mechanism that it has."""
    return [name for name in MECHANISMS if name == AS_TRAINED or variant(config, name) != config]


@dataclasses.dataclass(frozen=True)
class UnseenCells:
    """The window of one place: what is there, what was seen of it, and what the world predicts.

    Attributes:
        house: name of the scene.
        unseen_XYZ: bool, cells of the recorded grid that no observed frame shows.
        wall_XYZ: bool, true walls.
        made_XYZ: bool, predicted walls; None for a place that only the prior uses.
    """

    house: str
    unseen_XYZ: np.ndarray
    wall_XYZ: np.ndarray
    made_XYZ: np.ndarray | None = None


def wall_classes(names: Sequence[str]) -> np.ndarray:
    """Return (classes,) bool: the classes of a table that are walls, of any colour."""
    kinds = [name.partition("/")[0] for name in names]
    return np.array([GROUPS.get(kind, kind) == "wall" for kind in kinds])


def places(episodes: Sequence[Episode], count: int, context: int) -> list[tuple[int, int]]:
    """Return at most ``count`` pairs of an episode and its present frame, over all episodes."""
    each = -(-count // len(episodes))
    found = []
    for rank in range(each):
        for number in range(len(episodes)):
            room = episodes[number].length - context
            if room > 0:
                at = context - 1 + round((room - 1) * (rank + 0.5) / each)
                found.append((number, at))
    return found[:count]


def unseen_walls(
    config: Config, params: Params, episodes: Sequence[Episode], count: int
) -> list[UnseenCells]:
    """Start worlds at places and compare their windows with the recorded grids."""
    start = jax.jit(functools.partial(worlds.start, config.model))
    context, found = config.data.context, []
    some = places(episodes, count, context)
    with Meter("unseen walls", len(some), "places") as meter:
        for number, at in some:
            episode = episodes[number]
            seen = _observed(episode, at, context)
            grid = start(params, seen).map
            first = np.asarray(grid.history.start_3)
            made = np.asarray(windows.window(config.model, grid.classes_XYZ, first))
            cells = compare_window(config, episode, at, seen, np.asarray(grid.low_3), first)
            walls = wall_classes(class_grid.names(config.model.memory))
            made_wall = walls[np.maximum(made, 0)] & (made > 0)
            found.append(dataclasses.replace(cells, made_XYZ=made_wall))
            meter.advance(1)
    return found


def compare_window(
    config: Config,
    episode: Episode,
    at: int,
    seen: Frames,
    low_3: np.ndarray | None = None,
    first_3: np.ndarray | None = None,
) -> UnseenCells:
    """Return the recorded walls of a window, and which of its cells the observed frames show.

    ``seen`` are the observed frames, the present one, ``at``, last. ``low_3`` and ``first_3`` place
    the window; by default it is that of a world that has observed ``seen``, whose lattice begins at
    the first of them.
    """
    model, recorded = config.model, episode.voxels([at])
    if low_3 is None or first_3 is None:
        low_3, first_3 = _window_at(model, seen)
    off = np.round((low_3 - recorded.origin_T3[0]) / model.cell).astype(int) + first_3
    true = np.asarray(
        windows.cut_box(jnp.asarray(recorded.classes_TXYZ[0], jnp.int16), off, model.side)
    )
    corner = jnp.asarray(low_3 + first_3 * model.cell)
    shown = np.asarray(_shown(model, corner, seen.depth_THW, seen.camera))
    walls = wall_classes(recorded.names)
    unseen = (true != UNKNOWN) & ~shown
    return UnseenCells(episode.scene, unseen, walls[np.maximum(true, 0)] & (true > 0))


def _window_at(model: Any, seen: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest corner, metres, and first cell of the window after observed frames."""
    poses = np.asarray(seen.camera.world_from_camera)
    low_3 = np.asarray(model.memory.empty(model, poses[0, :3, 3]).low_3)
    return low_3, np.asarray(windows.first_cell(model, low_3, poses[-1, :3, 3]))


def _observed(episode: Episode, at: int, context: int) -> Frames:
    return episode.frames(range(at + 1 - context, at + 1))


@functools.partial(jax.jit, static_argnums=0)
def _shown(model: Any, corner_3: Array, depth_THW: Array, camera: Camera) -> Array:
    """Return (X, Y, Z) bool: the cells of a window of which any frame shows at least a pixel."""

    def one(frame: tuple[Array, Camera]) -> Array:
        air, surface = voxel_frames.visible_cells(model, corner_3, *frame, votes=1)
        return air | surface

    return jax.lax.map(one, (jnp.asarray(depth_THW), jax.tree.map(jnp.asarray, camera))).any(0)


def iou(cells: Sequence[UnseenCells], made: Sequence[np.ndarray]) -> float:
    """Return the intersection over union of walls over the unseen cells of all places."""
    both, either = _overlaps(cells, made).sum(0)
    return float(both / max(either, 1))


def _overlaps(cells: Sequence[UnseenCells], made: Sequence[np.ndarray]) -> np.ndarray:
    """Return (places, 2) counts of unseen cells: intersection and union of the walls."""
    found = [
        (
            (wall & one.wall_XYZ & one.unseen_XYZ).sum(),
            ((wall | one.wall_XYZ) & one.unseen_XYZ).sum(),
        )
        for one, wall in zip(cells, made, strict=True)
    ]
    return np.array(found, np.float64).reshape(-1, 2)


def ratio_interval(
    cells: Sequence[UnseenCells], made: Sequence[np.ndarray], base: Sequence[np.ndarray]
) -> tuple[float, float]:
    """Return the 95 % interval of the ratio of two IoUs, a percentile bootstrap over houses.

    Both ends are NaN with fewer than two houses.
    """
    houses, index = np.unique([one.house for one in cells], return_inverse=True)
    if len(houses) < 2:
        return math.nan, math.nan
    sums = np.zeros((2, len(houses), 2))
    for k, walls in enumerate((made, base)):
        np.add.at(sums[k], index, _overlaps(cells, walls))
    both, either = np.moveaxis(statistics.drawn(len(houses)) @ sums, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        own, other = both / either
        ratios = own / other
    tail = (1 - statistics.LEVEL) / 2
    low, high = np.nanquantile(ratios, [tail, 1 - tail])
    return float(low), float(high)


def mean_layouts(
    cells: Sequence[UnseenCells], others: Sequence[UnseenCells] = ()
) -> list[np.ndarray]:
    """Return for each place the mean layout of other houses: the share of walls at each cell.

    The windows are those of ``others``, or, if there are none, of the other places' houses. A share
    counts unseen cells only.
    """

    def layout(some: Sequence[UnseenCells]) -> np.ndarray:
        wall = np.sum([one.wall_XYZ & one.unseen_XYZ for one in some], 0)
        return wall / np.maximum(np.sum([one.unseen_XYZ for one in some], 0), 1)

    if others:
        return [layout(others)] * len(cells)
    found = []
    for one in cells:
        rest = [other for other in cells if other.house != one.house]
        found.append(layout(rest) if rest else np.zeros(one.wall_XYZ.shape))
    return found


def extended(cells: Sequence[UnseenCells]) -> float:
    """Return the IoU of the observed walls, extended by the number of cells that is best here."""
    walls = [one.wall_XYZ & ~one.unseen_XYZ for one in cells]
    return max(iou(cells, [extend(one, count) for one in walls]) for count in EXTENSIONS)


def extend(wall_XYZ: np.ndarray, count: int) -> np.ndarray:
    """Return walls (X, Y, Z), bool, extended along their lines and over the height of all of them.

    Along every line of cells in x or y that holds ``LINE`` or more of them at any height, the gaps
    are closed, and both ends are moved by ``count`` cells.
    """
    heights = np.flatnonzero(wall_XYZ.any((0, 1)))
    plan_XY = np.asarray(wall_XYZ.any(2))
    found_XY = plan_XY.copy()
    for plan, found in ((plan_XY, found_XY), (plan_XY.T, found_XY.T)):
        for number, line in enumerate(plan):
            at = np.flatnonzero(line)
            if len(at) >= LINE:
                found[number, max(at[0] - count, 0) : at[-1] + 1 + count] = True
    walls = np.zeros_like(wall_XYZ)
    if len(heights):
        walls[:, :, heights[0] : heights[-1] + 1] = found_XY[..., None]
    return walls


def unseen_scores(
    cells: Sequence[UnseenCells], others: Sequence[UnseenCells] = ()
) -> dict[str, Any]:
    """Return the IoU of unseen walls, and those of the baselines at their best settings."""
    layouts = mean_layouts(cells, others)
    cut = max(THRESHOLDS, key=lambda cut: iou(cells, [one >= cut for one in layouts]))
    prior = [one >= cut for one in layouts]
    made = [one.made_XYZ for one in cells if one.made_XYZ is not None]
    low, high = ratio_interval(cells, made, prior)
    return {
        "places": len(cells),
        "houses": len({one.house for one in cells}),
        "iou": iou(cells, made),
        "prior": iou(cells, prior),
        "times_low": low,
        "times_high": high,
        "extended": extended(cells),
        "prior_places": len(others) or len(cells),
    }


def prior_places(config: Config, episodes: Sequence[Episode]) -> list[UnseenCells]:
    """Return windows of training houses, for the mean layout."""
    context = config.data.context
    some = places(episodes, min(PRIOR_HOUSES, len(episodes)), context)
    return [
        compare_window(config, episodes[k], at, _observed(episodes[k], at, context))
        for k, at in some
    ]


def known_grid(config: Config, params: Params, walks: Sequence[RecordedWalk]) -> float:
    """Return the PSNR, dB, of rendering the recorded grids of walks, mean over frames."""
    made = horizon.render_bound(config, params, walks)
    truth = np.stack([walk.truth_THWC for walk in walks])
    return horizon.stretches(made, truth, [truth.shape[1]])[0]


@dataclasses.dataclass(frozen=True)
class LongWalks:
    """What long walks leave of a world.

    Attributes:
        video: (B, T, H, W, 3) uint8 imagined frames.
        seen: PSNR, dB, of the observed frames imagined at the start and at the end of the walks.
        doorways: number of doorways seen open, and of those still passable at the end.
    """

    video: np.ndarray
    seen: tuple[float, float]
    doorways: tuple[int, int]


def long_walks(
    config: Config,
    params: Params,
    walks: Sequence[RecordedWalk],
    doorways: Sequence[Sequence[np.ndarray]],
    label: str = "imagining",
) -> LongWalks:
    """Imagine walks, and measure at their start and end what was observed before them.

    ``doorways`` are the ways through the doorways that each walk's observed frames show open, from
    ``open_doorways``.
    """
    begun = horizon.start_walks(config, params, walks)
    actions = np.stack([walk.actions_T3 for walk in walks])
    video, after = horizon.imagine_actions(config, params, begun, actions, label=label)
    again = jax.jit(jax.vmap(functools.partial(_look_back, config), (None, 0, 0, 0)))
    keys = jax.random.split(jax.random.key(1), len(walks))
    context: Any = jax.tree.map(lambda *x: np.stack(x), *[walk.context for walk in walks])
    scores = []
    for state in (begun, after):
        made = np.asarray(again(params, state, context.camera, keys))
        off = np.square(unit_colours(made) - unit_colours(context.rgb_THWC))
        scores.append(float(np.asarray(psnr(off.mean((2, 3, 4)))).mean()))
    count = passed = 0
    for number, ways in enumerate(doorways):
        grid = jax.tree.map(lambda x, k=number: np.asarray(x[k]), after.map)
        count += len(ways)
        passed += sum(passable(config, grid, way) for way in ways)
    return LongWalks(video, (scores[0], scores[1]), (count, passed))


def _look_back(config: Config, params: Params, state: Any, camera: Camera, key: Array) -> Array:
    """Return the frames that a world imagines at cameras, without the images before them."""
    nets, grid = config.model.backbone, state.map
    pictures = voxel_renderer.empty_cache(nets.renderer, 1, jnp.dtype(config.model.dtype))
    if grid.history is not None:
        history = dataclasses.replace(grid.history, pictures=pictures)
        state = WorldState(state.frame, dataclasses.replace(grid, history=history))
    return worlds.imagine(config.model, params, state, Control(camera), key)[1].rgb_THWC


@functools.lru_cache(maxsize=64)
def house_of(scene: str) -> Mapping[str, Any] | None:
    """Return rooms and doorways of a generated house by its name; None for other scenes."""
    # Imported here: meshes take a while to import, and other evaluations need none.
    from pewm_jax.houses.generate import generate_house  # noqa: PLC0415

    found = re.fullmatch(r"house-(\d+)", scene)
    return dict(generate_house(int(found[1])).metadata) if found else None


def way_through(rect: Sequence[float], floor_z: float, cell_m: float) -> np.ndarray:
    """Return the points (lanes, N, 3), metres, of the ways through a doorway, side by side.

    ``rect`` is x0, y0, x1, y1 of the opening in the wall. A lane is one cell wide.
    """
    low, high = np.array(rect[:2], float), np.array(rect[2:], float)
    along = int((high - low)[1] > (high - low)[0])
    across = 1 - along
    lanes = np.arange(low[along] + cell_m / 2, high[along], cell_m)
    depth = np.arange(low[across] - ACROSS_M, high[across] + ACROSS_M + cell_m / 4, cell_m / 2)
    height = np.arange(floor_z + SILL_CELLS * cell_m, floor_z + BELOW_HEAD_M, cell_m / 2)
    points = np.zeros((len(lanes), len(depth), len(height), 3))
    points[..., along] = lanes[:, None, None]
    points[..., across] = depth[:, None]
    points[..., 2] = height
    return points.reshape(len(lanes), -1, 3)


def cells_at(grid: ClassGrid, cell_m: float, points: np.ndarray) -> np.ndarray:
    """Return the class ids of the cells at points (..., 3); unknown outside of the grid."""
    cells = np.asarray(grid.classes_XYZ)
    at = np.floor((points - np.asarray(grid.low_3)) / cell_m).astype(int)
    inside = np.asarray(((at >= 0) & (at < cells.shape)).all(-1))
    x, y, z = np.moveaxis(np.where(inside[..., None], at, 0), -1, 0)
    return np.where(inside, cells[x, y, z], UNKNOWN)


def passable(config: Config, grid: ClassGrid, way: np.ndarray) -> bool:
    """Return whether ``LANE`` lanes side by side are empty in a grid; unknown cells are not."""
    return _passes((cells_at(grid, config.model.cell, way) == class_grid.EMPTY).all(1))


def _passes(free_L: np.ndarray) -> bool:
    """Return whether ``LANE`` lanes side by side are free."""
    return bool(np.convolve(free_L, np.ones(LANE, int), "valid").max(initial=0) >= LANE)


def open_doorways(config: Config, episode: Episode, at: int, context: int) -> list[np.ndarray]:
    """Return the ways through the true doorways that the frames before a walk show open.

    A doorway counts if it lies in the world's window at the present frame, ``at``, the recorded
    grid lets one pass by some lanes, and the observed frames show at least half of each of these
    lanes empty. Frames before anything in the way last changed, such as a door, do not count.
    """
    house, model = house_of(episode.scene), config.model
    if house is None:
        return []
    grids = [
        ClassGrid(classes.astype(np.int16), low)
        for recorded in [episode.voxels(range(at + 1 - context, at + 1))]
        for classes, low in zip(recorded.classes_TXYZ, recorded.origin_T3, strict=True)
    ]
    seen = _observed(episode, at, context)
    floor = float(episode.world_from_camera[at][2, 3]) - model.memory.eye_m
    low, first = _window_at(model, seen)
    corner = low + first * model.cell
    found = []
    for *_, x0, y0, x1, y1 in house["doorways"]:
        way = way_through((x0, y0, x1, y1), floor, model.cell)
        cells = cells_at(grids[-1], model.cell, way)
        known = (cells != UNKNOWN) & (
            (way >= corner) & (way < corner + model.side * model.cell)
        ).all(-1)
        if known.all() and passable(config, grids[-1], way):
            same = [(cells_at(grid, model.cell, way) == cells).all() for grid in grids]
            since = context - int(np.argmin([*same[::-1], False]))
            shown = _points_shown(jax.tree.map(lambda x, k=since: x[k:], seen), way)
            free = (cells == class_grid.EMPTY).all(1)
            if _passes(free & (shown.mean(1) >= SEEN_SHARE)):
                found.append(way)
    return found


def most_doorways(config: Config, episode: Episode, starts: Sequence[int], context: int) -> int:
    """Return the first of some frames before which most true doorways are seen open."""
    counts = [len(open_doorways(config, episode, at, context)) for at in starts]
    return starts[int(np.argmax(counts))]


def _points_shown(seen: Frames, points: np.ndarray) -> np.ndarray:
    """Return which points (..., 3) lie in front of what some frame shows there."""
    found = np.zeros(points.shape[:-1], bool)
    height, width = seen.depth_THW.shape[1:]
    for depth, pose, (fx, fy, cx, cy) in zip(
        seen.depth_THW, seen.camera.world_from_camera, seen.camera.intrinsics_4, strict=True
    ):
        x, y, z = np.moveaxis((points - pose[:3, 3]) @ pose[:3, :3], -1, 0)
        front = z > voxel_frames.NEAREST_M
        far = np.where(front, z, 1)
        column, row = np.floor(x / far * fx + cx), np.floor(y / far * fy + cy)
        within = front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = (np.where(within, v, 0).astype(int) for v in (column, row))
        found |= within & (depth[row, column] > z)
    return found


def video_distance(
    made: Mapping[str, np.ndarray], truth: np.ndarray, i3d: VideoDistance
) -> dict[str, dict[str, float]]:
    """Return FVD and KVD over all windows of 16 frames of walks, by name."""
    frames = truth.shape[1]
    found = horizon.distances(dict(made), truth, [frames], frames // horizon.WINDOW, i3d)
    return {
        name: {kind: one["value"] for kind, one in ends[str(frames)].items()}
        for name, ends in found.items()
    }
