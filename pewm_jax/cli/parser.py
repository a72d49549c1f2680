"""Read the settings of a command from its arguments, with tyro; errors are one sentence.

The settings are dataclasses. Their fields are the flags, fields marked ``tyro.conf.Positional`` are
the positional arguments, and docstrings are the help. Several dataclasses are composed, not copied:
a field of type ``Flat[Join]`` adds the flags of ``Join`` without a prefix.

For the settings of an experiment, ``--config FILE`` overlays a JSON file, ``--SECTION.kind NAME``
replaces a section by that of another kind, ``--clip.width 64`` is short for ``--model.clip.width
64``, and names from earlier versions are accepted.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import inspect
import re
import sys
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from pewm_jax import registry
from pewm_jax.cli.plugins import Plugins, take
from pewm_jax.config import Config, Settings
from pewm_jax.config.migrations import (
    RENAMED_FLAGS,
    RENAMED_SETTINGS,
    kind_now,
    logs_with,
)
from pewm_jax.config.overlay import overlay, section_with_kinds, with_kind
from pewm_jax.errors import ConfigError, UserError, report

T = TypeVar("T")
Flat = Annotated[T, tyro.conf.arg(name="")]
"""Type of a field whose own fields are flags without a prefix."""
HELP = ("-h", "--help")
_PLAIN = (
    (r"invalid literal for int\(\) with base 10: (.*)", r"needs an integer, got \1"),
    (r"could not convert string to float: (.*)", r"needs a number, got \1"),
    (r"(?s)no type matching (?:\{None\}\|)?\{?(.*?)\}? could be .* from (\[.*?\])\..*",
     r"needs \1, got \2"),
)  # fmt: skip
"""Messages of tyro, and their replacements after the flag's name."""


