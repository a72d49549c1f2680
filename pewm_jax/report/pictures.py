"""Drawing: captioned grids of frames, depth in colours, and the map from above."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pewm_jax.io import atomic
from pewm_jax.types import Frames

INK, PAPER, QUIET = (28, 32, 40), (255, 255, 255), (112, 118, 130)
"""Text, background, secondary text."""
ROWS = "rows"
"""Folder of a report with the frames of each rollout shown: ``00-truth.png``, ``00-memory.png`` and
so on."""


def picture_steps(frames: int) -> np.ndarray:
    """Return the steps of a rollout that are shown as images; 0 is the present."""
    return np.unique(np.round(np.linspace(0, frames, 8)).astype(int))


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's built-in font, which is the same on every machine."""
    return ImageFont.load_default(size)


def as_bytes(rgb: np.ndarray) -> np.ndarray:
    """Convert colours, uint8 or float in [−1, 1], to uint8, clipped."""
    if rgb.dtype == np.uint8:
        return rgb
    return np.rint((np.clip(rgb.astype(np.float32), -1, 1) + 1) * 127.5).astype(np.uint8)


def after_present(
    present: Frames, rgb_THWC: np.ndarray, depth_THW: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return uint8 colours and depth of T frames, preceded by the last frame of ``present``."""
    rgb = [as_bytes(np.asarray(x)) for x in (present.rgb_THWC[-1:], rgb_THWC)]
    depth = [np.asarray(x, np.float32) for x in (present.depth_THW[-1:], depth_THW)]
    return np.concatenate(rgb), np.concatenate(depth)


def enlarge(image_HWC: np.ndarray, width: int) -> np.ndarray:
    """Resize a uint8 image (cubic) to a width, keeping its aspect ratio."""
    height = round(image_HWC.shape[0] * width / image_HWC.shape[1])
    return cv2.resize(image_HWC, (width, height), interpolation=cv2.INTER_CUBIC)


def depth_colours(depth_HW: np.ndarray, far_m: float) -> np.ndarray:
    """Return depth as colours from near (bright) to far (dark); missing depth is grey."""
    share = 1 - np.clip(depth_HW / far_m, 0, 1)
    bgr = cv2.applyColorMap(np.rint(share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.where((depth_HW > 0)[..., None], bgr[..., ::-1], np.uint8(128))


def dim(image_HWC: np.ndarray, mask_HW: np.ndarray) -> np.ndarray:
    """Grey out the pixels of a uint8 image outside a mask."""
    grey = image_HWC.mean(-1, keepdims=True) * 0.25 + 170
    return np.where(mask_HW[..., None], image_HWC, grey).astype(np.uint8)


def write(
    draw: ImageDraw.ImageDraw,
    place: tuple[float, float],
    text: str,
    *,
    size: int = 15,
    colour: tuple[int, int, int] = INK,
    anchor: str = "lm",
) -> None:
    """Draw a line of text; ``anchor`` as Pillow's (``lm`` left middle, ``mm`` centred)."""
    draw.text(place, text, fill=colour, font=font(size), anchor=anchor)


def grid(
    rows: Sequence[tuple[str, Sequence[np.ndarray]]],
    columns: Sequence[str],
    *,
    title: str = "",
    cell: int = 128,
    gap: int = 6,
) -> np.ndarray:
    """Arrange images in a captioned grid, one uint8 image with even sides.

    Args:
        rows: caption and images (uint8, all of one shape) of each row.
        columns: captions above the columns.
        title: a line above the grid.
        cell: width of an image, pixels.
        gap: space between images, pixels.
    """
    tall = round(rows[0][1][0].shape[0] * cell / rows[0][1][0].shape[1])
    left = 16 + max(int(font(15).getlength(caption)) for caption, _ in rows) + 10
    top = (34 if title else 8) + (24 if any(columns) else 0)
    width = left + len(columns) * (cell + gap) + gap
    height = top + len(rows) * (tall + gap) + gap
    canvas = Image.new("RGB", (width + width % 2, height + height % 2), PAPER)
    draw = ImageDraw.Draw(canvas)
    if title:
        write(draw, (16, 19), title, size=16)
    for j, caption in enumerate(columns):
        write(
            draw,
            (left + j * (cell + gap) + cell / 2, top - 13),
            caption,
            size=14,
            colour=QUIET,
            anchor="mm",
        )
    for i, (caption, images) in enumerate(rows):
        y = top + i * (tall + gap)
        write(draw, (16, y + tall / 2), caption)
        for j, image in enumerate(images):
            large = Image.fromarray(enlarge(image, cell))
            canvas.paste(large, (left + j * (cell + gap), y))
    return np.asarray(canvas)


def png(image_HWC: np.ndarray) -> bytes:
    """Encode a uint8 image as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image_HWC).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def save_png(path: Path, image_HWC: np.ndarray) -> Path:
    """Write a PNG file atomically; its folder is created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial:
        partial.write_bytes(png(image_HWC))
    return path


def from_above(
    points_world_P3: np.ndarray,
    colours_P3: np.ndarray,
    cell_m: tuple[float, float, float],
    path_T3: np.ndarray,
    heading: float,
    *,
    title: str,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
    width: int = 520,
) -> np.ndarray:
    """Draw a map's cells from above, lower cells first, with the agent's path.

    Args:
        points_world_P3: centres of the occupied cells, metres; without the ceiling.
        colours_P3: uint8 colours.
        cell_m: size of a cell.
        path_T3: camera positions, oldest first; the last one gets an arrow.
        heading: yaw of the last camera, radians.
        title: caption.
        bounds: lowest and highest (x, y) to show; all points by default.
        width: width of the image, pixels.
    """
    low, high = bounds if bounds is not None else map_bounds(points_world_P3, path_T3)
    scale = (width - 32) / max(high[0] - low[0], 1e-6)
    tall = math.ceil((high[1] - low[1]) * scale)
    top, bottom = 44, 40
    canvas = Image.new("RGB", (width, top + tall + bottom), (248, 248, 250))
    draw = ImageDraw.Draw(canvas)
    write(draw, (16, 22), title)

    def place(x: float, y: float) -> tuple[float, float]:
        return 16 + (x - low[0]) * scale, top + (high[1] - y) * scale

    half = cell_m[0] / 2 * scale, cell_m[1] / 2 * scale
    for index in np.argsort(points_world_P3[:, 2], kind="stable"):
        x, y = place(*points_world_P3[index, :2])
        box = [round(x - half[0]), round(y - half[1]), round(x + half[0]), round(y + half[1])]
        draw.rectangle(box, fill=tuple(int(c) for c in colours_P3[index]))
    trail = [place(*point[:2]) for point in path_T3]
    if len(trail) > 1:
        draw.line(trail, fill=(255, 255, 255), width=5, joint="curve")
        draw.line(trail, fill=(208, 48, 48), width=3, joint="curve")
    x, y = trail[-1]
    draw.ellipse([x - 6, y - 6, x + 6, y + 6], fill=(208, 48, 48), outline=(255, 255, 255), width=2)
    tip = (x + 22 * math.cos(heading), y - 22 * math.sin(heading))
    draw.line([(x, y), tip], fill=(208, 48, 48), width=4)
    y = top + tall + 20
    draw.line([(16, y), (16 + scale, y)], fill=INK, width=3)
    write(draw, (24 + scale, y), "1 m", size=14)
    return np.asarray(canvas)


def map_bounds(*points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest (x, y) of sets of points, with a margin of half a metre."""
    flat = np.concatenate([np.asarray(cloud)[:, :2] for cloud in points])
    return flat.min(0) - 0.5, flat.max(0) + 0.5


def farthest(frames: Frames) -> float:
    """Return the 98th percentile of the frames' depth, metres."""
    depth = np.asarray(frames.depth_THW)
    return float(np.quantile(depth[depth > 0], 0.98)) if (depth > 0).any() else 1.0
