"""The evaluation protocol as a value with a hash, and its file.

It fixes episodes (by the hash of their content), starts, context, motion, noise and horizon. It
does not depend on a model, so any two models of its image size can be evaluated with it and
compared clip by clip. Equal choices have equal hashes, wherever the data are stored.

The file is written before training and read by ``evaluate``; ``docs/evaluation.md`` describes it.
The location of the data and the version that wrote the file are notes, which are not hashed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import pewm_jax
from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.data.loader import require_recorded
from pewm_jax.eval.clips import VERSION, ClipChoice, choose, long_choices, needs_cameras
from pewm_jax.io import atomic

NOISE = "key(seed), folded with the clip's place in the list and its number in the chain"
"""How noise is derived from a seed."""


@dataclasses.dataclass(frozen=True)
class EpisodeKey:
    """An episode, identified by the ``sha256`` of its record (images, depths, poses, actions)."""

    name: str
    scene: str
    sha256: str


@dataclasses.dataclass(frozen=True)
class ClipKey:
    """A clip to imagine: the present frame, the frames observed and those to imagine.

    ``episode`` is the index in ``Protocol.episodes``, the last of ``context`` the present frame;
    ``motion_sha256`` hashes the recorded poses at the start and the targets, and the actions
    recorded between them.
    """

    episode: int
    start: int
    context: tuple[int, ...]
    targets: tuple[int, ...]
    motion_sha256: str


@dataclasses.dataclass(frozen=True)
class Protocol:
    """All choices of an evaluation.

    Attributes:
        split: name of the split's folder.
        context: number of frames observed before each clip.
        stride: number of recorded actions between two imagined frames.
        horizon: number of frames imagined from each start.
        long_horizon: likewise for long rollouts.
        seeds: seeds of the sampling noise; long rollouts use the first.
        control: ``actions`` or ``cameras``, which drive the model.
        clips: the scored clips, in the order that determines their noise.
        noise: how noise is derived from a seed.
        scoring: version of the scoring rules.
    """

    split: str
    height: int
    width: int
    context: int
    stride: int
    horizon: int
    long_horizon: int
    seeds: tuple[int, ...]
    control: str
    episodes: tuple[EpisodeKey, ...]
    clips: tuple[ClipKey, ...]
    rollouts: tuple[ClipKey, ...]
    noise: str = NOISE
    scoring: int = VERSION

    @property
    def sha256(self) -> str:
        """Return the hash of all choices."""
        return hash_of(dataclasses.asdict(self))

    @property
    def pieces_sha256(self) -> str:
        """Return the hash of all choices except the seeds, for the scores of one seed."""
        return hash_of(dataclasses.asdict(self) | {"seeds": None})


def hash_of(content: Any) -> str:
    """Return the sha256 of a JSON value, independent of the order of its keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def choose_clips(
    config: Config, episodes: Sequence[Episode]
) -> tuple[list[ClipChoice], list[ClipChoice]]:
    """Choose clips and long rollouts by the settings, on the return path of every episode.

    Raises:
        UserError: no episode is long enough.
    """
    clips = choose(config, episodes, config.evaluate.clips, config.evaluate.chain)
    return clips, long_choices(config, episodes)


def describe_shortened(config: Config, protocol: Protocol) -> str:
    """Return a sentence if long rollouts are shorter than requested, else ""."""
    asked = config.evaluate.video_clips * (config.model.clip.frames - 1)
    if protocol.long_horizon >= asked:
        return ""
    return (
        f"long rollouts have {protocol.long_horizon} frames instead of the {asked} of "
        "evaluate.video_clips: no walk of these data is long enough"
    )


def make_protocol(
    config: Config,
    episodes: Sequence[Episode],
    clips: Sequence[ClipChoice],
    rollouts: Sequence[ClipChoice],
) -> Protocol:
    """Return the protocol of chosen clips and long rollouts.

    Raises:
        UserError: the episodes have another image size than the clip's.
    """
    shape, keys, clip_keys = config.model.clip, [], {}
    for index in sorted({choice.episode for choice in (*clips, *rollouts)}):
        episode = episodes[index]
        if (episode.height, episode.width) != (shape.height, shape.width):
            raise UserError(
                f"episode {episode.name} has frames of {episode.height}×{episode.width} but clips "
                f"need {shape.height}×{shape.width}: collect or import the data at that size."
            )
        for choice in (*clips, *rollouts):
            if choice.episode == index:
                clip_keys[choice] = ClipKey(
                    len(keys),
                    choice.start,
                    choice.context_S,
                    choice.targets_N,
                    motion_hash(episode, choice),
                )
        keys.append(EpisodeKey(episode.name, episode.scene, content_hash(episode)))
    return Protocol(
        split=config.evaluate.split,
        height=shape.height,
        width=shape.width,
        context=config.data.context,
        stride=config.evaluate.stride,
        horizon=len(clips[0].targets_N),
        long_horizon=len(rollouts[0].targets_N),
        seeds=tuple(config.evaluate.seeds),
        control="cameras" if needs_cameras(episodes, [*rollouts, *clips]) else "actions",
        episodes=tuple(keys),
        clips=tuple(clip_keys[choice] for choice in clips),
        rollouts=tuple(clip_keys[choice] for choice in rollouts),
    )


