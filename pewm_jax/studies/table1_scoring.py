"""Scores of Table 1: one set of held-out clips for every row, every seed and the baselines.

Per clip: PSNR, SSIM, LPIPS and depth errors over pixels seen before, never seen and all; the logits
of I3D of the observed and imagined frames, for FVD and KVD; and SRC of a walk half as far and back.
Each row's scores are a file beside its weights.

Scores can also be *recorded*: small files that a repository can hold, so a row that was trained and
scored on one machine need not be trained again on another. The name of such a file contains a hash
of the settings of the row's training and of its backbone's, of the data and the weights they start
from, and of the scoring. If a row has a local folder, that is used instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax import shipped
from pewm_jax.config import Config, to_dict
from pewm_jax.data.dataset import MANIFEST, EpisodeSource
from pewm_jax.eval import protocol as protocols
from pewm_jax.eval.metrics import load_all
from pewm_jax.eval.metrics.revisits import ways
from pewm_jax.eval.protocol import Protocol, apply_protocol, resolve_clips
from pewm_jax.eval.reproject import ReprojectChoice, choose_settings, reproject_batch
from pewm_jax.eval.runner import ModelRunner, copy_last
from pewm_jax.eval.scoring import Batch, load_batch
from pewm_jax.geometry.actions import there_and_back
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import COMPRESSED, ResultCache, file_hash, inputs_hash
from pewm_jax.models.lpips.model import LEAST
from pewm_jax.studies.table1_rows import Row
from pewm_jax.studies.table1_training import Study, backbone_of, settings
from pewm_jax.train.runs import WEIGHTS, identity
from pewm_jax.types import Camera, Frames
from pewm_jax.worlds.rollouts import load_finished

NETWORKS = ("lpips_alex", "fvd", "kvd", "src[alex]", "dreamsim")
"""Metrics that need weights; those whose weights are missing are skipped and reported."""
SRC = "src[alex]"
SHORTEST = 9
"""Number of frames of the shortest clip that I3D accepts."""
BASELINES = ("reproject", "copy")
PROTOCOL, SCORES = "protocol.json", "scores"
TRUTH = "the_truth"
Arrays = dict[str, np.ndarray]
Model = Callable[[Frames, Any, Camera, np.ndarray], Frames]
"""``(context, control, camera, seeds_B2) -> (B, N) frames``."""


@dataclasses.dataclass(frozen=True)
class Scorer:
    """The clips and metrics with which all rows are scored.

    Attributes:
        config: the settings that all rows share, with those of the protocol.
        nets: the available metrics that need weights.
        left_out: name of a metric → reason why it is skipped.
        name: a hash of all that scores depend on besides the weights.
    """

    config: Config
    protocol: Protocol
    batches: tuple[Batch, ...]
    nets: Mapping[str, Any]
    left_out: Mapping[str, str]
    name: str
    log: Callable[[str], Any]

    @property
    def house(self) -> str:
        """Return the unit of clustering: ``house`` (scene), or ``episode`` with one scene."""
        clips, episodes = self.protocol.clips, self.protocol.episodes
        return "house" if len({episodes[clip.episode].scene for clip in clips}) > 1 else "episode"

    @property
    def house_of_clip(self) -> np.ndarray:
        """Return the index of each clip's ``house``."""
        of = "scene" if self.house == "house" else "name"
        named = [getattr(self.protocol.episodes[c.episode], of) for c in self.protocol.clips]
        return np.unique(named, return_inverse=True)[1]

    @property
    def frames(self) -> int:
        """Return the number of frames of a clip, including the observed one."""
        return self.config.model.clip.frames

    def row(self, config: Config, *, memory: bool) -> Arrays:
        """Score a trained row with its memory or an empty one, or return its stored scores.

        Raises:
            UserError: its weights are missing or damaged, or an imagined value is not finite.
        """
        run = Path(config.train.run)
        cache = ResultCache.for_weights(run / SCORES, file_hash(run / WEIGHTS), self.name)
        piece = "memory" if memory else "empty"

        def score() -> Arrays:
            fixed = apply_protocol(self.protocol, config)
            batch, context = self.config.evaluate.batch, self.config.data.context
            params, devices = load_finished(run)[1], jax.devices()
            model = ModelRunner(fixed, params, batch, context, self.log, devices=devices)

            def imagine(
                context: Frames, control: Any, camera: Camera, seeds_B2: np.ndarray
            ) -> Frames:
                del camera
                return model.run(context, control, seeds_B2, memory=memory)[2]

            return self._score(imagine, f"scoring {run.name} ({piece})")

        return cache.compute(piece, score)

    def _cache(self, out: Path) -> ResultCache:
        """Return the cache of results that do not depend on weights."""
        return ResultCache.for_weights(out / SCORES, "no weights", self.name)

    def reprojection(self, out: Path) -> ReprojectChoice:
        """Return the settings of ``reproject``, chosen on the validation split."""
        return choose_settings(self.config, self._cache(out), self.log)

    def baseline(self, name: str, out: Path) -> Arrays:
        """Score ``reproject`` or ``copy``, or return the stored scores."""
        settings = self.reprojection(out).settings if name == "reproject" else None

        def imagine(context: Frames, control: Any, camera: Camera, seeds_B2: np.ndarray) -> Frames:
            del control, seeds_B2
            if settings is None:
                return copy_last(context, camera.intrinsics_4.shape[1])
            return reproject_batch(settings, context, camera)

        piece = name if settings is None else f"{name}-{settings.name}"
        return self._cache(out).compute(piece, lambda: self._score(imagine, f"scoring {name}"))

    def truth(self, out: Path) -> Arrays:
        """Return the ground truth's logits, and the ceiling and floor of SRC."""
        return self._cache(out).compute(TRUTH, self._score_truth)

    def _score_truth(self) -> Arrays:
        def score(batch: Batch) -> Arrays:
            video = _joined(batch.context, batch.targets)
            values: Arrays = {}
            if "fvd" in self.nets:
                values["logits"] = self.nets["fvd"].features(video)
            if SRC in self.nets:
                values["walks"] = _there_and_back(video, self.frames // 2)
            return values

        whole = self._over_batches("the truth's own numbers", score)[0]
        if "walks" in whole:
            whole |= self._consistency(whole.pop("walks"))
        return whole

    def _over_batches(self, label: str, score: Callable[[Batch], Arrays]) -> tuple[Arrays, str]:
        """Return the scores of all clips, and a line on the time they took."""
        parts: dict[str, list[np.ndarray]] = {}
        with Meter(label, len(self.protocol.clips), "clips") as meter:
            for batch in self.batches:
                for key, values in score(batch).items():
                    parts.setdefault(key, []).append(values[: batch.real])
                meter.advance(batch.real)
        return {key: np.concatenate(each) for key, each in parts.items()}, meter.summary()

    def _consistency(self, walks_CTHWC: np.ndarray) -> Arrays:
        """Return SRC of the ground truth, and of each walk with the next clip's return path."""
        out, back = (np.asarray(way) for way in ways(walks_CTHWC))
        size, compare = self.config.evaluate.batch, self.nets[SRC].compare
        found = {}
        for name, other in (("src_ceiling", back), ("src_floor", np.roll(back, 1, 0))):
            firsts = range(0, len(out), size)
            parts = [compare(other[at : at + size], out[at : at + size]) for at in firsts]
            found[name] = np.concatenate([np.asarray(part) for part in parts])
        return found

    def _score(self, imagine: Model, label: str) -> Arrays:
        half, nets = (self.frames - 1) // 2, self.nets

        def score(batch: Batch) -> Arrays:
            seeds, camera = batch.seeds(self.config.evaluate.seeds[0]), batch.targets.camera
            frames = imagine(batch.context, batch.control, camera, seeds)
            values = {"sums": batch.sums(frames, nets.get("lpips_alex"))}
            if "fvd" in nets:
                values["logits"] = nets["fvd"].features(_joined(batch.context, frames))
            if SRC in nets:
                control = there_and_back(batch.control[:, :half])
                whole = jax.tree.map(
                    lambda a, b: np.concatenate([a[:, -1:], b], 1), batch.context.camera, camera
                )
                there = jax.tree.map(lambda x: _there_and_back(x, half)[:, 1:], whole)
                walk = _joined(batch.context, imagine(batch.context, control, there, seeds))
                values["src"] = np.asarray(nets[SRC](walk, walk))
            if "dreamsim" in nets:
                truth = _signal(batch.targets.rgb_THWC)
                values["dreamsim"] = np.asarray(nets["dreamsim"](frames.rgb_THWC, truth))
            return values

        found, took = self._over_batches(label, score)
        self.log(took)
        return found


def open_scorer(
    config: Config,
    out: Path,
    log: Callable[[str], Any],
    weights: Mapping[str, str | Path] | None = None,
) -> Scorer:
    """Fix the protocol before training, and read its clips.

    The ``protocol.json`` of the table's folder is written or, if it exists, used. ``weights`` are
    by metric its file or folder, for those that ship with no package.

    Raises:
        UserError: the data are missing or have changed, or the folder contains another protocol.
    """
    out.mkdir(parents=True, exist_ok=True)
    protocol = protocols.write_protocol(config, out / PROTOCOL, log)
    config = apply_protocol(protocol, config)
    split = Path(config.data.path) / config.evaluate.split
    episodes = EpisodeSource(split)
    clips = resolve_clips(config, episodes, protocol, str(split))[1]
    nets, left_out = _measures(config, weights, len(clips))
    for sentence in left_out.values():
        log(sentence)
    size = config.evaluate.batch
    batches = []
    with Meter("reading held-out clips", len(clips), "clips") as meter:
        for first in range(0, len(clips), size):
            some = clips[first : first + size]
            batches.append(load_batch(config, episodes, some, first, cameras=False))
            meter.advance(len(some))
    facts = {
        "protocol": protocol.sha256,
        "seed": config.evaluate.seeds[0],
        "noise": to_dict(config.model.noise),
        "nets": {name: getattr(net, "sha256", name) for name, net in nets.items()},
    }
    return Scorer(config, protocol, tuple(batches), nets, left_out, inputs_hash(facts), log)


def _measures(
    config: Config, weights: Mapping[str, str | Path] | None, clips: int
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the available metrics that need weights, and the reasons why others are skipped."""
    nets, left_out = load_all(NETWORKS, weights)
    clip = config.model.clip
    small = min(clip.height, clip.width) < LEAST["alex"]
    size = f"{LEAST['alex']} pixels each way and these have {clip.width} × {clip.height}"
    short = f"{SHORTEST} frames or more, and these have {clip.frames}"
    for names, unsuitable, why in (
        (("lpips_alex", SRC), small, f"AlexNet needs images of {size}"),
        ((SRC,), clip.frames % 2 == 0, "a walk half as far and back needs an odd clip.frames"),
        (("fvd", "kvd"), clip.frames < SHORTEST, f"I3D needs clips of {short}"),
        (("fvd", "kvd"), clips < 2, "it compares sets, and there is one clip"),
    ):
        for name in names if unsuitable else ():
            if nets.pop(name, None) is not None:
                left_out[name] = f"{name} is left out: {why}."
    return nets, left_out


def _joined(context: Frames, frames: Frames) -> np.ndarray:
    """Return the observed frame and those after it, (B, N + 1, H, W, 3) float32 in [−1, 1]."""
    parts = (_signal(context.rgb_THWC[:, -1:]), _signal(frames.rgb_THWC))
    return np.concatenate(parts, 1)


def _signal(rgb: Any) -> np.ndarray:
    rgb = np.asarray(rgb)
    return rgb.astype(np.float32) / 127.5 - 1 if rgb.dtype == np.uint8 else rgb.astype(np.float32)


def _there_and_back(x_BT: Any, half: int) -> np.ndarray:
    """Return frames 0 … half and back to 0 again, (B, 2 half + 1, …)."""
    x = np.asarray(x_BT)
    return np.concatenate([x[:, : half + 1], x[:, :half][:, ::-1]], 1)


FOLDER = "recorded"
VERSION = 1
"""Increase it when the code changes training or scoring: older scores are then ignored."""
ELSEWHERE = ("train.start", "data.path")
"""Settings of a training that are folders, whose location does not matter."""
ADDED: Mapping[str, Any] = {
    "train.noise_key": "weights",
    "train.beta1": 0.9,
    "train.beta2": 0.999,
    "train.epsilon": 1e-8,
}
"""Settings added later, with the values that reproduce the earlier behaviour; with these values
they are omitted from the name."""


def recorded_path(study: Study, row: Row, seed: int, steps: Mapping[str, int], scored: str) -> Path:
    """Return the file of a row's scores.

    ``steps`` are by name of a row or backbone, ``scored`` is the hash of the protocol and the
    metrics (``Scorer.name``).
    """
    start = study.base.train.start
    facts: list[Any] = [
        VERSION,
        scored,
        file_hash(Path(study.base.data.path) / "train" / MANIFEST),
        file_hash(shipped.find(start) / WEIGHTS) if start else "",
    ]
    facts += [file_hash(Path(row.encoder) / WEIGHTS)] if row.encoder else []
    for which in (backbone_of(study.base, row), row):
        config = settings(study, which, seed, steps[which.name], start="x")
        facts.append(_settings(config))
    return study.out / FOLDER / f"seed{seed}-{row.name}-{inputs_hash(facts)[:12]}.npz"


def _settings(config: Config) -> dict[str, Any]:
    """Return the settings that identify a training's scores, in the format of version 3."""
    found = identity(config) | {"version": 3}
    return {
        name: value
        for name, value in found.items()
        if name not in ELSEWHERE and not (name in ADDED and value == ADDED[name])
    }


def read_recorded(file: Path) -> dict[str, Arrays] | None:
    """Return the scores in a file by name, or None if it is missing or damaged."""
    flat = ResultCache(file.parent, COMPRESSED).get(file.stem)
    if flat is None:
        return None
    found: dict[str, Arrays] = {}
    for key, values in flat.items():
        name, _, measure = key.rpartition(":")
        found.setdefault(name, {})[measure] = values
    return found


def write_recorded(file: Path, found: Mapping[str, Arrays]) -> None:
    """Write scores (row → metric → values), unless the file already contains them."""
    flat = {f"{name}:{k}": x for name, arrays in found.items() for k, x in arrays.items()}
    cache = ResultCache(file.parent, COMPRESSED)
    stored = cache.get(file.stem) or {}
    if stored.keys() != flat.keys() or not all(
        np.array_equal(stored[key], values, equal_nan=True) for key, values in flat.items()
    ):
        cache.put(file.stem, flat)
