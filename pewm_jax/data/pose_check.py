"""Compare distant frames of a recording by reprojection, to see a wrong pose convention.

The points of one frame are moved into another and compared with the depth there. The median of the
difference is insensitive to occlusion. The same is done with other conventions of the poses: if one
of them fits much better, the convention of the recording is probably that one.
"""

from __future__ import annotations

import dataclasses
import itertools
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from pewm_jax.data.checks import depth_between
from pewm_jax.data.fit import turn_poses
from pewm_jax.io import atomic

KEPT = 16
"""Frames that are compared, spread over the first sequences."""
PAIRS = 6
"""Pairs of frames that are drawn and measured."""
SIDE = 240
"""Largest height or width of an image that is compared, pixels."""
LEAST_OVERLAP = 0.15
"""Smallest share of points of one frame that fall into the other."""
LARGE = 0.03
"""A median error above this share of the depth is reported as large."""
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CONVENTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "inverted poses (world-to-camera; --invert-poses)": np.linalg.inv,
    "cameras with y up and z backward (--camera-axes opengl)": lambda pose: pose @ _FLIP,
    "both": lambda pose: np.linalg.inv(pose) @ _FLIP,
}
"""What else the poses may be → the correction of one read as camera-to-world, OpenCV axes."""


@dataclasses.dataclass(frozen=True)
class _Kept:
    pose_44: np.ndarray
    world_44: np.ndarray
    turn_44: np.ndarray
    intrinsics_4: np.ndarray
    rgb_HWC: np.ndarray
    depth_HW: np.ndarray

    def under(self, convert: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the pose if those of the files had another convention."""
        in_file = np.linalg.inv(self.world_44) @ self.pose_44 @ np.linalg.inv(self.turn_44)
        return self.world_44 @ convert(in_file) @ self.turn_44


@dataclasses.dataclass(frozen=True)
class _Pair:
    """Two frames: points of the first in the second, the difference of depth there in metres."""

    first: int
    second: int
    error_m: float
    share: float


class PoseCheck:
    """Keeps some frames of an import and compares them; may be called by several threads."""

    def __init__(self) -> None:
        self._kept: list[_Kept] = []
        self._room, self._lock, self._asked = KEPT, threading.Lock(), False

    def choose(self, numbers: Sequence[int]) -> set[int]:
        """Return which frames of the next episode to pass to ``add``; only the first ones count."""
        count, self._room, self._asked = min(self._room, len(numbers)), 0, True
        return {numbers[round(k)] for k in np.linspace(0, len(numbers) - 1, count)}

    def add(
        self,
        pose_44: np.ndarray,
        intrinsics_4: np.ndarray,
        bgr: np.ndarray,
        depth: np.ndarray,
        *,
        world_44: np.ndarray,
        turns: int = 0,
    ) -> None:
        """Keep a frame: camera-to-world pose, intrinsics, colours and depth (H, W) in metres.

        ``world_44`` is the rotation from the recording's world to ours, ``turns`` are the quarter
        turns clockwise of the images.
        """
        step = max(1, -(-max(depth.shape) // SIDE))
        first = step // 2 + 0.5
        small = np.asarray(intrinsics_4, np.float64) / step
        small[2:] += 0.5 - first / step
        cut = (slice(step // 2, None, step),) * 2
        turn = turn_poses(np.eye(4)[None], turns)[0]
        images = bgr[cut][..., ::-1].copy(), depth[cut].copy()
        one = _Kept(np.array(pose_44), world_44, turn, small, *images)
        with self._lock:
            self._kept.append(one)

    def report(self, path: Path, log: Callable[[str], None]) -> None:
        """Draw pairs of distant frames to a PNG file, and print the error and what fits better."""
        if not self._asked:
            log("check: no frame was read, so poses cannot be checked; repeat with --overwrite.")
            return
        if not self._kept:
            log("check: there is no depth to reproject, so poses cannot be checked.")
            return
        poses = [one.pose_44 for one in self._kept]
        pairs = self._pairs(poses)
        if not pairs:
            log("check: no two of the frames looked at overlap, so poses cannot be checked.")
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn = np.vstack([self._draw(pair) for pair in pairs])
        done, code = cv2.imencode(".png", drawn[..., ::-1])
        assert done
        atomic.write_bytes(path, code.tobytes())
        metres, share = _median(pairs)
        log(
            f"check: reprojection between {len(pairs)} pairs of distant frames: median error "
            f"{100 * metres:.2g} cm, {share:.2%} of the depth; drawn in {path}."
        )
        if share <= LARGE:
            return
        log(
            "check: the error is large: the poses, the intrinsics or the depth scale do not fit "
            "the images."
        )
        for name, convert in CONVENTIONS.items():
            other = self._pairs([one.under(convert) for one in self._kept])
            if len(other) >= min(3, len(pairs)) and _median(other)[1] < share / 2:
                metres, other_share = _median(other)
                log(
                    f"check: with {name} it is {100 * metres:.2g} cm, {other_share:.2%}: that "
                    "fits better."
                )

    def _pairs(self, poses: Sequence[np.ndarray]) -> list[_Pair]:
        """Return the pairs with most motion between them that overlap, best first."""
        far = [
            (float(np.linalg.norm(poses[i][:3, 3] - poses[j][:3, 3])), i, j)
            for i, j in itertools.permutations(range(len(poses)), 2)
        ]
        found: list[_Pair] = []
        for _, i, j in sorted(far, reverse=True):
            pair = self._compare(poses, i, j)
            if pair is not None:
                found.append(pair)
            if len(found) == PAIRS:
                break
        return found

    def _compare(self, poses: Sequence[np.ndarray], i: int, j: int) -> _Pair | None:
        """Move the points of frame i into frame j; None if few of them are in its image."""
        one, other = self._kept[i], self._kept[j]
        points = _points(one)
        local = (np.linalg.inv(poses[j]) @ poses[i] @ points.T)[:3].T
        z = local[:, 2]
        u, v = _pixels(local, other.intrinsics_4)
        height, width = other.depth_HW.shape
        u, v = u - 0.5, v - 0.5
        inside = (z > 0.05) & (u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1)
        seen, known = depth_between(other.depth_HW, u[inside], v[inside])
        if known.sum() < max(20, LEAST_OVERLAP * len(points)):
            return None
        error = np.abs(z[inside][known] - seen[known])
        return _Pair(i, j, float(np.median(error)), float(np.median(error / seen[known])))

    def _draw(self, pair: _Pair) -> np.ndarray:
        """Return a row: both frames, the first moved into the second, and the two mixed."""
        one, other = self._kept[pair.first], self._kept[pair.second]
        points = _points(other)
        local = (np.linalg.inv(one.pose_44) @ other.pose_44 @ points.T)[:3].T
        u, v = _pixels(local, one.intrinsics_4)
        height, width = one.depth_HW.shape
        inside = (local[:, 2] > 0.05) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        moved = np.zeros_like(other.rgb_HWC)
        rows, columns = np.nonzero(other.depth_HW > 0)
        moved[rows[inside], columns[inside]] = one.rgb_HWC[
            v[inside].astype(int), u[inside].astype(int)
        ]
        mixed = np.where(moved.any(-1, keepdims=True), moved // 2 + other.rgb_HWC // 2, 0)
        first = cv2.resize(one.rgb_HWC, other.rgb_HWC.shape[1::-1])
        row = np.hstack([first, other.rgb_HWC, moved, mixed.astype(np.uint8)])
        return cv2.copyMakeBorder(row, 0, 4, 0, 0, cv2.BORDER_CONSTANT, value=(255, 255, 255))


def _points(one: _Kept) -> np.ndarray:
    """Return the measured points (N, 4) of a frame in its camera, homogeneous."""
    rows, columns = np.nonzero(one.depth_HW > 0)
    z = one.depth_HW[rows, columns].astype(np.float64)
    fx, fy, cx, cy = one.intrinsics_4
    return np.stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z, 0 * z + 1], -1)


def _pixels(local_N3: np.ndarray, intrinsics_4: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of points in an image, −1 for those behind the camera."""
    fx, fy, cx, cy = intrinsics_4
    safe = np.where(local_N3[:, 2] > 0.05, local_N3[:, 2], np.inf)
    ahead = np.isfinite(safe)
    u = np.where(ahead, local_N3[:, 0] / safe * fx + cx, -1.0)
    v = np.where(ahead, local_N3[:, 1] / safe * fy + cy, -1.0)
    return u, v


def _median(pairs: Sequence[_Pair]) -> tuple[float, float]:
    """Return the median error of pairs in metres and as a share of the depth."""
    metres, shares = ([getattr(pair, name) for pair in pairs] for name in ("error_m", "share"))
    return float(np.median(metres)), float(np.median(shares))
