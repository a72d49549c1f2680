"""The reprojection baseline: observed pixels rendered from the present camera without a network.

Every observed pixel becomes a coloured 3D point, a z-buffer renders the points for each frame to
imagine, and holes are filled with the nearest hit pixel. Its settings are those that score best on
the validation split; the evaluated split is not used to choose them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data import clips
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.errors import require
from pewm_jax.eval.metrics.images import MASKS, error_sums_batch, unit_colours
from pewm_jax.eval.statistics import scores
from pewm_jax.io.store import ResultCache, file_hash, inputs_hash
from pewm_jax.memory import rendering
from pewm_jax.types import Array, Camera, Clip, Frames, View


@dataclasses.dataclass(frozen=True)
class ReprojectSettings:
    """Rendering settings of observed pixels."""

    footprint: int = 1
    """Largest size of a point, pixels in each direction."""
    width: float = 1.0
    """Width of a point, in pixels of the frame that observed it."""
    average: bool = True
    """Blend all points at the front bilinearly; otherwise show the nearest point."""
    backs: bool = True
    """Show surfaces from behind too; otherwise a back face hides what lies behind it and is
    filled."""

    def __post_init__(self):
        """Validate."""
        require(self.footprint >= 1, f"footprint is {self.footprint}: use at least 1 pixel.")
        require(self.width > 0, f"width is {self.width}: use more than 0 pixels.")

    @property
    def name(self) -> str:
        """Return a short name of the settings, for file names."""
        how = "mean" if self.average else "nearest"
        return f"{how}-{self.footprint}px-{self.width:g}{'' if self.backs else '-fronts'}"

    def __str__(self) -> str:
        """Return a description of the settings."""
        size = "1 pixel each" if self.footprint == 1 else f"up to {self.footprint} pixels each"
        if self.footprint > 1 and self.width != 1:
            size += f", {self.width:g} observed pixels wide"
        shown = "the mean of those at the front" if self.average else "the nearest is shown"
        return f"points of {size}, {shown}{'' if self.backs else ', backs are not'}"


CANDIDATES = (
    ReprojectSettings(average=False),
    ReprojectSettings(),
    ReprojectSettings(footprint=3, average=False),
    ReprojectSettings(footprint=2),
    ReprojectSettings(footprint=3),
    ReprojectSettings(footprint=3, width=1.5),
    ReprojectSettings(footprint=2, backs=False),
    ReprojectSettings(footprint=3, backs=False),
)
"""The candidates tried on the validation split; the first is a plain z-buffer."""


def reproject(settings: ReprojectSettings, context: Frames, camera: Camera) -> Frames:
    """Render S observed frames from N other cameras, of images of the same size.

    Colours are float32 in [−1, 1]. Pixels without depth, such as those of padding frames, are
    ignored. An image without any observed point is black and has no depth.
    """
    view = rendering.fill_nearest(draw(settings, context, camera))
    return Frames(2 * view.features_THWF - 1, view.depth_THW, camera)


def draw(settings: ReprojectSettings, context: Frames, camera: Camera) -> View:
    """Return the rendering before holes are filled, colours in [0, 1]."""
    height, width = context.depth_THW.shape[1:]
    return rendering.splat_frames(
        dataclasses.replace(context, rgb_THWC=unit_colours(context.rgb_THWC)),
        camera,
        height,
        width,
        most=settings.footprint,
        pixels=settings.width,
        average=settings.average,
        backs=settings.backs,
    )


@functools.partial(jax.jit, static_argnums=0)
def reproject_batch(settings: ReprojectSettings, context: Frames, camera: Camera) -> Frames:
    """Render B clips in sequence, because the data of one clip fits a CPU cache."""

    def one(clip: tuple[Frames, Camera]) -> tuple[Array, Array]:
        frames = reproject(settings, *clip)
        return frames.rgb_THWC, frames.depth_THW

    rgb, depth = jax.lax.map(one, jax.tree.map(jnp.asarray, (context, camera)))
    return Frames(rgb, depth, camera)


SPLIT, CLIPS = "validation", 24
"""The split that chooses the settings, and the largest number of clips cut from it."""
VERSION = 1
"""Increase it whenever the same data would give different scores."""


@dataclasses.dataclass(frozen=True)
class ReprojectChoice:
    """The chosen settings, and the reason as a sentence.

    Attributes:
        scores: the name of each candidate → mean PSNR over all pixels of the clips, dB; empty if
            none could be tried.
        clips: number of clips they were tried on.
        data: sha256 of the index of the validation split; "" if there is none.
    """

    settings: ReprojectSettings
    scores: dict[str, float]
    clips: int
    why: str
    data: str = ""

    def facts(self) -> dict[str, Any]:
        """Return the report's entry."""
        return {
            "split": SPLIT if self.scores else None,
            "dataset_sha256": self.data,
            "clips": self.clips,
            "candidates": [
                {"settings": dataclasses.asdict(item), "psnr": self.scores.get(item.name)}
                for item in CANDIDATES
            ],
            "chosen": dataclasses.asdict(self.settings),
            "why": self.why,
        }


