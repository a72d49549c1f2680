"""Scores of Table 1 that outlive the weights: small files, which a repository can hold.

A row that was trained and scored on one machine need not be trained again on another. Its file is
named by a hash of the settings of its training and of its backbone's, of the data and the weights
that these start from, and of what was scored how. Where a row's own folder is there, that counts.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax import shipped
from pewm_jax.config import Config
from pewm_jax.data.dataset import MANIFEST
from pewm_jax.io import atomic
from pewm_jax.io.store import file_hash
from pewm_jax.studies.rows import Row
from pewm_jax.studies.trainings import Study, backbone_of, settings
from pewm_jax.train.runs import WEIGHTS, identity

FOLDER = "recorded"
VERSION = 1
"""Raise it when the code changes what is learnt or scored: older scores are then left aside."""
ELSEWHERE = ("train.start", "data.path")
"""Folders, which may lie anywhere, in the settings of a training."""
ADDED: Mapping[str, Any] = {
    "train.noise_key": "weights",
    "train.beta1": 0.9,
    "train.beta2": 0.999,
    "train.epsilon": 1e-8,
}
"""Settings that came later, with the values that stand for what was done before; with these they
are left out of the name."""
Arrays = dict[str, np.ndarray]


def path(study: Study, row: Row, seed: int, steps: Mapping[str, int], scored: str) -> Path:
    """Return the file of a row's scores.

    Args:
        study: what all rows share.
        row: the row.
        seed: of its training.
        steps: name of a row or backbone → steps.
        scored: hash of what is scored and how (``Scorer.name``).
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
    name = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    return study.out / FOLDER / f"seed{seed}-{row.name}-{name[:12]}.npz"


def _settings(config: Config) -> dict[str, Any]:
    """Return the settings that name a training's scores, as version 3 of the settings has them."""
    found = identity(config) | {"version": 3}
    return {
        name: value
        for name, value in found.items()
        if name not in ELSEWHERE and not (name in ADDED and value == ADDED[name])
    }


def read(file: Path) -> dict[str, Arrays] | None:
    """Return the scores in a file by name, or None where there is no whole one."""
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            found: dict[str, Arrays] = {}
            for key in arrays.files:
                name, _, measure = key.rpartition(":")
                found.setdefault(name, {})[measure] = arrays[key]
            return found
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error):
        return None


def write(file: Path, found: Mapping[str, Arrays]) -> None:
    """Write scores, name of a row → measure → numbers, unless they are there."""
    if _same(read(file), found):
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    flat = {
        f"{name}:{measure}": values
        for name, arrays in found.items()
        for measure, values in arrays.items()
    }
    with atomic.replacing(file) as partial, partial.open("wb") as opened:
        np.savez_compressed(opened, **flat)  # pyright: ignore[reportArgumentType]


def _same(kept: Mapping[str, Arrays] | None, found: Mapping[str, Arrays]) -> bool:
    if kept is None or kept.keys() != found.keys():
        return False
    return all(
        kept[name].keys() == found[name].keys()
        and all(np.array_equal(kept[name][k], found[name][k], equal_nan=True) for k in found[name])
        for name in found
    )
