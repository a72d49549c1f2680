"""Measure the scores of a voxel world for a report: resumable, and shared among processes.

``voxel_scores`` has the measurements. The short ones use the episodes of the report; long walks
need a data set of their own (``evaluate.long``), since its episodes are longer than the horizon.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.data.loader import require_same_cells
from pewm_jax.eval import horizon, voxel_scores
from pewm_jax.eval.horizon import RecordedWalk
from pewm_jax.eval.loaded_run import open_run
from pewm_jax.eval.metrics.videos import VideoDistance
from pewm_jax.eval.runner import workers
from pewm_jax.eval.voxel_scores import AS_TRAINED, KNOWN_FRAMES, MECHANISMS
from pewm_jax.io.store import Arrays, ResultCache, file_hash, inputs_hash, map_resumable
from pewm_jax.types import Params

UNSEEN, KNOWN, LONG, BESIDE = "unseen", "known", "long", "beside"
"""Pieces of work."""
VERSION = 4
"""Increase it whenever a score is measured in another way: older pieces are not reused then."""
STRETCHES = 3
"""Parts of equal length of a long walk, over which PSNR is averaged."""
Key = tuple[str, str]
"""A piece of work, and a mechanism that is switched off or the name of another world."""


@dataclasses.dataclass(frozen=True)
class _Walks:
    """Long walks, and the ways through the doorways that their observed frames show open."""

    walks: list[RecordedWalk]
    doorways: list[list[np.ndarray]]

    @property
    def truth(self) -> np.ndarray:
        """The true frames, (B, T, H, W, 3) uint8."""
        return np.stack([walk.truth_THWC for walk in self.walks])


def settings_of(config: Config) -> dict[str, Any]:
    """Return the settings on which the scores of a voxel world depend, and the long data's hash.

    Raises:
        UserError: ``evaluate.long`` is set and has no data.
    """
    chosen, data = config.evaluate, ""
    if chosen.long:
        manifest = Path(chosen.long) / chosen.split / MANIFEST
        if not manifest.is_file():
            raise UserError(
                f"evaluate.long is {chosen.long}, and {manifest} does not exist: give a data set "
                "of pewm-jax data collect --voxels, with episodes longer than "
                "evaluate.long_frames."
            )
        data = file_hash(manifest)
    return {
        "version": VERSION,
        "long_sha256": data,
        "frames": chosen.long_frames if chosen.long else 0,
        "beside": {name: open_run(name).weights_hash for name in chosen.beside},
        "rows": _rows(config),
        "prior_sha256": file_hash(prior) if (prior := _prior_manifest(config)).is_file() else "",
    }


def require_data(config: Config, episodes: Sequence[Episode]) -> None:
    """Refuse data or settings that cannot be measured, before hours of imagining.

    Raises:
        UserError: the episodes have no voxels or other ones than the world, long walks are too
            short, another world has another size of images, or there are too few windows for FVD.
    """
    if not config.model.capabilities.voxels:
        return
    chosen, first = config.evaluate, episodes[0]
    if first.voxel_grid is None:
        raise UserError(
            f"the episodes of {config.data.path} have no voxels, which this world is scored by: "
            "use data of pewm-jax data collect --voxels."
        )
    require_same_cells(config.model, first)
    if not chosen.long:
        return
    settings_of(config)  # refuses a folder without data
    source = EpisodeSource(Path(chosen.long) / chosen.split)
    some = [source[k] for k in range(min(len(source), chosen.batch))]
    require_same_cells(config.model, some[0])
    needed = config.data.context + chosen.long_frames
    for one in some:
        if one.length < needed:
            raise UserError(
                f"episode {one.name} of {chosen.long} has {one.length} frames, and long walks need "
                f"{needed} (data.context + evaluate.long_frames): collect longer episodes, or "
                "lower evaluate.long_frames."
            )
    windows = len(some) * (chosen.long_frames // horizon.WINDOW)
    if chosen.fvd == "on" and windows < 2:
        raise UserError(
            f"FVD needs two windows of {horizon.WINDOW} frames, and {len(some)} walks of "
            f"{chosen.long_frames} frames have {windows}: raise evaluate.long_frames or "
            "evaluate.batch, or use --fvd off."
        )
    size = config.model.clip.height, config.model.clip.width
    for name in chosen.beside:
        clip = open_run(name).config.model.clip
        if (clip.height, clip.width) != size:
            raise UserError(
                f"evaluate.beside names {name}, which has images of {clip.width}×{clip.height} "
                f"pixels, and this world has {size[1]}×{size[0]}: name worlds of the same size."
            )


def score(
    config: Config,
    params: Params,
    episodes: Sequence[Episode],
    cache: ResultCache,
    log: Callable[[str], Any],
    i3d: VideoDistance | None = None,
) -> dict[str, Any] | None:
    """Return the scores of a voxel world as plain values; None for other worlds.

    Raises:
        UserError: the episodes have no voxels or are too short, or another world cannot be read.
    """
    if not config.model.capabilities.voxels:
        return None
    settings = settings_of(config)
    rows = settings["rows"]
    long = None
    if config.evaluate.long:
        long = _read_walks(config)
    keys: list[Key] = [(UNSEEN, row) for row in rows] + [(KNOWN, AS_TRAINED)]
    if long is not None:
        keys += [(LONG, row) for row in rows] + [(BESIDE, n) for n in config.evaluate.beside]

    def work(todo: list[Key]) -> Iterator[tuple[Key, Arrays]]:
        log("measuring the voxels …")
        for key in todo:
            yield key, _measure(config, params, episodes, long, key)

    found = map_resumable(
        keys,
        lambda key: f"voxels-{key[0]}-{inputs_hash(_inputs(key, settings))[:16]}",
        work,
        cache=cache,
        what="voxels",
        workers=workers(),
    )
    return _facts(config, long, found, rows, i3d)


def _inputs(key: Key, settings: Mapping[str, Any]) -> list[Any]:
    """Return what a piece of work depends on, besides the protocol; other rows do not matter."""
    piece, name = key
    inputs: list[Any] = [VERSION, *key, MECHANISMS.get(name)]
    if key == (UNSEEN, AS_TRAINED):
        inputs += [settings["prior_sha256"], "interval"]
    if piece in (LONG, BESIDE):
        inputs += [settings["long_sha256"], settings["frames"]]
    return [*inputs, settings["beside"][name]] if piece == BESIDE else inputs


def _read_walks(config: Config) -> _Walks:
    """Read the long walks: one of each of the first ``evaluate.batch`` episodes.

    A walk starts where most doorways are seen open, as early as possible.
    """
    chosen, context = config.evaluate, config.data.context
    source = EpisodeSource(Path(chosen.long) / chosen.split)
    count = min(len(source), chosen.batch)
    some = [source[k] for k in range(count)]
    require_same_cells(config.model, some[0])
    first, walks, doorways = context - 1, [], []
    for one in some:
        starts = range(first, max(one.length - chosen.long_frames, first + 1))
        at = voxel_scores.most_doorways(config, one, starts, context)
        walks.append(horizon.read_walk(one, at, chosen.long_frames, context))
        doorways.append(voxel_scores.open_doorways(config, one, at, context))
    return _Walks(walks, doorways)


def _measure(
    config: Config, params: Params, episodes: Sequence[Episode], long: _Walks | None, key: Key
) -> Arrays:
    piece, name = key
    if piece == BESIDE:
        assert long is not None
        other = open_run(name)
        video = horizon.imagine_walks(other.config, other.params, long.walks, label=name)
        return {"video": video}
    changed = voxel_scores.variant(config, name)
    if piece == UNSEEN:
        cells = voxel_scores.unseen_walls(changed, params, episodes, config.evaluate.clips)
        others = _prior(config) if name == AS_TRAINED else []
        scores = voxel_scores.unseen_scores(cells, others)
        return {name: np.asarray(value, np.float64) for name, value in scores.items()}
    if piece == KNOWN:
        walks = _short_walks(config, episodes)
        psnr = voxel_scores.known_grid(config, params, walks)
        count = len(walks), len(walks[0].actions_T3)
        return {"psnr": np.asarray(psnr), "count": np.asarray(count)}
    assert long is not None
    made = voxel_scores.long_walks(changed, params, long.walks, long.doorways, label=name)
    return {
        "video": made.video,
        "seen": np.asarray(made.seen),
        "doorways": np.asarray(made.doorways),
    }


def _rows(config: Config) -> list[str]:
    """Return the rows of the table that are about this world."""
    return voxel_scores.mechanisms(config) if config.evaluate.mechanisms == "on" else [AS_TRAINED]


def _prior_manifest(config: Config) -> Path:
    return Path(config.data.path) / "train" / MANIFEST


def _prior(config: Config) -> list[voxel_scores.UnseenCells]:
    """Return windows of the training split, or none if it is not there."""
    if not _prior_manifest(config).is_file():
        return []
    source = EpisodeSource(_prior_manifest(config).parent)
    count = min(len(source), voxel_scores.PRIOR_HOUSES)
    return voxel_scores.prior_places(config, [source[k] for k in range(count)])


def _short_walks(config: Config, episodes: Sequence[Episode]) -> list[RecordedWalk]:
    """Return walks of equal length of the report's episodes, to be rendered from known grids."""
    context, count = config.data.context, min(len(episodes), config.evaluate.batch)
    some = [episodes[k] for k in range(count)]
    frames = min(KNOWN_FRAMES, min(one.length for one in some) - context)
    if frames < 1:
        raise UserError(
            f"the episodes of {config.data.path} have at most {context} frames, all of which are "
            "observed before a walk: collect longer ones, or lower data.context."
        )
    return [horizon.read_walk(one, context - 1, frames, context) for one in some]


