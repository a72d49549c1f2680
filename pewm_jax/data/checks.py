"""Checks of a single episode: cameras, actions, depth, voxels, and whether they agree.

``find_disagreement`` checks that depth images, poses and intrinsics describe the same world. A
surface point seen in one frame and transformed into another may be occluded there, but it cannot
float in front of that frame's surfaces. Wrong intrinsics, wrong axes, inverted poses, a trajectory
of other frames and a wrong depth scale all make points float.

Correct data has 0 to 2 % of floating points (generated houses, ICL-NUIM). Focal lengths that are
wrong by 20 % give 14 % and more, a depth scale wrong by a factor of two 37 % and more, inverted
poses 22 % and more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.episodes import SATURATED, Episode
from pewm_jax.data.voxels import LOOKS, disagreement, measured_points, off_lattice, outside
from pewm_jax.geometry.actions import PLANAR

MEDIAN_DEPTH_M = (0.05, 40.0)
"""Plausible median depths, metres; a recording outside this range has a wrong unit."""
MOST_MISSING = 0.97
"""Largest allowed share of pixels without depth."""
ORTHONORMAL = 1e-3
"""Largest allowed entry of |RᵀR − 1|."""
ACTION_M, ACTION_RAD = 2e-3, 2e-3
"""Largest allowed difference between an action and the motion between its two poses."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """A problem of an episode: file and record, frame (None: all), field, sentence."""

    where: str
    frame: int | None
    field: str
    what: str

    def __str__(self) -> str:
        frame = "" if self.frame is None else f", frame {self.frame}"
        return f"{self.where}{frame}, {self.field}: {self.what}"


Found = Iterator[tuple[int | None, str]]
"""Problems of one field: the number of the frame (None: all) and the sentence."""


def check_episode(episode: Episode, where: str) -> list[Problem]:
    """Return all problems of an episode; the cheap checks come first. All images are decoded.

    Args:
        episode: the episode to check.
        where: its file and record, for the messages.
    """
    try:
        depth_THW = episode.frames().depth_THW
        if episode.has_ids:
            episode.ids()
    except UserError as error:
        return [*check_motion(episode, None, where), Problem(where, None, "images", str(error))]
    saturated = list(_check_saturation(episode, depth_THW))
    usable = episode.has_depth and not saturated
    found = check_motion(episode, depth_THW if usable else None, where)
    if episode.has_depth:
        cells = _check_voxels(episode, depth_THW)
        found += [Problem(where, frame, "voxels", what) for frame, what in cells]
        found += [Problem(where, frame, "depth", what) for frame, what in saturated]
    return found


def check_motion(episode: Episode, depth_THW: np.ndarray | None, where: str) -> list[Problem]:
    """Check cameras and actions, and whether depth (T, H, W), if there is any, agrees with them.

    The images of the episode are not decoded; the intrinsics are those of ``depth_THW``.
    """
    found: list[Problem] = []

    def add(field: str, problems: Iterable[tuple[int | None, str]]) -> None:
        found.extend(Problem(where, frame, field, what) for frame, what in problems)

    add("intrinsics", _check_intrinsics(episode))
    add("world_from_camera", _check_poses(episode))
    posed = episode.info.get("poses") != "unknown"
    if posed:
        add("actions", _check_actions(episode))
    add("states", _check_states(episode))
    if depth_THW is None:
        return found
    add("depth", _check_units(depth_THW))
    moves = episode.info.get("moving") or episode.info.get("body")
    if not found and posed and not moves:
        # Wrong poses or units would only be reported again.
        add("depth", _check_geometry(episode, depth_THW))
    return found


def _check_voxels(episode: Episode, depth_THW: np.ndarray) -> Found:
    """Check that the grids decode, lie on one lattice, contain the camera, and match the depth."""
    try:
        grid, origin_T3 = episode.voxel_grid, episode.voxel_origin_T3
        if grid is None or origin_T3 is None:
            return
        for frame in range(episode.length):  # one at a time, because grids may be large
            episode.voxels([frame])
    except UserError as error:
        yield None, str(error)
        return
    for frame, off in off_lattice(origin_T3, grid.cell_m):
        yield frame, f"the grid's corner is {off:.3g} cells off the lattice of frame 0."
        return
    for frame in outside(origin_T3, grid, episode.world_from_camera[:, :3, 3]):
        what = "origins must be in metres, in the world of the poses."
        yield frame, f"the camera is not in the grid: {what}"
        return
    looks = np.unique(np.linspace(0, episode.length - 1, LOOKS).round().astype(int))
    worst = disagreement(episode.voxels(looks), depth_THW[looks], episode.camera(looks))
    if worst is not None:
        what = (
            f"disagrees with the depth: {worst[1]:.0%} of the points that the camera sees in the "
            "grid have only empty cells around them; check the order of the axes, the origins "
            "and the cell."
        )
        yield int(looks[worst[0]]), what


def check_depth(depth_THW: np.ndarray, where: str) -> list[Problem]:
    """Check that depths (T, H, W) are plausible in metres and not mostly missing."""
    return [Problem(where, frame, "depth", what) for frame, what in _check_units(depth_THW)]


def _check_units(depth_THW: np.ndarray) -> Found:
    valid = depth_THW[np.isfinite(depth_THW) & (depth_THW > 0)]
    bad = np.flatnonzero(~np.isfinite(depth_THW).all((1, 2)))
    if len(bad):
        yield int(bad[0]), "contains values that are not finite."
        return
    median = float(np.median(valid)) if len(valid) else 0.0
    if len(valid) and not _plausible(median):
        frame = _first_frame(depth_THW, median < MEDIAN_DEPTH_M[0])
        yield frame, _wrong_unit("the recording", median)
        return
    missing = float((depth_THW <= 0).mean())
    if missing > MOST_MISSING:
        what = (
            f"{missing:.0%} of the pixels have no depth (0, saturated, or beyond the largest depth "
            "stored): the unit is wrong or the depth images are empty; correct the depth scale."
        )
        yield None, what
        return
    for frame, image in enumerate(depth_THW):
        seen = image[image > 0]
        if len(seen) > (1 - MOST_MISSING) * image.size and not _plausible(np.median(seen)):
            yield frame, _wrong_unit("this frame", float(np.median(seen)))
            return


def _check_saturation(episode: Episode, depth_THW: np.ndarray) -> Found:
    """Check that no stored depth has the saturated value, which marks missing depth."""
    saturated = depth_THW > (SATURATED - 0.5) / episode.depth_per_metre
    if saturated.any():
        what = (
            f"{saturated.mean():.1%} of the episode's pixels hold the saturated value {SATURATED}, "
            "which is not a measurement: import the recording again with --overwrite, which stores "
            "0 there, or store 0 there yourself."
        )
        yield int(np.flatnonzero(saturated.any((1, 2)))[0]), what


def _plausible(median: float) -> bool:
    return MEDIAN_DEPTH_M[0] <= median <= MEDIAN_DEPTH_M[1]


def _wrong_unit(subject: str, median: float) -> str:
    small = median < MEDIAN_DEPTH_M[0]
    wrong = "metres were read as millimetres" if small else "the scale is too small"
    return (
        f"the median depth of {subject} is {median:.3g} m: the unit is wrong ({wrong}?); correct "
        "the depth scale."
    )


def _first_frame(depth_THW: np.ndarray, small: bool) -> int:
    low, high = MEDIAN_DEPTH_M
    for index, image in enumerate(depth_THW):
        seen = image[image > 0]
        if len(seen) and ((np.median(seen) < low) if small else (np.median(seen) > high)):
            return index
    return 0


def _check_geometry(episode: Episode, depth_THW: np.ndarray) -> Found:
    worst = find_disagreement(episode, depth_THW)
    if worst is not None:
        what = (
            f"disagrees with the poses: {worst.floating:.0%} of the points that frames such as "
            f"{worst.first} see float in front of the surfaces that this frame sees; check the "
            "intrinsics, the depth scale, the axes of the camera and the direction of the poses."
        )
        yield worst.second, what


def _check_intrinsics(episode: Episode) -> Found:
    fx, fy, cx, cy = (float(value) for value in episode.intrinsics_4)
    if not np.isfinite(episode.intrinsics_4).all() or min(fx, fy) <= 0:
        yield None, f"({fx}, {fy}, {cx}, {cy}) must be finite, with fx and fy above 0."
    elif not (0 < cx < episode.width and 0 < cy < episode.height):
        what = (
            f"the principal point ({cx:.1f}, {cy:.1f}) lies outside the "
            f"{episode.width}×{episode.height} image: the intrinsics belong to another image size."
        )
        yield None, what


def _check_poses(episode: Episode) -> Found:
    pose = np.asarray(episode.world_from_camera, np.float64)
    for frame in np.flatnonzero(~np.isfinite(pose).all((1, 2)))[:1]:
        yield int(frame), "contains NaN or infinity."
        return
    rotation = pose[:, :3, :3]
    off = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max((1, 2))
    mirrored = np.linalg.det(rotation) < 0
    bottom = np.abs(pose[:, 3] - [0, 0, 0, 1]).max(1)
    for frame in np.flatnonzero((off > ORTHONORMAL) | mirrored | (bottom > 1e-6))[:1]:
        what = f"the rotation is not orthonormal (off by {off[frame]:.2g})"
        if mirrored[frame] and off[frame] <= ORTHONORMAL:
            what = "the rotation is a mirror image (determinant −1)"
        if bottom[frame] > 1e-6:
            what = "the last row is not (0, 0, 0, 1)"
        yield int(frame), f"{what}: it must be a rigid transform."


def _check_states(episode: Episode) -> Found:
    if episode.states is None:
        return
    for frame in np.flatnonzero(~np.isfinite(episode.states).all(1))[:1]:
        yield int(frame), "contains NaN or infinity."


def _check_actions(episode: Episode) -> Found:
    actions = episode.actions
    if actions is None:
        return
    for frame in np.flatnonzero(~np.isfinite(actions).all(1))[:1]:
        yield int(frame), "contains NaN or infinity."
        return
    if actions.shape[1] != PLANAR or episode.info.get("handheld"):
        return  # the motion of other controls is unknown; poses of hand-held cameras are measured
    metres, radians = action_errors(episode.world_from_camera, actions)
    for frame in np.flatnonzero((metres > ACTION_M) | (radians > ACTION_RAD))[:1]:
        what = (
            f"the action ends {metres[frame]:.3g} m and {np.degrees(radians[frame]):.3g} degrees "
            f"away from the pose of frame {frame + 1}: actions and poses disagree."
        )
        yield int(frame), what


def action_errors(
    world_from_camera: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far actions (T − 1, 3) end from the poses (T, 4, 4) of the next frames.

    Returns:
        (T − 1,) distances in metres and (T − 1,) angles in radians.
    """
    pose = np.asarray(world_from_camera, np.float64)
    before, after = pose[:-1], pose[1:]
    yaw = np.arctan2(before[:, 1, 2], before[:, 0, 2])
    dx, dy, turn = np.asarray(actions, np.float64).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    moved = before[:, :3, 3] + np.stack([cos * dx - sin * dy, sin * dx + cos * dy, 0 * dx], -1)
    turned = np.zeros((len(turn), 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(turn)
    turned[:, 1, 0], turned[:, 0, 1], turned[:, 2, 2] = np.sin(turn), -np.sin(turn), 1
    between = np.swapaxes(turned @ before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    # Use the chord: the arc cosine of the trace is inaccurate for small angles.
    chord = np.linalg.norm(between - np.eye(3), axis=(1, 2)) / np.sqrt(8)
    return np.linalg.norm(after[:, :3, 3] - moved, axis=1), 2 * np.arcsin(np.minimum(chord, 1))


FLOATING = 0.05
"""A point floats if its depth is smaller than the other frame's by more than this fraction."""
MOST_FLOATING = 0.08
"""Largest allowed share of floating points, averaged over pairs of frames of one kind, in images of
``LIMIT_SIDE`` pixels and more. Smaller images consist mostly of edges: correct data has up to 3 %
at 32 pixels, 7 % at 24 and 17 % at 16, so the limit grows as the side shrinks."""
LIMIT_SIDE = 40
STRIDES = (1, 3, 6, 12)
PAIRS = 6
"""Pairs compared per stride and kind of motion."""
FEWEST_PAIRS = 3
LEAST_OVERLAP = 0.05
SAMPLES = 4096
"""Pixels compared per pair, approximately."""
_WIDEST_TURN = np.radians(60)


@dataclasses.dataclass(frozen=True)
class Disagreement:
    """The pair of frames that disagrees most: points of the first were moved into the second.

    ``floating`` is the share of points that float, over all pairs of this kind.
    """

    first: int
    second: int
    floating: float


def find_disagreement(episode: Episode, depth_THW: np.ndarray) -> Disagreement | None:
    """Return where depths (T, H, W) and finite, rigid cameras disagree.

    None if they agree or nothing overlaps.
    """
    worst: Disagreement | None = None
    most = MOST_FLOATING * max(1.0, LIMIT_SIDE / min(depth_THW.shape[1:]))
    for pairs in _pairs(np.asarray(episode.world_from_camera, np.float64)):
        shares = [(share_floating(episode, depth_THW, i, j), i, j) for i, j in pairs]
        known = [(share, i, j) for share, i, j in shares if share is not None]
        if len(known) < FEWEST_PAIRS:
            continue
        mean = float(np.mean([share for share, _, _ in known]))
        if mean > most and (worst is None or mean > worst.floating):
            _, i, j = max(known)
            worst = Disagreement(i, j, mean)
    return worst


def share_floating(
    episode: Episode, depth_THW: np.ndarray, first: int, second: int
) -> float | None:
    """Return the share of one frame's points that float in another; None if too few overlap."""
    height, width = depth_THW.shape[1:]
    fx, fy, cx, cy = np.asarray(episode.intrinsics_4, np.float64)
    pose = np.asarray(episode.world_from_camera, np.float64)
    step = max(1, int(np.sqrt(height * width / SAMPLES)))
    points, _ = measured_points(depth_THW[first], episode.intrinsics_4, pose[first], step)
    local = (points - pose[second, :3, 3]) @ pose[second, :3, :3]
    z = local[:, 2]
    safe = np.where(z > 0.1, z, 1.0)
    u, v = local[:, 0] / safe * fx + cx - 0.5, local[:, 1] / safe * fy + cy - 0.5
    inside = (z > 0.1) & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    other, smooth = depth_between(depth_THW[second], u[inside], v[inside])
    if smooth.sum() < max(20, LEAST_OVERLAP * len(points)):
        return None
    return float((z[inside][smooth] < (1 - FLOATING) * other[smooth]).mean())


def depth_between(
    depth_HW: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate depth between pixels, and return where it is reliable (no edge, no hole).

    1/z is linear on a plane, so this is exact there.
    """
    u0, v0 = u.astype(int), v.astype(int)
    corners = np.stack([depth_HW[v0 + b, u0 + a] for b in (0, 1) for a in (0, 1)])
    low = corners.min(0)
    smooth = (low > 0) & (corners.max(0) < 1.05 * low)
    a, b = u - u0, v - v0
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    inverse = (weights / np.where(corners > 0, corners, 1.0)).sum(0)
    return 1 / np.maximum(inverse, 1e-9), smooth


def _pairs(pose_T44: np.ndarray) -> list[list[tuple[int, int]]]:
    """Choose pairs over the whole episode: with the most motion (both directions) or rotation."""
    groups = []
    for stride in STRIDES:
        first = np.arange(len(pose_T44) - stride)
        if len(first) == 0:
            continue
        before, after = pose_T44[:-stride], pose_T44[stride:]
        moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
        cosine = np.clip((before[:, :3, 2] * after[:, :3, 2]).sum(1), -1, 1)
        turned = np.arccos(cosine)
        fits = turned < _WIDEST_TURN
        for score in (np.where(fits, moved, -1), np.where(fits, turned, -1)):
            bins = np.array_split(first, min(PAIRS, len(first)))
            best = [int(part[np.argmax(score[part])]) for part in bins]
            groups.append([(i, i + stride) for i in best if fits[i]])
        # With an agent that walks forward, depths that are too large recede instead of floating:
        # compare the pairs in reverse as well.
        groups.append([(j, i) for i, j in groups[-2]])
    return groups