def data_hash(config: Config) -> str:
    """Return the sha256 of the index of the validation split; "" if there is none."""
    manifest = Path(config.data.path) / SPLIT / MANIFEST
    return file_hash(manifest) if manifest.is_file() else ""


def choose_settings(
    config: Config, cache: ResultCache, log: Callable[[str], Any], lacking: str = ""
) -> ReprojectChoice:
    """Try all candidates on the data set's validation split and choose the best.

    Clips are cut as in training, the same at every call: one from each episode, then a second one,
    and so on. Scores are stored in ``cache``. Without a validation split whose clips fit the model,
    the default settings are used. ``lacking`` says why nothing can be reprojected, if so.
    """
    folder, data = Path(config.data.path) / SPLIT, data_hash(config)
    if lacking:
        return ReprojectChoice(ReprojectSettings(), {}, 0, lacking, data)
    try:
        episodes = EpisodeSource(folder)

        def score() -> dict[str, np.ndarray]:
            log(f"choosing the settings of the reprojection on {folder} …")
            batch = _cut(config, episodes)
            return {
                "psnr": np.array([_score(settings, batch) for settings in CANDIDATES]),
                "clips": np.array(len(batch.context_valid_S)),
            }

        found = cache.compute(_piece(config, data), score)
    except UserError as error:
        usual = ReprojectSettings()
        why = f"{usual}: the default, nothing was tried ({error})"
        return ReprojectChoice(usual, {}, 0, why, data)
    values, count = [float(value) for value in found["psnr"]], int(found["clips"])
    best = CANDIDATES[int(np.nanargmax(values))]
    why = (
        f"{best}: the best of {len(CANDIDATES)} settings by PSNR over all pixels of {count} clips "
        f"of {folder} ({max(values):.2f} dB; the worst {min(values):.2f})"
    )
    tried = {item.name: value for item, value in zip(CANDIDATES, values, strict=True)}
    return ReprojectChoice(best, tried, count, why, data)


def _piece(config: Config, data: str) -> str:
    """Return the name of the stored scores, which includes all that they depend on."""
    content = [
        VERSION,
        data,
        dataclasses.asdict(config.model.clip),
        [config.data.stride_min, config.data.stride_max, config.data.context],
        [item.name for item in CANDIDATES],
    ]
    return f"reproject-{inputs_hash(content)[:16]}"


def _cut(config: Config, episodes: EpisodeSource) -> Clip:
    """Cut at most ``CLIPS`` clips as in training, in a fixed order; raise if there is none."""
    rng, cut = np.random.default_rng(0), []
    size = (config.model.clip.height, config.model.clip.width)
    for turn in range(CLIPS if len(episodes) else 0):
        episode = episodes[turn % len(episodes)]
        if (episode.height, episode.width) != size:
            raise UserError(
                f"{episodes.path} has frames of {episode.height}×{episode.width}, the model's have "
                f"{size[0]}×{size[1]}; collect or import it at the model's size."
            )
        choice = clips.choose(config, episode.length, rng, episode.name)
        cut.append(clips.cut(episode, choice, config.data.context))
    if not cut:
        raise UserError(f"{episodes.path} has no episodes; collect some.")
    return clips.stack([dataclasses.replace(clip, actions_TA=None) for clip in cut])


def _score(settings: ReprojectSettings, batch: Clip) -> float:
    """Return the mean over clips of the PSNR over all pixels of a clip."""
    targets = jax.tree.map(lambda x: x[:, 1:], batch.frames)
    frames = reproject_batch(settings, batch.context, targets.camera)
    everything = np.ones(targets.depth_THW.shape, bool)
    sums = np.asarray(error_sums_batch(frames, targets, everything, everything)).sum(1)
    return float(scores(sums)[MASKS[-1]]["psnr"].mean())
