"""Habitat: meshes (HM3D's GLB files) and episodes (``.json.gz``); images are rendered.

An episode has ``scene_id``, ``start_position`` (y up), ``start_rotation`` (quaternion xyzw, forward
is −z) and perhaps ``reference_path`` or ``goals``. The agent starts there and walks by turns and
steps along the reference path, or else along the shortest path to the first goal. y is turned to z.
"""

from __future__ import annotations

import dataclasses
import functools
import gzip
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.config import UserError
from pewm_jax.data import navigation
from pewm_jax.data.episodes import SATURATED
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import Entry, Format, Load, Picture, RawSequence
from pewm_jax.data.render import render
from pewm_jax.data.scenes import Scene, load_scene
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.registry import register
from pewm_jax.types import Camera

SIZE = (256, 256)
"""Width and height of images without ``--size``."""
TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From y up to z up."""
RADIUS_M = 0.2
"""Radius of the agent where a shortest path is searched."""


@register("format", "habitat")
@dataclasses.dataclass(frozen=True)
class Habitat(Format):
    """Meshes and episodes of Habitat, such as HM3D's."""

    NAME: ClassVar[str] = "habitat"
    LAYOUT: ClassVar[str] = "*.glb and episodes in *.json.gz"
    USES: ClassVar[tuple[str, ...]] = (
        *("episodes", "fov", "camera_height"),
        *("frames", "step", "turn_deg"),
    )

    def recognise(self, src: Path) -> str:
        """Return the names of a mesh and of a file of episodes."""
        mesh = next(src.rglob("*.glb"), None)
        listed = next(src.rglob("*.json.gz"), None)
        return f"{mesh.name} and {listed.name}" if mesh and listed else ""

    def entries(self, options: ImportConfig) -> list[Entry]:
        """Return a sequence for each episode, of ``--frames`` frames or fewer."""
        src, where = options.src, options.episodes or options.src
        if not src.is_dir():
            raise UserError(f"{src} is not a folder; give the folder of the meshes.")
        meshes = sorted(src.rglob("*.glb"), key=lambda path: (".basis." in path.name, path))
        files = [where] if where.is_file() else sorted(where.rglob("*.json.gz"))
        episodes = [one for path in files for one in _episodes(path)]
        if not episodes:
            raise UserError(
                f"{where} has no episodes; give a .json.gz file of Habitat with --episodes."
            )
        world = _World(options)
        found = []
        for k, episode in enumerate(episodes):
            mesh = _mesh_of(str(episode.get("scene_id", "")), meshes, src)
            path = world.walk(mesh, episode, f"episode {episode.get('episode_id', k)}")
            name = f"{_stem(mesh)}/{episode.get('episode_id', k)}"
            found.append(Entry(name, len(path), functools.partial(world.open, mesh, path)))
        return found


