"""Reconstruction errors of a codec on held-out frames.

Frames are scored at their recorded size, which may differ from the training size. A decoder that
was trained by LPIPS is best by the network in its loss, so pictures are judged by networks that are
not in it: LPIPS with both of its networks, and FVD and KVD by the features of I3D.
"""

from __future__ import annotations

import dataclasses
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
from pewm_jax.eval.metrics import selection
from pewm_jax.eval.metrics.images import WINDOW, psnr, ssim_map, unit_colours
from pewm_jax.eval.metrics.perceptual import LPIPS, PACKAGED, read_lpips, select_lpips
from pewm_jax.eval.metrics.videos import VideoDistance
from pewm_jax.eval.runner import print_now
from pewm_jax.geometry import depth_images
from pewm_jax.io import atomic
from pewm_jax.io.store import file_hash
from pewm_jax.models.i3d.model import LEAST as I3D_LEAST
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips.model import LEAST
from pewm_jax.nn import target
from pewm_jax.train import runs
from pewm_jax.types import Array, Frames, Params
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig
from pewm_jax.worlds.rollouts import load_finished

FRAMES = 16
"""Number of frames scored per episode, evenly spaced."""
LABELS = {
    "psnr": "colour, PSNR, dB",
    "ssim": "colour, SSIM",
    "depth_cm": "depth error, cm",
    "depth_relative": "depth error, relative",
    "square_rgb": "latents of colour, mean square",
    "square_depth": "latents of depth, mean square",
    "sigma_data": "latents, noise.sigma_data",
}
"""The scores, as they are printed, besides LPIPS by network and the distances of sets."""


@dataclasses.dataclass(frozen=True)
class Judges:
    """The networks that judge colours.

    Attributes:
        lpips: LPIPS by name, such as ``lpips_vgg``.
        i3d: I3D, or None.
        about: for each that is left out, the reason as a sentence.
    """

    lpips: dict[str, LPIPS]
    i3d: VideoDistance | None
    about: tuple[str, ...]


def choose_judges(
    lpips: str, fvd: str, height: int, width: int, frames: int, *, accelerator: bool
) -> Judges:
    """Return the networks that the settings ``evaluate.lpips`` and ``evaluate.fvd`` select.

    By default those are LPIPS with every installed network that takes frames of this size, and I3D
    as in other evaluations. ``frames`` is the smallest number of frames of an episode that are
    scored.

    Raises:
        UserError: explicitly requested weights are missing, damaged, or unsuitable.
    """
    found, reasons = {}, []
    for net in PACKAGED.values() if not lpips else ():
        path = lpips_weights.installed(net)
        if path is not None and min(height, width) >= LEAST[net]:
            found[f"lpips_{net}"] = read_lpips(path, net)
    if lpips or not found:
        one, why = select_lpips(lpips, height, width)
        if one is None:
            reasons.append(why)
        else:
            found[f"lpips_{one.encoder}"] = one
    if frames < I3D_LEAST and fvd != selection.OFF:
        short = f"I3D needs {I3D_LEAST} frames, and an episode has {frames}."
        if fvd:
            raise UserError(f"--fvd is {fvd}, and episodes are too short for it: {short}")
        return Judges(found, None, (*reasons, f"FVD and KVD are not measured: {short}"))
    i3d, why = selection.select_fvd(fvd, frames, accelerator=accelerator)
    if i3d is None:
        reasons.append(why)
    return Judges(found, i3d, tuple(reasons))


def in_loss(train: CodecTrainConfig) -> list[str]:
    """Return the names of the metrics that the run's own stages descended."""
    weights = {"codec": train.lpips_weight, "sharpen": train.sharpen_lpips}
    used = any(weight and getattr(train, stage).steps for stage, weight in weights.items())
    return [f"lpips_{train.lpips_net}"] if used else []


