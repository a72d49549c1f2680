"""A cache of the image features of a data set, for encoders that are slower than reading a file.

A cache is a folder per split. It has one safetensors file per episode, with ``features_ThwF``, and
``cache.json``, which is written last. That file identifies the encoder's weights, the preprocessing
and the data, by hashes and settings. A cache is refused as stale if these differ from what the
reader uses. ``feature_build`` fills it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pewm_jax import registry as kinds
from pewm_jax.config import Encoder, UserError
from pewm_jax.data.dataset import Manifest, read_manifest
from pewm_jax.data.episodes import Episode
from pewm_jax.io import tensor_files, tree
from pewm_jax.types import Params

MANIFEST = "cache.json"
UNFINISHED = "caching.json"
"""A file that says what an unfinished cache is being filled with."""
TENSOR = "features_ThwF"
VERSION = 1
Dtype = Literal["float16", "bfloat16", "float32"]


@dataclasses.dataclass(frozen=True)
class FeatureCache:
    """An opened cache of one split; see ``open_cache`` and ``features``.

    Attributes:
        path: its folder.
        made_of: the fingerprint of encoder, preprocessing and data.
        files: episode name → (file name, number of frames).
    """

    path: Path
    made_of: Mapping[str, Any]
    files: Mapping[str, tuple[str, int]]


def fingerprint(config: Encoder, params: Params, data: Manifest) -> dict[str, Any]:
    """Return what features depend on: encoder, weights, preprocessing, data.

    Weights are identified by a hash of their float32 values, whatever dtype they are stored in;
    data by the hashes of the split's shards.

    Args:
        config: the encoder.
        params: the encoder's parameters, empty where it has none.
        data: the split's manifest.

    Raises:
        UserError: the features are the codec's latents.
    """
    config.require_own("are not kept in a cache")
    shards = "\n".join(shard.sha256 for shard in data.shards)
    return {
        "encoder": kinds.of(config).name,
        **config.preprocessing(),
        "weights": tree.digest(params),
        "data": hashlib.sha256(shards.encode()).hexdigest(),
    }


def open_cache(path: Path, config: Encoder, params: Params, data: Path) -> FeatureCache:
    """Open a finished cache, if it belongs to this encoder and this data.

    Args:
        path: the cache of one split.
        config: the encoder.
        params: the encoder's parameters, empty where it has none.
        data: the split that it should belong to.

    Raises:
        UserError: it is absent, unfinished, damaged or stale (made with other weights, other
            preprocessing or other data).
    """
    cache = read(path)
    require_fresh(cache, config, params, data)
    return cache


def require_fresh(cache: FeatureCache, config: Encoder, params: Params, data: Path) -> None:
    """Refuse a stale cache; see ``open_cache``.

    Raises:
        UserError: it is stale; the message says what differs.
    """
    refuse_stale(cache.path, cache.made_of, fingerprint(config, params, read_manifest(data)))


def features(
    cache: FeatureCache, episode: Episode | str, frame_indices: Sequence[int] | np.ndarray
) -> np.ndarray:
    """Return the features of some frames; only these are read from disk.

    Args:
        cache: from ``open_cache``.
        episode: an episode of its data, or the name of one.
        frame_indices: (T,) frame numbers, in any order.

    Returns:
        (T, h, w, F) in the stored dtype.

    Raises:
        UserError: the cache has no such episode or frame, or its file is damaged.
    """
    name = episode if isinstance(episode, str) else episode.name
    if name not in cache.files:
        raise UserError(f"{cache.path} has no features of episode {name}; make it again.")
    file, frames = cache.files[name]
    chosen = np.asarray(frame_indices, np.int64)
    if chosen.size and not (chosen.min() >= 0 and chosen.max() < frames):
        raise UserError(
            f"{cache.path} has {frames} frames of episode {name}, not frames {chosen.min()} to "
            f"{chosen.max()}."
        )
    place = _place(cache.path / file)
    stored = np.memmap(cache.path / file, np.uint8, "r", place.begin, (place.size,))
    return stored.view(place.dtype).reshape(place.shape)[chosen]


def refuse_stale(path: Path, have: Mapping[str, Any], want: Mapping[str, Any]) -> None:
    """Refuse a cache whose fingerprint differs from the one wanted.

    Raises:
        UserError: the fingerprints differ; the message says in what.
    """
    again = "make it again with `python -m pewm_jax.memory cache` in a new folder"
    for key in ("encoder", "network", "preprocessing"):
        old, new = have.get(key), want[key]
        if old != new:
            if isinstance(old, dict) and isinstance(new, dict):
                names = sorted(n for n in old.keys() | new.keys() if old.get(n) != new.get(n))
                old, new = ({n: d.get(n) for n in names} for d in (old, new))
            titles = {"network": "another network", "encoder": "another encoder"}
            raise UserError(
                f"{path} is stale: it was made with {titles.get(key, f'other {key}')} ({old}, now "
                f"{new}); {again}."
            )
    for key, what in (("weights", "other encoder weights"), ("data", "other data")):
        if have.get(key) != want[key]:
            raise UserError(
                f"{path} is stale: it was made with {what} (hash {str(have.get(key))[:12]}, now "
                f"{want[key][:12]}); {again}."
            )


def read(path: Path) -> FeatureCache:
    """Open a finished cache, stale or not.

    Raises:
        UserError: it is absent, unfinished, damaged or of another version.
    """
    if not (path / MANIFEST).is_file():
        begun = (path / UNFINISHED).is_file()
        hint = "is not finished: the command that makes it goes on" if begun else "is no cache"
        raise UserError(
            f"{path} {hint}; make it with `python -m pewm_jax.memory cache DATA {path}`."
        )
    value = read_json(path / MANIFEST)
    try:
        version, made_of = value["version"], value["made_of"]
        files = {name: (str(file), int(frames)) for name, (file, frames) in value["files"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{path / MANIFEST} does not parse ({error!r}); make it again.") from None
    if version != VERSION:
        raise UserError(f"{path} has format version {version}, this is {VERSION}; make it again.")
    return FeatureCache(path, made_of, files)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON table.

    Raises:
        UserError: the file is not JSON, or not a table.
    """
    try:
        value = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise UserError(f"{path} is not valid JSON ({error}); make the cache again.") from None
    if not isinstance(value, dict):
        raise UserError(f"{path} holds no table; make the cache again.")
    return value


def _place(path: Path) -> tensor_files.Place:
    places = tensor_files.places(path)
    if TENSOR not in places:
        raise UserError(f"{path} holds no {TENSOR}; make the cache again.")
    return places[TENSOR]
