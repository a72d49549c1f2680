"""Run ``pewm-jax data export``: write episodes in the format of another tool."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports import lerobot, points, recording, rlds, video
from pewm_jax.data.exports.options import SUFFIX, Chosen, ExportConfig, choose, new
from pewm_jax.io.progress import Meter

WHOLE: Mapping[str, Callable[[ExportConfig, Chosen, Path], None]] = {
    "lerobot": lerobot.export,
    "rlds": rlds.export,
}
"""Formats of whole data sets → what writes them into a folder."""
EACH: Mapping[str, Callable[[ExportConfig, Episode, Path], None]] = {
    "rerun": recording.export,
    "ply": points.export,
    "glb": points.export,
    "mp4": video.export,
}
"""Formats of single episodes → what writes them as a file."""


def export(config: ExportConfig, log: Callable[[str], None] = print) -> None:
    """Run ``data export``.

    Raises:
        UserError: SRC is no data set, DST exists, the episodes do not fit the format, or a package
            is not installed.
    """
    chosen, suffix = choose(config), SUFFIX.get(config.format)
    if suffix is None:
        with new(config.dst) as folder:
            WHOLE[config.format](config, chosen, folder)
        log(f"{config.dst}: {len(chosen)} episodes as {config.format}")
        return
    write = EACH[config.format]
    if config.dst.suffix.lower() == suffix:
        split, episode = next(iter(chosen))
        with new(config.dst) as file:
            write(config, episode, file)
        log(f"{config.dst}: {episode.name} of {split}, {episode.length} frames")
    else:
        with (
            new(config.dst) as folder,
            Meter(f"write {config.dst}", len(chosen), "episodes") as meter,
        ):
            folder.mkdir()
            for (split, _, index), (_, episode) in zip(chosen.places, chosen, strict=True):
                write(config, episode, folder / f"{split}-{index:06d}{suffix}")
                meter.advance(1)
        log(f"{config.dst}: {len(chosen)} episodes, a file of each")
