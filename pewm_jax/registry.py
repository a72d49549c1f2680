"""The registry of kinds: which settings a section of a model may hold, and their functions.

A model consists of parts (a backbone, a codec, a control, a memory with its encoder and reader, a
noise). Each part comes in several kinds. A kind is a frozen dataclass of settings and a module (or
any object) with its functions. One call makes it known::

    register("backbone", "mine", MyConfig, my_module)

From then on its functions are found by the type of the settings:
``functions(settings).apply(settings, …)``. In JSON, a section names its kind:
``{"backbone": {"kind": "mine", "layers": 4}}``. The functions of each part are documented in
``pewm_jax.models`` (``backbones``, ``codecs``, ``controls``, ``readers``, ``encoders``),
``pewm_jax.memory.memories``, ``pewm_jax.diffusion.noise`` and ``pewm_jax.worlds``.

When a name is not known, the modules of the entry-point group ``pewm_jax.kinds`` are imported, by
which installed packages register kinds of theirs.
"""

from __future__ import annotations

import dataclasses
import importlib
from importlib import metadata
from typing import Any, ClassVar

from pewm_jax.errors import ConfigError


class Settings:
    """Base class of the settings of all kinds.

    Attributes:
        SECTION: the section of a model that they belong to.
    """

    SECTION: ClassVar[str] = ""

    def check(self, model: Any) -> None:
        """Refuse a model that these settings do not fit into; called when a model is built.

        Args:
            model: the ``ModelConfig`` that they are part of.

        Raises:
            ConfigError: they do not fit.
        """


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of one part.

    Attributes:
        section: the part, such as ``backbone``.
        name: its name in JSON and flags.
        settings: its frozen dataclass, a subclass of the section's settings.
        where: the name of the module with its functions, imported when first used, so that
            reading settings loads no networks; or an object with the functions.
    """

    section: str
    name: str
    settings: type
    where: Any


GROUP = "pewm_jax.kinds"
"""The entry points whose modules register kinds when they are imported."""

_KINDS: dict[tuple[str, str], Kind] = {}
_ENTERED: set[str] = set()
"""Modules of entry points that were imported, or are being imported."""


def register(section: str, name: str, settings: type, where: Any) -> None:
    """Make a kind known.

    Registering the same settings again replaces them and their functions: the same class, or the
    one that a notebook's cell or a reloaded module defines anew.

    Args:
        section: the part of a model, such as ``backbone``.
        name: the kind's name in JSON and flags.
        settings: a frozen dataclass, subclass of the section's settings.
        where: the name of the module with its functions, or a module or other object.

    Raises:
        ConfigError: the settings are no frozen dataclass or of another section, or the name is
            taken by other settings.
    """
    if not (isinstance(settings, type) and issubclass(settings, Settings)) or (
        section != settings.SECTION
    ):
        raise ConfigError(
            f"{getattr(settings, '__name__', settings)} cannot be registered as a {section}: "
            f"derive a class from the settings of that section, which say SECTION = {section!r}."
        )
    parameters = vars(settings).get("__dataclass_params__")
    if parameters is None or not parameters.frozen:
        raise ConfigError(
            f"{settings.__name__} cannot be registered as a {section}: it is no frozen dataclass, "
            "so write @dataclasses.dataclass(frozen=True) above it."
        )
    taken = _KINDS.get((section, name))
    if taken is not None and not _same(taken.settings, settings):
        raise ConfigError(
            f"There is a {section} {name!r} already ({taken.settings.__name__}); choose another "
            "name."
        )
    _KINDS[section, name] = Kind(section, name, settings, where)


def _same(one: type, other: type) -> bool:
    """Tell whether two classes are one, or the same definition run twice."""
    return (one.__module__, one.__qualname__) == (other.__module__, other.__qualname__)


def names(section: str) -> list[str]:
    """Return the names of the kinds of a section."""
    return sorted(name for part, name in _KINDS if part == section)


def named(section: str, name: str) -> Kind:
    """Return a kind by its name; installed packages are asked for one that is not known.

    Raises:
        ConfigError: there is no such kind; the message lists the known ones, and the modules of
            entry points that could not be imported.
    """
    failed: list[str] = []
    if isinstance(name, str):  # a table read from JSON may hold anything
        if (section, name) not in _KINDS:
            failed = _import_entry_points()
        if (section, name) in _KINDS:
            return _KINDS[section, name]
    raise ConfigError(
        f"There is no {section} of kind {name!r}; there is {', '.join(names(section))} (a kind of "
        "your own is known once its module is imported: say --import MODULE to the command, or "
        f"name the module in an entry point of the group {GROUP!r})"
        + "".join(f"; {sentence.removesuffix('.')}" for sentence in failed)
        + "."
    )


def _import_entry_points() -> list[str]:
    """Import the modules that installed packages name, each once; return what went wrong."""
    failed = []
    for point in metadata.entry_points(group=GROUP):
        if point.module in _ENTERED:
            continue
        _ENTERED.add(point.module)  # before: what it imports may ask for a kind
        try:
            imported(point.module, f"entry point {point.name!r} of {GROUP}")
        except ConfigError as error:
            _ENTERED.discard(point.module)
            failed.append(str(error))
    return failed


def imported(name: str, what: str) -> Any:
    """Import a module of a user's.

    Args:
        name: its name.
        what: what asks for it, for the error message.

    Raises:
        ConfigError: it cannot be imported, for whatever reason.
    """
    try:
        return importlib.import_module(name)
    except Exception as error:  # a module may raise anything when it is run
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(
            f"{what}: the module {name} cannot be imported ({reason}); mend it, install what it "
            "needs, or put it where Python looks for modules."
        ) from error


def of(settings: Any) -> Kind:
    """Return the kind that settings are of, by their type.

    Raises:
        ConfigError: their type is not registered.
    """
    for same in (lambda one, other: one is other, _same):
        for kind in _KINDS.values():
            if same(kind.settings, type(settings)):
                return kind
    raise ConfigError(
        f"{type(settings).__name__} is not registered: call pewm_jax.config.register(section, "
        "name, settings, functions) once, where it is defined."
    )


def functions(settings: Any) -> Any:
    """Return the module or object with the functions for settings, chosen by their type.

    Raises:
        ConfigError: their type is not registered, or the module cannot be imported.
    """
    kind = of(settings)
    if not isinstance(kind.where, str):
        return kind.where
    return imported(kind.where, f"{kind.section} of kind {kind.name!r}")


def require_section(value: Any, section: str, where: str) -> None:
    """Refuse what are not settings of a section, also in the sections below it.

    Args:
        value: what was given.
        section: that it must be of.
        where: its name in the error message.

    Raises:
        ConfigError: in one sentence.
    """
    given = not isinstance(value, type) and dataclasses.is_dataclass(value)
    if not given or getattr(value, "SECTION", None) != section:
        found = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        there = [kind.settings.__name__ for kind in _KINDS.values() if kind.section == section]
        raise ConfigError(
            f"{where} is {found}: give it settings of the section {section!r}, such as "
            f"{' or '.join(there)}."
        )
    for field in dataclasses.fields(value):
        if isinstance(field.default, Settings):
            require_section(
                getattr(value, field.name), field.default.SECTION, f"{where}.{field.name}"
            )
