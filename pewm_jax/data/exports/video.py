"""Colours of an episode as a video."""

from __future__ import annotations

from pathlib import Path

from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports.options import ExportConfig
from pewm_jax.io.video import Video

GOP = 2
"""Frames from one key frame to the next, so that single frames can be decoded quickly."""


def open_video(path: Path, size: tuple[int, int], fps: int, *, grey12: bool = False) -> Video:
    """Open a file for exported images, whose frames can be decoded one by one."""
    return Video(path, size, fps, grey12=grey12, crf=18, gop=GOP)


def export(config: ExportConfig, episode: Episode, file: Path) -> None:
    """Write the colours of an episode as a video."""
    video = open_video(file, (episode.height, episode.width), config.fps)
    for k in range(episode.length):
        video.add(episode.frames([k]).rgb_THWC[0])
    video.close()
