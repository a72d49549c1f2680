"""Indoor scans that the package scenezoo reads: ScanNet++, MultiScan, 3RScan, ``.sens`` and others.

SceneZoo gives depth in metres, world-to-camera poses with OpenCV axes, and intrinsics with pixel
centres at integers. Nothing is downloaded.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.formats import reader
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.registry import register

CAMERA = ("world_to_camera", "rgb_intrinsics", "depth_intrinsics")
PINHOLE = {"PINHOLE", "SIMPLE_PINHOLE"}
FOCAL = np.s_[:, [0, 1, 0, 1], [0, 1, 2, 2]]  # fx, fy, cx, cy of the matrices
CENTRE = np.array([0, 0, 0.5, 0.5])  # from pixel centres at integers to ours
BLOCK_BYTES = 256_000_000  # of colours read at once: each call decodes a video from a key frame


@register("format", "scenezoo")
@dataclasses.dataclass(frozen=True)
class SceneZoo(reader.Format):
    """A data set that SceneZoo reads."""

    NAME: ClassVar[str] = "scenezoo"
    LAYOUT: ClassVar[str] = "a data set of SceneZoo, named by --dataset"
    DEPTH_SCALE: ClassVar[float | None] = None
    SIDEWAYS: ClassVar[bool] = True
    USES: ClassVar[tuple[str, ...]] = ("dataset", "camera")

    def recognise(self, src: Path) -> str:
        """Return an empty string: the user names the format and the data set."""
        del src
        return ""

    def entries(self, options: ImportConfig) -> list[reader.Entry]:
        """Return the scenes, whose folders are at most three levels below the source."""
        try:
            data, source = _opened(options)
        except ImportError as error:  # the package, or a library that Open3D needs
            how = "`pip install 'pewm-jax[scenes]'` installs it; docs/data.md lists what it needs"
            raise UserError(f"SceneZoo cannot be loaded ({_sentence(error)}): {how}.") from None
        folders = (path.name for end in ("*/", "*/*/", "*/*/*/") for path in options.src.glob(end))
        found, reasons = [], []
        for name in sorted(set(folders)):
            scene = _Scene(data, source, name, f"{options.src}, scene {name}", options)
            try:
                cameras = scene.read(CAMERA)
            except Exception as error:  # noqa: BLE001 - its readers raise many kinds
                reasons.append(f"{scene.label}: {_sentence(error)}.")
                if not isinstance(error.__cause__ or error, FileNotFoundError):
                    raise UserError(reasons[-1]) from None
                continue  # a folder that is no scene
            opened = functools.partial(scene.open, cameras)
            found += [reader.Entry(name, len(cameras), opened)] if len(cameras) else []
        if not found:
            lacks = f"has no scene of {data.name} with frames of --camera {source.name}"
            raise UserError(f"{options.src} {lacks}. {' '.join(reasons[:1])}".strip())
        return found


def _opened(options: ImportConfig) -> tuple[Any, Any]:
    """Return the data set and its chosen source of frames."""
    scenezoo = importlib.import_module("scenezoo")

    def usable(name: str) -> dict[str, Any]:
        sources = scenezoo.get_dataset_info(name).spec.frame_sources
        sources = [one for one in sources if PINHOLE & set(one.camera_models)]
        return {one.name: one for one in sources if not one.requires}

    every = {name: usable(name) for name in scenezoo.list_datasets(include_aliases=True)}
    wanted = (options.dataset or "").lower()
    if not every.get(wanted):
        known = ", ".join(name for name, sources in every.items() if sources)
        raise ConfigError(
            f"--dataset {wanted or 'is missing'}: name one with posed images: {known}."
        )
    name, known = options.camera or next(iter(every[wanted])), ", ".join(every[wanted])
    if name not in every[wanted]:
        raise ConfigError(f"--camera is {name}: {wanted} has the sources of frames {known}.")
    return scenezoo.get_dataset(wanted, options.src, offline=True), every[wanted][name]


@dataclasses.dataclass(frozen=True)
class _Scene:
    data: Any
    source: Any
    name: str
    label: str
    options: ImportConfig

    def read(self, wanted: Sequence[str], indices: list[int] | None = None) -> Any:
        """Return SceneZoo's batch of some frames, by default of all that have a camera."""
        get = self.data.get_frames
        more = {"source": self.source.name} if "source" in inspect.signature(get).parameters else {}
        items = tuple(name for name in wanted if name in self.source.items)
        return get(self.name, indices=indices, items=items, rotate_to_up=False, **more)

    def open(self, cameras: Any) -> reader.RawSequence:
        """Return the sequence of the frames that have a camera."""
        if cameras.camera_model not in PINHOLE:
            raise UserError(f"{self.label}: a camera {cameras.camera_model} is no pinhole camera.")
        numbers = [int(index) for index in cameras.indices]
        labels = [f"{self.label}, frame {number}" for number in numbers]
        matrices_T33 = (cameras.rgb_intrinsics, cameras.depth_intrinsics)
        focal_T4 = [matrix[FOCAL] + CENTRE for matrix in matrices_T33 if matrix is not None]

        def load(k: int, batch: Any = None, row: int = 0) -> reader.Picture:
            try:
                batch = batch or self.read(("rgb", "depth"), [numbers[k]])
            except Exception as error:  # noqa: BLE001 - its readers raise many kinds
                raise reader.BadFrameError(f"{labels[k]}: {_sentence(error)}.") from None
            bgr_HWC = np.ascontiguousarray(batch.rgb[row][..., ::-1])
            own_4 = None if self.options.intrinsics else focal_T4[0][k]
            depth_HW = None if batch.depth is None else batch.depth[row]
            return reader.Picture(bgr_HWC, depth_HW, own_4, focal_T4[-1][k])

        def read(chosen: Sequence[int]) -> Iterator[reader.Load]:
            count = min(256, max(1, BLOCK_BYTES // (3 * size[0] * size[1])))
            for start in range(0, len(chosen), count):
                block, batch = chosen[start : start + count], None
                with contextlib.suppress(Exception):  # else each is read alone and named
                    batch = self.read(("rgb", "depth"), [numbers[k] for k in block])
                for row, k in enumerate(block):
                    yield functools.partial(load, k, batch, row if batch else 0)

        size = load(0).bgr_HWC.shape[1::-1]
        pose_T44 = np.linalg.inv(cameras.world_to_camera.astype(float))
        scale = 1.0 if "depth" in self.source.items else None
        facts: dict[str, Any] = {"info": {"dataset": self.data.name, "camera": self.source.name}}
        if lost := cameras.source_frame_count - len(cameras):
            facts["note"] = f"{lost} of {lost + len(cameras)} frames of {self.name} have no camera"
        focal_4 = np.median(focal_T4[0], 0)
        return reader.RawSequence(pose_T44, focal_4, size, read, labels.__getitem__, scale, **facts)


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
