"""Run ``pewm-jax show``: imagine beside a recorded episode, and write it for other tools."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro

from pewm_jax.errors import ConfigError, UserError
from pewm_jax.io import runtime


@dataclasses.dataclass(frozen=True)
class Settings:
    """Imagine along a recorded episode, and write the frames and the map for other tools.

    The model observes some frames of the episode, then imagines the following ones with the
    recorded actions (or cameras, if the episode has no actions that the model takes).
    """

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder, the name of a model that ships with the library, or org/name on a hub."""
    rerun: Path | None = None
    """Recording for Rerun to write (FILE.rrd): frames, depth, paths and the map, imagined beside
    true (`pip install 'pewm-jax[rerun]'`)."""
    map: Path | None = None
    """Point cloud of the model's map to write (FILE.ply or FILE.glb)."""
    video: Path | None = None
    """Video to write (FILE.mp4): true beside imagined, colour above depth."""
    data: Path | None = None
    """Folder of the data set; by default that of the run."""
    split: str = ""
    """Split in it; by default that of the run's evaluation."""
    episode: int = 0
    """Number of the episode."""
    context: int = 8
    """Number of observed frames."""
    frames: int = 32
    """Number of frames to imagine, at most those that the episode has."""
    fps: int = 4
    """Frames per second of the video."""
    seed: int = 0
    """Seed of the sampling noise."""

    def __post_init__(self):
        """Validate."""
        wanted = {"rerun": (".rrd",), "map": (".ply", ".glb"), "video": (".mp4",)}
        given = {name: path for name in wanted if (path := getattr(self, name)) is not None}
        if not given:
            raise ConfigError("Nothing is to be written: give --rerun, --map or --video a file.")
        for name, path in given.items():
            if path.suffix.lower() not in wanted[name]:
                ends = " or ".join(wanted[name])
                raise ConfigError(f"--{name} is {path}: name a file that ends in {ends}.")
        if min(self.context, self.frames, self.fps) < 1:
            raise ConfigError("--context, --frames and --fps must be above 0.")


def run(settings: Settings) -> None:
    """Imagine, and write the files."""
    # Imported lazily: help and errors are fast.
    from pewm_jax.eval.loaded_run import open_run

    files = [path for path in (settings.rerun, settings.map, settings.video) if path is not None]
    for path in files:
        if path.exists():
            raise UserError(f"{path} exists already; choose a new name or remove it.")
    opened = open_run(settings.run)
    if settings.map and not opened.config.model.capabilities.points:
        raise ConfigError(f"--map: the memory of {settings.run} has no points; omit it.")
    runtime.cache_compilation(opened.home.parent)
    made = _imagined(settings, opened)
    writers: dict[str, Callable[[Path, Settings, Any], None]] = {
        "rerun": _recording,
        "map": _map,
        "video": _video,
    }
    from pewm_jax.data.exports.options import new

    for name, write in writers.items():
        path = getattr(settings, name)
        if path is not None:
            with new(path) as partial:
                write(partial, settings, made)
            print(f"{name}: {path}")


@dataclasses.dataclass(frozen=True)
class Imagined:
    """Frames of an episode (with colours uint8), and what a model imagined.

    Attributes:
        observed: (S,) observed frames.
        true: (T,) recorded frames after them.
        made: (T,) imagined ones.
        points: positions (N, 3) and uint8 colours (N, 3) of the map at the end, or None.
        name: name of the episode.
    """

    observed: Any
    true: Any
    made: Any
    points: tuple[Any, Any] | None
    name: str


