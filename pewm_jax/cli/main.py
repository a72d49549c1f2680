"""The command ``pewm-jax``: the table of commands, and their dispatch."""

from __future__ import annotations

import dataclasses
import importlib
import sys
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import pewm_jax
from pewm_jax.cli import parser, plugins
from pewm_jax.cli.parser import HELP, Arguments

PROGRAM = "pewm-jax"


@dataclasses.dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        about: one-line description.
        settings: ``MODULE:NAME`` of the dataclass of its settings; or of a function that takes its
            arguments and the words it was called by, and returns ``parser.Arguments``. The module
            must import quickly: it is imported for ``--help``.
        run: ``MODULE:NAME`` of the function that takes the settings; an integer that it returns is
            the exit code, otherwise 0. Heavy modules are imported here.
        resumes: whether the same command resumes after Ctrl-C, which is printed then.
    """

    about: str
    settings: str
    run: str
    resumes: bool = False


CLI, CONVERT = "pewm_jax.cli", "pewm_jax.convert"
COMMANDS = {
    "play": Command(
        "drive through a world that a model imagines, in the browser",
        f"{CLI}.play:Settings",
        f"{CLI}.play:run",
    ),
    "demo": Command(
        "collect, train and evaluate a small model by one command",
        f"{CLI}.demo:Settings",
        f"{CLI}.demo:run",
    ),
    "data collect": Command(
        "let an agent walk through houses, or your own environment (--env)",
        f"{CLI}.main:collect_arguments",
        f"{CLI}.main:collect",
        resumes=True,
    ),
    "data import": Command(
        "import recordings: scans, robots' data sets, simulators' episodes",
        f"{CLI}.data:import_arguments",
        f"{CLI}.data:import_data",
        resumes=True,
    ),
    "data validate": Command(
        "check a dataset: files, counts, units, poses, geometry",
        "pewm_jax.data.validate:ValidateConfig",
        f"{CLI}.main:validate",
    ),
    "data show": Command(
        "draw an episode as a contact sheet and its path from above",
        "pewm_jax.data.show:ShowConfig",
        "pewm_jax.data.show:show",
    ),
    "data export": Command(
        "write episodes for LeRobot, RLDS or Rerun, as points or as videos",
        "pewm_jax.data.exports.options:ExportConfig",
        "pewm_jax.data.exports.command:export",
    ),
    "show": Command(
        "imagine along an episode; write it for Rerun, as points or video",
        f"{CLI}.show:Settings",
        f"{CLI}.show:run",
    ),
    "train": Command(
        "train a world model, or resume an interrupted training",
        f"{CLI}.train:arguments",
        f"{CLI}.train:run",
    ),
    "protocol": Command(
        "choose the clips of an evaluation, before training",
        f"{CLI}.evaluate:ProtocolSettings",
        f"{CLI}.evaluate:protocol",
    ),
    "evaluate": Command(
        "evaluate a trained run on held-out scenes and write a report",
        f"{CLI}.evaluate:EvaluateSettings",
        f"{CLI}.evaluate:evaluate",
    ),
    "compare": Command(
        "compare two evaluated runs, with paired differences",
        f"{CLI}.evaluate:CompareSettings",
        f"{CLI}.evaluate:compare",
    ),
    "horizon": Command(
        "imagine hundreds of frames, and measure their quality",
        f"{CLI}.horizon:Settings",
        f"{CLI}.horizon:run",
    ),
    "table1": Command(
        "train and score every memory: the paper's Table 1, ablations",
        f"{CLI}.studies:Table1Settings",
        f"{CLI}.studies:table1",
    ),
    "table2": Command(
        "decide by policies, rankings and plans: the paper's Table 2",
        f"{CLI}.studies:Table2Settings",
        f"{CLI}.studies:table2",
    ),
    "practice": Command(
        "train a policy in imagination, and measure it",
        f"{CLI}.studies:PracticeSettings",
        f"{CLI}.studies:practice",
    ),
    "conditioning": Command(
        "train and score ways of giving actions to a network (EgoWM)",
        f"{CLI}.studies:ConditioningSettings",
        f"{CLI}.studies:conditioning",
    ),
    "memory cache": Command(
        "compute the image encoder's features of every frame once",
        "pewm_jax.memory.feature_cache:CacheConfig",
        "pewm_jax.memory.feature_cache:cache",
        resumes=True,
    ),
    "convert import cogvideox": Command(
        "a CogVideoX checkpoint in the layout of diffusers → our layout, or with --rgbd --camera "
        "[--memory] a world model to train from",
        f"{CONVERT}.options:ImportCogVideoX",
        f"{CONVERT}.commands:import_cogvideox",
    ),
    "convert import dinov2": Command(
        "DINOv2 (transformers or the original state dict) → the map's image encoder",
        f"{CONVERT}.options:ImportDINOv2",
        f"{CONVERT}.commands:import_dinov2",
    ),
    "convert import svd": Command(
        "a checkpoint of Stable Video Diffusion → a world model controlled by actions",
        f"{CONVERT}.options:ImportSVD",
        f"{CONVERT}.commands:import_svd",
    ),
    "convert import cosmos2": Command(
        "a checkpoint of Cosmos-Predict2 for video → a world model controlled by actions",
        f"{CONVERT}.options:ImportCosmos2",
        f"{CONVERT}.commands:import_cosmos2",
    ),
    "convert import lora": Command(
        "LoRA adapters of peft or diffusers → adapters on imported weights",
        f"{CONVERT}.options:ImportLoRA",
        f"{CONVERT}.commands:import_lora",
    ),
    "convert merge": Command(
        "a run that trained adapters → plain weights",
        f"{CONVERT}.options:Merge",
        f"{CONVERT}.commands:merge",
    ),
    "convert export diffusers": Command(
        "our CogVideoX weights, before or after fine-tuning → a folder for from_pretrained",
        f"{CONVERT}.options:ExportDiffusers",
        f"{CONVERT}.commands:export_diffusers",
    ),
    "convert export inference": Command(
        "a training run → averaged weights in bfloat16, settings and a card",
        f"{CONVERT}.options:ExportInference",
        f"{CONVERT}.commands:export_inference",
    ),
    "convert export stablehlo": Command(
        "a world model → programs that run without this library",
        f"{CONVERT}.options:ExportStableHLO",
        f"{CONVERT}.commands:export_stablehlo",
    ),
    "pull": Command(
        "download a world model by its name on a hub",
        f"{CLI}.hub:PullSettings",
        f"{CLI}.hub:pull",
        resumes=True,
    ),
    "push": Command(
        "upload a world model under a name on a hub",
        f"{CLI}.hub:PushSettings",
        f"{CLI}.hub:push",
    ),
    "plan": Command(
        "predict memory and time of a training on other hardware",
        f"{CLI}.train:arguments",
        f"{CLI}.train:plan",
    ),
}
GROUPS = {
    "data": "collect, import, validate, show and export episodes",
    "memory": "compute the image encoder's features of a data set once",
    "convert": "import CogVideoX, SVD, Cosmos, DINOv2, adapters; export weights",
    "convert import": "read a checkpoint of another library",
    "convert export": "write weights for another program",
}
"""One-line descriptions of groups of commands."""


def main(argv: Sequence[str] | None = None, called: str = "") -> int:
    """Run a command and return the exit code: 0, 1 problems found, 2 bad input, 130 interrupted.

    ``called``: the words typed instead of ``pewm-jax`` and the first word.
    """
    return parser.run(lambda words: execute(words, called), argv)


def deprecated(group: str) -> int:
    """Run a group of commands called as a module and return the exit code."""
    called = f"python -m pewm_jax.{group}"
    print(f"warning: `{called}` is deprecated; use `{PROGRAM} {group}`.", file=sys.stderr)
    return main([group, *sys.argv[1:]], called)


def execute(argv: Sequence[str], called: str = "") -> int:
    """Run a command and return its exit code; errors are raised. ``called``: as for ``main``."""
    if argv and argv[0] == "--version":
        print(f"{PROGRAM} {pewm_jax.__version__}")
        return 0
    name, rest = find(plugins.run(argv))
    if name not in COMMANDS:
        print(usage(name, called))
        return 0 if rest else 2
    command, values = COMMANDS[name], read(name, rest, _prog(name, called))
    try:
        found = function_of(command.run)(*values)
    except KeyboardInterrupt as error:
        if not command.resumes:
            raise
        again = "Interrupted; run the same command again to resume."
        raise KeyboardInterrupt(again) from error
    return found if isinstance(found, int) else 0


def find(argv: Sequence[str]) -> tuple[str, list[str]]:
    """Return the name of the command at the start of the arguments, and the other arguments.

    It is the name of a group if the arguments end, or ask for help, before a command.

    Raises:
        ConfigError: there is no such command; the message suggests the nearest one.
    """
    name, rest = "", list(argv)
    while name not in COMMANDS:
        if not rest or rest[0] in HELP:
            return name, rest
        words = list(below(name))
        what = f"command {name}" if name else "command"
        name = f"{name} {parser.choose(rest.pop(0), words, what)}".strip()
    return name, rest


def below(group: str) -> dict[str, str]:
    """Return the next words under a group ("" for all commands), with descriptions."""
    start = f"{group} " if group else ""
    found = {}
    for name, command in COMMANDS.items():
        if name.startswith(start):
            word = name.removeprefix(start).split()[0]
            found[word] = GROUPS.get(start + word, command.about)
    return found


def read(name: str, argv: Sequence[str], prog: str) -> list[Any]:
    """Return the arguments of a command's function, parsed from the command line."""
    return list(parser.read(arguments_of(name, argv, prog), argv, prog).values())


