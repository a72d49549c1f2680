"""``--import MODULE``: a file of a user's own is imported before settings are read."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import registry as kinds
from pewm_jax.config import ConfigError

HELP = "  --import MODULE    import it first: it registers parts of your own; may be repeated"
"""The line of the help text."""


def take(argv: Sequence[str]) -> list[str]:
    """Import the modules that ``--import`` names, such as kinds of a user's own.

    They are looked for in the current folder too, after all others.

    Args:
        argv: the arguments; the flag may be repeated.

    Returns:
        The other arguments.

    Raises:
        ConfigError: a flag without the name of a module, or one that cannot be imported.
    """
    rest, queue = [], list(argv)
    while queue:
        word = queue.pop(0)
        flag, equals, name = word.partition("=")
        if flag != "--import":
            rest.append(word)
            continue
        if not equals:
            name = queue.pop(0) if queue else ""
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            raise ConfigError(
                f"--import needs the name of a module, such as my_parts for my_parts.py, got "
                f"{name!r}."
            )
        look_here()
        kinds.imported(name, "--import")
    return rest


def look_here() -> None:
    """Let modules be found in the current folder too, after all others."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
