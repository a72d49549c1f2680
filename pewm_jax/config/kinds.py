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
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Any, ClassVar

from pewm_jax.config.errors import ConfigError


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


_KINDS: dict[tuple[str, str], Kind] = {}


def register(section: str, name: str, settings: type, where: Any) -> None:
    """Make a kind known; registering the same settings again replaces their functions.

    Args:
        section: the part of a model, such as ``backbone``.
        name: the kind's name in JSON and flags.
        settings: a frozen dataclass, subclass of the section's settings.
        where: the name of the module with its functions, or a module or other object.

    Raises:
        ConfigError: the settings are of another section, or the name is taken by other settings.
    """
    if getattr(settings, "SECTION", None) != section:
        raise ConfigError(
            f"{settings.__name__} cannot be registered as a {section}: derive it from the settings "
            f"of that section, which say SECTION = {section!r}."
        )
    taken = _KINDS.get((section, name))
    if taken is not None and taken.settings is not settings:
        raise ConfigError(
            f"There is a {section} {name!r} already ({taken.settings.__name__}); choose another "
            "name."
        )
    _KINDS[section, name] = Kind(section, name, settings, where)


def names(section: str) -> list[str]:
    """Return the names of the kinds of a section."""
    return sorted(name for part, name in _KINDS if part == section)


def named(section: str, name: str) -> Kind:
    """Return a kind by its name.

    Raises:
        ConfigError: there is no such kind; the message lists the known ones.
    """
    kind = _KINDS.get((section, name))
    if kind is None:
        raise ConfigError(
            f"There is no {section} of kind {name!r}; there is {', '.join(names(section))} (a kind "
            "of your own is known once the module that registers it is imported)."
        )
    return kind


def of(settings: Any) -> Kind:
    """Return the kind that settings are of, by their type.

    Raises:
        ConfigError: their type is not registered.
    """
    for kind in _KINDS.values():
        if kind.settings is type(settings):
            return kind
    raise ConfigError(
        f"{type(settings).__name__} is not registered: call pewm_jax.config.register(section, "
        "name, settings, functions) once, where it is defined."
    )


def functions(settings: Any) -> Any:
    """Return the module or object with the functions for settings, chosen by their type."""
    where = of(settings).where
    return importlib.import_module(where) if isinstance(where, str) else where
