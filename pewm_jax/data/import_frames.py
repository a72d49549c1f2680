"""Make episodes of the frames of a recording: decode, fit, encode, check.

Frames are handled by threads, in order and few at a time: memory holds the encoded images of one
episode, and a few that are decoded.
"""

from __future__ import annotations

import collections
import dataclasses
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data import checks
from pewm_jax.data.episodes import (
    MILLIMETRES,
    SATURATED,
    Episode,
    encode_png,
    pack_encoded,
    read_episode,
    to_millimetres,
)
from pewm_jax.data.fit import Fit, resampled, turn_poses, turns_upright
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import BadFrameError, Entry, Format, Load, Picture, RawSequence
from pewm_jax.data.import_files import Part
from pewm_jax.data.pose_check import PoseCheck
from pewm_jax.data.record_format import new_header
from pewm_jax.data.voxels import VoxelFrames, encode, header_of
from pewm_jax.geometry.actions import PLANAR, actions_between
from pewm_jax.io.progress import Meter

_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
CHECK_SIDE = 96
"""Depth is checked on every n-th pixel, so that the shorter side has at least this many."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Pose of a camera with OpenCV's axes in one with OpenGL's."""


@dataclasses.dataclass
class BadFrames:
    """The frames that were left out: damaged ones, up to a limit, and those with a lost pose."""

    limit: int
    damaged: list[str] = dataclasses.field(default_factory=list)
    lost: list[str] = dataclasses.field(default_factory=list)

    def add(self, sentence: str) -> None:
        """Count a damaged frame; raise UserError if there are more than the limit."""
        self.damaged.append(sentence)
        if len(self.damaged) > self.limit:
            which = f" (bad frame {len(self.damaged)})" if self.limit else ""
            raise UserError(
                f"{sentence.rstrip('.')}{which}; nothing was added: repair it, or leave out up to "
                "N such frames with --skip_bad N."
            )

    def lines(self) -> Iterator[str]:
        """Yield a line for each kind of frame that was left out."""
        if self.damaged:
            yield f"{_frames(self.damaged)} left out as bad; first: {self.damaged[0]}"
        if self.lost:
            yield f"{_frames(self.lost)} left out because the pose is lost; first: {self.lost[0]}."


def _frames(found: list[str]) -> str:
    return f"{len(found)} {'frame' if len(found) == 1 else 'frames'}"


@dataclasses.dataclass(frozen=True)
class _Encoded:
    """One frame for the record.

    Attributes:
        number: of the frame in its sequence.
        rgb, depth: PNG images.
        per_metre: stored value of one metre.
        metres_hw: depth on every n-th pixel, for the checks.
        depth_size: width and height of the recorded depth image.
        fault: why the frame cannot be used.
    """

    number: int
    rgb: bytes = b""
    depth: bytes | None = None
    per_metre: float = MILLIMETRES
    metres_hw: np.ndarray | None = None
    depth_size: tuple[int, ...] = ()
    fault: str = ""


