"""Habitat: meshes (HM3D's GLB files) and episodes (``.json.gz``); images are rendered.

An episode has ``scene_id``, ``start_position`` (y up), ``start_rotation`` (quaternion xyzw, forward
is −z) and perhaps ``reference_path`` or ``goals``; files of object navigation have the goals of
each category once. The agent starts there and walks by turns and steps along the reference path, or
else along the shortest path to the first goal. y is turned to z.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data import navigation
from pewm_jax.data.episodes import SATURATED
from pewm_jax.data.formats.habitat_walk import NoWayError, read_episodes, walk
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import Entry, Format, Load, Picture, RawSequence
from pewm_jax.data.render import render
from pewm_jax.data.scenes import Scene, load_scene
from pewm_jax.geometry.cameras import intrinsics_from_fov
from pewm_jax.io.progress import Meter
from pewm_jax.registry import register
from pewm_jax.types import Camera

SIZE = (256, 256)
"""Width and height of images without ``--size``."""
RADIUS_M = 0.2
"""Radius of the agent where a shortest path is searched."""


@register("format", "habitat")
@dataclasses.dataclass(frozen=True)
class Habitat(Format):
    """Meshes and episodes of Habitat, such as HM3D's."""

    NAME: ClassVar[str] = "habitat"
    LAYOUT: ClassVar[str] = "*.glb and episodes in *.json.gz"
    DEPTH_SCALE: ClassVar[float | None] = None
    LAST: ClassVar[int] = 2
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
        episodes = [one for path in files for one in read_episodes(path)]
        if not episodes:
            raise UserError(
                f"{where} has no episodes; give a .json.gz file of Habitat with --episodes."
            )
        found, lost = [], []
        with Meter("searching paths", len(episodes), "episodes") as meter:
            for k, episode in enumerate(episodes):
                mesh = _mesh_of(str(episode.get("scene_id", "")), meshes, src)
                number = episode.get("episode_id", k)
                grids = functools.partial(_grid, mesh)
                try:
                    path = walk(episode, options, grids, f"episode {number} of {mesh.name}")
                    found.append((f"{_stem(mesh)}/{number}", mesh, path))
                except NoWayError as error:
                    lost.append(str(error))
                meter.advance(1)
        if not found:
            raise UserError(f"{lost[0]}, and no other episode can be walked; check the meshes.")
        note = f"{len(lost)} of {len(episodes)} episodes are left out; first: " + "".join(lost[:1])
        world = _World(options, note if lost else "")
        return [
            Entry(name, len(path), functools.partial(world.open, mesh, path))
            for name, mesh, path in found
        ]


@dataclasses.dataclass(frozen=True)
class _World:
    options: ImportConfig
    note: str

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
            *(pose_T44, intrinsics, size, read, lambda k: f"{label} {k}", scale),
            info=info,
            note=self.note,
        )


@functools.lru_cache(maxsize=1)
def _scene(mesh: Path) -> Scene:
    return load_scene(mesh, "y")


@functools.lru_cache(maxsize=4)
def _grid(mesh: Path, near_z: float | None) -> navigation.NavGrid:
    return navigation.navigable(_scene(mesh), agent_radius_m=RADIUS_M, near_z=near_z)


def _stem(mesh: Path) -> str:
    return mesh.name.split(".")[0]


def _mesh_of(scene_id: str, meshes: list[Path], src: Path) -> Path:
    """Return the mesh that an episode names, rather one without compressed textures."""
    wanted = Path(scene_id).name.split(".")[0]
    found = [path for path in meshes if _stem(path) == wanted]
    if not found:
        raise UserError(
            f"{src} has no mesh {wanted}.glb or {wanted}.basis.glb, which an episode names: put it "
            "below this folder, or give the episodes of other meshes with --episodes."
        )
    return found[0]
