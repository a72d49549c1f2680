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
from pewm_jax.report.pictures import after_present, farthest, grid, save_png
from pewm_jax.report.video import encode_h264, side_by_side
from pewm_jax.train.watch import IMAGINED, Preview, Previewed
from pewm_jax.types import Frames, Params
from pewm_jax.worlds.stages import Stage

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
        file = run / "previews" / f"{stage.name}-{step:06d}.png"
        shown = [_columns(clip, imagined, index) for index, clip in enumerate(clips[:SHOWN])]
        times = ["observed", *(str(index + 1) for index in range(len(shown[0][0][1]) - 1))]
        rows = [(name, list(rgb)) for columns in shown for name, rgb, _ in columns]
        save_png(file, grid(rows, times, title=f"{stage.title}, step {step}", cell=96))
        pictures = []
        for index, columns in enumerate(shown):
            where = f"step {step}, clip {index + 1} of {len(shown)}"
            footers = [
                f"{where}: {f'imagined {time}' if at else time}" for at, time in enumerate(times)
            ]
            far_m = farthest(clips[index][1])
            pictures += side_by_side(columns, footers, far_m=far_m, cell=192)
        video = file.with_suffix(".mp4")
        with atomic.replacing(video) as partial:
            partial.write_bytes(encode_h264(pictures))
        psnrs = {name: _score(clips, frames) for name, frames in imagined.items()}
        return Previewed((file, video), psnrs)

    return preview


def _score(clips: Sequence[tuple[Frames, Frames, Any]], frames: Frames) -> float:
    """Return the mean PSNR in dB over frames and clips (B, N)."""
    truth = np.stack([true.rgb_THWC for _, true, _ in clips])
    difference = unit_colours(frames.rgb_THWC[: len(clips)]) - unit_colours(truth)
    return float(psnr((difference**2).mean((2, 3, 4))).mean())


def _columns(
    clip: tuple[Frames, Frames, Any], imagined: Mapping[str, Frames], index: int
) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return caption, colours and depth of a clip's ground truth and of each variant."""
    seen, true, _ = clip
    made = [("truth", true.rgb_THWC, true.depth_THW)]
    made += [(IMAGINED[n], x.rgb_THWC[index], x.depth_THW[index]) for n, x in imagined.items()]
    return [(name, *after_present(seen, rgb, depth)) for name, rgb, depth in made]
