"""What a hand-held depth camera records of a walk: other views than a robot's, and errors.

A hand-held camera has its own field of view and height, and its pitch and roll change slowly. Its
recording has errors of the sizes that structured light and time-of-flight cameras have with poses
from tracking: noise of depth that grows with its square, missing depth at edges and beyond a range,
depth that is displaced against colour, poses that drift and jitter, exposure that drifts, and noise
of colour. Each recording draws how large its errors are, up to the constants below.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from pewm_jax.errors import UserError

HFOV_DEG = 55.0, 100.0
"""Smallest and largest horizontal field of view."""
LOWER_M = 0.4
"""How far, at most, the camera is below its usual height."""
PITCH_DEG, ROLL_DEG = 12.0, 4.0
"""Deviations of pitch and roll."""
SLOW = 8
"""Frames over which pitch, roll and drifts are correlated."""

QUADRATIC = 0.003
"""Largest deviation of depth at 1 m, metres; it grows with z²."""
BROAD = 4
"""Pixels over which most of the noise of depth is correlated."""
EDGE, EDGE_LOST = 0.1, 0.7
"""Relative difference of neighbouring depths that is an edge, and largest share lost there."""
RANGE_M = 3.5, 10.0
"""Smallest and largest range of a sensor; beyond it depth is missing."""
SHIFT = 0.015
"""Largest displacement of depth against colour, as a share of the image's width."""
DRIFT_DEG, DRIFT_M = 0.6, 0.015
"""Largest deviations of the slow errors of poses; their jitter is a third of it."""
GAIN, BIAS = 0.08, 0.02
"""Largest deviations of the logarithm of a frame's exposure, and of its bias, of colours in [0, 1].
"""
GRAIN = 0.02
"""Largest deviation of the noise of colours in [0, 1]."""

ERRORS = ("exposure", "grain", "noise", "edges", "range", "shift", "poses")
"""Kinds of errors: drift of exposure, noise of colour; noise of depth, depth missing at edges and
beyond a range, depth displaced against colour; errors of poses."""


@dataclasses.dataclass(frozen=True)
class Recorded:
    """T frames as recorded: colours uint8, depth in metres (0 where missing), camera-to-world."""

    rgb_THWC: np.ndarray
    depth_THW: np.ndarray
    pose_T44: np.ndarray


def slow_noise(rng: np.random.Generator, frames: int, columns: int) -> np.ndarray:
    """Return (T, columns) noise of deviation 1 that changes slowly."""
    noise = rng.normal(size=(frames + 8 * SLOW, columns))
    smooth = ndimage.gaussian_filter1d(noise, SLOW, axis=0)[4 * SLOW :][:frames]
    return smooth * np.sqrt(2 * SLOW * np.sqrt(np.pi))


def tilts(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Return rotations (T, 3, 3) of a camera about its own x axis (pitch) and z axis (roll)."""
    angles_T2 = slow_noise(rng, frames, 2) * (PITCH_DEG, ROLL_DEG)
    return Rotation.from_euler("xz", angles_T2, degrees=True).as_matrix().astype(np.float32)


def record(
    rng: np.random.Generator | None,
    rgb_THWC: np.ndarray,
    depth_THW: np.ndarray,
    pose_T44: np.ndarray,
    errors: Collection[str] = ERRORS,
) -> Recorded:
    """Return frames with the errors of a recording.

    Args:
        rng: all that the errors depend on; None for a recording without errors.
        rgb_THWC: (T, H, W, 3) uint8 true colours.
        depth_THW: (T, H, W) true depth, metres; 0 where there is no surface.
        pose_T44: (T, 4, 4) true camera-to-world.
        errors: kinds that it has, of ``ERRORS``; one kind is the same whatever the others are.

    Raises:
        UserError: an unknown kind of error.
    """
    if unknown := set(errors) - set(ERRORS):
        raise UserError(f"errors has {min(unknown)!r}: use some of {', '.join(ERRORS)}.")
    if rng is None:
        return Recorded(rgb_THWC, depth_THW, pose_T44)
    frames = len(pose_T44)
    colours = rgb_THWC / 255.0
    exposure_T2 = slow_noise(rng, frames, 2) * rng.uniform(0, 1, 2) * (GAIN, BIAS)
    if "exposure" in errors:
        colours = colours * np.exp(exposure_T2[:, :1, None, None]) + exposure_T2[:, 1:, None, None]
    grain = rng.normal(size=colours.shape) * rng.uniform(0, GRAIN)
    colours += grain * ("grain" in errors)
    depth = _measured(rng, depth_THW, errors)
    moved = _pose_errors(rng, frames)
    return Recorded(
        np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8),
        depth,
        (pose_T44 @ moved if "poses" in errors else pose_T44).astype(np.float32),
    )


def _measured(
    rng: np.random.Generator, depth_THW: np.ndarray, errors: Collection[str]
) -> np.ndarray:
    """Return depth as measured, metres, 0 where missing."""
    shape, width = depth_THW.shape, depth_THW.shape[-1]
    size = rng.uniform(0, QUADRATIC)
    broad = ndimage.gaussian_filter(rng.normal(size=shape), (0, BROAD, BROAD))
    broad *= 2 * BROAD * np.sqrt(np.pi)  # deviation 1
    noise = size * depth_THW**2 * (broad + 0.3 * rng.normal(size=shape))
    farthest = ndimage.maximum_filter(depth_THW, (0, 3, 3))
    nearest = ndimage.minimum_filter(depth_THW, (0, 3, 3))
    edge = farthest - nearest > EDGE * np.maximum(nearest, 1e-3)
    lost = edge & (rng.random(shape) < rng.uniform(0, EDGE_LOST)) & ("edges" in errors)
    far = (depth_THW > rng.uniform(*RANGE_M)) & ("range" in errors)
    measured = np.where(lost | far, 0, depth_THW + noise * ("noise" in errors))
    moved = np.rint(rng.uniform(-SHIFT, SHIFT, 2) * width).astype(int) * ("shift" in errors)
    rows, columns = (
        np.clip(np.arange(side) - by, 0, side - 1)
        for side, by in zip(shape[1:], moved, strict=True)
    )
    return np.maximum(measured[:, rows][:, :, columns], 0).astype(np.float32)


def _pose_errors(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Return (T, 4, 4) errors of poses, in the cameras' own axes."""
    size_2 = rng.uniform(0, 1, 2).repeat(3) * np.repeat((DRIFT_DEG, DRIFT_M), 3)
    errors_T6 = (slow_noise(rng, frames, 6) + rng.normal(size=(frames, 6)) / 3) * size_2
    made = np.tile(np.eye(4), (frames, 1, 1))
    made[:, :3, :3] = Rotation.from_rotvec(errors_T6[:, :3], degrees=True).as_matrix()
    made[:, :3, 3] = errors_T6[:, 3:]
    return made