def _imagined(settings: Settings, opened: Any) -> Imagined:
    """Imagine along the episode.

    Raises:
        UserError: the episode does not exist or is too short.
    """
    import jax
    import numpy as np

    from pewm_jax import worlds
    from pewm_jax.codecs.signals import rgb_from_signal
    from pewm_jax.data.dataset import EpisodeSource
    from pewm_jax.data.loader import require_same_cells
    from pewm_jax.eval.clips import recorded_control, steered_by_record
    from pewm_jax.geometry.actions import PLANAR
    from pewm_jax.types import Frames
    from pewm_jax.worlds.rollouts import rollout

    config, params = opened.config, opened.params
    data = settings.data or Path(config.data.path)
    source = EpisodeSource(data / (settings.split or config.evaluate.split))
    if not 0 <= settings.episode < len(source):
        raise UserError(
            f"--episode is {settings.episode}, and {source.path} has 0 to {len(source) - 1}."
        )
    episode = source[settings.episode]
    require_same_cells(config.model, episode)
    count = min(settings.frames, episode.length - settings.context)
    if count < 1:
        raise UserError(
            f"{episode.name} has {episode.length} frames, too few for --context "
            f"{settings.context}; choose a longer episode or observe fewer frames."
        )
    first = settings.context - 1
    after = np.arange(first + 1, first + 1 + count)
    observed, true = episode.frames(range(settings.context)), episode.frames(after)
    planar = episode.actions is not None and episode.actions.shape[1] == PLANAR
    control: Any = true.camera
    if steered_by_record(config.model):
        control = recorded_control(config.model, episode, range(first, first + 1 + count))
    elif planar and episode.actions is not None:
        control = episode.actions[first : first + count]
    print(f"imagining {count} frames …", flush=True)
    state = worlds.start(config, params, observed)
    state, frames = rollout(config, params, state, control, jax.random.key(settings.seed))
    rgb = np.asarray(frames.rgb_THWC)
    rgb = rgb if rgb.dtype == np.uint8 else np.asarray(rgb_from_signal(rgb))
    made = Frames(rgb, np.asarray(frames.depth_THW, np.float32), true.camera)
    return Imagined(observed, true, made, _points(config, state), episode.name)


def _points(config: Any, state: Any) -> tuple[Any, Any] | None:
    """Return positions and uint8 colours of the points in a world's memory, if it has any."""
    import numpy as np

    from pewm_jax import worlds

    model = config.model
    if not model.capabilities.points:
        return None
    points, features, valid = worlds.memory_points(config, state)[:3]
    valid = np.asarray(valid)
    colours = np.asarray(model.point_colours(features), np.float32)[valid]
    colours = np.rint((np.clip(colours, -1, 1) + 1) * 127.5).astype(np.uint8)
    return np.asarray(points, np.float32)[valid], colours


def _recording(path: Path, settings: Settings, made: Imagined) -> None:
    """Write the recording for Rerun."""
    import numpy as np

    from pewm_jax.data.exports.recording import Recording

    first = settings.context
    with Recording(path, made.name, "true", "imagined") as recording:
        recording.frames("true", made.observed)
        recording.frames("true", made.true, first)
        recording.frames("imagined", made.made, first)
        poses = (made.observed.camera.world_from_camera, made.true.camera.world_from_camera)
        recording.path("true", np.concatenate(poses))
        recording.path("imagined", made.made.camera.world_from_camera)
        if made.points is not None:
            recording.points("map", *made.points, POINT_M)


POINT_M = 0.05
"""Diameter at which points of a map are drawn, metres."""


def _map(path: Path, settings: Settings, made: Imagined) -> None:
    """Write the map as a point cloud."""
    from pewm_jax.data.exports import points

    if made.points is None or not len(made.points[0]):
        raise UserError(f"the map of {settings.run} is empty, so there is nothing to write.")
    points.write(path, *made.points)


def _video(path: Path, settings: Settings, made: Imagined) -> None:
    """Write true beside imagined."""
    from pewm_jax.report.pictures import farthest
    from pewm_jax.report.video import encode_h264, side_by_side

    columns = [
        ("true", made.true.rgb_THWC, made.true.depth_THW),
        ("imagined", made.made.rgb_THWC, made.made.depth_THW),
    ]
    footers = [f"{made.name}, imagined {k + 1}" for k in range(len(made.true.rgb_THWC))]
    pictures = side_by_side(columns, footers, far_m=farthest(made.true))
    path.write_bytes(encode_h264(pictures, settings.fps))