def _facts(
    config: Config,
    long: _Walks | None,
    found: Mapping[Key, Arrays],
    rows: Sequence[str],
    i3d: VideoDistance | None,
) -> dict[str, Any]:
    """Return all scores as plain values."""
    unseen = {name: float(value) for name, value in found[UNSEEN, AS_TRAINED].items()}
    frames = int(found[KNOWN, AS_TRAINED]["count"][1])
    facts: dict[str, Any] = {
        "unseen": {name: value for name, value in unseen.items() if not math.isnan(value)},
        "known": {"psnr": float(found[KNOWN, AS_TRAINED]["psnr"]), "frames": frames},
        "long": None,
        "rows": {row: {"iou": float(found[UNSEEN, row]["iou"])} for row in rows},
    }
    if long is None:
        return facts
    truth = long.truth
    made = {row: found[LONG, row]["video"] for row in rows}
    made |= {name: found[BESIDE, name]["video"] for name in config.evaluate.beside}
    fvd = voxel_scores.video_distance(made, truth, i3d) if i3d else {}
    count = truth.shape[1]
    ends = [count * (k + 1) // STRETCHES for k in range(STRETCHES)]
    for row in rows:
        piece = found[LONG, row]
        facts["rows"][row] |= {
            "seen": [float(x) for x in piece["seen"]],
            "lost": float(piece["seen"][0] - piece["seen"][1]),
            "doorways": [int(x) for x in piece["doorways"]],
        }
    for name, video in made.items():
        scores = facts["rows"].setdefault(name, {})
        scores |= {"psnr": horizon.stretches(video, truth, ends), **fvd.get(name, {})}
    facts["long"] = {
        "data": config.evaluate.long,
        "walks": len(long.walks),
        "frames": count,
        "ends": ends,
        "beside": list(config.evaluate.beside),
    }
    return facts