def content_hash(episode: Episode) -> str:
    """Return the sha256 of an episode's record."""
    return hashlib.sha256(episode.record).hexdigest()


def motion_hash(episode: Episode, choice: ClipChoice) -> str:
    """Return the hash of a clip's recorded motion, before any arithmetic."""
    poses = episode.world_from_camera[[choice.start, *choice.targets_N]]
    digest = hashlib.sha256(np.ascontiguousarray(poses, "<f4").tobytes())
    if episode.actions is not None:
        steps = episode.actions[choice.start : choice.targets_N[-1]]
        digest.update(np.ascontiguousarray(steps, "<f4").tobytes())
    return digest.hexdigest()


def find_clips(
    protocol: Protocol, episodes: Sequence[Episode], where: str
) -> tuple[list[ClipChoice], list[ClipChoice]]:
    """Find a protocol's clips and long rollouts in a data set.

    The data set, named ``where`` in error messages, may contain other episodes, in any order.

    Raises:
        UserError: an episode is missing, or its content has changed.
    """
    wanted, found, names = {key.name for key in protocol.episodes}, {}, set()
    for index in range(len(episodes)):
        episode = episodes[index]
        names.add(episode.name)
        if episode.name in wanted:  # the record contains its name, so no other can be equal
            found[content_hash(episode)] = index
    for key in protocol.episodes:
        if key.sha256 not in found:
            there = "has another one of that name" if key.name in names else "does not have it"
            raise UserError(
                f"the protocol scores episode {key.name} (sha256 {key.sha256[:12]}…), but {where} "
                f"{there}; give the folder of the protocol's data by --data and --split, or write "
                "a protocol for this one."
            )

    def choice(clip: ClipKey) -> ClipChoice:
        key = protocol.episodes[clip.episode]
        index = found[key.sha256]
        return ClipChoice(index, key.name, key.scene, clip.start, clip.context, clip.targets)

    return [choice(clip) for clip in protocol.clips], [choice(clip) for clip in protocol.rollouts]


def resolve_clips(
    config: Config, episodes: Sequence[Episode], fixed: Protocol | None, where: str
) -> tuple[Protocol, list[ClipChoice], list[ClipChoice]]:
    """Return the protocol, its clips and its long rollouts: fixed, or chosen by the settings.

    Errors are those of ``find_clips``, ``choose_clips`` and ``make_protocol``.
    """
    if fixed is not None:
        return fixed, *find_clips(fixed, episodes, where)
    clips, rollouts = choose_clips(config, episodes)
    return make_protocol(config, episodes, clips, rollouts), clips, rollouts


def apply_protocol(protocol: Protocol, config: Config) -> Config:
    """Return an experiment's settings, with those fixed by the protocol replaced.

    Raises:
        UserError: the model's clips have another size, or do not fill the horizon.
    """
    clip = config.model.clip
    if (clip.height, clip.width) != (protocol.height, protocol.width):
        raise UserError(
            f"the protocol is for images of {protocol.height}×{protocol.width} but this model "
            f"makes {clip.height}×{clip.width}: write a protocol for data of the model's size."
        )
    each = clip.frames - 1
    for horizon in (protocol.horizon, protocol.long_horizon):
        if horizon % each:
            raise UserError(
                f"the protocol needs {horizon} imagined frames but this model imagines {each} "
                f"at once: write a protocol whose horizon is a multiple of {each}."
            )
    evaluate = dataclasses.replace(
        config.evaluate,
        split=protocol.split,
        clips=len(protocol.clips),
        chain=protocol.horizon // each,
        stride=protocol.stride,
        seeds=protocol.seeds,
        video_clips=protocol.long_horizon // each,
    )
    data = dataclasses.replace(config.data, context=protocol.context)
    return dataclasses.replace(config, evaluate=evaluate, data=data)


def difference(one: Protocol, two: Protocol) -> str:
    """Return a phrase with the first difference between two protocols; "" if there is none."""
    for field in dataclasses.fields(Protocol):
        first, second = getattr(one, field.name), getattr(two, field.name)
        if first == second:
            continue
        if field.name not in ("episodes", "clips", "rollouts"):
            return f"{field.name.replace('_', ' ')} {first} and {second}"
        if len(first) != len(second):
            return f"{len(first)} and {len(second)} {field.name}"
        if field.name == "episodes":
            return "other episodes"
        pair = next((a, b) for a, b in zip(first, second, strict=True) if a != b)
        starts = " and ".join(f"frame {key.start}" for key in pair)
        return f"other {field.name}, such as one from {starts}"
    return ""


FORMAT, FILE_VERSION = "pewm-protocol", 1
OFF = "off"
"""Value of ``--protocol`` that ignores the file in the run's settings."""
FIXED = ("clips", "seeds", "chain", "stride", "video_clips")
"""Settings of ``EvalConfig`` that a protocol file overrides."""


