"""Side-by-side videos in H.264, which every browser plays."""

from __future__ import annotations

import io
from collections.abc import Sequence

import av
import numpy as np
from PIL import Image, ImageDraw

from pewm_jax.evaluation.pictures import PAPER, QUIET, as_bytes, depth_colours, enlarge, write


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
        cell: width of a picture, pixels.

    Returns:
        T uint8 pictures of one size with even sides.
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


def encode_h264(pictures: Sequence[np.ndarray], frames_per_second: int = 4) -> bytes:
    """Encode pictures as an MP4 with H.264, yuv420p; equal pictures give equal bytes.

    x264 is used without its macroblock tree, whose vectorised code reads memory that nobody wrote:
    with it, a few bits differ from run to run.

    Args:
        pictures: uint8 (H, W, 3) with even sides, all of one size.
        frames_per_second: playing speed.
    """
    buffer = io.BytesIO()
    height, width = pictures[0].shape[:2]
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=frames_per_second)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {
            "crf": "21",
            "preset": "medium",
            "threads": "1",
            "x264-params": "mbtree=0",
        }
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return buffer.getvalue()