def score(
    run: str | Path,
    *,
    data: str | Path | None = None,
    split: str | None = None,
    lpips: str | Path | None = None,
    fvd: str | Path | None = None,
    log: Callable[[str], Any] = print_now,
) -> Path:
    """Score a trained codec on a split; print the scores and write them to a file.

    Args:
        run: the folder of a finished run of the world `codec`, or the name of a codec that ships
            with the library.
        data: the data set's folder; by default the run's.
        split: the folder inside it; by default the run's ``evaluate.split``.
        lpips: as ``evaluate.lpips``, by default that of the run; see ``choose_judges``.
        fvd: as ``evaluate.fvd``, likewise.
        log: prints a line.

    Returns:
        The file written, ``RUN/report/codec-SPLIT.json``. Scores are means over frames, then over
        episodes, then over scenes; ``error`` is the standard error over scenes. ``in_loss`` names
        those that the run's own loss contains. ``videos`` are FVD and KVD between the sets of
        decoded and of recorded episodes, or None.

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
    judges = choose_judges(
        str(config.evaluate.lpips if lpips is None else lpips),
        str(config.evaluate.fvd if fvd is None else fvd),
        min(episode.height for episode in episodes),
        min(episode.width for episode in episodes),
        min(FRAMES, *(episode.length for episode in episodes)),
        accelerator=target.current().platform != "cpu",
    )
    measure = jax.jit(functools.partial(_measure, config.model))
    scenes: dict[str, list[dict[str, float]]] = {}
    features: dict[str, list[np.ndarray]] = {"made": [], "truth": []}
    for episode in episodes:
        count = min(FRAMES, episode.length)
        frames = episode.frames(np.linspace(0, episode.length - 1, count).round().astype(int))
        found, made_THWC = measure(params["codec"], frames)
        pair = {"made": made_THWC[None], "truth": frames.rgb_THWC[None]}
        found |= {name: one.frames(*pair.values())[0] for name, one in judges.lpips.items()}
        scenes.setdefault(episode.scene, []).append(_mean_of_frames(jax.device_get(found)))
        if judges.i3d is not None:
            for name, video in pair.items():
                features[name].append(judges.i3d.features(video))
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
        "in_loss": in_loss(config.train) if isinstance(config.train, CodecTrainConfig) else [],
        "videos": _videos(judges.i3d, features),
    }
    path = home / "report" / f"codec-{folder.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    log(f"{folder}: {len(scenes)} scenes, {', '.join(sizes)} pixels")
    labels = {name: about for name, about in LABELS.items() if name in numbers}
    labels |= {name: f"colour, LPIPS[{one.encoder}]" for name, one in judges.lpips.items()}
    for name, about in labels.items():
        mean, error = numbers[name]["mean"], numbers[name]["error"]
        text = "nothing measured" if mean is None else f"{mean:.3f}"
        text += f" ± {error:.3f}" if error is not None else ""
        log(f"  {about:<30} {text}" + " (in this run's loss)" * (name in result["in_loss"]))
    for found in (result["videos"] or {}).values():
        text = f"{found['value']:.4g}"
        if found["floor"]:
            half, floor = (found[name]["mean"] for name in ("half", "floor"))
            text += f", of halves {half:.4g}, their floor {floor:.4g}"
        log(f"  {'colour, ' + found['name']:<30} {text}")
    for reason in judges.about:
        log(reason)
    return path


def _videos(
    i3d: VideoDistance | None, features: Mapping[str, list[np.ndarray]]
) -> dict[str, Any] | None:
    """Return FVD and KVD of decoded episodes; None without I3D, or for fewer than two episodes."""
    if i3d is None or len(features["made"]) < 2:
        return None
    made, truth = (np.concatenate(features[name]) for name in ("made", "truth"))
    return {
        kind: {"name": one.name(FRAMES, len(made)), **one.score(made, truth).facts()}
        for kind, one in i3d.kinds().items()
    }


def measures(model: CodecTask, params: Params, frames: Frames) -> dict[str, Array]:
    """Return reconstruction errors of one episode's frames, of any size that the codec accepts.

    Per frame (T,): ``psnr`` of colour in dB, and ``ssim`` if a frame is as large as its window;
    over measured pixels within the model's range, ``depth_cm``, the mean absolute error in cm, and
    ``depth_relative`` (NaN if nothing was measured); ``square_rgb`` and ``square_depth``, the mean
    squares of the normalised latents, whose mean is about 1 if the frames resemble the training
    data; ``sigma_data``, the root of the mean square of both, for the noise ``edm``.
    """
    return _measure(model, params, frames)[0]


def _measure(model: CodecTask, params: Params, frames: Frames) -> tuple[dict[str, Array], Array]:
    """Return ``measures``, and the decoded colours (T, H, W, 3) in [−1, 1]."""
    rgb = signal_from_rgb(frames.rgb_THWC)
    depth = jnp.asarray(frames.depth_THW)
    whole = depth_images.fill_depth(depth, model.clip.far_m)
    grey = jnp.broadcast_to(signal_from_depth(model.clip, whole)[..., None], rgb.shape)
    both = jnp.stack([rgb, grey])
    latents = model.codec.encode(params, both)  # type: ignore[arg-type]
    decoded = model.codec.decode(params, latents)  # type: ignore[arg-type]
    made, truth = unit_colours(decoded[0]), unit_colours(frames.rgb_THWC)
    squared = jnp.square(made - truth)
    inside = (depth >= model.clip.near_m) & (depth <= model.clip.far_m)
    off = jnp.abs(depth_from_signal(model.clip, decoded[1].mean(-1)) - depth) * inside
    count = inside.sum((1, 2))
    squares = jnp.square(latents).mean((2, 3, 4))
    found = {
        "psnr": psnr(squared.mean((1, 2, 3))),
        "depth_cm": 100 * off.sum((1, 2)) / count,
        "depth_relative": (off / jnp.where(inside, depth, 1)).sum((1, 2)) / count,
        "square_rgb": squares[0],
        "square_depth": squares[1],
        "sigma_data": jnp.sqrt(squares.mean(0)),
    }
    if min(made.shape[1:3]) >= WINDOW:
        found["ssim"] = ssim_map(made, truth).mean((1, 2))
    return found, 2 * made - 1


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
