"""Building a feature cache: encode every frame of a split; can be resumed."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs.signals import signal_from_rgb
from pewm_jax.config import Encoder, UserError
from pewm_jax.data.dataset import EpisodeSource, write_json
from pewm_jax.data.episodes import Episode
from pewm_jax.io import tree, weights
from pewm_jax.io.progress import Meter
from pewm_jax.memory.feature_cache import (
    MANIFEST,
    TENSOR,
    UNFINISHED,
    VERSION,
    Dtype,
    FeatureCache,
    fingerprint,
    read,
    read_json,
    refuse_stale,
)
from pewm_jax.types import Array, Params


def build(
    config: Encoder,
    params: Params,
    data: Path,
    out: Path,
    *,
    dtype: Dtype = "float16",
    batch: int = 16,
    say: Callable[[str], None] = print,
) -> FeatureCache:
    """Compute the features of every frame of a split, or continue an interrupted build.

    Frames are spread over all devices. Each episode's file is written atomically.

    Args:
        config: the encoder.
        params: the encoder's parameters, empty where it has none.
        data: a finished split.
        out: the folder to fill.
        dtype: dtype of the stored features.
        batch: frames encoded at once, rounded up to a multiple of the devices.
        say: shows a progress line.

    Returns:
        The finished cache.

    Raises:
        UserError: the data cannot be read, ``out`` holds another cache or is being filled by
            another process, or a feature is too large for the dtype.
    """
    source = EpisodeSource(data)
    made_of = fingerprint(config, params, source.manifest)
    if (out / MANIFEST).is_file():
        cache = read(out)
        refuse_stale(out, cache.made_of, made_of)
        say(f"{out}: finished already, {len(cache.files)} episodes")
        return cache
    settings = {"version": VERSION, "made_of": made_of, "dtype": dtype}
    files: dict[str, tuple[str, int]] = {}
    with _locked(out):
        _begin(out, settings)
        encode = _Encoder(config, params, batch, say)
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
    say(f"{out}: {meter.summary()}")
    return FeatureCache(out, made_of, files)


class _Encoder:
    """The encoder compiled for batches of frames, spread over all devices."""

    def __init__(self, config: Encoder, params: Params, batch: int, say: Callable[[str], None]):
        devices = jax.devices()
        mesh = jax.make_mesh((len(devices),), ("frames",), (AxisType.Auto,), devices=devices)
        self._spread = NamedSharding(mesh, P("frames"))
        self._params = jax.device_put(params, NamedSharding(mesh, P()))
        self._batch = -(-batch // len(devices)) * len(devices)
        self._say, self._compiled = say, set()

        def encode(params: Params, rgb_THWC: Array) -> Array:
            return config.encode(params, signal_from_rgb(rgb_THWC))

        self._encode = jax.jit(encode, out_shardings=self._spread)

    def __call__(self, episode: Episode, advance: Callable[[int], None]) -> np.ndarray:
        """Return an episode's features (T, h, w, F) in float32."""
        size = (episode.height, episode.width)
        if size not in self._compiled:
            self._compiled.add(size)
            self._say(f"compiling the encoder for {self._batch} frames of {size[1]}×{size[0]} …")
        found = []
        for start in range(0, episode.length, self._batch):
            chosen = np.arange(start, min(start + self._batch, episode.length))
            rgb = episode.frames(chosen).rgb_THWC
            rest = np.zeros((self._batch - len(rgb), *rgb.shape[1:]), rgb.dtype)
            rgb = jax.device_put(np.concatenate([rgb, rest]), self._spread)
            out = jax.device_get(self._encode(self._params, rgb))[: len(chosen)]
            found.append(np.asarray(out, np.float32))
            advance(len(chosen))
        return np.concatenate(found)


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
    """Record what a folder is being filled with, or compare with the earlier record."""
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
