"""The command ``pewm-jax``: finds the subcommand and hands its arguments on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import pewm_jax
from pewm_jax.cli import (
    compare,
    convert,
    data,
    demo,
    evaluate,
    horizon,
    memory,
    play,
    plugins,
    practice,
    protocol,
    table1,
    table2,
    train,
)
from pewm_jax.config import command_line as cli

PROGRAM = "pewm-jax"


@dataclasses.dataclass(frozen=True)
class Command:
    """A subcommand.

    Attributes:
        main: takes the arguments after its name and the words it was called by; returns the exit
            code. Its module must be light: what is heavy is imported when it is needed.
        about: what it does, in one line.
    """

    main: Callable[[Sequence[str], str], int]
    about: str


COMMANDS = {
    "play": Command(play.main, "drive through a world that a model imagines, in the browser"),
    "demo": Command(demo.main, "collect, train, imagine and score, small and by one command"),
    "data": Command(data.main, "collect, import, validate and show episodes"),
    "train": Command(train.main, "train a world model, or go on where a training stopped"),
    "protocol": Command(protocol.main, "choose what runs are scored by, before training them"),
    "evaluate": Command(evaluate.main, "score a trained run on held-out scenes and write a report"),
    "compare": Command(compare.main, "set two scored runs side by side, with paired differences"),
    "horizon": Command(horizon.main, "imagine hundreds of frames, and measure what comes of it"),
    "table1": Command(table1.main, "train and score every memory: the paper's Table 1, ablations"),
    "table2": Command(table2.main, "decide by policies, rankings and plans: the paper's Table 2"),
    "practice": Command(practice.main, "let a policy practise in imagination, and measure it"),
    "memory": Command(memory.main, "compute the image encoder's features of a data set once"),
    "convert": Command(convert.main, "bring a CogVideoX or DINOv2 in, take trained weights out"),
    "plan": Command(train.plan, "say what a training would take on hardware that is not here"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand; returns the exit code: 0, 2 bad input, 130 interrupted."""
    return cli.run(_main, argv)


def _main(argv: Sequence[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(usage())
        return 0 if argv else 2
    if argv[0] == "--version":
        print(f"{PROGRAM} {pewm_jax.__version__}")
        return 0
    argv = plugins.take(argv)  # also for commands that need no worlds of a user's own
    name = cli.choose(argv[0] if argv else "", list(COMMANDS), "command")
    return COMMANDS[name].main(argv[1:], f"{PROGRAM} {name}")


def usage() -> str:
    """Return the help text: a line for each subcommand."""
    lines = [f"  {name:<10}{command.about}" for name, command in COMMANDS.items()]
    return "\n".join(
        [f"usage: {PROGRAM} COMMAND …", "", "commands:", *lines, "", "Each has --help."]
    )