def apply_protocol_file(
    config: Config, changes: Mapping[str, Any]
) -> tuple[Config, Protocol | None]:
    """Return the settings with those of their protocol file applied, and the protocol or None.

    ``changes`` are the overrides given for the evaluation; None values are ignored.

    Raises:
        UserError: the file cannot be used, the model does not fit it, or an override changes a
            setting that it fixes.
    """
    name = config.evaluate.protocol
    if name in ("", OFF):
        return config, None
    also = [f"--{key}" for key in FIXED if changes.get(key) is not None]
    if also:
        raise ConfigError(
            f"{' and '.join(also)} cannot be combined with the protocol {name}, which fixes it: "
            f"omit it, or use --protocol {OFF}."
        )
    protocol = load_protocol(Path(name))
    config = apply_protocol(protocol, config)
    if changes.get("split") is not None:
        evaluate = dataclasses.replace(config.evaluate, split=changes["split"])
        config = dataclasses.replace(config, evaluate=evaluate)
    return config, protocol


def write_protocol(config: Config, path: Path, log: Callable[[str], Any]) -> Protocol:
    """Choose clips by an experiment's settings and write them to a file, before training.

    A file with the same protocol is not changed.

    Raises:
        UserError: the data are missing or too short, or the file contains another protocol.
    """
    split = Path(config.data.path) / config.evaluate.split
    episodes = EpisodeSource(split)
    require_recorded(config.model, episodes)
    protocol = make_protocol(config, episodes, *choose_clips(config, episodes))
    if path.exists():
        other = difference(load_protocol(path), protocol)
        if other:
            raise UserError(
                f"{path} contains another protocol ({other}): choose another file by --out, or "
                "delete it if no run has been evaluated with it."
            )
        log(f"{path} already contains this protocol")
    else:
        save_protocol(path, protocol, {"data": str(split)})
    scenes = {key.scene for key in protocol.episodes}
    log(
        f"protocol {protocol.sha256}\n{len(protocol.clips)} clips of {protocol.horizon} imagined "
        f"frames and {len(protocol.rollouts)} long rollouts of {protocol.long_horizon}, in "
        f"{len(protocol.episodes)} episodes of {len(scenes)} houses of {split}; seeds "
        f"{', '.join(map(str, protocol.seeds))}, {protocol.context} frames of context, stride "
        f"{protocol.stride}, driven by {protocol.control}"
    )
    if short := describe_shortened(config, protocol):
        log(short)
    return protocol


def save_protocol(path: Path, protocol: Protocol, notes: dict[str, Any]) -> None:
    """Write a protocol file with notes that are not hashed; its folder is created."""
    value = {
        "format": FORMAT,
        "version": FILE_VERSION,
        "sha256": protocol.sha256,
        "notes": {"written_by": f"pewm_jax {pewm_jax.__version__}", **notes},
        "protocol": dataclasses.asdict(protocol),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def load_protocol(path: Path) -> Protocol:
    """Read a protocol file.

    Raises:
        UserError: it is missing, not a protocol, of another version, or was changed after it was
            written.
    """
    if path.exists() and not path.is_file():  # a device file may be endless
        kind = "a folder" if path.is_dir() else "not a regular file"
        raise UserError(f"the protocol {path} is {kind}; give a file that ends in .json.")
    try:
        value = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise UserError(
            f"the protocol {path} cannot be read ({error.strerror}); write one with `pewm-jax "
            "protocol`."
        ) from None
    except ValueError as error:
        raise UserError(f"the protocol {path} is not JSON ({error}); write it again.") from None
    content = value.get("protocol") if isinstance(value, dict) else None
    if not isinstance(content, dict) or value.get("format") != FORMAT:
        raise UserError(f"{path} is not a protocol: write one with `pewm-jax protocol`.")
    versions = value.get("version"), content.get("scoring")
    if versions != (FILE_VERSION, VERSION):
        raise UserError(
            f"the protocol {path} has versions {versions[0]} (file) and {versions[1]} (scoring), "
            f"this library's are {FILE_VERSION} and {VERSION}; write it again, and evaluate every "
            "run with the new one."
        )
    if hash_of(content) != value.get("sha256"):
        raise UserError(
            f"the protocol {path} was changed after it was written: its content does not match its "
            "hash; write it again with `pewm-jax protocol`."
        )
    try:
        return _parse(content)
    except (KeyError, TypeError) as error:
        raise UserError(
            f"the protocol {path} does not parse ({error!r}); write it again."
        ) from None


def _parse(content: dict[str, Any]) -> Protocol:
    def clips(name: str) -> tuple[ClipKey, ...]:
        lists = ("context", "targets")
        return tuple(
            ClipKey(**clip | {key: tuple(clip[key]) for key in lists}) for clip in content[name]
        )

    return Protocol(
        **content
        | {
            "seeds": tuple(content["seeds"]),
            "episodes": tuple(EpisodeKey(**episode) for episode in content["episodes"]),
            "clips": clips("clips"),
            "rollouts": clips("rollouts"),
        }
    )
