"""Errors that refuse a setting, or other user input, in one sentence."""

from __future__ import annotations

import re
from typing import Any


class UserError(ValueError):
    """Bad input from a user, in one sentence: what is wrong, where, and what to do."""


class ConfigError(UserError):
    """A setting that cannot work; the message says what is wrong, where, and what to do."""


def require(condition: bool, sentence: str) -> None:
    """Refuse a setting with a sentence unless the condition holds."""
    if not condition:
        raise ConfigError(sentence)


def require_positive(section: Any, where: str, *names: str) -> None:
    """Refuse sizes and counts below 1; the message names the field."""
    for name in names:
        value = getattr(section, name)
        require(value >= 1, f"{where}.{name} is {value}: use at least 1.")


def is_pattern(text: str) -> bool:
    """Tell whether a text is a regular expression."""
    try:
        re.compile(text)
    except re.error:
        return False
    return True
