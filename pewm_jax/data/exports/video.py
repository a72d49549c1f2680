"""Videos of frames, encoded by PyAV: colour in H.264, 12-bit images in HEVC without loss."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports.options import ExportConfig

GOP = 2
"""Frames from one key frame to the next, so that single frames can be decoded quickly."""


class Video:
    """An MP4 that is written frame by frame.

    Colour, uint8 (H, W, 3), is H.264 with ``crf`` 18; images of an odd side are not subsampled.
    With ``grey12``, images are uint16 (H, W) below 4096, stored without loss as HEVC, at least 16
    pixels high and wide.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int, *, grey12: bool = False):
        """Open a file for frames of a height and width."""
        self._container = av.open(str(path), "w", format="mp4")
        self._stream = self._container.add_stream("libx265" if grey12 else "libx264", rate=fps)
        self._stream.height, self._stream.width = size
        odd = bool(size[0] % 2 or size[1] % 2)
        self.pix_fmt = "gray12le" if grey12 else "yuv444p" if odd else "yuv420p"
        self._stream.pix_fmt = self.pix_fmt
        lossless = {"x265-params": "lossless=1:log-level=error", "preset": "ultrafast"}
        options = lossless if grey12 else {"crf": "18", "preset": "veryfast"}
        self._stream.options = {"g": str(GOP), **options}
        self._format = "gray12le" if grey12 else "rgb24"
        self.frames = self.bytes = 0  # that are encoded so far

    def add(self, image: np.ndarray) -> None:
        """Append a frame."""
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


def export(config: ExportConfig, episode: Episode, file: Path) -> None:
    """Write the colours of an episode as a video."""
    video = Video(file, (episode.height, episode.width), config.fps)
    for k in range(episode.length):
        video.add(episode.frames([k]).rgb_THWC[0])
    video.close()
