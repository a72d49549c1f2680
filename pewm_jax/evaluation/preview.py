"""Samples during training: the same few held-out clips, imagined anew each time, and measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax import atomic
from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.evaluation.images import psnr, unit_colours
from pewm_jax.evaluation.imagine import Imagination, aloud
from pewm_jax.evaluation.pictures import as_bytes, farthest, grid, save_png
from pewm_jax.evaluation.protocol import choose, load_clip, stack
from pewm_jax.evaluation.video import encode_h264, side_by_side
from pewm_jax.training.samples import IMAGINED, Preview, Previewed
from pewm_jax.training.stages import Stage
from pewm_jax.types import Frames, Params

SPLIT, CLIPS, SHOWN = "validation", 8, 3
"""Where previews come from, how many clips are measured, and how many of them are shown."""


def make_preview(config: Config, run: Path, say: Callable[[str], Any] = aloud) -> Preview | None:
    """Prepare previews for a training run, where its data can be previewed.

    A training needs no previews: without validation data, or where that cannot be replayed (too
    short, or moved in ways that are not upright), one line says so and there are none.

    Args:
        config: the experiment; clips come from ``data.path``/validation.
        run: its folder; pictures and videos go to ``previews/`` inside.
        say: told why there are no previews.

    Returns:
        ``preview(params, stage, step)``: imagines the clips with the current weights, measures
        their PSNR with its map and with an empty map (of a stage without memory, such as PEWM's
        stage 1: of the model, which has none), and writes ``previews/stage2-000250.png`` with rows
        truth, with its map, empty map and ``previews/stage2-000250.mp4``, the same side by side. It
        is compiled once per stage. None where there is nothing to preview.
    """
    quick = dataclasses.replace(config.evaluate, split=SPLIT, batch=CLIPS)
    config = dataclasses.replace(config, evaluate=quick)
    try:
        episodes = EpisodeSource(Path(config.data.path) / SPLIT)
        choices = choose(config, episodes, CLIPS, 1)
        clips = [load_clip(config, episodes, choice) for choice in choices]
    except UserError as error:
        say(f"no previews of this training: {error}")
        return None
    context = stack([clip[0] for clip in clips], CLIPS)
    actions = stack([clip[2] for clip in clips], CLIPS)
    seeds = np.stack([np.zeros(CLIPS, int), np.arange(CLIPS)], -1)
    models: dict[str, Imagination] = {}

    def preview(params: Params, stage: Stage, step: int) -> Previewed:
        if stage.name not in models:
            models[stage.name] = Imagination(config, params, CLIPS, config.data.context)
        variants = {"memory": True, "empty": False} if stage.memory else {"model": False}
        made: dict[str, Frames] = {}
        for name, memory in variants.items():
            _, _, made[name] = models[stage.name].run(
                context, actions, seeds, memory=memory, params=params
            )
        name = f"{stage.name}-{step:06d}"
        shown = clips[:SHOWN]
        picture = _picture(shown, made, f"{stage.title}, step {step}")
        return Previewed(
            (
                save_png(run / "previews" / f"{name}.png", picture),
                _save_video(run / "previews" / f"{name}.mp4", shown, made, f"step {step}"),
            ),
            {name: _score(clips, frames) for name, frames in made.items()},
        )

    return preview


_Loaded = tuple[Frames, Frames, np.ndarray]
"""Context, true frames and actions of a clip, as ``protocol.load_clip`` gives them."""


def _score(clips: Sequence[_Loaded], frames: Frames) -> float:
    """Return the mean PSNR, decibels, over frames and clips (B, N)."""
    truth = np.stack([true.rgb_THWC for _, true, _ in clips])
    difference = unit_colours(frames.rgb_THWC[: len(clips)]) - unit_colours(truth)
    return float(psnr((difference**2).mean((2, 3, 4))).mean())


def _picture(clips: Sequence[_Loaded], made: Mapping[str, Frames], title: str) -> np.ndarray:
    """Lay out the frames of every clip: a row of the truth, a row of each variant."""
    rows = []
    for index, (seen, true, _) in enumerate(clips):
        present = seen.rgb_THWC[-1]
        rows.append(("truth", [present, *true.rgb_THWC]))
        rows += [
            (IMAGINED[name], [present, *as_bytes(frames.rgb_THWC[index])])
            for name, frames in made.items()
        ]
    count = len(clips[0][1].depth_THW)
    columns = ["observed", *(f"{index + 1}" for index in range(count))]
    return grid(rows, columns, title=title, cell=96)


def _save_video(
    path: Path, clips: Sequence[_Loaded], made: Mapping[str, Frames], title: str
) -> Path:
    """Write the clips one after the other, truth and variants side by side; aside, then renamed."""
    pictures = []
    for index, (seen, true, _) in enumerate(clips):
        columns = [
            (name, _with_present(seen, rgb), _with_present_depth(seen, depth))
            for name, rgb, depth in (
                ("truth", true.rgb_THWC, true.depth_THW),
                *(
                    (IMAGINED[name], as_bytes(frames.rgb_THWC[index]), frames.depth_THW[index])
                    for name, frames in made.items()
                ),
            )
        ]
        times = range(len(true.depth_THW) + 1)
        where = f"{title}, clip {index + 1} of {len(clips)}"
        footers = [f"{where}: {f'imagined {time}' if time else 'observed'}" for time in times]
        pictures += side_by_side(columns, footers, far_m=farthest(true), cell=192)
    with atomic.replacing(path) as partial:
        partial.write_bytes(encode_h264(pictures))
    return path


def _with_present(seen: Frames, rgb_THWC: np.ndarray) -> np.ndarray:
    return np.concatenate([seen.rgb_THWC[-1:], rgb_THWC])


def _with_present_depth(seen: Frames, depth_THW: np.ndarray) -> np.ndarray:
    return np.concatenate([seen.depth_THW[-1:], np.asarray(depth_THW, np.float32)])
