"""Side-by-side videos: H.264, which every browser plays, and GIF, which every page shows."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from pewm_jax.io.video import Video
from pewm_jax.report.pictures import PAPER, QUIET, as_bytes, depth_colours, enlarge, write


def side_by_side(
    columns: Sequence[tuple[str, np.ndarray, np.ndarray]],
    footers: Sequence[str],
    *,
    far_m: float,
    cell: int = 256,
) -> list[np.ndarray]:
    """Draw several versions of the same frames side by side, colour above depth.

    Args:
        columns: caption, colours (T, H, W, 3) and depth (T, H, W) of each version.
        footers: T lines, one under each frame.
        far_m: depth drawn darkest.
        cell: width of an image, pixels.

    Returns:
        T uint8 images of one size with even sides.
    """
    height, width = columns[0][1].shape[1:3]
    tall = round(height * cell / width)
    header, footer, gap = 34, 30, 8
    size = (gap + len(columns) * (cell + gap), header + 2 * (tall + gap) + footer)
    size = (size[0] + size[0] % 2, size[1] + size[1] % 2)
    pictures = []
    for t, line in enumerate(footers):
        canvas = Image.new("RGB", size, PAPER)
        draw = ImageDraw.Draw(canvas)
        for j, (caption, rgb, depth) in enumerate(columns):
            x = gap + j * (cell + gap)
            write(draw, (x + cell / 2, header / 2), caption, size=17, anchor="mm")
            canvas.paste(Image.fromarray(enlarge(as_bytes(rgb[t]), cell)), (x, header))
            shade = depth_colours(depth[t], far_m)
            canvas.paste(Image.fromarray(enlarge(shade, cell)), (x, header + tall + gap))
        write(draw, (size[0] / 2, size[1] - footer / 2), line, colour=QUIET, anchor="mm")
        pictures.append(np.asarray(canvas))
    return pictures


def small_frames(columns: Sequence[tuple[str, np.ndarray]], *, cell: int = 160) -> list[np.ndarray]:
    """Draw the colours (T, H, W, 3) of several captioned versions side by side: T uint8 images."""
    height, width = columns[0][1].shape[1:3]
    header, gap = 20, 4
    size = (gap + len(columns) * (cell + gap), header + round(height * cell / width) + gap)
    pictures = []
    for t in range(len(columns[0][1])):
        canvas = Image.new("RGB", size, PAPER)
        draw = ImageDraw.Draw(canvas)
        for j, (caption, rgb) in enumerate(columns):
            x = gap + j * (cell + gap)
            write(draw, (x + cell / 2, header / 2), caption, size=13, anchor="mm")
            canvas.paste(Image.fromarray(enlarge(as_bytes(rgb[t]), cell)), (x, header))
        pictures.append(np.asarray(canvas))
    return pictures


def encode_gif(pictures: Sequence[np.ndarray], frames_per_second: int = 4) -> bytes:
    """Encode uint8 images (H, W, 3), all of one size, as a looping GIF."""
    buffer = io.BytesIO()
    first, *others = [Image.fromarray(picture) for picture in pictures]
    first.save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=round(1000 / frames_per_second),
        loop=0,
        optimize=True,
    )
    return buffer.getvalue()


def encode_h264(pictures: Sequence[np.ndarray], frames_per_second: int = 4) -> bytes:
    """Encode uint8 (H, W, 3) images with even sides as an MP4 with H.264, yuv420p.

    Equal images give equal bytes.
    """
    buffer = io.BytesIO()
    film = Video(buffer, pictures[0].shape[:2], frames_per_second)
    for picture in pictures:
        film.add(picture)
    film.close()
    return buffer.getvalue()
