"""Videos that are encoded image by image with PyAV: colour in H.264, 12-bit images in HEVC."""

from __future__ import annotations

import io
from pathlib import Path

import av
import numpy as np


class Video:
    """An MP4 that is written image by image, so that none has to be stored.

    Colour, uint8 (H, W, 3), is H.264; images of an odd side are not subsampled. With ``grey12``,
    images are uint16 (H, W) below 4096, stored without loss as HEVC, at least 16 pixels high and
    wide.

    x264 is used without its macroblock tree, whose vectorised code reads uninitialised memory: with
    it, a few bits differ from run to run.
    """

    def __init__(
        self,
        where: io.BytesIO | str | Path,
        size: tuple[int, int],
        fps: int = 4,
        *,
        grey12: bool = False,
        crf: int = 21,
        gop: int = 0,
    ):
        """Open a buffer or a file for images of a height and width.

        Args:
            crf: constant rate factor of colour: lower is better and larger.
            gop: images from one key frame to the next; 0 leaves it to the encoder.
        """
        target = where if isinstance(where, io.BytesIO) else str(where)
        self._container = av.open(target, "w", format="mp4")
        self._stream = self._container.add_stream("libx265" if grey12 else "libx264", rate=fps)
        self._stream.height, self._stream.width = size
        odd = bool(size[0] % 2 or size[1] % 2)
        self.pix_fmt = "gray12le" if grey12 else "yuv444p" if odd else "yuv420p"
        self._stream.pix_fmt = self.pix_fmt
        lossless: dict[str, object] = {"x265-params": "lossless=1:log-level=error"}
        colour: dict[str, object] = {
            "crf": str(crf),
            "preset": "medium",
            "threads": "1",
            "x264-params": "mbtree=0",
        }
        keys: dict[str, object] = {"g": str(gop)} if gop else {}
        self._stream.options = keys | (lossless if grey12 else colour)
        self._format = "gray12le" if grey12 else "rgb24"
        self.frames = self.bytes = 0  # that are encoded so far

    def add(self, image: np.ndarray) -> None:
        """Append an image."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=self._format)
        frame.pts = self.frames
        packets = self._stream.encode(frame)
        self._container.mux(packets)
        self.frames += 1
        self.bytes += sum(packet.size for packet in packets)

    def close(self) -> None:
        """Flush and finish the file."""
        self._container.mux(self._stream.encode())
        self._container.close()
