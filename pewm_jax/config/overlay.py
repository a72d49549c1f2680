"""Lay settings over others: a JSON file over an experiment, or another kind over a section.

A section that gets another kind keeps the settings that both kinds have. The result is validated as
a whole at the end, because later settings may make earlier ones fit.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pewm_jax import registry as kinds
from pewm_jax.config.experiment import Config
from pewm_jax.config.migrations import upgrade
from pewm_jax.config.serialize import accepts, from_dict, needed, to_dict
from pewm_jax.errors import ConfigError
from pewm_jax.registry import Settings

T = TypeVar("T")


def overlay(default: T, path: Path) -> T:
    """Override a default with the settings of a JSON file, nested like the configuration.

    Raises:
        ConfigError: the file is absent, not JSON, or holds settings that do not exist or fit.
    """
    try:
        values = json.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"--config {path} cannot be read ({error.strerror}).") from None
    except ValueError as error:
        raise ConfigError(f"--config {path} is not valid JSON ({error}).") from None
    if not isinstance(values, dict):
        raise ConfigError(
            f'--config {path} must hold a table such as {{"train": {{"seed": 1}}}}, not '
            f"a {type(values).__name__}."
        )
    if isinstance(default, Config):
        there = to_dict(default.model)
        under = {".".join(where): name for where, name in _kinds_in(there)}
        values = upgrade(values, path.name, under)
        for where, name in sorted(_kinds_in(values), key=lambda found: len(found[0])):
            try:
                default = with_kind(default, where, name)
            except ConfigError as error:
                place = ".".join([path.name, *where, "kind"])
                raise ConfigError(f"{place}: {error}") from None
    merged = _deep_merge(to_dict(default), values)
    return from_dict(type(default), merged, path.name)


def _kinds_in(values: dict[str, Any], *path: str) -> Iterator[tuple[tuple[str, ...], str]]:
    """List the paths of the sections of a table that name their kind, with the name."""
    for name, value in values.items():
        if name == "kind" and isinstance(value, str):
            yield path, value
        elif isinstance(value, dict):
            yield from _kinds_in(value, *path, name)


def with_kind(default: T, path: Sequence[str], name: str) -> T:
    """Replace a section by settings of another kind, with the settings that both kinds have.

    The result is not validated, because later changes may make it fit. Nothing changes if there is
    no section with kinds at the path. A ``ConfigError`` refuses an unknown kind or one without
    defaults.
    """
    section = section_with_kinds(default, path)
    return default if section is None else _replaced(default, path, _as_kind(section, name))


def section_with_kinds(settings: Any, path: Sequence[str]) -> Any:
    """Return the settings at a path if their section has kinds, else None."""
    for name in path:
        if not dataclasses.is_dataclass(settings) or not hasattr(settings, name):
            return None
        settings = getattr(settings, name)
    return settings if path and isinstance(settings, Settings) else None


def _as_kind(old: Any, name: str) -> Any:
    """Return settings of another kind, keeping what both kinds have, without validation."""
    kind = kinds.named(old.SECTION, name)
    if kind.settings is type(old):
        return old
    missing = needed(kind.settings)
    if missing:
        raise ConfigError(
            f"The {kind.section} {name!r} cannot be chosen by its name: its settings "
            f"{', '.join(missing)} have no default; give {kind.settings.__name__} one for each."
        )
    values = {field.name: getattr(old, field.name) for field in dataclasses.fields(old)}
    both = values.keys() & {field.name for field in dataclasses.fields(kind.settings)}
    shared = {name for name in both if accepts(kind.settings, name, values[name])}
    return _unchecked(kind.settings(), {name: values[name] for name in shared})


def _replaced(settings: Any, path: Sequence[str], value: Any) -> Any:
    """Return settings with the value at a path replaced."""
    if not path:
        return value
    inner = _replaced(getattr(settings, path[0]), path[1:], value)
    changes = {path[0]: inner}
    if isinstance(settings, Config) and list(path) == ["model"]:
        # Another world has other stages, which start with their default settings.
        common = to_dict(settings.train)
        wanted = {field.name for field in dataclasses.fields(value.TRAIN)}
        changes["train"] = from_dict(
            value.TRAIN, {name: common[name] for name in common.keys() & wanted}, "train"
        )
    return _unchecked(settings, changes)


def _unchecked(settings: Any, changes: dict[str, Any]) -> Any:
    """Return changed settings without validation; later flags may make them fit."""
    new = object.__new__(type(settings))
    for field in dataclasses.fields(settings):
        value = changes.get(field.name, getattr(settings, field.name))
        object.__setattr__(new, field.name, value)
    return new


def _deep_merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for name, value in over.items():
        below = merged.get(name)
        if isinstance(value, dict) and isinstance(below, dict):
            merged[name] = _deep_merge(below, value)
        else:
            merged[name] = value
    return merged
