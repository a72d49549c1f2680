"""Sample pictures during training: the same few held-out clips, imagined anew each time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.evaluation.imagine import Imagination, aloud
from pewm_jax.evaluation.pictures import as_bytes, grid, save_png
from pewm_jax.evaluation.protocol import choose, load_clip, stack
from pewm_jax.types import Params

SPLIT, CLIPS = "validation", 3


def make_preview(
    config: Config, run: Path, say: Callable[[str], Any] = aloud
) -> Callable[[Params, int, int], Path] | None:
    """Prepare previews for a training run, where its data can be previewed.

    A training needs no previews: without validation data, or where that cannot be replayed (too
    short, or moved in ways that are not upright), one line says so and there are none.

    Args:
        config: the experiment; clips come from ``data.path``/validation.
        run: its folder; pictures go to ``previews/`` inside.
        say: told why there are no previews.

    Returns:
        ``preview(params, stage, step)``: imagines the clips with the current weights and writes
        ``previews/stage2-000250.png`` with rows truth, with its map, empty map (stage 1: truth,
        model). It is compiled once per stage. None where there is nothing to preview.
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
    models: dict[int, Imagination] = {}

    def preview(params: Params, stage: int, step: int) -> Path:
        if stage not in models:
            models[stage] = Imagination(config, params, CLIPS, config.data.context)
        variants = {"model": False} if stage == 1 else {"with its map": True, "empty map": False}
        made = {}
        for name, memory in variants.items():
            _, _, frames = models[stage].run(context, actions, seeds, memory=memory, params=params)
            made[name] = as_bytes(frames.rgb_THWC)
        rows = []
        for index, (seen, true, _) in enumerate(clips):
            present = seen.rgb_THWC[-1]
            rows.append(("truth", [present, *true.rgb_THWC]))
            rows += [(name, [present, *rgb[index]]) for name, rgb in made.items()]
        count = len(clips[0][1].depth_THW)
        columns = ["observed", *(f"{index + 1}" for index in range(count))]
        picture = grid(rows, columns, title=f"stage {stage}, step {step}", cell=96)
        return save_png(run / "previews" / f"stage{stage}-{step:06d}.png", picture)

    return preview
