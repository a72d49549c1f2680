"""What every format provides: sequences of frames that are read one at a time, when asked for."""

from __future__ import annotations

import abc
import dataclasses
import itertools
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import cv2
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.episodes import decode_image
from pewm_jax.registry import Settings

if TYPE_CHECKING:
    from pewm_jax.data.formats.options import ImportConfig


class BadFrameError(UserError):
    """One frame cannot be used; ``--skip_bad`` leaves such frames out."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """One frame as it was recorded.

    Attributes:
        bgr_HWC: uint8 colours, blue first, as OpenCV decodes them.
        depth_HW: uint16 or float32; ``RawSequence.depth_scale`` of it are one metre. 0, the largest
            16-bit value, and values that are not finite are no measurement. None without depth.
            Its size may differ from that of the colours.
        intrinsics_4: of this frame's colours if they differ from those of the sequence.
        depth_intrinsics_4: of the depth image; by default the colours' intrinsics, scaled to it.
    """

    bgr_HWC: np.ndarray
    depth_HW: np.ndarray | None = None
    intrinsics_4: np.ndarray | None = None
    depth_intrinsics_4: np.ndarray | None = None


Load: TypeAlias = Callable[[], Picture]
"""Read one frame; may be called in another thread. Raises BadFrameError."""


@dataclasses.dataclass(frozen=True)
class RawSequence:
    """An opened sequence of T frames.

    Attributes:
        pose_T44: (T, 4, 4) float64 camera to world, OpenCV axes, in the recording's own world,
            metres; rows that are not finite are lost poses. None if the data have no poses.
        intrinsics_4: fx, fy, cx, cy of the colour images, pixel centres at +0.5; None if unknown.
        size: width and height of the colour images.
        read: returns a loader for each of some increasing frame numbers, in order.
        labels: returns the name of a frame in messages, such as its file.
        depth_scale: stored value of one metre; None if there is no depth.
        faults: frames that are known to be unusable, with the reason.
        actions_TA: (T − 1, A) recorded actions that are no planar motion, or None.
        states_TS: (T, S) the agent's own state at each frame, such as the angles of its joints.
        state_is_action: whether the action of a frame is the state at the next frame that is kept.
        voxels: returns the grids of some frames in a world that was turned by a (4, 4) matrix.
        info: facts about the episode that the format knows.
        note: a sentence for the user about what was taken from where.
        posed_from_colour_44: pose of the colour camera in the frame of the camera that ``pose_T44``
            is of, OpenCV axes; None if it is the same camera.
    """

    pose_T44: np.ndarray | None
    intrinsics_4: np.ndarray | None
    size: tuple[int, int]
    read: Callable[[Sequence[int]], Iterable[Load]]
    labels: Callable[[int], str]
    depth_scale: float | None = 1000.0
    faults: Mapping[int, str] = dataclasses.field(default_factory=dict)
    actions_TA: np.ndarray | None = None
    states_TS: np.ndarray | None = None
    state_is_action: bool = False
    voxels: Callable[[Sequence[int], np.ndarray], Any] | None = None
    info: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    note: str = ""
    posed_from_colour_44: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class Entry:
    """A sequence that was found: its name, its number of frames T, and how to open it."""

    name: str
    frames: int
    open: Callable[[], RawSequence]


@dataclasses.dataclass(frozen=True)
class Format(Settings, abc.ABC):
    """Interface of a format.

    Attributes:
        NAME: its name in the command.
        LAYOUT: the files by which it is recognised.
        UP: the axis of its world that points up.
        CENTRES: the coordinate of the first pixel's centre in its intrinsics.
        DEPTH_SCALE: stored depth of one metre, if the files do not say it; None if they do.
        SIDEWAYS: whether images may lie on their side and are turned upright.
        USES: the options that it takes beside those of all formats.
        LAST: recognised after formats with a smaller number.
    """

    SECTION: ClassVar[str] = "format"
    NAME: ClassVar[str] = ""
    LAYOUT: ClassVar[str] = ""
    UP: ClassVar[str] = "z"
    CENTRES: ClassVar[str] = "integer"
    DEPTH_SCALE: ClassVar[float | None] = 1000.0
    SIDEWAYS: ClassVar[bool] = False
    USES: ClassVar[tuple[str, ...]] = ()
    LAST: ClassVar[int] = 0

    @abc.abstractmethod
    def recognise(self, src: Path) -> str:
        """Return which files show that a folder has this format; empty if it does not."""

    @abc.abstractmethod
    def entries(self, options: ImportConfig) -> list[Entry]:
        """Find the sequences of ``options.src`` in order, without reading their images.

        Raises:
            UserError: files are missing or do not parse.
        """


@dataclasses.dataclass(frozen=True)
class FolderFormat(Format):
    """A format whose sequences are folders; a folder of several of them is read as well."""

    @abc.abstractmethod
    def found(self, folder: Path) -> str:
        """Return which files show that a folder is one sequence; empty if it is not."""

    @abc.abstractmethod
    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return the sequence of one folder."""

    def recognise(self, src: Path) -> str:
        """Return which files were found in the folder or in the first that fits below it."""
        for folder in itertools.islice(self._candidates(src), 100):
            why = self.found(folder)
            if why:
                return why if folder == src else f"{why} in {folder.relative_to(src)}/"
        return ""

    def entries(self, options: ImportConfig) -> list[Entry]:
        """Return the sequences of the folder itself or else of the folders below it."""
        folders = [folder for folder in self._candidates(options.src) if self.found(folder)]
        folders = [options.src] if options.src in folders else folders
        if not folders:
            raise UserError(
                f"{options.src} has no sequence in the layout of {self.NAME}: {self.LAYOUT}."
            )
        return [self.entry(folder, options) for folder in folders]

    def _candidates(self, src: Path) -> Iterator[Path]:
        """Yield the folder, then the folders in it, then those below; in the order of names."""
        yield src
        for folder in subfolders(src):
            yield folder
            yield from subfolders(folder)


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder, in the order of their names."""
    with os.scandir(folder) as inside:
        names = sorted(item.name for item in inside if item.is_dir())
    return [folder / name for name in names]


def numbered(folder: Path, start: str, ends: str | tuple[str, ...]) -> dict[int, str]:
    """Return the names of files ``startNUMBERend`` by their numbers, increasing.

    Only names are kept, so that a folder may have very many files. Empty if there is no folder.
    """
    if not folder.is_dir():
        return {}
    ends = (ends,) if isinstance(ends, str) else ends
    found = {}
    with os.scandir(folder) as inside:
        for item in inside:
            for end in ends:
                middle = item.name[len(start) : len(item.name) - len(end)]
                if item.name.startswith(start) and item.name.endswith(end) and middle.isdecimal():
                    found[int(middle)] = item.name
                    break
    return dict(sorted(found.items()))


def has_numbered(folder: Path, start: str, ends: str | tuple[str, ...]) -> bool:
    """Tell whether a folder has a file ``startNUMBERend``, looking at a few thousand at most."""
    if not folder.is_dir():
        return False
    ends = (ends,) if isinstance(ends, str) else ends
    with os.scandir(folder) as inside:
        for item in itertools.islice(inside, 5000):
            name = next(
                (item.name.removesuffix(end) for end in ends if item.name.endswith(end)), ""
            )
            if name.startswith(start) and name.removeprefix(start).isdecimal():
                return True
    return False


def read_image(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """Decode an image file.

    Raises:
        BadFrameError: it is missing, truncated or damaged.
    """
    try:
        code = path.read_bytes()
    except FileNotFoundError:
        raise BadFrameError(f"{path} does not exist, but the recording lists it.") from None
    image = decode_image(code, flags) if _is_whole(code) else None
    if image is None:
        why = "damaged or truncated" if code else "empty"
        raise BadFrameError(f"{path} does not decode as an image; it is {why}.")
    return image


def read_colour(path: Path) -> np.ndarray:
    """Return an image file as (H, W, 3) uint8, blue first; an orientation tag is ignored."""
    return read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def read_depth(path: Path) -> np.ndarray:
    """Return a depth image (H, W) as stored; BadFrameError if it has several channels."""
    image = read_image(path)
    if image.ndim != 2:
        raise BadFrameError(f"{path} has {image.shape[2]} channels; a depth image must have one.")
    return image


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image file."""
    height, width = read_colour(path).shape[:2]
    return width, height


