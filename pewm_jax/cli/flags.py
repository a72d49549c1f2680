"""Names of an experiment's flags: short forms, old names, and flags that select kinds.

``--clip.width 64`` is short for ``--model.clip.width 64``. Names from earlier versions are
accepted. ``--model.memory.kind images`` replaces a section's settings by those of another kind;
settings that both kinds have are kept.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from pewm_jax import registry as kinds
from pewm_jax.config import Config, ConfigError, Settings
from pewm_jax.config.migrations import RENAMED_FLAGS, RENAMED_SETTINGS, kind_now
from pewm_jax.config.overlay import section_with_kinds, with_kind

T = TypeVar("T")


def full_names(flags: Sequence[str], default: Any) -> list[str]:
    """Return flags by their full, current names, if the default is an experiment.

    Args:
        flags: the arguments.
        default: the settings that they override.
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
    """Return earlier names of a world's settings → present names."""
    fields = {field.name for field in dataclasses.fields(model)}
    tables = RENAMED_SETTINGS.values()
    return {old: new for table in tables for old, new in table.items() if new in fields}


def take_kinds(flags: Sequence[str], default: T) -> tuple[T, list[str]]:
    """Apply ``--SECTION.kind NAME`` and remove it from the arguments.

    Args:
        flags: the arguments, by their full names.
        default: the settings that they override.

    Returns:
        The default with settings of the chosen kinds, which may still be inconsistent, and the
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
        section = section_with_kinds(default, path)
        if section is None:
            rest.append(flag if name is None else f"{flag}={name}")
        elif name is None:
            there = ", ".join(kinds.names(section.SECTION))
            raise ConfigError(f"{flag} needs a value: {there}.")
        else:
            default = with_kind(default, path, kind_now(section.SECTION, name))
    return default, rest


def flags_of(settings: Any, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """Yield the flags of settings (or of a dataclass type), including nested ones, and fields."""
    instance = None if isinstance(settings, type) else settings
    if isinstance(instance, Settings) and prefix != "--":
        yield f"{prefix}kind", None
    hints = typing.get_type_hints(type(instance) if instance else settings, include_extras=True)
    for field in dataclasses.fields(settings):
        value = kinds.default_of(field) if instance is None else getattr(instance, field.name)
        flat = any(getattr(mark, "name", None) == "" for mark in typing.get_args(hints[field.name]))
        if flat:
            yield from flags_of(value, prefix)
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from flags_of(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", field


def kinds_text(default: Any, prefix: str = "") -> str:
    """Return one line per section that has several kinds, for the help text."""
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
    if lines and not prefix:
        lines.insert(0, "Parts of the model with several kinds:")
    return "\n".join(lines)
