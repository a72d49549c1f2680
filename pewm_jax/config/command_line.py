"""Command lines: settings from a preset, a JSON file and flags; errors in one sentence."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import hashlib
import io
import json
import platform
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from pewm_jax import config as configuration
from pewm_jax.config import ConfigError, UserError
from pewm_jax.config import flags as flag_names
from pewm_jax.errors import report

T = TypeVar("T")
_RULE = "─╭╮╰╯-+ "
_PLAIN = (
    (r": invalid literal for int\(\) with base 10: (.*)", r" needs a whole number, got \1"),
    (r": could not convert string to float: (.*)", r" needs a number, got \1"),
)


def run(main: Callable[[Sequence[str]], int | None], argv: Sequence[str] | None = None) -> int:
    """Run a command; turn errors into an exit code and one sentence on stderr.

    Args:
        main: the command; takes the arguments and returns an exit code (None is 0).
        argv: the arguments, by default those of the process.

    Returns:
        0; 2 for bad input and for files that cannot be used; 130, or the error's ``exit_code``,
        for an interruption.
    """
    try:
        return main(sys.argv[1:] if argv is None else argv) or 0
    except (UserError, OSError, KeyboardInterrupt) as error:
        return report(error)


def parse(
    kind: type[T],
    argv: Sequence[str],
    *,
    default: T,
    prog: str,
    description: str | None = None,
) -> T:
    """Read a configuration from flags such as ``--train.stage1.steps 10``.

    First ``--config FILE`` overrides the defaults with a JSON file of settings, then kinds are
    chosen (see ``pewm_jax.config.flags``), then flags are read. ``--help`` prints every field with
    its docstring and exits.

    Args:
        kind: the frozen dataclass to read.
        argv: the arguments.
        default: the settings if no flags are given.
        prog: the command as the user typed it, for help and error messages.
        description: the first paragraph of the help text.

    Raises:
        ConfigError: an unknown flag (with the nearest known one), or a value that is refused.
    """
    file, flags = _take_config_file(argv, kind)
    if file is not None:
        default = overlay(default, file)
    known: Any = kind
    if dataclasses.is_dataclass(default):
        default, flags = flag_names.take_kinds(flag_names.spelled_out(flags, default), default)
        known = default
    _refuse_unknown(flags, known, prog)
    if "-h" in flags or "--help" in flags:
        return tyro.cli(
            kind,
            args=["--help"],
            default=default,
            prog=prog,
            description=_with_kinds(description, default),
            use_underscores=True,
        )
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
            return tyro.cli(kind, args=flags, default=default, prog=prog, use_underscores=True)
    except SystemExit:
        raise ConfigError(_sentence(output.getvalue(), prog)) from None


def _with_kinds(description: str | None, default: Any) -> str | None:
    """Append the list of kinds of parts to a description."""
    kinds = flag_names.kinds_text(default) if isinstance(default, configuration.Config) else ""
    if not kinds:
        return description
    return f"{description}\n\nParts of the model of which there are several kinds:\n{kinds}"


def parse_command(kind: type[T], argv: Sequence[str], prog: str) -> T:
    """Read the flags of a subcommand such as ``pewm-jax data collect``.

    Args:
        kind: the frozen dataclass to read; fields without a default must be given.
        argv: the arguments after the command's name.
        prog: the command as the user typed it, for help and error messages.

    Raises:
        ConfigError: the arguments cannot be read.
    """
    nothing: T = tyro.MISSING_NONPROP  # type: ignore[assignment]
    if _take_config_file(argv, kind)[0] is not None:
        raise ConfigError(f"--config is not a setting; `{prog} --help` lists them all.")
    try:
        return parse(kind, argv, default=nothing, prog=prog)
    except ConfigError as error:
        raise ConfigError(_first_sentence(str(error), kind.__name__, prog)) from None


def _first_sentence(message: str, kind: str, prog: str) -> str:
    """Extract the first statement of the parser's message, without its frame and help."""
    parts = [part.strip() for part in re.split(r"-{5,}", message)]
    text = next((part for part in parts if part.strip(".")), message)
    text = text.removeprefix(f"Error parsing {kind}: ").removeprefix(f"{kind}: ")
    if text.startswith("Missing from"):
        text = f"{text}; `{prog} --help` explains"
    text = text.removesuffix(" .")
    return text if text.endswith(".") else f"{text}."


