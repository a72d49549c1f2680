"""Import a recording (colour, depth, trajectory) as an episode; it is validated before writing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import tyro

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import checks, dataset
from pewm_jax.data.episodes import (
    DEPTH_LIMIT_M,
    SATURATED,
    EpisodeArrays,
    decode_image,
    read_episode,
    write_episode,
)
from pewm_jax.data.recordings import RecordedFrame, read_recording, read_voxels
from pewm_jax.data.voxels import VoxelFrames, VoxelGrid, require_alike
from pewm_jax.geometry.actions import actions_between
from pewm_jax.geometry.cameras import resize_intrinsics
from pewm_jax.io.progress import Meter

_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


@dataclasses.dataclass(frozen=True)
class _Imported:
    """A shard of one imported episode: its frames, and whether it has actions and voxels."""

    shard: dataset.Shard
    frames: int
    actions: bool
    voxels: bool


@dataclasses.dataclass(frozen=True)
class ImportConfig:
    """Import a recording: a folder of colour images, depth images and a trajectory.

    The camera must have OpenCV axes (x right, y down, z forward) and the trajectory must be
    camera-to-world, as written by Open3D and TUM. If there is a folder voxels/ (a .npz for each
    colour image, and classes.json), its grids of class ids around the agent are imported as well.
    """

    src: Annotated[Path, tyro.conf.Positional]
    """The recording: image/, depth/ and a .log file (Open3D), or rgb.txt, depth.txt and
    groundtruth.txt (TUM)."""
    out: Annotated[Path, tyro.conf.Positional]
    """Dataset folder; the episode is added to its split."""
    intrinsics: tuple[float, float, float, float]
    """fx fy cx cy in pixels of the recorded images."""
    pixel_centres: Literal["integer", "half"] = "integer"
    """Coordinate of the centre of the first pixel in cx and cy: `integer` is 0 (Open3D, TUM,
    OpenCV), `half` is 0.5."""
    depth_scale: float = 1000.0
    """Value of a depth image that means one metre: 1000 for millimetres, 5000 for TUM. The largest
    16-bit value, 65535, means no measurement, regardless of the scale."""
    max_depth: float = DEPTH_LIMIT_M
    """Depths beyond this become "no measurement", metres. By default all depths that the format can
    store are kept; give the range of the sensor, such as 10, to drop unreliable depths."""
    stride: int = 1
    """Keep every n-th frame."""
    size: tuple[int, int] | None = None
    """Width and height to resize to, pixels; by default the images keep their size."""
    trajectory: Path | None = None
    """Trajectory file; by default groundtruth.txt or the only .log file of the recording."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "-y"
    """Axis of the recording's world that points up, written --up=-y. Trajectories that start at a
    level camera have y down, so up is -y; with motion capture (TUM) it is z."""
    split: str = "train"
    """Split to add to."""
    name: str | None = None
    """Name of the episode; by default the name of the folder."""
    overwrite: bool = False
    """Replace an episode of the same name."""

    def __post_init__(self):
        """Validate."""
        if self.stride < 1:
            raise ConfigError(f"--stride is {self.stride}: use 1 or more.")
        if not self.depth_scale > 0:
            raise ConfigError(f"--depth-scale is {self.depth_scale}: use 1000 for millimetres.")
        if not 0 < self.max_depth <= DEPTH_LIMIT_M:
            raise ConfigError(
                f"--max-depth is {self.max_depth}: use metres above 0, up to the {DEPTH_LIMIT_M} "
                "that the format can store."
            )
        if self.size is not None and min(self.size) < 1:
            raise ConfigError(f"--size is {self.size}: use a width and height in pixels.")
        if min(self.intrinsics[:2]) <= 0:
            raise ConfigError(f"--intrinsics {self.intrinsics}: fx and fy must be above 0.")
        for what, value in (("split", self.split), ("name", self.name or "episode")):
            if not value or any(c in value for c in "/\\") or value.startswith("."):
                raise ConfigError(f"--{what} is {value!r}: use a plain name without slashes.")


