"""Errors that refuse a setting, or other user input, in one sentence, and their exit codes."""

from __future__ import annotations

import errno
import re
import sys
from collections.abc import Callable
from typing import Any


class UserError(ValueError):
    """Bad input from a user, in one sentence: what is wrong, where, and what to do."""


class ConfigError(UserError):
    """A setting that cannot work; the message says what is wrong, where, and what to do."""


def require(condition: bool, sentence: str) -> None:
    """Refuse a setting with a sentence unless the condition holds."""
    if not condition:
        raise ConfigError(sentence)


def require_fields(
    section: Any, where: str, accepts: Callable[[Any], bool], hint: str, *names: str
) -> None:
    """Refuse fields whose value is not accepted: "``where``.name is value: use ``hint``."."""
    for name in names:
        value = getattr(section, name)
        require(accepts(value), f"{where}.{name} is {value}: use {hint}.")


def require_positive(section: Any, where: str, *names: str) -> None:
    """Refuse sizes and counts below 1; the message names the field."""
    require_fields(section, where, lambda value: value >= 1, "at least 1", *names)


def is_pattern(text: str) -> bool:
    """Tell whether a text is a regular expression."""
    try:
        re.compile(text)
    except re.error:
        return False
    return True


def report(error: UserError | OSError | KeyboardInterrupt) -> int:
    """Print an error as one sentence on stderr, and return the exit code.

    The code is 2 for bad input and for files that cannot be used; 130, or the error's
    ``exit_code``, for an interruption.
    """
    if isinstance(error, KeyboardInterrupt):
        print(str(error) or "Interrupted.", file=sys.stderr)
        return getattr(error, "exit_code", 130)
    sentence = _file_sentence(error) if isinstance(error, OSError) else str(error)
    print(f"error: {sentence}", file=sys.stderr)
    return 2


def _file_sentence(error: OSError) -> str:
    """Return a sentence: the file that could not be used, the reason, and what to do."""
    where = f"{error.filename}: " if error.filename else ""
    if error.errno in {errno.ENOSPC, errno.EDQUOT}:
        fix = "free some space there"
    elif error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
        fix = "allow access to it or name another folder"
    else:
        fix = "fix that"
    return f"{where}{error.strerror or error}; {fix}, then run the same command again."
