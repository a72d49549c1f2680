"""Flags of commands that are not settings: joining processes, and the target of a plan."""

from __future__ import annotations

import dataclasses
import re

from pewm_jax.errors import require

COMPILED = ("auto", "on", "off")
"""Whether a plan compiles the step."""
COMPILERS = ("cpu", "target")
"""Whose compiler a plan uses."""


def is_address(text: str) -> bool:
    """Tell whether a text is HOST:PORT with a port that exists."""
    found = re.fullmatch(r".+:([0-9]{1,5})", text)
    return found is not None and 1 <= int(found[1]) <= 65535


@dataclasses.dataclass(frozen=True)
class Join:
    """How this process joins the others of its job."""

    distributed: bool = False
    """Join the other processes of this job. JAX detects SLURM, Kubernetes and TPU."""
    coordinator: str = ""
    """HOST:PORT of process 0, if JAX cannot detect it."""
    processes: int = 0
    """Number of processes, if JAX cannot detect it."""
    process: int = -1
    """Number of this process, if JAX cannot detect it."""
    patience: int = 60
    """With --distributed: seconds to wait for all processes."""

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
    """What `pewm-jax train` and `pewm-jax plan` take besides the settings of a run."""

    plan: bool = False
    """Do not train: print what training would take on other hardware, as `pewm-jax plan` does."""
    devices: int = 8
    """Of a plan: number of devices."""
    slices: int = 1
    """Of a plan for TPUs with `--compiler target`: number of equal slices that make up the devices.
    Slices are joined by the data-centre network, along the mesh axis `data`."""
    chip: str = "h200"
    """Of a plan: rtx4090, a100, h100, h200, b200, v4, v5e, v5p, v6e or tpu7x."""
    compiler: str = "cpu"
    """Of a plan: `target` compiles the step with the chip's own compiler, which needs the extra
    plan-tpu or plan-cuda; `cpu` compiles it for virtual CPU devices and estimates the chip's."""
    fit: bool = False
    """Of a plan with `--compiler target`: search rematerialization, micro-batches and the mesh for
    the fastest settings that fit."""
    tries: int = 4
    """Of a plan with `--fit`: largest number of settings that are compiled for each stage."""
    inference: bool = False
    """Of a plan with `--compiler target`: compile what a trained model runs, on one device and with
    weights in bfloat16, instead of the training."""
    quantize: str = ""
    """Of a plan with `--inference`: `int8` or `fp8` keeps the weights of the denoiser in 8 bits."""
    json: str = ""
    """Of a plan: also write the numbers of every stage to this file."""
    compiled: str = "auto"
    """Of a plan: `on` compiles the step and reads the program, `off` prints the estimates of the
    formulas alone, `auto` compiles unless that takes very long."""
    profile: int = 0
    """Profile this many steps, for TensorBoard and Perfetto."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.compiled in COMPILED,
            f"--compiled is {self.compiled}: use {', '.join(COMPILED)}.",
        )
        require(
            self.compiler in COMPILERS,
            f"--compiler is {self.compiler}: use {', '.join(COMPILERS)}.",
        )
        require(
            self.slices >= 1 and self.devices % self.slices == 0,
            f"--slices is {self.slices}: use a divisor of --devices {self.devices}.",
        )
        require(
            self.slices == 1 or self.compiler == "target",
            f"--slices {self.slices} describes devices for their compiler: add --compiler target.",
        )
        require(
            self.compiler == "cpu" or self.compiled != "off",
            "--compiler target compiles and --compiled off does not: give one of them.",
        )
        for name in ("fit", "inference"):
            require(
                not getattr(self, name) or self.compiler == "target",
                f"--{name} compiles for the chip: add --compiler target.",
            )
        require(
            not (self.fit and self.inference),
            "--fit searches settings of training and --inference plans none: give one of them.",
        )
        require(
            not self.quantize or self.inference,
            f"--quantize {self.quantize} is for inference: add --inference --compiler target.",
        )
        require(self.tries >= 1, f"--tries is {self.tries}: use at least 1.")
        require(self.devices >= 1, f"--devices is {self.devices}: use at least 1.")
        require(self.profile >= 0, f"--profile is {self.profile}: use 0 or more steps.")
