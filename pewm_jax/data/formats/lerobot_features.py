"""The features of a LeRobot data set, version 3: cameras, depth, pose, intrinsics, actions."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.episodes import SATURATED
from pewm_jax.geometry.cameras import pose_from_yaw

INFO = "meta/info.json"
STATE = "observation.state"
"""Name of the feature that holds the agent's own state."""
CODES = 4096
"""Number of depth codes; the lowest and the highest are no measurement."""
POSES = ("world_from_camera", "camera_to_world", "camera_pose", "pose")
"""Ends of the names of features that hold the camera's pose."""


class Features:
    """The features that ``info.json`` lists; UserError for a damaged file or another version."""

    def __init__(self, root: Path):
        self.root = root
        path = root / INFO
        try:
            self.info = json.loads(path.read_text("utf-8"))
            self.features: dict[str, dict[str, Any]] = dict(self.info["features"])
            self.fps = float(self.info["fps"])
            version = str(self.info["codebase_version"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path} does not have LeRobot's entries ({error!r}).") from None
        if not version.startswith("v3."):
            raise UserError(
                f"{path} has version {version}, and v3 is read: convert the data set with "
                "LeRobot's script convert_dataset_v21_to_v30."
            )
        self.action = "action" if "action" in self.features else None
        self.state = STATE if self._is_vector(STATE) else None

    def _is_vector(self, key: str) -> bool:
        """Tell whether a feature exists and has numbers along one axis."""
        return len(self.features.get(key, {}).get("shape") or []) == 1

    def is_video(self, key: str) -> bool:
        """Tell whether a feature is stored as a video."""
        return self.features[key]["dtype"] == "video"

    def _about(self, key: str) -> dict[str, Any]:
        own = self.features[key]
        return {**(own.get("video_info") or {}), **(own.get("info") or {})}

    def _is_depth(self, key: str) -> bool:
        about = self._about(key)
        return bool(about.get("is_depth_map") or about.get("video.is_depth_map"))

    def _images(self, depth: bool) -> list[str]:
        kinds = ("video", "image")
        keys = [key for key, own in self.features.items() if own.get("dtype") in kinds]
        return [key for key in keys if self._is_depth(key) == depth]

    def camera(self, wanted: str | None) -> str:
        """Return the feature of the colour images; ``wanted`` may be the end of its name."""
        known = self._images(depth=False)
        found = [k for k in known if wanted in (None, k) or k.endswith(f".{wanted}")]
        if not found:
            what = "has no colour images" if wanted is None else f"has no camera {wanted!r}"
            raise ConfigError(f"{self.root} {what}; its cameras are {', '.join(known) or 'none'}.")
        return found[0]

    def depth_of(self, camera: str) -> str | None:
        """Return the feature of a camera's depth: of the same name, or the only one of all."""
        known, only = self._images(depth=True), len(self._images(depth=False)) == 1
        name = camera.rpartition(".")[2]
        named = [key for key in known if self._owner(key) == name]
        return next(iter(named or (known if only else [])), None)

    def pose(self, wanted: str | None, camera: str) -> str | None:
        """Return the feature of a camera's pose, None if no name tells one."""
        if wanted is not None:
            if wanted not in self.features:
                raise ConfigError(
                    f"--pose {wanted}: {self.root} has no such feature; it has "
                    f"{', '.join(self.features)}."
                )
            return wanted
        for end in POSES:
            found = self._belonging(camera, [k for k in self._sized(7, 12, 16) if _ends(k, end)])
            if found:
                return found
        return None

    def intrinsics(self, camera: str) -> str | None:
        """Return the feature of a camera's intrinsics, 4 numbers or a matrix; or None."""
        return self._belonging(camera, [k for k in self._sized(4, 9) if "intrinsics" in k])

    def _sized(self, *sizes: int) -> list[str]:
        own = self.features.items()
        return [key for key, about in own if math.prod(about.get("shape") or [0]) in sizes]

    def _belonging(self, camera: str, keys: list[str]) -> str | None:
        """Return the key that has the camera's name in it, else one without another camera's."""
        own = [key for key in keys if self._owner(key) == camera.rpartition(".")[2]]
        return next(iter(own or [key for key in keys if not self._owner(key)]), None)

    def _owner(self, key: str) -> str:
        """Return the longest name of a camera that is in a feature's name, empty if none is."""
        names = [camera.rpartition(".")[2] for camera in self._images(depth=False)]
        return max((name for name in names if name in key.rpartition(".")[2]), key=len, default="")

    def fixed_intrinsics(self, camera: str) -> np.ndarray | None:
        """Return intrinsics that ``info.json`` has for a camera, or None."""
        values = self._about(camera).get("intrinsics")
        known = isinstance(values, list) and len(values) == 4
        return np.array(values, np.float64) if known else None

    @functools.lru_cache(maxsize=4)  # noqa: B019 - few, and they live as long as an import
    def depth_codes(self, key: str) -> tuple[np.ndarray, float]:
        """Return the stored depth (4096,) uint16 of each code, and the value of one metre."""
        about = self._about(key)
        if not self.is_video(key):
            return np.zeros(0, np.uint16), 1.0 if about.get("depth_unit") == "m" else 1000.0
        low, high = (
            float(about.get(f"video.depth_{e}", d)) for e, d in (("min", 0.01), ("max", 10))
        )
        shift, log = float(about.get("video.shift", 3.5)), about.get("video.use_log", True)
        share = np.arange(CODES) / (CODES - 1)
        if log:
            ends = np.log([low + shift, high + shift])
            metres = np.exp(ends[0] + share * (ends[1] - ends[0])) - shift
        else:
            metres = low + share * (high - low)
        per_metre = float(math.floor((SATURATED - 1) / high))
        stored = np.rint(metres * per_metre)
        stored[[0, -1]] = 0
        return stored.astype(np.uint16), per_metre


def focal_of(values: np.ndarray) -> np.ndarray:
    """Return fx, fy, cx, cy of 4 numbers, or of a 3×3 matrix."""
    flat = np.asarray(values, np.float64).reshape(-1)
    return flat if len(flat) == 4 else flat[[0, 4, 2, 5]]


def poses_of(values: np.ndarray, name: str) -> np.ndarray:
    """Return camera-to-world poses (T, 4, 4) of 16, 12, 7 or 3 numbers per frame."""
    rows = np.asarray(values, np.float64).reshape(len(values), -1)
    pose = np.tile(np.eye(4), (len(rows), 1, 1))
    known = np.isfinite(rows).all(1)
    pose[~known] = np.nan
    count = rows.shape[1]
    if count in (12, 16):
        pose[known, : count // 4] = rows[known].reshape(-1, count // 4, 4)
    elif count == 7:
        pose[known, :3, 3] = rows[known, :3]
        pose[known, :3, :3] = Rotation.from_quat(rows[known, 3:]).as_matrix()
    elif count == 3:
        for k in np.flatnonzero(known):
            pose[k] = pose_from_yaw(np.array([*rows[k, :2], 0.0]), float(rows[k, 2]))
    else:
        raise UserError(
            f"--pose {name} has {count} numbers per frame: a pose has 16 or 12 (a matrix, row by "
            "row), 7 (xyz, quaternion xyzw) or 3 (x, y, yaw)."
        )
    return pose


def _ends(key: str, end: str) -> bool:
    """Tell whether a feature is named as a camera's pose; ``ee_pose`` and actions are others."""
    last = key.rpartition(".")[2]
    fits = last.endswith(end) if end != "pose" or "cam" in last else last == end
    return fits and not key.startswith("action")
