"""The protocol as a file: written before anything is trained, read by ``evaluate``.

``docs/evaluation.md`` describes it. Where the data lay when it was written, and by which version,
is noted beside the choices and not hashed.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pewm_jax
from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval.fixed import (
    ClipKey,
    EpisodeKey,
    Protocol,
    chosen,
    difference,
    fix,
    hash_of,
    lay,
    shortened,
)
from pewm_jax.eval.protocol import VERSION
from pewm_jax.io import atomic

FORMAT, FILE_VERSION = "pewm-protocol", 1
OFF = "off"
"""The setting that chooses clips by the settings, though the run names a file."""
FIXED = ("clips", "seeds", "chain", "stride", "video_clips")
"""Settings of ``EvalConfig`` that a file stands above."""


def given(config: Config, changes: Mapping[str, Any]) -> tuple[Config, Protocol | None]:
    """Return the settings under the protocol's file that they name, and what it holds.

    Args:
        config: the run's, with overrides for the evaluation.
        changes: those overrides; None is none.

    Returns:
        The settings as they are, and None, if they name no file.

    Raises:
        UserError: the file cannot be used, the model does not fit it, or an override says something
            that it fixes.
    """
    name = config.evaluate.protocol
    if name in ("", OFF):
        return config, None
    also = [f"--{key}" for key in FIXED if changes.get(key) is not None]
    if also:
        raise ConfigError(
            f"{' and '.join(also)} cannot be chosen beside the protocol {name}, which fixes that: "
            f"leave it out, or say --protocol {OFF}."
        )
    protocol = load(Path(name))
    config = lay(protocol, config)
    if changes.get("split") is not None:
        evaluate = dataclasses.replace(config.evaluate, split=changes["split"])
        config = dataclasses.replace(config, evaluate=evaluate)
    return config, protocol


def write(config: Config, path: Path, say: Callable[[str], Any]) -> Protocol:
    """Choose clips by an experiment's settings and write them to a file, before training.

    A file that holds the same protocol is left as it is.

    Args:
        config: gives the size and length of clips, ``data.path``, ``data.context`` and
            ``evaluate``.
        path: the file.
        say: shows a line.

    Raises:
        UserError: the data are absent or too short, or the file holds another protocol.
    """
    split = Path(config.data.path) / config.evaluate.split
    episodes = EpisodeSource(split)
    protocol = fix(config, episodes, *chosen(config, episodes))
    if path.exists():
        other = difference(load(path), protocol)
        if other:
            raise UserError(
                f"{path} holds another protocol ({other}): name another file by --out, or delete "
                "it if nothing has been scored by it."
            )
        say(f"{path} holds this protocol already")
    else:
        save(path, protocol, {"data": str(split)})
    scenes = {key.scene for key in protocol.episodes}
    say(
        f"protocol {protocol.sha256}\n{len(protocol.clips)} clips of {protocol.horizon} imagined "
        f"frames and {len(protocol.rollouts)} long rollouts of {protocol.long_horizon}, in "
        f"{len(protocol.episodes)} episodes of {len(scenes)} houses of {split}; seeds "
        f"{', '.join(map(str, protocol.seeds))}, {protocol.context} frames of context, stride "
        f"{protocol.stride}, driven by {protocol.control}"
    )
    if short := shortened(config, protocol):
        say(short)
    return protocol


def save(path: Path, protocol: Protocol, notes: dict[str, Any]) -> None:
    """Write a protocol's file; its folder is made.

    Args:
        path: the file.
        protocol: what was chosen.
        notes: facts that are not hashed, such as where the data lie.
    """
    value = {
        "format": FORMAT,
        "version": FILE_VERSION,
        "sha256": protocol.sha256,
        "notes": {"written_by": f"pewm_jax {pewm_jax.__version__}", **notes},
        "protocol": dataclasses.asdict(protocol),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def load(path: Path) -> Protocol:
    """Read a protocol's file.

    Raises:
        UserError: it is absent, no protocol, of another version, or was changed since it was
            written.
    """
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
        raise UserError(f"{path} is no protocol: write one with `pewm-jax protocol`.")
    versions = value.get("version"), content.get("scoring")
    if versions != (FILE_VERSION, VERSION):
        raise UserError(
            f"the protocol {path} has versions {versions[0]} (file) and {versions[1]} (scoring), "
            f"this library's are {FILE_VERSION} and {VERSION}; write it again, and score every run "
            "by the new one."
        )
    if hash_of(content) != value.get("sha256"):
        raise UserError(
            f"the protocol {path} was changed after it was written: what it says is not what its "
            "hash is of; write it again with `pewm-jax protocol`."
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