def take(kind: type[T], argv: Sequence[str]) -> tuple[T, list[str]]:
    """Take the flags of a flat dataclass of bools, numbers and strings out of the arguments.

    Args:
        kind: the frozen dataclass.
        argv: the arguments.

    Returns:
        The dataclass, and all other arguments.

    Raises:
        ConfigError: a flag without its value, or a value that is refused.
    """
    fields = {f"--{field.name}": field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    found: dict[str, Any] = {}
    rest, queue = [], list(argv)
    while queue:
        flag, equals, value = queue.pop(0).partition("=")
        if flag not in fields:
            rest.append(flag + equals + value)
            continue
        field = fields[flag]
        if isinstance(field.default, bool):
            if equals:
                raise ConfigError(f"{flag} takes no value: leave out {equals}{value}.")
            found[field.name] = True
            continue
        if not equals:
            if not queue:
                raise ConfigError(f"{flag} needs a value: {field.metadata['help']}.")
            value = queue.pop(0)
        try:
            found[field.name] = type(field.default)(value)
        except ValueError:
            raise ConfigError(f"{flag} needs a whole number, got {value!r}.") from None
    return kind(**found), rest


def list_flags(kind: type) -> str:
    """Return one line for each field of a dataclass that ``take`` reads."""
    lines = []
    for field in dataclasses.fields(kind):
        name = "" if isinstance(field.default, bool) else " " + type(field.default).__name__.upper()
        lines.append(f"  --{field.name + name:<16} {field.metadata['help']}")
    return "\n".join(lines)


def overlay(default: T, path: Path) -> T:
    """Override a default with the settings of a JSON file, nested like the configuration.

    Raises:
        ConfigError: the file is absent, not JSON, or holds settings that do not exist or fit.
    """
    try:
        values = json.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"--config {path} cannot be read ({error.strerror}).") from None
    except ValueError as error:
        raise ConfigError(f"--config {path} is not valid JSON ({error}).") from None
    if not isinstance(values, dict):
        raise ConfigError(
            f'--config {path} must hold a table such as {{"train": {{"seed": 1}}}}, not '
            f"a {type(values).__name__}."
        )
    if isinstance(default, configuration.Config):
        there = configuration.to_dict(default.model)
        under = {".".join(where): name for where, name in _kinds_in(there)}
        values = configuration.upgrade(values, path.name, under)
        for where, name in sorted(_kinds_in(values), key=lambda found: len(found[0])):
            try:
                default = flag_names.with_kind(default, where, name)
            except ConfigError as error:
                place = ".".join([path.name, *where, "kind"])
                raise ConfigError(f"{place}: {error}") from None
    merged = _deep_merge(configuration.to_dict(default), values)
    return configuration.from_dict(type(default), merged, path.name)


def _kinds_in(values: dict[str, Any], *path: str) -> Iterator[tuple[tuple[str, ...], str]]:
    """List the paths of the sections of a table that name their kind, with the name."""
    for name, value in values.items():
        if name == "kind" and isinstance(value, str):
            yield path, value
        elif isinstance(value, dict):
            yield from _kinds_in(value, *path, name)


