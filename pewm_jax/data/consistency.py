"""Check that depth images, poses and intrinsics of an episode describe the same world.

A surface that one frame sees, moved into another frame, may be hidden there behind something, but
it cannot float in front of what that frame sees. Wrong intrinsics, wrong axes, inverted poses, a
trajectory of other frames and a wrong depth scale all make points float.

Right data has 0 to 2 % of floating points (made houses, ICL-NUIM). Focal lengths wrong by 20 % give
14 % and more, a depth scale wrong by a factor of two 37 % and more, inverted poses 22 % and more.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pewm_jax.data.episodes import Episode

FLOATING = 0.05
"""A point floats if its depth is smaller than the other frame's by more than this fraction."""
MOST_FLOATING = 0.08
"""Largest share of floating points, averaged over pairs of frames of one kind, in images of
``LIMIT_SIDE`` pixels and more. Smaller ones are mostly edges: right data has up to 3 % at 32
pixels, 7 % at 24 and 17 % at 16, so the limit grows as the side shrinks."""
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
    """The pair of frames that fits worst.

    Attributes:
        first: the frame whose points were moved.
        second: the frame they were moved into.
        floating: share of its points that float, over all pairs of this kind.
    """

    first: int
    second: int
    floating: float


def find_disagreement(episode: Episode, depth_THW: np.ndarray) -> Disagreement | None:
    """Return where depth and cameras disagree, or None where they agree or nothing overlaps.

    Args:
        episode: gives poses and intrinsics; they must be finite and rigid.
        depth_THW: all its depths in metres.
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
    """Return the share of one frame's points that float in another; None where too few overlap."""
    height, width = depth_THW.shape[1:]
    fx, fy, cx, cy = np.asarray(episode.intrinsics_4, np.float64)
    pose = np.asarray(episode.world_from_camera, np.float64)
    step = max(1, int(np.sqrt(height * width / SAMPLES)))
    v, u = np.mgrid[0:height:step, 0:width:step]
    z = depth_THW[first][v, u].astype(np.float64)
    seen = z > 0
    u, v, z = u[seen] + 0.5, v[seen] + 0.5, z[seen]
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], -1)
    world = points @ pose[first, :3, :3].T + pose[first, :3, 3]
    local = (world - pose[second, :3, 3]) @ pose[second, :3, :3]
    z = local[:, 2]
    safe = np.where(z > 0.1, z, 1.0)
    u, v = local[:, 0] / safe * fx + cx - 0.5, local[:, 1] / safe * fy + cy - 0.5
    inside = (z > 0.1) & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    other, smooth = _depth_between(depth_THW[second], u[inside], v[inside])
    if smooth.sum() < max(20, LEAST_OVERLAP * len(points)):
        return None
    return float((z[inside][smooth] < (1 - FLOATING) * other[smooth]).mean())


def _depth_between(
    depth_HW: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate depth between pixels: 1/z is linear on a plane, so this is exact there.

    Returns:
        depths, and where they can be trusted (no edge, no missing measurement).
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
    """Choose pairs over the whole episode: those that move most, both ways, and that turn most."""
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
        # An agent that walks forward sees too large depths recede, not float: look back as well.
        groups.append([(j, i) for i, j in groups[-2]])
    return groups
