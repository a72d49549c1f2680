"""Decode chosen frames of a video in order, one at a time (PyAV)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np

from pewm_jax.config import UserError


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video; raise the decoder's errors as a ``UserError``."""
    if not path.is_file():
        raise UserError(f"{path} does not exist, but the recording needs it.")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise UserError(f"{path} has no video in it.")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            yield container, stream
    except av.error.FFmpegError as error:
        reason = " ".join(str(error).split())[:120]
        raise UserError(
            f"{path} cannot be decoded as a video ({reason}); it is truncated or damaged, copy it "
            "again."
        ) from None


def video_size(path: Path) -> tuple[int, int]:
    """Return width and height of a video."""
    with _opened(path) as (_, stream):
        return stream.codec_context.width, stream.codec_context.height


def frame_times(path: Path) -> np.ndarray:
    """Return the times (N,) of all frames in order, seconds; nothing is decoded."""
    with _opened(path) as (container, stream):
        stamps = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
        return np.sort(np.array(stamps, np.float64)) * float(stream.time_base)


def frames_at(path: Path, times: Sequence[float], tolerance_s: float) -> Iterator[av.VideoFrame]:
    """Yield the frames at increasing times, seconds; the decoder starts at the first of them.

    Raises:
        UserError: there is no frame within ``tolerance_s`` of a time, or the video is damaged.
    """
    if not len(times):
        return
    with _opened(path) as (container, stream):
        base, wanted = float(stream.time_base), iter(times)
        time = next(wanted)
        container.seek(max(0, int((time - tolerance_s) / base)), stream=stream, backward=True)
        for frame in container.decode(stream):
            at = frame.pts * base if frame.pts is not None else -np.inf
            if at < time - tolerance_s:
                continue
            if at > time + tolerance_s:
                break
            yield frame
            time = next(wanted, None)
            if time is None:
                return
        raise UserError(
            f"{path} has no frame at {time:.3f} s: it is truncated, or does not belong to these "
            "data."
        )


def bgr(frame: av.VideoFrame) -> np.ndarray:
    """Return a frame as (H, W, 3) uint8, blue first."""
    return frame.to_ndarray(format="bgr24")