@dataclasses.dataclass(frozen=True)
class ConfigFile:
    """A file of settings."""

    config: Path | None = None
    """JSON file of settings, nested like a run's config.json; flags override it."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """The arguments of a command.

    Attributes:
        groups: dataclasses whose fields become flags, each with its default; None for the default
            of the class itself.
        description: the first paragraph of the help; by default the docstring of the first group.
        epilog: text after the help, printed verbatim.
        hint: the command whose ``--help`` lists the settings, for error messages.
        renamed: earlier names of flags, with the present ones.
        argv: the words to parse in place of those typed; None for those.
    """

    groups: Mapping[str, tuple[type, Any]]
    description: str | None = None
    epilog: str = ""
    hint: str = ""
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    argv: Sequence[str] | None = None


def run(main: Callable[[Sequence[str]], int | None], argv: Sequence[str] | None = None) -> int:
    """Run a command, which returns an exit code (None is 0); convert errors to one and a sentence.

    ``argv`` are by default the arguments of the process.

    Returns:
        0; 2 for invalid input and unusable files; 130, or the error's ``exit_code``, for an
        interruption.
    """
    try:
        return main(sys.argv[1:] if argv is None else argv) or 0
    except (UserError, OSError, KeyboardInterrupt) as error:
        return report(error)


def parse(
    kind: type[T],
    argv: Sequence[str],
    *,
    default: T | None = None,
    prog: str,
    description: str | None = None,
) -> T:
    """Read one frozen dataclass from flags such as ``--train.stage1.steps 10``.

    ``default``: the settings if no flags are given; None for the defaults of the class. ``prog``
    and ``description``: as for ``read`` and ``Arguments``.

    Raises:
        ConfigError: an unknown flag (with the nearest known one), or an invalid value.
    """
    return read(Arguments({"settings": (kind, default)}, description), argv, prog)["settings"]


def read(wanted: Arguments, argv: Sequence[str], prog: str) -> dict[str, Any]:
    """Parse a command's arguments; ``--help`` prints every flag with its docstring and exits.

    ``prog`` is the command as the user typed it, for help and error messages.

    Returns:
        The settings of each group, by its name.

    Raises:
        ConfigError: an unknown flag (with the nearest known one), an invalid value, or a missing
            argument.
    """
    words = argv if wanted.argv is None else wanted.argv
    flags = [wanted.renamed.get(word, word) for word in words]
    groups = dict(wanted.groups)
    for name in (name for kind, _ in groups.values() for name in getattr(kind, "REPEATED", ())):
        flags = _joined(flags, name)
    extra: dict[str, tuple[type, Any]] = {"plugins": (Plugins, Plugins())}
    epilog = wanted.epilog
    for name, (kind, default) in groups.items():
        if isinstance(default, Config):
            files, flags = take(flags, lambda flag: flag == "--config")
            if any(file is None for _, file in files):
                raise ConfigError("--config needs the name of a JSON file of settings.")
            flags = _joined(_present_logs(flags), "--log")
            under = overlay(default, Path(str(files[0][1]))) if files else default
            config, flags = take_kinds(full_names(flags, under), under)
            groups[name] = kind, config
            extra["file"] = ConfigFile, ConfigFile()
            epilog = "\n\n".join(text for text in (kinds_text(config), epilog) if text)
    description = wanted.description or inspect.getdoc(next(iter(groups.values()))[0])
    everything = groups | extra
    hint = wanted.hint or prog
    known = [name for kind, default in everything.values() for name, _ in flags_of(default or kind)]

    if any(word in HELP for word in flags):
        flags = ["--help"]  # also in place of a flag's value

    def refuse(event: Any) -> None:
        raise ConfigError(_sentence(event, known, hint))

    try:
        with _on_parse_error(refuse):
            found = tyro.cli(
                _composed(everything),
                args=flags,
                prog=prog,
                description=description,
                use_underscores=True,
            )
    except SystemExit as end:
        if end.code == 0 and epilog:
            print(epilog)
        raise
    return {name: getattr(found, name) for name in groups}


def full_names(flags: Sequence[str], default: Any) -> list[str]:
    """Return flags by their full, current names if what they override is an experiment."""
    if not isinstance(default, Config):
        return list(flags)
    sections = {field.name for field in dataclasses.fields(default)}
    short = {field.name for field in dataclasses.fields(default.model)} - sections

    def full(flag: str) -> str:
        if not flag.startswith("--"):
            return flag
        name, equals, value = flag[2:].partition("=")
        name, given = name.replace("-", "_"), flag
        head, dot, last = name.removeprefix("no_").rpartition(".")
        if name.startswith("no_") and dot:
            name = f"{head}.no_{last}"
            given = f"--{name}{equals}{value}"
        for old, new in RENAMED_FLAGS:
            if name == old or (old.endswith((".", "_")) and name.startswith(old)):
                return f"--{new}{name.removeprefix(old)}{equals}{value}"
        for old, new in _renamed(default.model).items():
            if name in (old, f"model.{old}"):
                return f"--model.{new}{equals}{value}"
        first = name.partition(".")[0]
        ours = first in short or first.removeprefix("no_") in short
        return f"--model.{name}{equals}{value}" if ours else given

    return [full(flag) for flag in flags]


def _renamed(model: Any) -> dict[str, str]:
    """Return earlier names of a world's settings → present names."""
    fields = {field.name for field in dataclasses.fields(model)}
    tables = RENAMED_SETTINGS.values()
    return {old: new for table in tables for old, new in table.items() if new in fields}


def _present_logs(flags: Sequence[str]) -> list[str]:
    """Return flags with ``--log`` for its full name and for ``--train.wandb PROJECT``."""
    projects, rest = take(flags, lambda flag: flag == "--train.wandb")
    rest = [re.sub(r"^--train\.log(?==|$)", "--log", flag) for flag in rest]
    if not projects or not projects[-1][1]:
        return rest
    logs = logs_with(projects[-1][1])
    print(
        f"warning: --train.wandb PROJECT is deprecated; use --log {' '.join(logs)}.",
        file=sys.stderr,
    )
    return [*rest, "--log", *logs]