@dataclasses.dataclass
class _Opened:
    """A sequence that is being read, with everything that is the same for all of its frames.

    Attributes:
        raw: the sequence.
        pose_T44: camera to world, z up, of turned images; not finite where lost.
        intrinsics_4: of the recorded colours, centres at +0.5.
        fit: to the images of the dataset.
        scale: stored depth of one metre in the recording; None without depth.
        step: depth is checked on every n-th pixel.
    """

    raw: RawSequence
    pose_T44: np.ndarray
    intrinsics_4: np.ndarray
    fit: Fit
    scale: float | None

    @property
    def step(self) -> int:
        return max(1, min(self.fit.target) // CHECK_SIDE)


@dataclasses.dataclass
class RecordMaker:
    """Makes the records of an import.

    Attributes:
        found: the format.
        config: the settings.
        bad: counts frames that are left out.
        check: receives frames for ``--check``, or None.
        made: width and height of the images that were made.
        moves: what the episodes have of the camera's motion, and their grids, in words.
        notes: what the format tells the user, in order.
    """

    found: Format
    config: ImportConfig
    bad: BadFrames
    check: PoseCheck | None
    made: tuple[int, int] = (0, 0)
    moves: str = "poses only (6 degrees of freedom)"
    notes: dict[str, None] = dataclasses.field(default_factory=dict)
    _last: tuple[Entry, RawSequence] | None = dataclasses.field(default=None, init=False)

    def records(self, part: Part, meter: Meter) -> Iterator[bytes]:
        """Yield the record of an episode; none if no frame can be used.

        Raises:
            UserError: too many frames are damaged, or the episode does not pass the checks.
        """
        seen = self._open(part)
        known = ~_lost(seen.pose_T44)
        self.bad.lost += [seen.raw.labels(k) for k in part.frames if not known[k]]
        numbers = [k for k in part.frames if known[k]]
        for k in [k for k in numbers if k in seen.raw.faults]:
            self.bad.add(seen.raw.faults[k])
        numbers = [k for k in numbers if k not in seen.raw.faults]
        meter.advance(len(part.frames) - len(numbers))
        frames = list(self._encoded(seen, numbers, meter))
        if frames:
            self.made = seen.fit.target
            yield self._record(part, seen, frames)

    def _open(self, part: Part) -> _Opened:
        if self._last is None or self._last[0] is not part.entry:  # parts of one are consecutive
            self._last = part.entry, part.entry.open()
        raw, config = self._last[1], self.config
        if raw.note:
            self.notes[raw.note] = None
        if raw.pose_T44 is None:
            pose, turns = np.tile(FORWARD, (part.entry.frames, 1, 1)), 0
        else:
            pose, turns = self._poses(np.array(raw.pose_T44, np.float64), raw.posed_from_colour_44)
        scale = None if raw.depth_scale is None else config.depth_scale or raw.depth_scale
        fit = Fit(raw.size, config.size, config.fit, turns)
        return _Opened(raw, pose, self._intrinsics(raw), fit, scale)

    def _poses(
        self, pose: np.ndarray, posed_from_colour: np.ndarray | None
    ) -> tuple[np.ndarray, int]:
        """Return the poses in our world and convention, and the quarter turns of the images."""
        config, known = self.config, np.isfinite(pose).all((1, 2))
        pose[_lost(pose)] = np.nan
        whole = pose[known]
        if config.invert_poses:
            rigid = np.abs(np.linalg.det(whole)) > 0.1  # others are refused later
            whole[rigid] = np.linalg.inv(whole[rigid])
        if config.camera_axes == "opengl":
            whole = whole @ OPENGL
        if posed_from_colour is not None:
            whole = whole @ posed_from_colour
        whole = self._world @ whole
        if config.rotate != "auto":
            turns = int(config.rotate) // 90
        else:
            turns = turns_upright(whole) if self.found.SIDEWAYS else 0
        pose[known] = turn_poses(whole, turns)
        return pose, turns

    @property
    def _world(self) -> np.ndarray:
        """The (4, 4) rotation from the recording's world to ours."""
        return world_from_recording(self.config.up or self.found.UP)

    def _intrinsics(self, raw: RawSequence) -> np.ndarray:
        """Return the intrinsics of the recorded colour images, centres at +0.5."""
        config = self.config
        if config.intrinsics is not None:
            half = 0.5 if (config.pixel_centres or self.found.CENTRES) == "integer" else 0.0
            return np.array(config.intrinsics) + np.array([0, 0, half, half])
        if raw.intrinsics_4 is not None:
            return np.asarray(raw.intrinsics_4, np.float64)
        if raw.depth_scale is None or raw.pose_T44 is None:  # no geometry is computed
            return _assumed(raw.size)
        raise UserError(
            f"{config.src}: the files do not have the camera's intrinsics; give --intrinsics fx fy "
            "cx cy, in pixels of the recorded images."
        )

    def _encoded(self, seen: _Opened, numbers: list[int], meter: Meter) -> Iterator[_Encoded]:
        """Yield the frames that can be used, in order."""
        chosen = set() if self.check is None else self.check.choose(numbers)

        def encoded(number: int, load: Load) -> _Encoded:
            try:
                picture = _checked(load(), seen, number)
            except BadFrameError as error:
                return _Encoded(number, fault=str(error))
            return self._encode(seen, number, picture, number in chosen)

        size: tuple[int, ...] | None = None
        for one in _in_threads(encoded, zip(numbers, seen.raw.read(numbers), strict=True)):
            meter.advance(1)
            fault = one.fault
            if not fault and one.depth_size != (size or one.depth_size):
                fault = _another_size(seen.raw.labels(one.number), one.depth_size, size, " (depth)")
            if fault:
                self.bad.add(fault)
            else:
                size = one.depth_size
                yield one

    def _encode(self, seen: _Opened, number: int, picture: Picture, looked_at: bool) -> _Encoded:
        fit, focal = seen.fit, seen.intrinsics_4
        image, own = picture.bgr_HWC, picture.intrinsics_4
        if own is not None and np.abs(own - focal).max() > 1e-3:
            image = resampled(image, own, focal)
        colours, depth = fit.colours(image), picture.depth_HW
        if depth is None or seen.scale is None:
            return _Encoded(number, encode_png(colours))
        depth_4, recorded = picture.depth_intrinsics_4, depth.shape[::-1]
        if depth_4 is None and own is not None:
            depth_4 = own * np.tile(np.array(depth.shape[::-1]) / fit.source, 2)
        depth = fit.depth(depth, depth_4, focal)
        step = seen.step
        thumb = _metres(depth[step // 2 :: step, step // 2 :: step], seen.scale)
        stored, per_metre = _to_store(depth, seen.scale, self.config.max_depth)
        if looked_at and self.check is not None:
            metres = stored / np.float32(per_metre)
            frame = (fit.intrinsics(focal), colours, metres)
            self.check.add(seen.pose_T44[number], *frame, world_44=self._world, turns=fit.turns)
        images = encode_png(colours), encode_png(stored)
        return _Encoded(number, *images, per_metre, thumb, recorded)

    def _record(self, part: Part, seen: _Opened, frames: list[_Encoded]) -> bytes:
        """Check an episode and return its record; ``frames`` is emptied."""
        raw, config = seen.raw, self.config
        numbers = [one.number for one in frames]
        labels = [raw.labels(k) for k in numbers]
        pose, intrinsics = seen.pose_T44[numbers], seen.fit.intrinsics(seen.intrinsics_4)
        thumbs = _stacked(frames, labels)
        if thumbs is not None:
            # Check the units before large depths are dropped, which could hide that they are wrong.
            self._refuse(checks.check_depth(thumbs, str(config.src)), labels)
            thumbs[~(thumbs <= config.max_depth)] = 0
        voxels: VoxelFrames | None = None
        if raw.voxels is not None:
            voxels = raw.voxels(numbers, self._world)
        actions = _actions(raw, part, numbers, pose)
        if actions is not None:
            self.moves = "planar actions" if actions.shape[1] == PLANAR else "recorded actions"
        if voxels is not None:
            self.moves = f"{self.moves.split(', voxels')[0]}, voxels of {voxels.grid.side}³ cells"
        header = new_header(
            part.name,
            part.scene,
            (len(frames), seen.fit.target[1], seen.fit.target[0]),
            self._info(part, raw, numbers),
        )
        small = {
            "intrinsics": intrinsics,
            "world_from_camera": pose,
            "actions": actions,
            "voxel_origins": None if voxels is None else voxels.origin_T3,
            "states": None if raw.states_TS is None else raw.states_TS[numbers],
        }
        looked = _for_checks(header, small, thumbs, seen.step)
        self._refuse(checks.check_motion(looked, thumbs, str(config.src)), labels)
        streams = {"rgb": [one.rgb for one in frames]}
        about: dict[str, dict[str, Any]] = {}
        if thumbs is not None:
            streams["depth"] = [one.depth for one in frames if one.depth is not None]
            if frames[0].per_metre != MILLIMETRES:
                about["depth"] = {"per_metre": frames[0].per_metre}
        if voxels is not None:
            streams["voxels"] = [encode(grid) for grid in voxels.classes_TXYZ]
            about["voxels"] = header_of(voxels)
        frames.clear()  # the record is a copy: it is not in memory twice when it is written
        record = pack_encoded(header, small, streams, about)
        streams.clear()
        if voxels is not None:
            found = checks.check_episode(read_episode(record), str(config.src))
            self._refuse(found, labels)
        return record

    def _info(self, part: Part, raw: RawSequence, numbers: list[int]) -> dict[str, Any]:
        """Return the facts about an episode that are stored with it."""
        info = {"policy": "recorded", "stride": self.config.stride, "format": self.found.NAME}
        info |= {"source": self.config.src.resolve().name, "import": part.mark, **raw.info}
        if raw.pose_T44 is None:
            info["poses"] = "unknown"
        if raw.intrinsics_4 is None and self.config.intrinsics is None:
            info["intrinsics"] = "assumed, 90 degrees"
        left_out = sorted(set(part.frames) - set(numbers))
        return info | ({"left_out": left_out} if left_out else {})

    def _refuse(self, problems: list[checks.Problem], labels: list[str]) -> None:
        """Raise UserError for the first problem, naming the frame's file."""
        if not problems:
            return
        first, stride = problems[0], self.config.stride
        if first.frame is not None:
            counted = f" (counted with --stride {stride})" if stride > 1 else ""
            first = dataclasses.replace(first, where=f"{labels[first.frame]}{counted}")
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise UserError(f"{first}{more} Nothing was added.")


FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of a level camera at the origin that looks along x, for data without poses."""


def _assumed(size: tuple[int, int]) -> np.ndarray:
    """Return the intrinsics of a camera with 90 degrees across the width."""
    width, height = size
    return np.array([width / 2, width / 2, width / 2, height / 2])


def _lost(pose_T44: np.ndarray) -> np.ndarray:
    """Return which poses (T,) have no finite number in their first three rows.

    Those with some are wrong rather than lost: the checks refuse them.
    """
    return np.logical_not(np.isfinite(pose_T44[:, :3]).any((1, 2)))


def _checked(picture: Picture, seen: _Opened, number: int) -> Picture:
    """Return a frame; BadFrameError if it has another size than the first."""
    found, expected = picture.bgr_HWC.shape[1::-1], seen.raw.size
    if tuple(found) != tuple(expected):
        raise BadFrameError(_another_size(seen.raw.labels(number), found, expected))
    return picture


def _another_size(where: str, found: Any, expected: Any, kind: str = "") -> str:
    """Return the sentence about an image of another size, width and height."""
    return (
        f"{where}{kind} has {found[0]}×{found[1]} pixels, the first image {expected[0]}×"
        f"{expected[1]}: all images of a sequence must have one size."
    )


def _metres(stored_hw: np.ndarray, scale: float) -> np.ndarray:
    """Return depths in metres; the saturated value of a 16-bit image becomes 0."""
    metres = (stored_hw / scale).astype(np.float32)
    if stored_hw.dtype == np.uint16:
        metres[stored_hw == SATURATED] = 0
    return metres


def _to_store(depth_HW: np.ndarray, scale: float, max_m: float) -> tuple[np.ndarray, float]:
    """Return depth as 16 bits, and its value of one metre; 16-bit images keep their values."""
    if depth_HW.dtype != np.uint16:
        metres = depth_HW / scale
        return to_millimetres(np.where(metres <= max_m, metres, 0)), MILLIMETRES
    kept = (depth_HW != SATURATED) & (depth_HW <= max_m * scale)
    return np.where(kept, depth_HW, np.uint16(0)), scale


def _stacked(frames: list[_Encoded], labels: list[str]) -> np.ndarray | None:
    """Return the depths to check (T, h, w); None without depth."""
    kinds = [None if one.metres_hw is None else one.per_metre for one in frames]
    other = next((k for k, kind in enumerate(kinds) if kind != kinds[0]), None)
    if other is not None:
        raise UserError(
            f"{labels[other]}: its depth image is of another kind than that of {labels[0]}: use "
            "one kind, such as 16-bit PNG, for a sequence."
        )
    found = [one.metres_hw for one in frames if one.metres_hw is not None]
    return np.stack(found) if found else None


def _for_checks(
    header: dict[str, Any], small: dict[str, Any], thumbs: np.ndarray | None, step: int
) -> Episode:
    """Return an episode without images, whose intrinsics are those of the depths to check."""
    height, width, intrinsics = header["height"], header["width"], small["intrinsics"]
    if thumbs is not None:
        height, width = thumbs.shape[1:]
        first = step // 2 + 0.5  # position of the first pixel's centre in the whole image
        intrinsics = intrinsics / step
        intrinsics[2:] += 0.5 - first / step
    return Episode(
        **{k: header[k] for k in ("name", "scene", "info")},
        length=header["frames"],
        height=height,
        width=width,
        intrinsics_4=intrinsics.astype(np.float32),
        world_from_camera=small["world_from_camera"].astype(np.float32),
        actions=small["actions"],
        states=small["states"],
        action_ids=None,
        voxel_origin_T3=None,
        header=header,
        record=b"",
    )


def _actions(
    raw: RawSequence, part: Part, numbers: list[int], pose: np.ndarray
) -> np.ndarray | None:
    """Return recorded actions, or those of a planar motion; None if there are none.

    Recorded actions of frames that are left out are joined as ``data.clips.join_actions`` does;
    where the next state is the action, it is that of the next frame that is kept.
    """
    if raw.state_is_action and raw.states_TS is not None:
        return raw.states_TS[numbers[1:]].astype(np.float32)
    planar = planar_actions(pose) if raw.pose_T44 is not None else None
    if raw.actions_TA is None:
        return planar
    if planar is not None and raw.actions_TA.shape[1] == PLANAR:
        derived = len(numbers) < part.entry.frames or not _agree(raw.actions_TA, pose)
        return planar if derived else raw.actions_TA.astype(np.float32)
    if len(set(np.diff(numbers))) > 1:
        raise UserError(
            f"{part.name}: frames in the middle cannot be left out, because actions of width "
            f"{raw.actions_TA.shape[1]} lead from each frame to the next: repair the frames."
        )
    stride = numbers[1] - numbers[0] if len(numbers) > 1 else 1
    rows = np.array(numbers[:-1])[:, None] + np.arange(stride)
    return raw.actions_TA[rows].reshape(len(rows), -1).astype(np.float32)


def _in_threads(function: Any, arguments: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """Yield the results of a function in order; a few calls run ahead in threads."""
    workers = max(2, os.cpu_count() or 2)
    waiting: collections.deque[Future[Any]] = collections.deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for words in arguments:
                waiting.append(pool.submit(function, *words))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def world_from_recording(up: str) -> np.ndarray:
    """Return the (4, 4) rotation that takes a recording's up axis to z."""
    axis = np.array(_AXES[up[-1]], float) * (-1 if up.startswith("-") else 1)
    keep = np.array(_AXES["y" if up[-1] == "x" else "x"], float)  # this axis stays horizontal
    rotation = np.eye(4)
    rotation[:3, :3] = np.stack([keep, np.cross(axis, keep), axis])
    return rotation


def _agree(actions_TA: np.ndarray, pose_T44: np.ndarray) -> bool:
    """Tell whether planar actions lead from each pose to the next."""
    metres, radians = checks.action_errors(pose_T44, actions_TA)
    return bool(((metres < checks.ACTION_M) & (radians < checks.ACTION_RAD)).all())


def planar_actions(world_from_camera: np.ndarray) -> np.ndarray | None:
    """Return the (T − 1, 3) actions of a camera that only moves and turns on the ground.

    Returns:
        None if no such actions lead through the poses (T, 4, 4), as with a hand-held camera.
    """
    if len(world_from_camera) < 2:
        return None
    actions = np.asarray(actions_between(np.asarray(world_from_camera, np.float32)))
    return actions if _agree(actions, world_from_camera) else None
