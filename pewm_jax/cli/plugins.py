"""``--plugin FILE``: run a user's own code before settings are read."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from pewm_jax import registry as kinds
from pewm_jax.config import ConfigError, UserError


@dataclasses.dataclass(frozen=True)
class Plugins:
    """User code that runs before settings are read; a flag of every command."""

    plugin: tuple[Path, ...] = ()
    """FILE.py: run this Python file first; it registers your own worlds or parts. May be
    repeated."""


def run(argv: Sequence[str]) -> list[str]:
    """Import the files given by ``--plugin``, and the modules given by the deprecated ``--import``.

    Modules are also looked up in the current folder, after all other locations.

    Returns:
        The other arguments.

    Raises:
        ConfigError: a flag has no value, or a file or module cannot be imported.
    """
    found, rest = take(argv, lambda flag: flag in ("--import", "--plugin"))
    for flag, value in found:
        name = value or ""
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


def take(
    argv: Sequence[str], wanted: Callable[[str], bool]
) -> tuple[list[tuple[str, str | None]], list[str]]:
    """Split arguments into the wanted flags with their values, None if missing, and the others."""
    found: list[tuple[str, str | None]] = []
    rest, queue = [], list(argv)
    while queue:
        word = queue.pop(0)
        flag, equals, value = word.partition("=")
        if wanted(flag):
            found.append((flag, value if equals else queue.pop(0) if queue else None))
        else:
            rest.append(word)
    return found, rest


def load_file(name: str) -> None:
    """Import a Python file; its module has the file's name.

    Raises:
        ConfigError: there is no such file, it cannot be imported, or it is called as a module of
            Python or of an installed package, which it would replace.
    """
    file = Path(name)
    if not name.endswith(".py") or not file.is_file():
        raise ConfigError(
            f"--plugin needs the path of a Python file that registers kinds, got {name!r}."
        )
    if _hides_a_module(file):
        raise ConfigError(
            f"--plugin: {file} is called as the module {file.stem!r}, which it would replace: "
            f"rename it, such as to my_{file.stem}.py."
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
        raise ConfigError(f"--plugin: {file} cannot be imported{_why(error, file)}") from error


def _hides_a_module(file: Path) -> bool:
    """Tell whether a file is called as a module of Python or of an installed package."""
    if file.stem in sys.stdlib_module_names:
        return True
    try:
        spec = importlib.util.find_spec(file.stem)
    except (ImportError, ValueError):
        return False
    if spec is None or spec.origin is None or "site-packages" not in Path(spec.origin).parts:
        return False
    return Path(spec.origin).resolve() != file.resolve()


def _why(error: Exception, file: Path) -> str:
    """Return the end of a sentence: the line that raised an error, and the error."""
    text = " ".join(str(error).split())
    if isinstance(error, UserError):
        return f": {text}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == file.resolve()]
    where = f"line {lines[-1]}, " if lines else ""
    return f" ({where}{type(error).__name__}: {text})."


def look_here() -> None:
    """Add the current folder to the end of the module search path."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