def cache_compilation(folder: Path) -> None:
    """Make JAX cache compiled programs in a folder, so that the next start is faster.

    There is one cache per set of processor features, for which programs are compiled. Call this
    from command lines only: it sets a global option of JAX. A folder that the caller has chosen, by
    ``JAX_COMPILATION_CACHE_DIR`` or ``jax.config``, stays, and so does a cache that the caller has
    switched off (``JAX_ENABLE_COMPILATION_CACHE``).
    """
    import jax  # noqa: PLC0415 - takes seconds, and refusals do not need it

    chosen: Any = jax.config
    if chosen.jax_compilation_cache_dir or not chosen.jax_enable_compilation_cache:
        return
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else [platform.processor()]
    features = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    kind = hashlib.sha256(features.encode()).hexdigest()[:12]
    jax.config.update("jax_compilation_cache_dir", str((folder / ".cache" / kind).resolve()))


def choose(name: str, known: Sequence[str], what: str) -> str:
    """Return ``name`` if it is known.

    Raises:
        ConfigError: it is not known; the message lists the known names, and the nearest first.
    """
    if name in known:
        return name
    raise ConfigError(
        f"There is no {what} {name!r}{_nearest(name, known)}; there is {', '.join(known)}."
    )


def _take_config_file(argv: Sequence[str], kind: type) -> tuple[Path | None, list[str]]:
    """Take ``--config FILE`` out of the arguments, unless the dataclass has such a field."""
    flags = list(argv)
    if "--config" in dict(flag_names.of(kind)):
        return None, flags
    for index, flag in enumerate(flags):
        if flag.startswith("--config="):
            return Path(flag.removeprefix("--config=")), flags[:index] + flags[index + 1 :]
        if flag == "--config":
            if index + 1 == len(flags):
                raise ConfigError("--config needs the name of a JSON file of settings.")
            return Path(flags[index + 1]), flags[:index] + flags[index + 2 :]
    return None, flags


def _refuse_unknown(flags: Sequence[str], kind: Any, prog: str) -> None:
    known = [name for name, _ in flag_names.of(kind)]
    for flag in flags:
        if not flag.startswith("--") or flag == "--help":
            continue
        name = flag.split("=")[0].replace("-", "_").replace("__", "--", 1)
        spellings = (name, _negated(name))
        if not any(spelling in known for spelling in spellings):
            raise ConfigError(
                f"{flag.split('=')[0]} is not a setting{_nearest(name, known)}; "
                f"`{prog} --help` lists them all."
            )


def _negated(name: str) -> str:
    """Return the flag that ``--a.no_b`` negates: ``--a.b``."""
    head, dot, last = name[2:].rpartition(".")
    return f"--{head}{dot}{last.removeprefix('no_')}"


def _nearest(name: str, known: Sequence[str]) -> str:
    """Suggest a flag with the same last part, or else with the most similar spelling."""
    last = name.rsplit(".", 1)[-1].lstrip("-")
    close = [flag for flag in known if flag.rsplit(".", 1)[-1].lstrip("-") == last]
    close = close or difflib.get_close_matches(name, known, 1, 0.5)
    return f" (did you mean {close[0]}?)" if close else ""


def _sentence(box: str, prog: str) -> str:
    """Extract the message from the frame that the parser draws around it."""
    lines = []
    for line in box.splitlines()[1:]:
        content = line.strip(" │|")
        if content.strip(_RULE):
            lines.append(content)
        elif lines:
            break
    text = " ".join(lines).strip()
    if text.startswith("Error parsing "):
        where, _, text_rest = text.removeprefix("Error parsing ").partition(": ")
        text = f"{where}: {text_rest}" if where.startswith("--") else text_rest
    for pattern, plain in _PLAIN:
        text = re.sub(pattern, plain, text)
    if text.startswith("Unrecognized"):
        text += f"; `{prog} --help` lists the settings"
    end = "" if text.endswith((".", "!", "?")) else "."
    return text + end if text else f"The settings cannot be read; see `{prog} --help`."


def _deep_merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for name, value in over.items():
        below = merged.get(name)
        if isinstance(value, dict) and isinstance(below, dict):
            merged[name] = _deep_merge(below, value)
        else:
            merged[name] = value
    return merged
