"""Strict conversion of configurations to and from plain values and JSON."""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

from pewm_jax import registry as kinds
from pewm_jax.config import migrations
from pewm_jax.config.experiment import Config
from pewm_jax.config.training import TrainSettings
from pewm_jax.errors import ConfigError, require
from pewm_jax.io import atomic

T = TypeVar("T")


def to_dict(config: Any) -> dict[str, Any]:
    """Turn a configuration into plain dictionaries, lists, numbers and strings.

    Settings that come in kinds get an entry ``kind`` with the kind's name.
    """
    out: dict[str, Any] = {"kind": kinds.of(config).name} if _has_kinds(type(config)) else {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        out[field.name] = to_dict(value) if dataclasses.is_dataclass(value) else value
    return out


def from_dict(kind: type[T], values: dict[str, Any], where: str = "config") -> T:
    """Build a configuration dataclass from plain dictionaries, strictly.

    Args:
        kind: the dataclass to build, e.g. ``Config``, or the base of several kinds of settings.
        values: nested plain values; absent fields take their defaults. Values of a ``Config`` of
            an earlier version are upgraded.
        where: name of this place in error messages.

    Raises:
        ConfigError: a key does not exist, or a value has the wrong type or is refused.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} must be a table of settings, got {type(values).__name__}.")
    if issubclass(kind, Config):
        values = migrations.upgrade(values, where)
    if _has_kinds(kind):
        values, kind = dict(values), _named(kind, values, where)
        values.pop("kind", None)
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - set(fields))
    if unknown:
        raise ConfigError(
            f"{where} has no setting {', '.join(unknown)}; it has {', '.join(sorted(fields))}."
        )
    hints = typing.get_type_hints(kind)
    built: dict[str, Any] = {}
    for name, value in values.items():
        usual = kinds.usual(fields[name])
        hint = usual if hints[name] is Any else hints[name]
        if isinstance(value, dict) and "kind" not in value and _has_kinds(usual):
            hint = usual  # a section without a kind is of the default one
        built[name] = _coerce(hint, value, f"{where}.{name}")
    if issubclass(kind, Config):
        built = _with_training(built, values, where)
    missing = sorted(name for name in needed(kind) if name not in built)
    require(not missing, f"{where} lacks {', '.join(missing)}, which has no default: add it.")
    return kind(**built)


def needed(kind: type) -> list[str]:
    """Return the names of the settings without a default."""
    nothing = dataclasses.MISSING
    fields = dataclasses.fields(kind)
    return [f.name for f in fields if f.init and f.default is f.default_factory is nothing]


def _with_training(built: dict[str, Any], values: dict[str, Any], where: str) -> dict[str, Any]:
    """Build the section ``train``, whose stages depend on the model."""
    stages = built.get("model", Config().model).TRAIN
    return built | {"train": from_dict(stages, values.get("train", {}), f"{where}.train")}


def _has_kinds(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, kinds.Settings)


def _named(base: type, values: dict[str, Any], where: str) -> type:
    """Return the settings' class that a table names by its ``kind``."""
    section = base.SECTION  # type: ignore[attr-defined]
    if "kind" not in values:
        return base if dataclasses.is_dataclass(base) else kinds.named(section, "").settings
    try:
        return kinds.named(section, values["kind"]).settings
    except ConfigError as error:
        raise ConfigError(f"{where}.kind: {error}") from None


def _coerce(hint: Any, value: Any, where: str) -> Any:
    """Check one plain value against a type hint; lists become tuples."""
    if dataclasses.is_dataclass(hint) or _has_kinds(hint):
        if hint is TrainSettings:  # its stages depend on the model, see ``_with_training``
            return value
        return from_dict(typing.cast("type", hint), value, where)
    args = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        return _coerce_tuple(args, value, where)
    if typing.get_origin(hint) is Literal:
        choices = ", ".join(map(repr, args))
        require(value in args, f"{where} is {value!r}; choose one of {choices}.")
        return value
    number = isinstance(value, int) and not isinstance(value, bool)
    if hint is float and number:
        return float(value)
    fits = number if hint is int else isinstance(value, hint)
    require(fits, f"{where} must be {hint.__name__}, got {value!r}.")
    return value


def accepts(kind: type, name: str, value: Any) -> bool:
    """Tell whether a setting of a kind can have a plain value or a dataclass, by its type."""
    hint = typing.get_type_hints(kind)[name]
    if hint is Any:
        return True
    if dataclasses.is_dataclass(value):
        return isinstance(value, hint)
    try:
        _coerce(hint, value, name)
    except ConfigError:
        return False
    return True


def _coerce_tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """Check a list against the element types of a tuple."""
    require(isinstance(value, (list, tuple)), f"{where} must be a list, got {value!r}.")
    inner = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
    require(len(inner) == len(value), f"{where} needs {len(inner)} values, got {len(value)}.")
    return tuple(_coerce(h, v, where) for h, v in zip(inner, value, strict=True))


def save(config: Any, path: Path) -> None:
    """Write a configuration as JSON, atomically."""
    atomic.write_text(path, json.dumps(to_dict(config), indent=2) + "\n")


def load(path: Path, kind: type[T] = Config) -> T:
    """Read a configuration from JSON.

    Raises:
        ConfigError: the file is absent or unreadable, or holds no valid settings.
    """
    try:
        values = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(
            f"{path} does not exist: is this a run folder made by train.py?"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}); allow reading it.") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid JSON ({error}); restore it.") from None
    return from_dict(kind, values, path.name)