def import_recording(config: ImportConfig, log: Callable[[str], None] = print) -> None:
    """Read, convert, check and add a recording to a dataset; ``log`` receives the lines to print.

    If the recording has problems, nothing is written.

    Raises:
        UserError: files are missing or do not match, or the episode fails validation.
    """
    name = config.name or config.src.resolve().name
    folder, turn = config.out / config.split, world_from_recording(config.up)
    path = folder / f"recording-{name}.array_record"
    imported = _other_shards(config, path, name)
    frames = read_recording(config.src, config.trajectory)[:: config.stride]
    rgb, depth, source_size = _read_images(config, frames)
    height, width = depth.shape[1:]
    half = 0.5 if config.pixel_centres == "integer" else 0.0
    intrinsics = np.array(config.intrinsics, np.float32) + np.array([0, 0, half, half], np.float32)
    scale = (width / source_size[0], height / source_size[1])
    pose = turn @ np.stack([frame.world_from_camera for frame in frames])
    # Check the units before large depths are dropped, which could hide that they are wrong.
    _refuse(checks.check_depth(depth, str(config.src)), config, frames)
    depth[depth > config.max_depth] = 0
    voxels = read_voxels(config.src, [frame.colour for frame in frames], turn)
    if voxels is not None:
        _require_same_grid(folder, imported, voxels, config)
    acts = planar_actions(pose)
    arrays = EpisodeArrays(
        rgb, depth, resize_intrinsics(intrinsics, *scale), pose, acts, voxels=voxels
    )
    info = {"policy": "recorded", "stride": config.stride, "source": config.src.resolve().name}
    record = write_episode(arrays, name, name, info)
    _refuse(checks.check_episode(read_episode(record), str(config.src)), config, frames)
    shard = dataset.write_shard(path, [record])
    imported.append(_Imported(shard, len(frames), acts is not None, voxels is not None))
    _write_manifest(folder, imported)
    moves = "poses only (6 degrees of freedom)" if acts is None else "planar actions"
    grids = "" if voxels is None else f", voxels of {voxels.grid.side}³ cells"
    log(f"{folder}: added {name}, {len(frames)} frames of {width}×{height} pixels, {moves}{grids}.")


def _write_manifest(folder: Path, imported: list[_Imported]) -> None:
    """List the shards, and which fields each contains; voxels only if there are any."""
    settings: dict[str, Any] = {"made_by": "import"}
    for field in ("frames", "actions", "voxels"):
        values = {one.shard.file: getattr(one, field) for one in imported}
        if field != "voxels" or any(values.values()):
            settings[field] = values
    shards, total = tuple(one.shard for one in imported), sum(one.frames for one in imported)
    dataset.write_manifest(folder, dataset.Manifest(folder.name, shards, settings, total))


def world_from_recording(up: str) -> np.ndarray:
    """Return the (4, 4) rotation that takes a recording's up axis to z."""
    axis = np.array(_AXES[up[-1]], float) * (-1 if up.startswith("-") else 1)
    keep = np.array(_AXES["y" if up[-1] == "x" else "x"], float)  # this axis stays horizontal
    rotation = np.eye(4)
    rotation[:3, :3] = np.stack([keep, np.cross(axis, keep), axis])
    return rotation


def planar_actions(world_from_camera: np.ndarray) -> np.ndarray | None:
    """Return the (T − 1, 3) actions of a camera that only moves and turns on the ground.

    Returns:
        None if no such actions lead through the poses (T, 4, 4), as with a hand-held camera.
    """
    if len(world_from_camera) < 2:
        return None
    actions = np.asarray(actions_between(np.asarray(world_from_camera, np.float32)))
    metres, radians = checks.action_errors(world_from_camera, actions)
    return (
        actions
        if bool(((metres < checks.ACTION_M) & (radians < checks.ACTION_RAD)).all())
        else None
    )


def _other_shards(config: ImportConfig, replaced: Path, name: str) -> list[_Imported]:
    """Return the existing shards without the one to replace."""
    folder = replaced.parent
    if not folder.exists():
        return []
    if not (folder / dataset.MANIFEST).is_file():
        # A killed import leaves its shard, which is complete and checked because it was renamed.
        strays = sorted(folder.glob("recording-*.array_record"))
        if len(strays) < len([*folder.glob("*.array_record"), *folder.glob("*.json")]):
            raise UserError(
                f"{folder} holds an unfinished collection; finish it, or give another --split."
            )
        return [_inspect(path, dataset.describe_shard(path)) for path in strays if path != replaced]
    # The shard to replace may be newer than the list, if an import was killed between the two.
    manifest = dataset.read_manifest(folder, check_files=False)
    if manifest.settings.get("made_by") != "import":
        raise UserError(f"{folder} was made by `collect`; import into another --split or folder.")
    kept = [shard for shard in manifest.shards if shard.file != replaced.name]
    if len(kept) < len(manifest.shards) and not config.overwrite:
        raise UserError(
            f"{folder} already has an episode named {name}; give another --name or --overwrite."
        )
    for shard in kept:
        dataset.check_size(folder / shard.file, shard)
    frames, actions = manifest.settings["frames"], manifest.settings.get("actions", {})
    voxels = manifest.settings.get("voxels", {})  # not listed where no recording has any
    return [
        _Imported(shard, frames[shard.file], actions[shard.file], voxels.get(shard.file, False))
        if shard.file in actions
        else _inspect(folder / shard.file, shard)  # imported before actions were listed
        for shard in kept
    ]


