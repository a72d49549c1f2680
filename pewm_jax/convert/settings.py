"""Foreign settings, read strictly: of the right class, none unknown, each of its kind."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from pewm_jax.config import UserError


def require_class(values: Mapping[str, Any], what: str, name: str) -> None:
    """Insist that settings name a class, or none.

    Args:
        values: the JSON object.
        what: what they describe, for the message: ``The U-Net``.
        name: the class that can be read.

    Raises:
        UserError: another class.
    """
    kind = values.get("_class_name", name)
    if kind != name:
        raise UserError(f"{what} is a {kind}; only {name} can be read.")


def require_known(values: Mapping[str, Any], what: str, known: Collection[str]) -> None:
    """Insist that every setting is known; those that begin with ``_`` are the writer's own notes.

    Raises:
        UserError: with the list of those that are not.
    """
    unknown = sorted(key for key in values if not key.startswith("_") and key not in known)
    if unknown:
        raise UserError(
            f"{what} has settings that are not known: {', '.join(unknown)}; known are "
            f"{', '.join(sorted(known))}."
        )


def of_network(
    values: Mapping[str, Any],
    what: str,
    name: str,
    defaults: Mapping[str, Any],
    without_effect: Collection[str] = (),
) -> dict[str, Any]:
    """Return the settings of a network of one class; absent ones have the class's defaults.

    Args:
        values: the JSON object.
        what: what they describe, for messages.
        name: the class that can be read.
        defaults: the settings that matter, and what the class takes for absent ones.
        without_effect: settings that may stand there and change nothing.

    Raises:
        UserError: another class, or a setting that is not known.
    """
    require_class(values, what, name)
    require_known(values, what, {*defaults, *without_effect})
    return {key: values.get(key, default) for key, default in defaults.items()}


def require_only(given: Mapping[str, Any], what: str, only: Mapping[str, Any]) -> None:
    """Insist on the values of settings of which only one is supported.

    Raises:
        UserError: another value.
    """
    for key, value in only.items():
        if _plain(given.get(key, value)) != _plain(value):
            raise UserError(f"{what}'s {key} is {given[key]!r}; only {value!r} is supported.")


def require_like(given: Mapping[str, Any], what: str, examples: Mapping[str, Any]) -> None:
    """Insist that settings are of the kinds of examples.

    A whole number will do for a number; a list must be as long as a tuple in the examples, and of
    any length for a list.

    Raises:
        UserError: a setting of another kind.
    """
    for key, example in examples.items():
        if not _alike(given[key], example):
            raise UserError(
                f"{what}'s {key} is {given[key]!r}; one like {example!r} belongs there."
            )


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _alike(value: Any, example: Any) -> bool:
    if isinstance(example, tuple | list):
        fits = isinstance(value, tuple | list)
        fits = fits and (isinstance(example, list) or len(value) == len(example))
        return fits and all(_alike(item, example[0]) for item in value)
    if isinstance(example, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is type(example)
