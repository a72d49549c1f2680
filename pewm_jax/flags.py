"""Names of an experiment's flags: short forms, old names, and flags that choose kinds.

``--clip.width 64`` is short for ``--model.clip.width 64``. Names from earlier versions are
accepted. ``--model.memory.kind images`` replaces a section's settings by those of another kind;
settings that both kinds have are kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from pewm_jax import config as configuration
from pewm_jax.config import Config, ConfigError, Settings, kinds, serialize
from pewm_jax.config.migrations import RENAMED_FLAGS

T = TypeVar("T")


def spelled_out(flags: Sequence[str], default: Any) -> list[str]:
    """Return flags by their full, current names, if the default is an experiment.

    Args:
        flags: the arguments.
        default: the settings that they change.
    """
    if not isinstance(default, Config):
        return list(flags)
    sections = {field.name for field in dataclasses.fields(default)}
    short = {field.name for field in dataclasses.fields(default.model)} - sections

    def full(flag: str) -> str:
        if not flag.startswith("--"):
            return flag
        name, equals, value = flag[2:].partition("=")
        name = name.replace("-", "_")
        for old, new in RENAMED_FLAGS:
            if name == old or (old.endswith((".", "_")) and name.startswith(old)):
                return f"--{new}{name.removeprefix(old)}{equals}{value}"
        first = name.partition(".")[0].removeprefix("no_")
        return f"--model.{name}{equals}{value}" if first in short else flag

    return [full(flag) for flag in flags]


def take_kinds(flags: Sequence[str], default: T) -> tuple[T, list[str]]:
    """Take ``--SECTION.kind NAME`` out of the arguments.

    Args:
        flags: the arguments, by their full names.
        default: the settings that they change.

    Returns:
        The default with settings of the chosen kinds, which need not fit each other yet, and the
        other arguments.

    Raises:
        ConfigError: there is no such kind.
    """
    rest: list[str] = []
    queue = list(flags)
    while queue:
        flag, equals, value = queue.pop(0).partition("=")
        path = flag.removeprefix("--").split(".")
        section = _section(default, path[:-1])
        if not flag.startswith("--") or path[-1] != "kind" or section is None:
            rest.append(flag + equals + value)
            continue
        if not equals:
            if not queue:
                known = ", ".join(kinds.names(section.SECTION))
                raise ConfigError(f"{flag} needs a value: {known}.")
            value = queue.pop(0)
        default = _replaced(default, path[:-1], _as_kind(section, value))
    return default, rest


def of(settings: Any, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """Yield the flags of settings (or of a dataclass type), nested ones too, with their fields."""
    instance = None if isinstance(settings, type) else settings
    if isinstance(instance, Settings) and prefix != "--":
        yield f"{prefix}kind", None
    for field in dataclasses.fields(settings):
        value = field.default if instance is None else getattr(instance, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from of(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", field


def kinds_text(default: Any, prefix: str = "") -> str:
    """Return one line for each section that has several kinds, for the help text."""
    lines = []
    for field in dataclasses.fields(default):
        value = getattr(default, field.name)
        if not dataclasses.is_dataclass(value):
            continue
        name = f"{prefix}{field.name}"
        if isinstance(value, Settings):
            known = kinds.names(value.SECTION)
            if len(known) > 1:
                lines.append(f"  --{name}.kind {{{','.join(known)}}} ({kinds.of(value).name})")
        below = kinds_text(value, f"{name}.")
        lines += [below] if below else []
    return "\n".join(lines)


def _section(settings: Any, path: Sequence[str]) -> Any:
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
    values = {field.name: getattr(old, field.name) for field in dataclasses.fields(old)}
    both = values.keys() & {field.name for field in dataclasses.fields(kind.settings)}
    shared = {name for name in both if serialize.accepts(kind.settings, name, values[name])}
    return _unchecked(kind.settings(), {name: values[name] for name in shared})


def _replaced(settings: Any, path: Sequence[str], value: Any) -> Any:
    """Return settings with the value at a path replaced."""
    if not path:
        return value
    inner = _replaced(getattr(settings, path[0]), path[1:], value)
    changes = {path[0]: inner}
    if isinstance(settings, Config) and path == ["model"]:
        # Another world has other stages, which start with their default settings.
        common = configuration.to_dict(settings.train)
        wanted = {field.name for field in dataclasses.fields(value.TRAIN)}
        changes["train"] = configuration.from_dict(
            value.TRAIN, {name: common[name] for name in common.keys() & wanted}, "train"
        )
    return _unchecked(settings, changes)


def _unchecked(settings: Any, changes: dict[str, Any]) -> Any:
    """Return changed settings, not validated: the flags that follow may be what makes them fit."""
    new = object.__new__(type(settings))
    for field in dataclasses.fields(settings):
        value = changes.get(field.name, getattr(settings, field.name))
        object.__setattr__(new, field.name, value)
    return new
