"""Plan edits of a generated house that a recorded walk reaches from another room.

An edit is made while the agent is in another room than the edited one: a wall is moved, a door
opened, or a chair removed. The place is not in view then; the walk leads to where it can be seen.
Episodes and frames are the first ones that fit, so nothing is selected by how a world draws it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pewm_jax.data.episodes import Episode
from pewm_jax.data.render import draw_blocks
from pewm_jax.data.voxels import VoxelFrames
from pewm_jax.eval.voxel_scores import house_of
from pewm_jax.houses.floorplan import DOOR_TOP_M
from pewm_jax.houses.generate import object_boxes
from pewm_jax.houses.kinds import kind_of
from pewm_jax.memory import class_grid
from pewm_jax.types import WorldState
from pewm_jax.worlds.persist import world as persist

KINDS = ("wall", "door", "chair")
CHAIRS = ("chair", "armchair", "office_chair")
"""Kinds of furniture that count as chairs."""
MOVED_M = 1.0
"""Distance by which a wall is moved into its room, metres."""
LONGEST, AFTER = 48, 10
"""Most frames between an edit and the first view of it, and frames that follow."""
NEAR_M, FAR_M = 0.8, 3.5
"""Distances from which an edited place is seen."""
ASIDE = 0.7
"""Largest tangent of the angle between the place and the middle of the image."""
REACH_M = 4.5
"""Largest distance of the place from the grid's middle when the edit is made, along an axis."""
CLEAR_M = 0.5
"""Distance that a moved wall keeps from the walk."""
BESIDE_M = 0.12
"""Distance around a chair that is emptied with it, metres."""
AGREES_M = 0.45
"""Largest difference between the place's depth and that measured in its direction."""
CHANGED_SHARE = {"wall": 0.3, "door": 0.15, "chair": 0.08}
"""Least share of an image's pixels that an edit changes in some frames drawn from the recorded
grid."""
CHANGED_LEVELS = 30
"""Levels of 255 by which a colour must differ."""
CHANGED_FRAMES = 4
"""Number of these frames."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """An edit of a walk.

    Attributes:
        about: what is edited.
        start: frame at which the edit is made.
        end: last frame of the walk.
        box_23: the box that is emptied or moved, metres.
        move: rigid (4, 4) by which its content moves; None if it is removed.
        changed_T: share of the pixels that the edit changes in each frame after ``start``, drawn
            from the recorded grid; empty if it was not computed.
    """

    about: str
    start: int
    end: int
    box_23: np.ndarray
    move: np.ndarray | None = None
    changed_T: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))


@dataclasses.dataclass(frozen=True)
class _Place:
    """A place that could be edited: its rooms, a point that is looked at, and the edit."""

    rooms: tuple[int, ...]
    point_3: np.ndarray
    box_23: np.ndarray
    about: str
    move: np.ndarray | None = None


def apply(model: Any, state: WorldState, plan: Plan) -> WorldState:
    """Return a world with the edit."""
    change, *arguments = _change(plan)
    return persist.edit(state, change, model.memory, *arguments)


def _change(plan: Plan) -> tuple[Any, ...]:
    """Return the function of ``class_grid`` that makes an edit, and the arguments after a grid."""
    box = plan.box_23.astype(np.float32)
    if plan.move is None:
        return class_grid.erase, box
    return class_grid.move, box, plan.move.astype(np.float32)


def first_plan(
    model: Any, episodes: Sequence[Episode], kind: str
) -> tuple[Episode, Plan] | tuple[None, None]:
    """Return the first episode in which an edit of a kind can be shown, and the edit.

    An edit of a door from one of its own two rooms is returned only if no episode has one from a
    third room.
    """
    for beside in (False, True) if kind == "door" else (False,):
        for number in range(len(episodes)):
            found = plan(model, episodes[number], kind, beside=beside)
            if found is not None:
                return episodes[number], found
    return None, None


def plan(model: Any, episode: Episode, kind: str, *, beside: bool = False) -> Plan | None:
    """Return the first edit of a kind that a walk reaches from another room; None if there is none.

    The episode must have voxels and actions; scenes other than generated houses have no plan. A
    door belongs to both its rooms; with ``beside`` the edit may be made from its second room.
    """
    house = house_of(episode.scene)
    if house is None or episode.actions is None:
        return None
    floor = float(episode.world_from_camera[0, 2, 3]) - model.memory.eye_m
    path = np.asarray(episode.world_from_camera)[:, :3, 3]
    rooms = np.array([_room_at(house, xy) for xy in path[:, :2]])
    for place in _places(house, kind, floor, model.cell):
        inside = place.rooms[:1] if beside else place.rooms
        not_from = np.isin(rooms, (-1, *inside))
        found = _walk_to(episode, place, path, not_from, np.isin(rooms, place.rooms))
        if found is None:
            continue
        start, end = found
        if kind == "wall" and not _is_clear(place, path[start : end + 1]):
            continue
        if kind == "door" and not _is_closed(episode, start, place.box_23):
            continue
        made = Plan(place.about, start, end, place.box_23, place.move)
        changed = _changed(model, episode, made)
        if (changed >= CHANGED_SHARE[kind]).sum() >= CHANGED_FRAMES:
            return dataclasses.replace(made, changed_T=changed)
    return None


def _changed(model: Any, episode: Episode, plan: Plan) -> np.ndarray:
    """Return the share of the pixels that an edit changes in each frame of its walk, (T,)."""
    recorded = episode.voxels([plan.start])
    grid = class_grid.ClassGrid(recorded.classes_TXYZ[0].astype(np.int16), recorded.origin_T3[0])
    change, *arguments = _change(plan)
    edited = change(model.memory, grid, *arguments)
    frames = range(plan.start + 1, plan.end + 1)

    def drawn(classes_XYZ: Any) -> np.ndarray:
        cells = VoxelFrames(
            np.broadcast_to(np.asarray(classes_XYZ), (len(frames), *classes_XYZ.shape)),
            np.broadcast_to(recorded.origin_T3, (len(frames), 3)),
            recorded.cell_m,
            recorded.names,
        )
        seen = draw_blocks(cells, episode.camera(frames), episode.height, episode.width)
        return seen.rgb_THWC.astype(int)

    off = np.abs(drawn(grid.classes_XYZ) - drawn(edited.classes_XYZ)).max(-1)
    return (off > CHANGED_LEVELS).mean((1, 2))


def _room_at(house: Mapping[str, Any], xy: np.ndarray) -> int:
    for number, (x0, y0, x1, y1) in enumerate(house["rooms"]):
        if x0 <= xy[0] <= x1 and y0 <= xy[1] <= y1:
            return number
    return -1  # in a doorway


def _places(house: Mapping[str, Any], kind: str, floor_z: float, cell_m: float) -> Iterator[_Place]:
    if kind == "chair":
        yield from _chairs(house, floor_z)
    elif kind == "door":
        for a, b, x0, y0, x1, y1 in house["doorways"]:
            # The leaf lies in the surface of the wall, so its cells may be those beside it.
            low = np.array([x0 - cell_m, y0 - cell_m, floor_z])
            high = np.array([x1 + cell_m, y1 + cell_m, floor_z + DOOR_TOP_M])
            along = int(y1 - y0 > x1 - x0)
            low[along] += 1.5 * cell_m
            high[along] -= 1.5 * cell_m
            middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, floor_z + 1.0])
            yield _Place((int(a), int(b)), middle, np.stack([low, high]), "the door is opened")
    else:
        yield from _walls(house, floor_z, cell_m)


def _chairs(house: Mapping[str, Any], floor_z: float) -> Iterator[_Place]:
    for node, (low, high) in object_boxes(int(house["seed"])).items():
        if kind_of(node) not in CHAIRS or "face" in node:
            continue
        box = np.stack([low - BESIDE_M, high + BESIDE_M])
        box[0, 2] = floor_z + 0.02
        room = int(node.removeprefix("room").split("-")[0])
        yield _Place((room,), box.mean(0), box, "the chair is removed")


def _walls(house: Mapping[str, Any], floor_z: float, cell_m: float) -> Iterator[_Place]:
    """Yield the walls of rooms without the corners; a wall's cells lie in front of its surface."""
    for number, rect in enumerate(house["rooms"]):
        for side in range(4):
            axis, far = side % 2, side // 2
            low, high = np.array([*rect[:2], floor_z + 0.02]), np.array([*rect[2:], floor_z + 3.0])
            inward = -1.0 if far else 1.0
            low[axis] = high[axis] = rect[axis + 2 * far]
            # The cell that contains the surface may begin up to a cell before it.
            low[axis] -= cell_m
            high[axis] += cell_m
            other = 1 - axis
            low[other] += 2 * cell_m
            high[other] -= 2 * cell_m
            if high[other] - low[other] < 1.0:
                continue
            move = np.eye(4)
            move[axis, 3] = inward * MOVED_M
            middle = np.array([(rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2, floor_z + 1.25])
            middle[axis] = rect[axis + 2 * far]
            yield _Place((number,), middle, np.stack([low, high]), "the wall is moved by 1 m", move)


def _walk_to(
    episode: Episode,
    place: _Place,
    path_T3: np.ndarray,
    not_from_T: np.ndarray,
    inside_T: np.ndarray,
) -> tuple[int, int] | None:
    """Return the frame at which to edit and the last one: the first walk that shows the place.

    ``not_from_T`` is true at frames at which the place may not be edited. ``inside_T`` is true at
    those in its rooms, from which it must be seen: the back of a wall belongs to another room.
    """
    for seen in (np.flatnonzero(inside_T[1:-1]) + 1).tolist():
        if not _in_view(episode, seen, place.point_3):
            continue
        for start in range(max(seen - LONGEST, 0), seen):
            near = np.abs(place.point_3 - path_T3[start])[:2].max() <= REACH_M
            if near and not not_from_T[start] and not _is_shown(episode, start, place.point_3):
                return start, min(seen + AFTER, episode.length - 1)
    return None


def _in_view(episode: Episode, frame: int, point_3: np.ndarray) -> bool:
    """Return whether a frame shows a point near the middle of the image, from nearby."""
    x, _, z = _seen_from(episode, frame, point_3)
    return NEAR_M <= z <= FAR_M and abs(x) <= ASIDE * z and _is_shown(episode, frame, point_3)


def _is_shown(episode: Episode, frame: int, point_3: np.ndarray) -> bool:
    """Return whether a point is in a frame's image and nothing stands before it."""
    x, y, z = _seen_from(episode, frame, point_3)
    if z <= 0:
        return False
    fx, fy, cx, cy = episode.intrinsics_4
    column, row = np.floor([x / z * fx + cx, y / z * fy + cy])
    if not (0 <= column < episode.width and 0 <= row < episode.height):
        return False
    depth = episode.frames([frame]).depth_THW[0, int(row), int(column)]
    return bool(abs(depth - z) < AGREES_M)


def _seen_from(episode: Episode, frame: int, point_3: np.ndarray) -> np.ndarray:
    """Return a point in the coordinates of a frame's camera, metres."""
    pose = np.asarray(episode.world_from_camera[frame], np.float64)
    return (point_3 - pose[:3, 3]) @ pose[:3, :3]


def _is_clear(place: _Place, path_T3: np.ndarray) -> bool:
    """Return whether a moved wall stays away from the walk, on the side of its room."""
    assert place.move is not None
    box = place.box_23 + place.move[:3, 3]
    away = np.maximum(np.maximum(box[0] - path_T3, path_T3 - box[1]), 0)[:, :2]
    return bool(np.linalg.norm(away, axis=-1).min() >= CLEAR_M)


def _is_closed(episode: Episode, frame: int, box_23: np.ndarray) -> bool:
    """Return whether the recorded grid of a frame has a door's leaf in a box."""
    grid = episode.voxels([frame])
    doors = [name.partition("/")[0] == "door" for name in grid.names]
    at = np.floor((box_23 - grid.origin_T3[0]) / grid.cell_m).astype(int)
    (x0, y0, z0), (x1, y1, z1) = np.clip(at, 0, grid.classes_TXYZ.shape[1])
    cells = grid.classes_TXYZ[0, x0 : x1 + 1, y0 : y1 + 1, z0 : z1 + 1]
    return bool(np.array(doors)[cells].sum() >= 12)