def arguments_of(name: str, argv: Sequence[str], prog: str) -> Arguments:
    """Return the arguments of a command; see ``Command.settings``."""
    found = function_of(COMMANDS[name].settings)
    return Arguments({"settings": (found, None)}) if isinstance(found, type) else found(argv, prog)


def function_of(where: str) -> Callable[..., Any]:
    """Import the object ``MODULE:NAME``."""
    module, _, name = where.partition(":")
    return getattr(importlib.import_module(module), name)


def usage(group: str = "", called: str = "") -> str:
    """Return the help of a group: one line per command."""
    start = f"{group} " if group else ""
    names = [name.removeprefix(start) for name in COMMANDS if name.startswith(start)]
    found = {name: COMMANDS[start + name].about for name in names} if group else below("")
    width = max(8, *map(len, found)) + 2
    lines = [
        textwrap.fill(
            about, 80, initial_indent=f"  {name:<{width}}", subsequent_indent=" " * (width + 2)
        )
        for name, about in found.items()
    ]
    usage_line = f"usage: {_prog(group, called)} COMMAND …"
    return "\n".join([usage_line, "", "commands:", *lines, "", "Each has --help."])


def _prog(name: str, called: str) -> str:
    """Return the command as the user typed it."""
    rest = name.partition(" ")[2]
    return f"{called} {rest}".strip() if called else f"{PROGRAM} {name}".strip()


def collect_arguments(argv: Sequence[str], prog: str) -> Arguments:
    """Return the arguments of ``data collect``; with ``--env``, those for a user's environment."""
    if any(word.split("=")[0] == "--env" for word in argv):
        from pewm_jax.data.collect_env import CollectEnvConfig

        return Arguments({"settings": (CollectEnvConfig, None)}, hint=f"{prog} --env")
    from pewm_jax.data.make_episode import CollectConfig

    return Arguments({"settings": (CollectConfig, None)}, renamed={"--voxels": "--voxels.record"})


def collect(settings: Any) -> None:
    """Run ``data collect``."""
    from pewm_jax.data.make_episode import CollectConfig

    if isinstance(settings, CollectConfig):
        from pewm_jax.data.collect import collect as collect_houses

        collect_houses(settings)
    else:
        from pewm_jax.data.collect_env import collect_env

        collect_env(settings)


def validate(settings: Any) -> int:
    """Run ``data validate``; return 1 if there are problems."""
    from pewm_jax.data.validate import validate as find_problems

    return 1 if find_problems(settings).problems else 0
