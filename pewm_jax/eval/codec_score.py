"""Reconstruction errors of a codec on held-out frames.

Frames are scored at their recorded size, which may differ from the training size.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import shipped
from pewm_jax.codecs.signals import depth_from_signal, signal_from_depth, signal_from_rgb
from pewm_jax.config import UserError
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.runner import print_now
from pewm_jax.geometry import depth_images
from pewm_jax.io import atomic
from pewm_jax.io.store import file_hash
from pewm_jax.train import runs
from pewm_jax.types import Array, Frames, Params
from pewm_jax.worlds.codec import CodecTask
from pewm_jax.worlds.rollouts import load_finished

FRAMES = 16
"""Number of frames scored per episode, evenly spaced."""
LABELS = {
    "psnr": "colour, PSNR, dB",
    "depth_cm": "depth error, cm",
    "depth_relative": "depth error, relative",
    "square_rgb": "latents of colour, mean square",
    "square_depth": "latents of depth, mean square",
    "sigma_data": "latents, noise.sigma_data",
}
"""The scores, as they are printed."""


def score(
    run: str | Path,
    *,
    data: str | Path | None = None,
    split: str | None = None,
    log: Callable[[str], Any] = print_now,
) -> Path:
    """Score a trained codec on a split; print the scores and write them to a file.

    Args:
        run: the folder of a finished run of the world `codec`, or the name of a codec that ships
            with the library.
        data: the data set's folder; by default the run's.
        split: the folder inside it; by default the run's ``evaluate.split``.
        log: prints a line.

    Returns:
        The file written, ``RUN/report/codec-SPLIT.json``. Scores are means over frames, then over
        episodes, then over scenes; ``error`` is the standard error over scenes.

    Raises:
        UserError: the run, its weights or the data are missing, damaged or incompatible.
    """
    home, run = shipped.home(run), shipped.find(run)
    config, params = load_finished(run)
    if not isinstance(config.model, CodecTask):
        raise UserError(f"{run} contains a world model, not a codec: use pewm-jax evaluate.")
    if not runs.is_finished(run, config):
        raise UserError(
            f"{run} is not fully trained: run the training command again, which resumes and then "
            "fits the latents' statistics."
        )
    folder = Path(data or config.data.path) / (split or config.evaluate.split)
    episodes = EpisodeSource(folder)
    measure = jax.jit(functools.partial(measures, config.model))
    scenes: dict[str, list[dict[str, float]]] = {}
    for episode in episodes:
        count = min(FRAMES, episode.length)
        frames = episode.frames(np.linspace(0, episode.length - 1, count).round().astype(int))
        found = jax.device_get(measure(params["codec"], frames))
        scenes.setdefault(episode.scene, []).append(_mean_of_frames(found))
    sizes = sorted({f"{episode.width}×{episode.height}" for episode in episodes})
    numbers = {
        name: _mean_over_scenes([[one[name] for one in scene] for scene in scenes.values()])
        for name in next(iter(scenes.values()))[0]
    }
    result = {
        "data": str(folder),
        "dataset_sha256": file_hash(folder / MANIFEST),
        "weights_sha256": file_hash(run / "weights.safetensors"),
        "size": sizes,
        "scenes": len(scenes),
        "episodes": len(episodes),
        "frames_of_each": FRAMES,
        "parameters": sum(x.size for x in jax.tree.leaves(params["codec"])),
        "numbers": numbers,
    }
    path = home / "report" / f"codec-{folder.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    log(f"{folder}: {len(scenes)} scenes, {', '.join(sizes)} pixels")
    for name, about in LABELS.items():
        mean, error = numbers[name]["mean"], numbers[name]["error"]
        text = "nothing measured" if mean is None else f"{mean:.3f}"
        log(f"  {about:<30} {text}" + (f" ± {error:.3f}" if error is not None else ""))
    return path


def measures(model: CodecTask, params: Params, frames: Frames) -> dict[str, Array]:
    """Return reconstruction errors of one episode's frames, of any size that the codec accepts.

    Per frame (T,): ``psnr`` of colour in dB; over measured pixels within the model's range,
    ``depth_cm``, the mean absolute error in cm, and ``depth_relative`` (NaN if nothing was
    measured); ``square_rgb`` and ``square_depth``, the mean squares of the normalised latents,
    whose mean is about 1 if the frames resemble the training data; ``sigma_data``, the root of the
    mean square of both, for the noise ``edm``.
    """
    rgb = signal_from_rgb(frames.rgb_THWC)
    depth = jnp.asarray(frames.depth_THW)
    whole = depth_images.fill_depth(depth, model.clip.far_m)
    grey = jnp.broadcast_to(signal_from_depth(model.clip, whole)[..., None], rgb.shape)
    both = jnp.stack([rgb, grey])
    latents = model.codec.encode(params, both)  # type: ignore[arg-type]
    decoded = model.codec.decode(params, latents)  # type: ignore[arg-type]
    squared = jnp.square(unit_colours(decoded[0]) - unit_colours(frames.rgb_THWC))
    inside = (depth >= model.clip.near_m) & (depth <= model.clip.far_m)
    off = jnp.abs(depth_from_signal(model.clip, decoded[1].mean(-1)) - depth) * inside
    count = inside.sum((1, 2))
    squares = jnp.square(latents).mean((2, 3, 4))
    return {
        "psnr": psnr(squared.mean((1, 2, 3))),
        "depth_cm": 100 * off.sum((1, 2)) / count,
        "depth_relative": (off / jnp.where(inside, depth, 1)).sum((1, 2)) / count,
        "square_rgb": squares[0],
        "square_depth": squares[1],
        "sigma_data": jnp.sqrt(squares.mean(0)),
    }


def _mean_of_frames(found: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Average over the frames with a finite value."""
    means = {}
    for name, values in found.items():
        known = values[np.isfinite(values)]
        means[name] = float(known.mean()) if len(known) else float("nan")
    return means


def _mean_over_scenes(scenes: list[list[float]]) -> dict[str, float | None]:
    """Average episodes, then scenes; None if there is nothing to average."""
    means = np.array([np.mean(scene) for scene in scenes])
    means = means[np.isfinite(means)]
    many = len(means) > 1
    return {
        "mean": float(means.mean()) if len(means) else None,
        "error": float(means.std(ddof=1) / np.sqrt(len(means))) if many else None,
    }
