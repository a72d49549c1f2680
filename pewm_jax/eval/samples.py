"""The scores of every clip of a report, kept beside it, so that any two runs can be paired later.

``samples.npz`` holds an array for each of ``clips``, ``frames`` and ``rollouts``, each method, mask
and metric, under a name such as ``clips/memory/seen/psnr``; NaN where a clip has no score. Its
member ``about`` is JSON. ``docs/evaluation.md`` describes it.
"""

from __future__ import annotations

import dataclasses
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval.long_rollouts import LongRollouts
from pewm_jax.eval.protocol import ClipChoice
from pewm_jax.eval.scoring import Scored
from pewm_jax.eval.statistics import scores
from pewm_jax.io import atomic
from pewm_jax.report.labels import own_method

SAMPLES, VERSION = "samples.npz", 1
PARTS = ("clips", "frames", "rollouts")
"""Whole clips (seeds, clips); their frames, (seeds, clips, horizon); and the frames of long
rollouts, (1, rollouts, long horizon)."""


@dataclasses.dataclass(frozen=True)
class Samples:
    """What ``samples.npz`` holds.

    Attributes:
        about: ``version``, ``protocol_sha256``, ``weights_sha256``, ``lpips_weights_sha256``,
            ``seeds``, ``clustered_by``, and ``clips`` and ``rollouts``: name, scene and start of
            each.
        arrays: the scores by name.
    """

    about: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray] = dataclasses.field(repr=False)

    @property
    def own(self) -> str:
        """The method that is the model itself: ``memory``, or ``model`` if it has none."""
        return own_method(name.split("/")[1] for name in self.arrays)

    def table(self, part: str, method: str) -> dict[str, dict[str, np.ndarray]]:
        """Return ``[mask][metric]`` of one of ``PARTS``; empty where there is no such method."""
        found: dict[str, dict[str, np.ndarray]] = {}
        for name, array in self.arrays.items():
            where, whose, mask, metric = name.split("/")
            if (where, whose) == (part, method):
                found.setdefault(mask, {})[metric] = array
        return found

    def houses(self, part: str) -> list[str]:
        """Return the name of each clip's house: its scene, or its episode if there is one scene."""
        listed = self.about["rollouts" if part == "rollouts" else "clips"]
        return [entry[1 if self.about["clustered_by"] == "scene" else 0] for entry in listed]


def gather(scored: Scored, long: LongRollouts, **facts: Any) -> Samples:
    """Return the scores of every clip, frame and long rollout.

    Args:
        scored: errors of the clips.
        long: the same of long rollouts.
        facts: the hashes and seeds of ``Samples.about``.
    """
    arrays = {}
    for method, sums_SCT39 in scored.sums.items():
        arrays |= _named("clips", method, sums_SCT39.sum(2)) | _named("frames", method, sums_SCT39)
    for method, sums_SCT39 in long.scored.sums.items():
        arrays |= _named("rollouts", method, sums_SCT39)
    about = {
        "version": VERSION,
        **facts,
        "clustered_by": scored.clustered_by,
        "clips": _listed(scored.choices),
        "rollouts": _listed(long.scored.choices),
    }
    return Samples(about, arrays)


def _named(part: str, method: str, sums: np.ndarray) -> dict[str, np.ndarray]:
    return {
        f"{part}/{method}/{mask}/{metric}": values
        for mask, by_metric in scores(sums).items()
        for metric, values in by_metric.items()
    }


def _listed(choices: Sequence[ClipChoice]) -> list[list[Any]]:
    return [[choice.name, choice.scene, choice.start] for choice in choices]


def save(folder: Path, samples: Samples) -> None:
    """Write ``samples.npz`` into a report's folder."""
    about = np.array(json.dumps(samples.about))
    with atomic.replacing(folder / SAMPLES) as partial, partial.open("wb") as file:
        np.savez_compressed(file, about=about, **samples.arrays)  # pyright: ignore[reportArgumentType]


def load(folder: Path) -> Samples:
    """Read ``samples.npz`` of a report's folder.

    Raises:
        UserError: it is absent, damaged, or of another version.
    """
    path = folder / SAMPLES
    again = "score the run again with `pewm-jax evaluate`; what is scored is kept"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
            about = json.loads(str(arrays.pop("about")))
    except FileNotFoundError:
        raise UserError(f"{folder} has no {SAMPLES}, the scores clip by clip: {again}.") from None
    except (
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,  # of a method of compression that there is not
        ValueError,
        EOFError,
        KeyError,
    ) as error:
        raise UserError(f"{path} is damaged ({error}): {again}.") from None
    if about.get("version") != VERSION:
        raise UserError(
            f"{path} is of version {about.get('version')}, this library reads {VERSION}: {again}."
        )
    return Samples(about, arrays)