@dataclasses.dataclass(frozen=True)
class _World:
    options: ImportConfig

    def open(self, mesh: Path, pose_T44: np.ndarray) -> RawSequence:
        """Return the frames along poses, which are rendered when they are read."""
        size = self.options.size or SIZE
        intrinsics = intrinsics_from_fov(size[1], size[0], self.options.fov)
        scene = _scene(mesh)
        # A unit that no depth in the scene exceeds.
        across = float(np.linalg.norm(np.ptp(scene.vertices_V3, axis=0)))
        scale = float(np.floor(min(10000.0, (SATURATED - 1) / across)))

        def load(k: int) -> Picture:
            seen = render(scene, Camera(intrinsics, pose_T44[k : k + 1]), size[1], size[0])
            depth = np.rint(seen.depth_THW[0] * scale).clip(0, SATURATED - 1).astype(np.uint16)
            return Picture(np.ascontiguousarray(seen.rgb_THWC[0, ..., ::-1]), depth)

        def read(chosen: Sequence[int]) -> Iterator[Load]:
            return (functools.partial(load, k) for k in chosen)

        info = {"step_m": self.options.step, "turn_deg": self.options.turn_deg}
        label = f"{mesh}, frame"
        return RawSequence(
            pose_T44, intrinsics, size, read, lambda k: f"{label} {k}", scale, info=info
        )

    def walk(self, mesh: Path, episode: dict[str, Any], what: str) -> np.ndarray:
        """Return the poses (T, 4, 4) of an episode's walk, z up."""
        try:
            start = TURN @ np.array(episode["start_position"], float).reshape(3)
            turn = Rotation.from_quat(np.array(episode["start_rotation"], float)).as_matrix()
            goal = [list(one["position"]) for one in (episode.get("goals") or [])[:1]]
            listed = np.array(episode.get("reference_path") or goal, float).reshape(-1, 3) @ TURN.T
        except (KeyError, ValueError, TypeError) as error:
            raise UserError(
                f"{what} of {mesh.name} lacks start, rotation or goal ({error!r})."
            ) from None
        if not np.isfinite([*start, *turn.ravel()]).all():
            raise UserError(f"{what} of {mesh.name} starts at a position that is not finite.")
        forward = TURN @ turn @ [0, 0, -1]
        pose = np.array([*start, np.arctan2(forward[1], forward[0])])
        if not episode.get("reference_path") and len(listed):
            listed = _around(mesh, start, listed[0])
        poses = [pose]
        for target in listed:
            poses += self._towards(poses[-1], target)
        eye = np.array([0, 0, self.options.camera_height])
        shown = poses[: self.options.frames]
        return np.stack([pose_from_yaw(one[:3] + eye, float(one[3])) for one in shown])

    def _towards(self, pose_4: np.ndarray, target_3: np.ndarray) -> list[np.ndarray]:
        """Return poses x, y, z, yaw that turn to a point and go there in equal steps."""
        way = target_3 - pose_4[:3]
        far = float(np.linalg.norm(way[:2]))
        if far < 1e-3:
            return []
        turn = (np.arctan2(way[1], way[0]) - pose_4[3] + np.pi) % (2 * np.pi) - np.pi
        turns = int(np.ceil(abs(turn) / np.radians(self.options.turn_deg) - 1e-6))
        steps = int(np.ceil(far / self.options.step - 1e-6))
        turned = [pose_4 + np.array([0, 0, 0, turn * k / turns]) for k in range(1, turns + 1)]
        faced, move = turned[-1] if turned else pose_4, np.append(way, 0)
        return [*turned, *(faced + move * (k / steps) for k in range(1, steps + 1))]


@functools.lru_cache(maxsize=1)
def _scene(mesh: Path) -> Scene:
    return load_scene(mesh, "y")


@functools.lru_cache(maxsize=4)
def _grid(mesh: Path) -> navigation.NavGrid:
    return navigation.navigable(_scene(mesh), agent_radius_m=RADIUS_M)


def _around(mesh: Path, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the points (N, 3) of the shortest path to a goal, a straight line if none is found."""
    grid = _grid(mesh)
    ends = [navigation.nearest_free(grid, point[:2]) for point in (start, goal)]
    path = navigation.shortest_path(grid, *ends)
    if path is None or abs(start[2] - grid.floor_z) > 0.5:  # on another storey
        return goal[None]
    return np.column_stack([path[1:], np.full(len(path) - 1, start[2])])


def _episodes(path: Path) -> list[dict[str, Any]]:
    """Read one file of episodes; a file that only refers to others has none."""
    try:
        with gzip.open(path, "rt", encoding="utf-8") as file:
            found = json.load(file)["episodes"]
    except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read as episodes of Habitat ({error!r}).") from None
    return [one for one in found if isinstance(one, dict)]


def _stem(mesh: Path) -> str:
    return mesh.name.split(".")[0]


def _mesh_of(scene_id: str, meshes: list[Path], src: Path) -> Path:
    """Return the mesh that an episode names, rather one without compressed textures."""
    wanted = Path(scene_id).name.split(".")[0]
    found = [path for path in meshes if _stem(path) == wanted]
    if not found:
        raise UserError(
            f"{src} has no mesh {wanted}.glb or {wanted}.basis.glb, which an episode names: put it "
            "below this folder."
        )
    return found[0]