def _inspect(path: Path, shard: dataset.Shard) -> _Imported:
    """Open a shard and return which fields it contains."""
    episode = read_episode(dataset.read_record(path, 0), str(path))
    acts, grid = episode.actions is not None, episode.voxel_grid
    return _Imported(shard, episode.length, acts, grid is not None)


def _require_same_grid(
    folder: Path, imported: list[_Imported], voxels: VoxelFrames, config: ImportConfig
) -> None:
    """Raise UserError if the voxels' grid differs from that of the split."""
    for one in imported:
        if one.voxels:
            path = folder / one.shard.file
            there = read_episode(dataset.read_record(path, 0), str(path)).voxel_grid
            assert isinstance(there, VoxelGrid)
            require_alike(there, voxels.grid, str(config.src / "voxels"))
            return


def _read_images(
    config: ImportConfig, frames: list[RecordedFrame]
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Return rgb (T, H, W, 3), depth in metres (T, H, W), and the recorded width and height."""
    first = _read(frames[0].colour, cv2.IMREAD_COLOR)
    source = (first.shape[1], first.shape[0])
    size = config.size or source
    rgb = np.empty((len(frames), size[1], size[0], 3), np.uint8)
    depth = np.empty((len(frames), size[1], size[0]), np.float32)
    with Meter(f"reading {config.src}", len(frames), "frames") as meter:
        for k, frame in enumerate(frames):
            colour = _read(frame.colour, cv2.IMREAD_COLOR)
            distance = _read(frame.depth, cv2.IMREAD_UNCHANGED)
            for path, image in ((frame.colour, colour), (frame.depth, distance)):
                if (image.shape[1], image.shape[0]) != source:
                    raise UserError(
                        f"{path} has {image.shape[1]}×{image.shape[0]} pixels, the first image "
                        f"{source[0]}×{source[1]}: colour and depth must be registered and have "
                        "the same size."
                    )
            if distance.ndim != 2:
                raise UserError(
                    f"{frame.depth} has {distance.shape[2]} channels; a depth image must have one."
                )
            shrink = size[0] < source[0]
            how = cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
            rgb[k] = cv2.resize(colour, size, interpolation=how)[..., ::-1]
            depth[k] = _metres(_nearest(distance, size), config.depth_scale)
            meter.advance(1)
    return rgb, depth, source


def _metres(values_HW: np.ndarray, scale: float) -> np.ndarray:
    """Return depths in metres; the saturated value of a 16-bit image becomes 0."""
    metres = values_HW / scale
    if values_HW.dtype == np.uint16:
        metres[values_HW == SATURATED] = 0
    return metres


def _nearest(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize with nearest-neighbour sampling: interpolated depths would lie between surfaces."""
    height, width = image.shape
    rows = ((np.arange(size[1]) + 0.5) * height / size[1]).astype(int)
    columns = ((np.arange(size[0]) + 0.5) * width / size[0]).astype(int)
    return image[rows][:, columns]


def _read(path: Path, flags: int) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path} does not exist, but the recording lists it.")
    code = path.read_bytes()
    image = decode_image(code, flags)
    if image is None:
        why = "damaged" if code else "empty"
        raise UserError(f"{path} does not decode as an image; it is {why}.")
    return image


def _refuse(
    problems: list[checks.Problem], config: ImportConfig, frames: list[RecordedFrame]
) -> None:
    """Raise UserError for the first problem, naming the depth image's file."""
    if not problems:
        return
    first = problems[0]
    if first.frame is not None:
        counted = f" (counted with --stride {config.stride})" if config.stride > 1 else ""
        first = dataclasses.replace(first, where=f"{frames[first.frame].depth}{counted}")
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    raise UserError(f"{first}{more} Nothing was written.")
