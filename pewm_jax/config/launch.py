"""Flags that say how a command is launched; they are not stored in a configuration."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from pewm_jax.errors import require

COMPILED = ("auto", "on", "off")
"""Whether a plan compiles the step."""


def _flag(default: Any, text: str) -> Any:
    return dataclasses.field(default=default, metadata={"help": text})


def is_address(text: str) -> bool:
    """Tell whether a text is HOST:PORT with a port that exists."""
    found = re.fullmatch(r".+:([0-9]{1,5})", text)
    return found is not None and 1 <= int(found[1]) <= 65535


@dataclasses.dataclass(frozen=True)
class Join:
    """The flags by which a process joins the others of its job; help texts are in the metadata.

    Attributes:
        distributed: join the other processes of the job.
        coordinator: address of process 0; if empty, JAX detects it.
        processes: number of processes; if 0, JAX detects it.
        process: number of this process; if −1, JAX detects it.
        patience: seconds to wait for the other processes.
    """

    distributed: bool = _flag(
        False, "join the other processes of this job (JAX detects SLURM, Kubernetes and TPU)"
    )
    coordinator: str = _flag("", "HOST:PORT of process 0, if JAX cannot detect it")
    processes: int = _flag(0, "number of processes, if JAX cannot detect it")
    process: int = _flag(-1, "number of this process, if JAX cannot detect it")
    patience: int = _flag(60, "with --distributed: seconds to wait for all processes")

    def __post_init__(self):
        """Validate."""
        require(self.processes >= 0, f"--processes is {self.processes}: use 1 or more.")
        require(self.patience >= 1, f"--patience is {self.patience}: use 1 second or more.")
        require(
            not self.coordinator or is_address(self.coordinator),
            f"--coordinator is {self.coordinator}: give it as HOST:PORT, such as node-0:1234, with "
            "a port from 1 to 65535.",
        )
        given = bool(self.coordinator), self.processes > 0, self.process >= 0
        require(
            all(given) or not any(given),
            "--coordinator, --processes and --process go together: give all three, or none and "
            "let JAX detect them.",
        )
        require(
            self.distributed or not any(given),
            "--coordinator, --processes and --process need --distributed.",
        )
        require(
            not given[2] or self.process < self.processes,
            f"--process is {self.process}: number the {self.processes} processes from 0.",
        )


@dataclasses.dataclass(frozen=True)
class Launch(Join):
    """The flags of ``train.py`` that are not settings; their help texts are in the metadata.

    Attributes:
        plan: do not train, but compile for other hardware and print what training would take.
        devices: devices to plan for.
        chip: kind of device to plan for.
        compiled: whether a plan compiles the step.
        profile: steps to trace.
    """

    plan: bool = _flag(False, "do not train: compile the step and print what training would take")
    devices: int = _flag(8, "with --plan: how many devices")
    chip: str = _flag("h200", "with --plan: h100, h200, b200, v5p or v6e")
    compiled: str = _flag(
        "auto",
        "with --plan: on compiles the step and says what the program does, off gives the formulas' "
        "numbers alone, auto leaves compiling out where it takes very long",
    )
    profile: int = _flag(0, "profile this many steps, for TensorBoard and Perfetto")

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.compiled in COMPILED,
            f"--compiled is {self.compiled}: use {', '.join(COMPILED)}.",
        )
        require(self.devices >= 1, f"--devices is {self.devices}: use at least 1.")
        require(self.profile >= 0, f"--profile is {self.profile}: use 0 or more steps.")
