"""Recordings for the viewer of Rerun: frames, depth, the camera's path, and points."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports.options import ExportConfig
from pewm_jax.data.exports.points import fuse
from pewm_jax.types import Frames

APPLICATION = "pewm_jax"
QUALITY = 95
"""Of JPEG, for frames that are not recorded ones."""


class Recording:
    """An ``.rrd`` file; a context manager. Frames of several sources share one timeline.

    Args:
        file: the file.
        name: name of the recording.
        shown: sources whose images are shown side by side, above the world in 3D.

    Raises:
        UserError: rerun-sdk is not installed.
    """

    def __init__(self, file: Path, name: str, *shown: str):
        try:
            self._rerun: Any = importlib.import_module("rerun")
            views: Any = importlib.import_module("rerun.blueprint")
        except ImportError:
            raise UserError(
                "recordings for Rerun need rerun-sdk: install it with `pip install "
                "'pewm-jax[rerun]'`."
            ) from None
        self._stream = self._rerun.RecordingStream(APPLICATION, recording_id=name)
        images = [
            views.Spatial2DView(origin=f"world/{source}/camera/{what}", name=f"{source}: {what}")
            for what in ("rgb", "depth")
            for source in shown
        ]
        world = views.Spatial3DView(origin="world", name="world")
        grid = views.Grid(*images, grid_columns=len(shown))
        layout = views.Blueprint(views.Horizontal(world, grid))
        self._stream.save(file, default_blueprint=layout)
        axes = self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP
        self._stream.log("world", axes, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stream.flush()
        self._stream.disconnect()

    def frames(
        self, source: str, frames: Frames, first: int = 0, codes: list[bytes] | None = None
    ) -> None:
        """Log frames (T,) of a source from a step on: camera, colours and depth.

        Args:
            source: name of the source, such as ``true``.
            frames: NumPy frames, rgb uint8, depth in metres.
            first: step of the first frame on the timeline ``frame``.
            codes: PNG images to log in place of the colours, which they encode.
        """
        rr, at = self._rerun, f"world/{source}/camera"
        height, width = frames.depth_THW.shape[1:]
        for k, (rgb, depth) in enumerate(zip(frames.rgb_THWC, frames.depth_THW, strict=True)):
            fx, fy, cx, cy = (float(x) for x in frames.camera.intrinsics_4[k])
            pose = np.asarray(frames.camera.world_from_camera[k])
            self._stream.set_time("frame", sequence=first + k)
            self._stream.log(at, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            lens = rr.Pinhole(
                resolution=[width, height],
                focal_length=[fx, fy],
                principal_point=[cx, cy],
                camera_xyz=rr.ViewCoordinates.RDF,
            )
            self._stream.log(at, lens)
            image = (
                rr.Image(rgb).compress(jpeg_quality=QUALITY)
                if codes is None
                else rr.EncodedImage(contents=codes[k], media_type="image/png")
            )
            self._stream.log(f"{at}/rgb", image)
            millimetres = np.rint(np.clip(depth, 0, 65.534) * 1000).astype(np.uint16)
            self._stream.log(f"{at}/depth", rr.DepthImage(millimetres, meter=1000.0))

    def path(self, source: str, world_from_camera: np.ndarray) -> None:
        """Log the line through the positions of poses (T, 4, 4)."""
        line = self._rerun.LineStrips3D([np.asarray(world_from_camera)[:, :3, 3]])
        self._stream.log(f"world/{source}/path", line, static=True)

    def points(self, name: str, points_N3: np.ndarray, colours_N3: np.ndarray, side_m: float):
        """Log points in metres with uint8 colours, drawn as spheres of a diameter in metres."""
        cloud = self._rerun.Points3D(points_N3, colors=colours_N3, radii=side_m / 2)
        self._stream.log(f"world/{name}", cloud, static=True)


def export(config: ExportConfig, episode: Episode, file: Path) -> None:
    """Write an episode: its frames, path, and the points that all frames measured."""
    with Recording(file, episode.name, "true") as recording:
        recording.path("true", episode.world_from_camera)
        for k in range(episode.length):
            recording.frames("true", episode.frames([k]), k, [episode.encoded("rgb", k)])
        recording.points("map", *fuse(episode, config.point_m), config.point_m)
