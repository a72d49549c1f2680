"""Settings of ``pewm-jax data export``, and the episodes that it writes."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import dataset
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.io import atomic

Formats = Literal["lerobot", "rlds", "rerun", "ply", "glb", "mp4"]
SUFFIX = {"rerun": ".rrd", "ply": ".ply", "glb": ".glb", "mp4": ".mp4"}
"""Formats with one file per episode → its suffix."""


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """Write recorded episodes in the format of another tool.

    `lerobot` is LeRobot's v3 and `rlds` the layout of TensorFlow Datasets, each with all episodes
    in a new folder. `rerun` (frames, depth, camera, points), `ply` and `glb` (the points of all
    frames) and `mp4` have one file per episode. A run's imagined frames are written by `pewm-jax
    show`.
    """

    format: Annotated[Formats, tyro.conf.Positional, tyro.conf.arg(metavar="FORMAT")]
    """lerobot, rlds, rerun, ply, glb or mp4."""
    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """A dataset folder, or one split in it, such as data/demo/train."""
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder to create; or a file such as episode.rrd, for the first chosen episode."""
    episodes: tuple[int, ...] = ()
    """Numbers of episodes, counted over all splits; by default all."""
    fps: int = 10
    """Frames per second: episodes have no clock."""
    point_m: float = 0.02
    """Side of the cubes in which the points of rerun, ply and glb are averaged, metres."""
    name: str = ""
    """Name of the data set; by default that of SRC."""

    def __post_init__(self):
        """Validate."""
        if self.fps < 1:
            raise ConfigError(f"--fps is {self.fps}: use at least 1 frame per second.")
        if not self.point_m > 0:
            raise ConfigError(f"--point_m is {self.point_m}: use metres above 0.")


@dataclasses.dataclass(frozen=True)
class Chosen:
    """The episodes to write.

    Attributes:
        places: split, source and number in the split of every episode, in order.
    """

    places: Sequence[tuple[str, EpisodeSource, int]]

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[tuple[str, Episode]]:
        for split, source, index in self.places:
            yield split, source[index]

    @property
    def splits(self) -> dict[str, int]:
        """Return the number of episodes by split."""
        names = [split for split, _, _ in self.places]
        return {name: names.count(name) for name in dict.fromkeys(names)}


@contextlib.contextmanager
def new(dst: Path) -> Iterator[Path]:
    """Yield a temporary path of the same suffix that becomes ``dst`` when it is complete.

    Raises:
        UserError: ``dst`` exists.
    """
    if dst.exists() or dst.is_symlink():
        raise UserError(f"{dst} exists already; choose a new path or remove that one.")
    dst.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(dst) as partial:
        if not dst.suffix:
            yield partial
            return
        named = partial.with_name(f"{partial.stem}.partial{dst.suffix}")
        try:
            yield named
            named.replace(partial)
        finally:
            atomic.remove(named)


def choose(config: ExportConfig) -> Chosen:
    """Return the episodes of ``config.src`` to write."""
    src = config.src
    if (src / "config.json").is_file() and not (src / dataset.MANIFEST).is_file():
        raise UserError(
            f"{src} is a run; `pewm-jax show {src} --rerun FILE` writes what it imagines."
        )
    if (src / dataset.MANIFEST).is_file():
        found = {src.resolve().name: src}
    else:
        found = {name: src / name for name in dataset.splits(src)}
    if not found:
        dataset.read_manifest(src)  # raises the error that fits
    places = [
        (split, source, index)
        for split, source in ((name, EpisodeSource(path)) for name, path in found.items())
        for index in range(len(source))
    ]
    beyond = [k for k in config.episodes if not 0 <= k < len(places)]
    if beyond:
        raise ConfigError(f"--episodes has {beyond[0]}, and {src} has 0 to {len(places) - 1}.")
    return Chosen([places[k] for k in config.episodes] if config.episodes else places)


def require_alike(episodes: Sequence[Episode], what: str) -> None:
    """Raise UserError if episodes differ in image size, or in which actions or states they have."""

    def facts(one: Episode) -> tuple[object, ...]:
        sizes = [None if x is None else x.shape[1] for x in (one.actions, one.states)]
        return one.width, one.height, *sizes, one.action_ids is not None

    first = facts(episodes[0])
    for one in episodes:
        if facts(one) != first:
            raise UserError(
                f"{one.name} differs from {episodes[0].name} in image size, actions or states, and "
                f"all episodes of a {what} data set are alike; choose --episodes."
            )
