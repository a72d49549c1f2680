"""A cache of the image encoder's features of a data set, and the command that fills it.

The cache is named by a fingerprint of encoder, preprocessing and data; training refuses one that
does not match. An interrupted run resumes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax import registry as kinds
from pewm_jax.codecs.signals import signal_from_rgb
from pewm_jax.config import Encoder, UserError
from pewm_jax.data import dataset
from pewm_jax.data.dataset import EpisodeSource, Manifest, read_manifest, write_json
from pewm_jax.data.episodes import Episode
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.io import tensor_files, tree, weights
from pewm_jax.io.progress import Meter
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.types import Array, Params

MANIFEST = "cache.json"
UNFINISHED = "caching.json"
"""The file with the settings of an unfinished cache."""
TENSOR = "features_ThwF"
VERSION = 1
Dtype = Literal["float16", "bfloat16", "float32"]


@dataclasses.dataclass(frozen=True)
class FeatureCache:
    """An open cache of one split; see ``open_cache`` and ``features``.

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
    """Open a finished cache, if it was made with this encoder and this split of data.

    Raises:
        UserError: it is absent, unfinished, damaged or stale (made with other weights, other
            preprocessing or other data).
    """
    cache = read(path)
    require_fresh(cache, config, params, data)
    return cache


def require_fresh(cache: FeatureCache, config: Encoder, params: Params, data: Path) -> None:
    """Refuse a stale cache; see ``open_cache``."""
    refuse_stale(cache.path, cache.made_of, fingerprint(config, params, read_manifest(data)))


