"""``--plugin FILE``: run a user's own code before settings are read."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import registry as kinds
from pewm_jax.config import ConfigError


@dataclasses.dataclass(frozen=True)
class Plugins:
    """User code that runs before settings are read; a flag of every command."""

    plugin: tuple[Path, ...] = ()
    """FILE.py: run this Python file first; it registers your own worlds or parts. May be
    repeated."""


def take(argv: Sequence[str]) -> list[str]:
    """Import the files given by ``--plugin``, and the modules given by the deprecated ``--import``.

    Modules are also looked up in the current folder, after all other locations.

    Args:
        argv: the arguments; the flags may be repeated.

    Returns:
        The other arguments.

    Raises:
        ConfigError: a flag has no value, or a file or module cannot be imported.
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
        message = "warning: --import MODULE is deprecated; use --plugin FILE.py."
        print(message, file=sys.stderr)
        look_here()
        kinds.imported(name, "--import")
    return rest


def load_file(name: str) -> None:
    """Import a Python file; its module has the file's name.

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
    """Add the current folder to the end of the module search path."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