def take_kinds(flags: Sequence[str], default: T) -> tuple[T, list[str]]:
    """Apply ``--SECTION.kind NAME`` and remove it from the arguments, which have their full names.

    Returns:
        The default with settings of the chosen kinds, which may still be inconsistent, and the
        other arguments.

    Raises:
        ConfigError: there is no such kind, or a flag lacks its value.
    """
    found, rest = take(flags, lambda flag: flag.startswith("--") and flag.endswith(".kind"))
    chosen = [(flag.removeprefix("--").split(".")[:-1], name, flag) for flag, name in found]
    for path, name, flag in sorted(chosen, key=lambda choice: len(choice[0])):
        section = section_with_kinds(default, path)
        if section is None:
            rest.append(flag if name is None else f"{flag}={name}")
        elif name is None:
            there = ", ".join(registry.names(section.SECTION))
            raise ConfigError(f"{flag} needs a value: {there}.")
        else:
            default = with_kind(default, path, kind_now(section.SECTION, name))
    return default, rest


def flags_of(settings: Any, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """Yield the flags of settings (or of a dataclass type), including nested ones, and fields."""
    instance = None if isinstance(settings, type) else settings
    if isinstance(instance, Settings) and prefix != "--":
        yield f"{prefix}kind", None
    hints = typing.get_type_hints(type(instance) if instance else settings, include_extras=True)
    for field in dataclasses.fields(settings):
        value = registry.default_of(field) if instance is None else getattr(instance, field.name)
        flat = any(getattr(mark, "name", None) == "" for mark in typing.get_args(hints[field.name]))
        if flat:
            yield from flags_of(value, prefix)
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from flags_of(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", field


def kinds_text(default: Any, prefix: str = "") -> str:
    """Return one line per section that has several kinds, for the help text."""
    lines = []
    for field in dataclasses.fields(default):
        value = getattr(default, field.name)
        if not dataclasses.is_dataclass(value):
            continue
        name = f"{prefix}{field.name}"
        if isinstance(value, Settings):
            known = registry.names(value.SECTION)
            if len(known) > 1:
                lines.append(f"  --{name}.kind {{{','.join(known)}}} ({registry.of(value).name})")
        below = kinds_text(value, f"{name}.")
        lines += [below] if below else []
    if lines and not prefix:
        lines.insert(0, "Parts of the model with several kinds:")
    return "\n".join(lines)


def _composed(groups: Mapping[str, tuple[type, Any]]) -> type:
    """Return a dataclass whose flags are those of all groups."""
    fields: list[Any] = []
    for name, (kind, default) in groups.items():
        field = () if default is None else (dataclasses.field(default=default),)
        fields.append((name, Flat[kind], *field))  # type: ignore[valid-type]
    return dataclasses.make_dataclass("Arguments", fields, kw_only=True)


def _on_parse_error(refuse: Callable[[Any], None]) -> contextlib.AbstractContextManager[Any]:
    """Call a function with each error found by tyro.

    This hook of tyro is private. Versions without it print their own message and exit with 2.
    """
    try:
        from tyro._errors import on_parse_error
    except ImportError:
        return contextlib.nullcontext()
    return on_parse_error(refuse)


def _sentence(event: Any, known: Sequence[str], hint: str) -> str:
    """Return one sentence about an error: what is wrong, where, and what to do."""
    unknown = getattr(event, "tokens", None) or getattr(event, "unrecognized_tokens", None)
    if unknown:
        return _unknown(unknown, known, hint)
    if missing := [found.arg for found in getattr(event, "missing_arguments", ())]:
        return _missing(missing, hint)
    argument = getattr(event, "argument", None)
    where = "" if argument is None else _name_of(argument)
    if hasattr(event, "choices"):
        choices = [choice for choice in event.choices if choice != "None"]
        return f"{where} is {event.value!r}: use {', '.join(choices)}."
    if argument is not None and not hasattr(event, "message"):
        count = argument.lowered.nargs
        return f"{where} needs {f'{count} values' if count not in (1, '?', '*') else 'a value'}."
    return _refused(str(getattr(event, "message", "")), where, hint)


def _refused(message: str, where: str, hint: str) -> str:
    """Return a sentence about an invalid value."""
    text = re.sub(r"\[/?\w+\]", "", message).strip()
    for pattern, plain in _PLAIN if where else ():
        text, count = re.subn(pattern, plain, text)
        if count:
            return f"{where} {text}."
    text = " ".join(text.split())
    if not text:
        return f"The arguments cannot be read; see `{hint} --help`."
    text = f"{where}: {text}" if where else text
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _missing(arguments: Sequence[Any], hint: str) -> str:
    """Return a sentence about missing arguments."""
    if len(arguments) > 1:
        return f"{' and '.join(map(_name_of, arguments))} are missing; see `{hint} --help`."
    text = arguments[0].field.helptext
    about = " ".join(str(text() if callable(text) else text).split()).rstrip(".")
    return f"{_name_of(arguments[0])} is missing ({about}); see `{hint} --help`."


def _unknown(tokens: Sequence[str], known: Sequence[str], hint: str) -> str:
    """Return a sentence about unknown arguments."""
    if not tokens[0].startswith("--"):
        return f"{tokens[0]} is an unexpected argument; `{hint} --help` lists the settings."
    flag = tokens[0].split("=")[0]
    name = "--" + flag[2:].replace("-", "_")
    return f"{flag} is not a setting{_nearest(name, known)}; `{hint} --help` lists them all."


def _name_of(argument: Any) -> str:
    """Return an argument's name in messages: its flag, or its position's name in capitals."""
    if argument.is_positional():
        shown = str(argument.lowered.metavar)
        name = argument.field.intern_name.rpartition(".")[2].upper()
        return name if shown in ("PATH", "STR") else shown
    return argument.lowered.name_or_flags[0]


def _joined(flags: Sequence[str], name: str) -> list[str]:
    """Join repeated flags with several values: ``--p a --p b`` becomes ``--p a b``."""
    values: list[str] = []
    rest: list[str] = []
    into = rest
    for flag in flags:
        if flag == name or flag.startswith(f"{name}="):
            into = values
            values += [flag.removeprefix(f"{name}=")] if flag != name else []
            continue
        into = rest if flag.startswith("--") else into
        into.append(flag)
    given = any(flag.split("=")[0] == name for flag in flags)
    return [*rest, name, *values] if given else rest


def optional(kind: type, *names: str) -> type:
    """Return a dataclass with some fields of another one, each None by default.

    Types and docstrings are those of the dataclass; the order of the names is that of the help.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    texts = _field_docs(kind)
    fields = [
        (
            name,
            Annotated[
                hints[name] | None,
                tyro.conf.arg(help=texts[name], help_behavior_hint="(default: the run's)"),
            ],
            dataclasses.field(default=None),
        )
        for name in names
    ]
    return dataclasses.make_dataclass(f"Optional{kind.__name__}", fields, frozen=True)


def _field_docs(kind: type) -> dict[str, str]:
    """Return the docstring under each field of a dataclass."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def choose(name: str, known: Sequence[str], what: str) -> str:
    """Return ``name`` if it is known, or raise ConfigError with the known names and the nearest."""
    if name in known:
        return name
    raise ConfigError(
        f"There is no {what} {name!r}{_nearest(name, known)}; choose from {', '.join(known)}."
    )


def _nearest(name: str, known: Sequence[str]) -> str:
    """Suggest a flag with the same last part, or else with the most similar spelling."""
    last = name.rsplit(".", 1)[-1].lstrip("-")
    close = [flag for flag in known if flag.rsplit(".", 1)[-1].lstrip("-") == last]
    close = close or difflib.get_close_matches(name, known, 1, 0.5)
    return f" (did you mean {close[0]}?)" if close else ""
