"""Which settings of the reprojection are taken: those that score best on the validation split.

The model's settings were chosen there too; the split that is reported chooses nothing.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data import clips
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.eval.images import MASKS, error_sums_batch
from pewm_jax.eval.imagine import print_now
from pewm_jax.eval.partial import Partials
from pewm_jax.eval.protocol import file_hash
from pewm_jax.eval.reproject import CANDIDATES, ReprojectSettings, reproject_batch
from pewm_jax.eval.statistics import scores
from pewm_jax.types import Clip

SPLIT, CLIPS = "validation", 24
"""The split that chooses, and the most clips that are cut from it."""
VERSION = 1
"""Increase it whenever the same data would give other scores."""


@dataclasses.dataclass(frozen=True)
class ReprojectChoice:
    """The settings that are used, and why.

    Attributes:
        settings: those chosen.
        scores: the name of each candidate → mean PSNR over all pixels of the clips, decibels; empty
            where nothing could be tried.
        clips: how many clips they were tried on.
        why: a sentence for people.
        data: sha256 of the index of the validation split; "" if there is none.
    """

    settings: ReprojectSettings
    scores: dict[str, float]
    clips: int
    why: str
    data: str = ""

    def facts(self) -> dict[str, Any]:
        """Return what the report says of it."""
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
    config: Config, partials: Partials, say: Callable[[str], Any] = print_now
) -> ReprojectChoice:
    """Try all candidates on the data set's validation split and take the best.

    Clips are cut as in training, the same at every call: one from each episode, then a second one,
    and so on. Scores are kept with the partial results. Without a validation split whose clips fit
    the model, the default settings are taken.

    Args:
        config: the experiment.
        partials: where scores are kept.
        say: shows a line.
    """
    folder, data = Path(config.data.path) / SPLIT, data_hash(config)
    try:
        episodes = EpisodeSource(folder)
        found = partials.get(name := _piece(config, data))
        if found is None:
            say(f"choosing the settings of the reprojection on {folder} …")
            batch = _cut(config, episodes)
            found = partials.put(
                name,
                psnr=np.array([_score(settings, batch) for settings in CANDIDATES]),
                clips=np.array(len(batch.context_valid_S)),
            )
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
    """Name the kept scores by all that they depend on."""
    content = [
        VERSION,
        data,
        dataclasses.asdict(config.model.clip),
        [config.data.stride_min, config.data.stride_max, config.data.context],
        [item.name for item in CANDIDATES],
    ]
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return f"reproject-{digest[:16]}"


def _cut(config: Config, episodes: EpisodeSource) -> Clip:
    """Cut at most ``CLIPS`` clips as training does, in a fixed order.

    Raises:
        UserError: there is none, or their frames have another size than the model's.
    """
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
        raise UserError(f"{episodes.path} has no episode; collect some.")
    return clips.stack([dataclasses.replace(clip, actions_TA=None) for clip in cut])


def _score(settings: ReprojectSettings, batch: Clip) -> float:
    """Return the mean PSNR over clips, of all pixels of a clip together."""
    targets = jax.tree.map(lambda x: x[:, 1:], batch.frames)
    frames = reproject_batch(settings, batch.context, targets.camera)
    everything = np.ones(targets.depth_THW.shape, bool)
    sums = np.asarray(error_sums_batch(frames, targets, everything, everything)).sum(1)
    return float(scores(sums)[MASKS[-1]]["psnr"].mean())
