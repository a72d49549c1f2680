"""Partial scores, which survive an interruption: one small file per finished piece of work.

Files are in ``WEIGHTS/FINGERPRINT/``: the hash of the weights, and the fingerprint of weights and
protocol. Opening the folder deletes the files of other weights. Files of other protocols stay, so a
quick look with fewer clips does not discard the scores of the full report. Files are written
atomically; an unreadable one counts as not done.
"""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import numpy as np

from pewm_jax.io import atomic


class Partials:
    """Named sets of arrays of one evaluation.

    Args:
        folder: the folder of all partial results of a report.
        weights: hash of the weights; results of other weights are deleted.
        fingerprint: fingerprint of weights and protocol.
    """

    def __init__(self, folder: Path, weights: str, fingerprint: str):
        self.folder = folder / weights[:16] / fingerprint[:16]
        self.folder.mkdir(parents=True, exist_ok=True)
        for other in folder.iterdir():
            if other != self.folder.parent and other.is_dir():
                shutil.rmtree(other)

    def get(self, name: str) -> dict[str, np.ndarray] | None:
        """Return a finished piece, or None."""
        path = self.folder / f"{name}.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return {key: arrays[key] for key in arrays.files}
        except (FileNotFoundError, zipfile.BadZipFile, ValueError, EOFError, KeyError):
            return None

    def put(self, name: str, **arrays: np.ndarray) -> dict[str, np.ndarray]:
        """Store a finished piece and return it."""
        path = self.folder / f"{name}.npz"
        with atomic.replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
        return arrays
