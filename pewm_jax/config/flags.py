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
from pewm_jax import registry as kinds
from pewm_jax.config import Config, ConfigError, Settings, serialize
from pewm_jax.config.migrations import RENAMED_FLAGS, RENAMED_SETTINGS, kind_now

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
        name, given = name.replace("-", "_"), flag
        head, dot, last = name.removeprefix("no_").rpartition(".")
        if name.startswith("no_") and dot:
            name = f"{head}.no_{last}"
            given = f"--{name}{equals}{value}"
        for old, new in RENAMED_FLAGS:
            if name == old or (old.endswith((".", "_")) and name.startswith(old)):
                return f"--{new}{name.removeprefix(old)}{equals}{value}"
        for old, new in _renamed(default.model).items():
            if name in (old, f"model.{old}"):
                return f"--model.{new}{equals}{value}"
        first = name.partition(".")[0]
        ours = first in short or first.removeprefix("no_") in short
        return f"--model.{name}{equals}{value}" if ours else given

    return [full(flag) for flag in flags]


def _renamed(model: Any) -> dict[str, str]:
    """Return earlier names of a world's settings, with their names now."""
    fields = {field.name for field in dataclasses.fields(model)}
    tables = RENAMED_SETTINGS.values()
    return {old: new for table in tables for old, new in table.items() if new in fields}


def take_kinds(flags: Sequence[str], default: T) -> tuple[T, list[str]]:
    """Take ``--SECTION.kind NAME`` out of the arguments.

    Args:
        flags: the arguments, by their full names.
        default: the settings that they change.

    Returns:
        The default with settings of the chosen kinds, which need not fit each other yet, and the
        other arguments.

    Raises:
        ConfigError: there is no such kind, or a flag lacks its value.
    """
    rest: list[str] = []
    chosen: list[tuple[list[str], str | None, str]] = []
    queue = list(flags)
    while queue:
        word = queue.pop(0)
        flag, equals, value = word.partition("=")
        if not (flag.startswith("--") and flag.endswith(".kind")):
            rest.append(word)
            continue
        path = flag.removeprefix("--").split(".")[:-1]
        chosen.append((path, value if equals else queue.pop(0) if queue else None, flag))
    for path, name, flag in sorted(chosen, key=lambda choice: len(choice[0])):
        section = _section(default, path)
        if section is None:
            rest.append(flag if name is None else f"{flag}={name}")
        elif name is None:
            there = ", ".join(kinds.names(section.SECTION))
            raise ConfigError(f"{flag} needs a value: {there}.")
        else:
            default = with_kind(default, path, kind_now(section.SECTION, name))
    return default, rest


def with_kind(default: T, path: Sequence[str], name: str) -> T:
    """Put settings of another kind into a section, with what both kinds have in common.

    Args:
        default: the settings that the section is in.
        path: of the section; where there is none that has kinds, nothing changes.
        name: of the kind.

    Returns:
        Settings that are not validated: what follows may be what makes them fit each other.

    Raises:
        ConfigError: there is no such kind, or one that cannot be made from defaults.
    """
    section = _section(default, path)
    return default if section is None else _replaced(default, path, _as_kind(section, name))


def of(settings: Any, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """Yield the flags of settings (or of a dataclass type), nested ones too, with their fields."""
    instance = None if isinstance(settings, type) else settings
    if isinstance(instance, Settings) and prefix != "--":
        yield f"{prefix}kind", None
    for field in dataclasses.fields(settings):
        value = kinds.default_of(field) if instance is None else getattr(instance, field.name)
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
    needed = serialize.needed(kind.settings)
    if needed:
        raise ConfigError(
            f"The {kind.section} {name!r} cannot be chosen by its name: its settings "
            f"{', '.join(needed)} have no default; give {kind.settings.__name__} one for each."
        )
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
    if isinstance(settings, Config) and list(path) == ["model"]:
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
