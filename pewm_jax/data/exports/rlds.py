"""RLDS: episodes of steps in the layout of TensorFlow Datasets, written without TensorFlow.

::

    NAME/1.0.0/features.json                              the features of an episode
               dataset_info.json                          splits, and episodes per file
               NAME-train.tfrecord-00000-of-00001         an episode per record

``tfds.load(NAME, data_dir=DST)`` and ``tfds.builder_from_directory(DST/NAME/1.0.0)`` read it.
Images are the recorded PNGs: colour, and depth in millimetres with 0 for missing. The last step of
an episode has no action: zeros.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import ConfigError
from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports.options import Chosen, ExportConfig, require_alike
from pewm_jax.io.progress import Meter

VERSION = "1.0.0"
SHARD_BYTES = 100_000_000
"""Size of a file, about."""
CLASSES = "tensorflow_datasets.core.features"
Values = np.ndarray | Sequence[bytes]


def export(config: ExportConfig, chosen: Chosen, folder: Path) -> None:
    """Write episodes into a folder.

    Raises:
        ConfigError: the name is not one of TensorFlow Datasets.
        UserError: episodes are not alike.
    """
    # Imported lazily: it takes a second, and imports torch if that is installed.
    from tensorboardX.record_writer import RecordWriter  # noqa: PLC0415

    name = config.name or re.sub(r"\W+", "_", config.src.resolve().name).strip("_").lower()
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ConfigError(f"--name is {name!r}: use small letters, digits and underscores.")
    inside = folder / name / VERSION
    inside.mkdir(parents=True)
    first = next(iter(chosen))[1]
    splits = []
    with Meter(f"write {config.dst}", len(chosen), "episodes") as meter:
        for split in chosen.splits:
            places = [place for place in chosen.places if place[0] == split]
            total = sum(len(source[index].record) for _, source, index in places)
            files = min(len(places), max(1, round(total / SHARD_BYTES)))
            lengths, count = [], 0
            for number, part in enumerate(np.array_split(np.arange(len(places)), files)):
                path = f"{name}-{split}.tfrecord-{number:05d}-of-{files:05d}"
                writer = RecordWriter(str(inside / path))
                for k in part:
                    episode = places[k][1][places[k][2]]
                    require_alike([first, episode], "RLDS")
                    record = example(_episode(episode))
                    writer.write(record)
                    count += len(record)
                    meter.advance(1)
                writer.close()
                lengths.append(str(len(part)))
            template = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
            splits.append({
                "filepathTemplate": template, "name": split, "numBytes": str(count),
                "shardLengths": lengths,
            })  # fmt: skip
    info = {
        "description": "Episodes recorded by pewm_jax: posed RGB-D frames and actions.",
        "fileFormat": "tfrecord", "name": name, "splits": splits, "version": VERSION,
    }  # fmt: skip
    for file, value in (("features", _features(first)), ("dataset_info", info)):
        (inside / f"{file}.json").write_text(json.dumps(value, indent=4), "utf-8")


def _episode(episode: Episode) -> dict[str, Values]:
    """Return the features of an episode by their names in a record."""
    count = episode.length
    last = np.arange(count) == count - 1
    poses = np.asarray(episode.world_from_camera, np.float32)
    text = str(episode.info.get("task", "")).encode()
    steps: dict[str, Values] = {
        "observation/image": [episode.encoded("rgb", k) for k in range(count)],
        "observation/depth": [episode.encoded("depth", k) for k in range(count)],
        "observation/world_from_camera": poses,
        "observation/intrinsics": np.tile(np.asarray(episode.intrinsics_4, np.float32), (count, 1)),
        "reward": np.zeros(count, np.float32),
        "discount": np.ones(count, np.float32),
        "is_first": np.arange(count) == 0,
        "is_last": last,
        "is_terminal": np.zeros(count, bool),
        "language_instruction": [text] * count,
    }
    if episode.actions is not None:
        none = np.zeros((1, episode.actions.shape[1]), np.float32)
        steps["action"] = np.concatenate([np.asarray(episode.actions, np.float32), none])
    if episode.action_ids is not None:
        steps["action_id"] = np.append(episode.action_ids, -1)
    about = {"name": [episode.name.encode()], "scene": [episode.scene.encode()]}
    return {
        **{f"steps/{key}": value for key, value in steps.items()},
        **{f"episode_metadata/{key}": value for key, value in about.items()},
    }


def _features(episode: Episode) -> dict[str, Any]:
    """Return the content of ``features.json``."""
    size = episode.height, episode.width
    steps = {
        "reward": _tensor("float32"), "discount": _tensor("float32"), "is_first": _tensor("bool"),
        "is_last": _tensor("bool"), "is_terminal": _tensor("bool"),
        "language_instruction": _text(),
        "observation": _table({
            "image": _image("uint8", *size, 3), "depth": _image("uint16", *size, 1),
            "world_from_camera": _tensor("float32", 4, 4), "intrinsics": _tensor("float32", 4),
        }),
    }  # fmt: skip
    if episode.actions is not None:
        steps["action"] = _tensor("float32", episode.actions.shape[1])
    if episode.action_ids is not None:
        steps["action_id"] = _tensor("int32")
    return _table({
        "steps": {
            "pythonClassName": f"{CLASSES}.dataset_feature.Dataset",
            "sequence": {"feature": _table(steps), "length": "-1"},
        },
        "episode_metadata": _table({"name": _text(), "scene": _text()}),
    })  # fmt: skip


def _table(features: Mapping[str, Any]) -> dict[str, Any]:
    name = f"{CLASSES}.features_dict.FeaturesDict"
    return {"pythonClassName": name, "featuresDict": {"features": dict(features)}}


def _tensor(dtype: str, *shape: int) -> dict[str, Any]:
    kind = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    return {
        "pythonClassName": f"{CLASSES}.{kind}",
        "tensor": {"dtype": dtype, "encoding": "none", "shape": _shape(*shape)},
    }


def _image(dtype: str, *shape: int) -> dict[str, Any]:
    return {
        "pythonClassName": f"{CLASSES}.image_feature.Image",
        "image": {"dtype": dtype, "encodingFormat": "png", "shape": _shape(*shape)},
    }


def _text() -> dict[str, Any]:
    return {"pythonClassName": f"{CLASSES}.text_feature.Text", "text": {}}


def _shape(*shape: int) -> dict[str, Any]:
    return {"dimensions": [str(size) for size in shape]} if shape else {}


def example(features: Mapping[str, Values]) -> bytes:
    """Return a ``tf.train.Example``: floats, integers and booleans, and bytes, by name."""
    entries = []
    for name in sorted(features):
        values = features[name]
        if not isinstance(values, np.ndarray):
            listed = b"".join(_field(1, value) for value in values)
            feature = _field(1, listed)
        elif values.dtype.kind == "f":
            feature = _field(2, _field(1, np.ascontiguousarray(values, "<f4").tobytes()))
        else:
            packed = b"".join(_varint(int(value)) for value in values.reshape(-1))
            feature = _field(3, _field(1, packed))
        entries.append(_field(1, _field(1, name.encode()) + _field(2, feature)))
    return _field(1, b"".join(entries))


def _field(number: int, content: bytes) -> bytes:
    """Return a field with a length, in the wire format of protocol buffers."""
    return bytes([number << 3 | 2]) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """Return a whole number in the wire format; negative ones are in two's complement."""
    return bytes(_groups(value % (1 << 64)))


def _groups(value: int) -> Iterator[int]:
    while value >= 128:
        yield value % 128 | 128
        value >>= 7
    yield value