def features(
    cache: FeatureCache, episode: Episode | str, frame_indices: Sequence[int] | np.ndarray
) -> np.ndarray:
    """Return (T, h, w, F) features of some frames of an episode; only these are read from disk.

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
    """Refuse a cache whose fingerprint is not the one wanted; the error names the difference."""
    again = "make it again with `pewm-jax memory cache` in a new folder"
    titles = {
        "encoder": "another encoder",
        "network": "another network",
        "preprocessing": "other preprocessing",
        "weights": "other encoder weights",
        "data": "other data",
    }
    for key, title in titles.items():
        old, new = have.get(key), want[key]
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            names = sorted(n for n in old.keys() | new.keys() if old.get(n) != new.get(n))
            old, new = ({n: d.get(n) for n in names} for d in (old, new))
        if key in ("weights", "data"):
            old, new = f"hash {str(old)[:12]}", new[:12]
        raise UserError(f"{path} is stale: it was made with {title} ({old}, now {new}); {again}.")


def read(path: Path) -> FeatureCache:
    """Open a finished cache, stale or not.

    Raises:
        UserError: it is absent, unfinished, damaged or of another version.
    """
    if not (path / MANIFEST).is_file():
        begun = (path / UNFINISHED).is_file()
        hint = "is not finished: run the command again to resume" if begun else "is no cache"
        raise UserError(f"{path} {hint}; make it with `pewm-jax memory cache DATA {path}`.")
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


def build(
    config: Encoder,
    params: Params,
    data: Path,
    out: Path,
    *,
    dtype: Dtype = "float16",
    batch: int = 16,
    log: Callable[[str], None] = print,
) -> FeatureCache:
    """Compute the features of every frame of a split, or continue an interrupted build.

    Frames are spread over all devices, ``batch`` of them at once (rounded up to a multiple of the
    devices). Each episode's file is written atomically; ``log`` shows a progress line.

    Raises:
        UserError: the data cannot be read, ``out`` holds another cache or is being filled by
            another process, or a feature is too large for the dtype.
    """
    source = EpisodeSource(data)
    made_of = fingerprint(config, params, source.manifest)
    if (out / MANIFEST).is_file():
        cache = read(out)
        refuse_stale(out, cache.made_of, made_of)
        log(f"{out}: finished already, {len(cache.files)} episodes")
        return cache
    settings = {"version": VERSION, "made_of": made_of, "dtype": dtype}
    files: dict[str, tuple[str, int]] = {}
    with _locked(out):
        _begin(out, settings)
        encode = _encoder_of(config, params, batch, log)
        with Meter("features", source.manifest.frames, "frames") as meter:
            for index in range(len(source)):
                episode: Episode = source[index]
                path = out / f"{index:06d}.safetensors"
                if episode.name in files:
                    raise UserError(
                        f"{data} has two episodes named {episode.name}; features are kept by name."
                    )
                if not path.is_file():
                    found = encode(episode, meter.advance)
                    weights.save(path, {TENSOR: _narrow(found, dtype, episode.name)})
                else:
                    meter.advance(episode.length)
                files[episode.name] = (path.name, episode.length)
        write_json(out / MANIFEST, {**settings, "files": files})
        (out / UNFINISHED).unlink()
    log(f"{out}: {meter.summary()}")
    return FeatureCache(out, made_of, files)


def _encoder_of(
    config: Encoder, params: Params, batch: int, log: Callable[[str], None]
) -> Callable[[Episode, Callable[[int], None]], np.ndarray]:
    """Return a function from episodes to float32 features, by batches spread over all devices."""
    devices = jax.devices()
    mesh = jax.make_mesh((len(devices),), ("frames",), (AxisType.Auto,), devices=devices)
    spread = NamedSharding(mesh, P("frames"))
    weights_there = jax.device_put(params, NamedSharding(mesh, P()))
    size = -(-batch // len(devices)) * len(devices)
    compiled = set()

    @functools.partial(jax.jit, out_shardings=spread)
    def encode(params: Params, rgb_THWC: Array) -> Array:
        return config.encode(params, signal_from_rgb(rgb_THWC))

    def features(episode: Episode, advance: Callable[[int], None]) -> np.ndarray:
        if (episode.height, episode.width) not in compiled:
            compiled.add((episode.height, episode.width))
            shape = f"{episode.width}×{episode.height}"
            log(f"compiling the encoder for {size} frames of {shape} …")
        found = []
        for start in range(0, episode.length, size):
            chosen = np.arange(start, min(start + size, episode.length))
            rgb = episode.frames(chosen).rgb_THWC
            rest = np.zeros((size - len(rgb), *rgb.shape[1:]), rgb.dtype)
            rgb = jax.device_put(np.concatenate([rgb, rest]), spread)
            out = jax.device_get(encode(weights_there, rgb))[: len(chosen)]
            found.append(np.asarray(out, np.float32))
            advance(len(chosen))
        return np.concatenate(found)

    return features


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Lock a folder, so that only one process fills it."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "caching.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(f"{out} is being filled by another process; wait for it.") from None
        yield


def _begin(out: Path, settings: Mapping[str, Any]) -> None:
    """Record the settings of an unfinished cache, or compare with the earlier record."""
    note = out / UNFINISHED
    if note.is_file():
        before = read_json(note)
        refuse_stale(out, before.get("made_of", {}), settings["made_of"])
        if before != settings:
            raise UserError(
                f"{out} was begun with dtype {before.get('dtype')}, not {settings['dtype']}; go on "
                "with that or remove the folder."
            )
        return
    unknown = [p.name for p in out.iterdir() if p.name != "caching.lock"]
    if unknown:
        raise UserError(
            f"{out} holds other files ({tree.listing(unknown)}); name an empty or a new folder."
        )
    write_json(note, settings)


def _narrow(found: np.ndarray, dtype: Dtype, name: str) -> np.ndarray:
    """Convert features to the stored dtype, or refuse values that it cannot hold."""
    with np.errstate(over="ignore"):
        narrow = found.astype(jax.numpy.dtype(dtype))
    if not np.isfinite(narrow.astype(np.float32)).all():
        raise UserError(
            f"episode {name} has features that {dtype} does not hold (up to "
            f"{np.abs(found).max():.3g}); use --dtype bfloat16 or float32."
        )
    return narrow


@dataclasses.dataclass(frozen=True)
class CacheConfig:
    """Compute the image encoder's features of every frame of a data set once, and store them.

    After an interruption, run the same command again. A cache made with other encoder weights,
    other preprocessing or other data is refused when it is read.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """A dataset folder, all finished splits of which are encoded, or the folder of one split."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder to fill; for a dataset, it gets a folder per split."""
    encoder: str = ""
    """Folder of DINOv2 made by `pewm-jax convert import dinov2`; if empty, patch colours,
    which have no weights, are the encoder."""
    size: int = 518
    """Side in pixels of the square that images are resized to for DINOv2; `memory.encoder.size` of
    the experiment."""
    patch: int = 2
    """Pixels per patch of the patch colours; `memory.encoder.patch` of the experiment."""
    dtype: Dtype = "float16"
    """Dtype of the stored features."""
    batch: int = 16
    """Frames encoded at once."""


def cache(config: CacheConfig) -> None:
    """Fill the cache of a split, or of every split of a dataset.

    Raises:
        UserError: the data, the encoder or the folder to fill cannot be used.
    """
    if config.batch < 1:
        raise UserError(f"--batch is {config.batch}: encode at least 1 frame at once.")
    settings, params = _encoder(config)
    splits = {config.data: config.out}
    if not (config.data / dataset.MANIFEST).is_file():
        splits = {config.data / s: config.out / s for s in dataset.splits(config.data)} or splits
    for data, out in splits.items():
        build(settings, params, data, out, dtype=config.dtype, batch=config.batch)


def _encoder(config: CacheConfig) -> tuple[Encoder, Params]:
    """Return the encoder's settings, as an experiment has them, and its parameters."""
    if not config.encoder:
        return PatchColoursConfig(patch=config.patch), {}
    network, params = dinov2.load(Path(config.encoder))
    return DINOv2EncoderConfig(size=config.size, network=network), params
