"""Previews during training: a few fixed held-out clips, imagined and scored at intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval.clips import choose, load_clip, needs_cameras, stack
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.runner import ModelRunner, print_now
from pewm_jax.io import atomic
from pewm_jax.report.pictures import as_bytes, farthest, grid, save_png
from pewm_jax.report.video import encode_h264, side_by_side
from pewm_jax.train.stages import Stage
from pewm_jax.train.watch import IMAGINED, Preview, Previewed
from pewm_jax.types import Frames, Params

SPLIT, CLIPS, SHOWN = "validation", 8, 3
"""The split of previews, the number of scored clips, and the number of displayed clips."""


def make_preview(
    config: Config, run: Path, log: Callable[[str], Any] = print_now
) -> Preview | None:
    """Prepare previews for a training run, or return None if its data allows none.

    Previews are optional: without validation data, or if it is too short, a line is logged and no
    previews are made.

    Returns:
        ``preview(params, stage, step)``. It imagines the clips with the current weights and
        measures their PSNR with its map and with an empty map, or, in a stage without memory (such
        as PEWM's stage 1), of the model without a map. It writes ``previews/stage2-000250.png`` in
        the run's folder with the rows ground truth, with its map, empty map, and
        ``previews/stage2-000250.mp4``, the same side by side. It is compiled once per stage.
    """
    quick = dataclasses.replace(config.evaluate, split=SPLIT, batch=CLIPS)
    config = dataclasses.replace(config, evaluate=quick)
    try:
        episodes = EpisodeSource(Path(config.data.path) / SPLIT)
        choices = choose(config, episodes, CLIPS, 1)
        cameras = needs_cameras(episodes, choices)
        clips = [load_clip(config, episodes, choice, cameras=cameras) for choice in choices]
    except UserError as error:
        log(f"no previews of this training: {error}")
        return None
    context = stack([clip[0] for clip in clips], CLIPS)
    control = stack([clip[2] for clip in clips], CLIPS)
    seeds = np.stack([np.zeros(CLIPS, int), np.arange(CLIPS)], -1)
    models: dict[str, ModelRunner] = {}

    def preview(params: Params, stage: Stage, step: int) -> Previewed:
        if stage.name not in models:
            models[stage.name] = ModelRunner(
                config, params, CLIPS, config.data.context, cameras=cameras
            )
        variants = {"memory": True, "empty": False} if stage.memory else {"model": False}
        imagined: dict[str, Frames] = {}
        for name, memory in variants.items():
            _, _, imagined[name] = models[stage.name].run(
                context, control, seeds, memory=memory, params=params
            )
        name = f"{stage.name}-{step:06d}"
        shown = clips[:SHOWN]
        picture = _picture(shown, imagined, f"{stage.title}, step {step}")
        return Previewed(
            (
                save_png(run / "previews" / f"{name}.png", picture),
                _save_video(run / "previews" / f"{name}.mp4", shown, imagined, f"step {step}"),
            ),
            {name: _score(clips, frames) for name, frames in imagined.items()},
        )

    return preview


_Loaded = tuple[Frames, Frames, Any]
"""Context, ground-truth frames and control of a clip, as returned by ``load_clip``."""


def _score(clips: Sequence[_Loaded], frames: Frames) -> float:
    """Return the mean PSNR in dB over frames and clips (B, N)."""
    truth = np.stack([true.rgb_THWC for _, true, _ in clips])
    difference = unit_colours(frames.rgb_THWC[: len(clips)]) - unit_colours(truth)
    return float(psnr((difference**2).mean((2, 3, 4))).mean())


def _picture(clips: Sequence[_Loaded], imagined: Mapping[str, Frames], title: str) -> np.ndarray:
    """Arrange the frames of every clip: a row for the ground truth and a row for each variant."""
    rows = []
    for index, (seen, true, _) in enumerate(clips):
        present = seen.rgb_THWC[-1]
        rows.append(("truth", [present, *true.rgb_THWC]))
        rows += [
            (IMAGINED[name], [present, *as_bytes(frames.rgb_THWC[index])])
            for name, frames in imagined.items()
        ]
    count = len(clips[0][1].depth_THW)
    columns = ["observed", *(f"{index + 1}" for index in range(count))]
    return grid(rows, columns, title=title, cell=96)


def _save_video(
    path: Path, clips: Sequence[_Loaded], imagined: Mapping[str, Frames], title: str
) -> Path:
    """Write a video atomically: one clip after another, ground truth and variants side by side."""
    pictures = []
    for index, (seen, true, _) in enumerate(clips):
        columns = [
            (name, _with_present(seen, rgb), _with_present_depth(seen, depth))
            for name, rgb, depth in (
                ("truth", true.rgb_THWC, true.depth_THW),
                *(
                    (IMAGINED[name], as_bytes(frames.rgb_THWC[index]), frames.depth_THW[index])
                    for name, frames in imagined.items()
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
