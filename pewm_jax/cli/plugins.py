"""``--plugin FILE`` and ``--import MODULE``: a user's own code runs before settings are read."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import registry as kinds
from pewm_jax.config import ConfigError

HELP = (
    "  --plugin FILE.py   run this file first: it registers worlds or parts of your own; may be\n"
    "                     repeated\n"
    "  --import MODULE    the same for a module that Python finds"
)
"""The line of the help text."""


def take(argv: Sequence[str]) -> list[str]:
    """Import what ``--import`` and ``--plugin`` name, such as kinds of a user's own.

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
        if flag not in ("--import", "--plugin"):
            rest.append(word)
            continue
        if not equals:
            name = queue.pop(0) if queue else ""
        if flag == "--plugin":
            load_file(name)
            continue
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            raise ConfigError(
                f"--import needs the name of a module, such as my_parts for my_parts.py, got "
                f"{name!r}."
            )
        look_here()
        kinds.imported(name, "--import")
    return rest


def load_file(name: str) -> None:
    """Import a Python file; its module is called as the file is.

    Raises:
        ConfigError: there is no such file, or it cannot be imported.
    """
    file = Path(name)
    if not name.endswith(".py") or not file.is_file():
        raise ConfigError(
            f"--plugin needs the path of a Python file that registers kinds, got {name!r}."
        )
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a file may raise anything when it is run
        del sys.modules[file.stem]
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(f"--plugin: {file} cannot be imported ({reason}).") from error


def look_here() -> None:
    """Let modules be found in the current folder too, after all others."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