_PNG = b"\x89PNG\r\n\x1a\n"


def _is_whole(code: bytes) -> bool:
    """Tell whether an image ends as its format demands; for PNG, whether all checksums fit.

    Versions of OpenCV differ in what they return for a truncated file: nothing, or a part.
    """
    if code.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in code[-4096:]
    if not code.startswith(_PNG):
        return bool(code)
    at = len(_PNG)
    while at + 12 <= len(code):
        size, kind = struct.unpack_from(">I4s", code, at)
        end = at + 8 + size
        if end + 4 > len(code):
            return False
        if zlib.crc32(code[at + 4 : end]) != struct.unpack_from(">I", code, end)[0]:
            return False
        if kind == b"IEND":
            return True
        at = end + 4
    return False


def read_numbers(path: Path, count: int, separator: str | None = None) -> np.ndarray:
    """Read a text file of exactly ``count`` numbers; ``nan``, ``inf`` and ``-1.#INF`` are numbers.

    Raises:
        BadFrameError: the file is missing or has something else.
    """
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadFrameError(f"{path} cannot be read as text ({type(error).__name__}).") from None
    words = text.replace(separator, " ").split() if separator else text.split()
    try:
        values = np.array([np.nan if "#" in word else float(word) for word in words])
    except ValueError:
        values = np.empty(0)
    if len(values) != count:
        raise BadFrameError(f"{path} has {len(words)} words where {count} numbers are expected.")
    return values


def read_table(path: Path, columns: int, separator: str | None = None) -> np.ndarray:
    """Read the lines of a text file as (N, ``columns``) numbers; comments and headers are left out.

    Further columns are ignored.

    Raises:
        UserError: a line has fewer numbers, or the file cannot be read.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read as text ({error}).") from None
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.split(separator)
        if not line.strip() or line.startswith("#") or (number == 1 and _is_heading(words)):
            continue
        try:
            rows.append([float(word) for word in words[:columns]])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != columns:
            raise UserError(
                f"{path}, line {number}: expected {columns} numbers, found {line.strip()[:80]!r}."
            )
    return np.array(rows, np.float64).reshape(-1, columns)


def _is_heading(words: Sequence[str]) -> bool:
    return bool(words) and words[0].strip()[:1].isalpha() and words[0].strip().lower() != "nan"
