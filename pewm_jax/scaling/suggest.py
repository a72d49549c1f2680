"""Which arrangement of devices suits a stage best: all of them, by the sums on paper."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from pewm_jax.config import Config, functions
from pewm_jax.scaling.footprint import Arranged, Footprint, footprint
from pewm_jax.scaling.predict import Prediction, predict
from pewm_jax.training.chips import Chip
from pewm_jax.training.stages import Stage

MARGIN = 0.9
"""Share of the memory that a plan may fill; the rest is for the runtime and for fragmentation."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """One arrangement, and what it takes.

    Attributes:
        mesh: the arrangement.
        footprint: bytes on one device.
        time: the step.
        fits: whether memory suffices.
    """

    mesh: Arranged
    footprint: Footprint
    time: Prediction
    fits: bool

    @property
    def flags(self) -> str:
        """The flags of ``train.py`` that ask for it."""
        return " ".join(f"--train.mesh.{name} {n}" for name, n in self.mesh.sizes.items())


def has_flash(config: Config, chip: Chip) -> bool:
    """Whether attention runs in a kernel that holds no logits: cuDNN's, in 16 bits."""
    gpu = "NVIDIA" in chip.device_kind
    return (
        gpu
        and config.model.dtype == "bfloat16"
        and getattr(config.model.backbone, "attention", "xla") != "xla"
    )


def weigh(config: Config, stage: Stage, mesh: Arranged, chip: Chip) -> Choice:
    """Say what a stage takes on an arrangement of one kind of device."""
    wide = 2 if config.model.dtype == "bfloat16" else 4
    needed = footprint(config, stage, mesh, wide=wide, flash=has_flash(config, chip))
    time = predict(config, stage, mesh, chip)
    return Choice(mesh, needed, time, needed.peak <= MARGIN * chip.memory)


def arrangements(config: Config, stage: Stage, devices: int) -> Iterator[Arranged]:
    """Yield all meshes of so many devices that can share the stage's batch and heads.

    ``tensor`` and ``context`` stay within what a block has to split: the heads, and 64 tokens of a
    frame for each device.
    """
    batch = stage.settings(config).batch
    heads = functions(config.model).split_heads(config.model, stage).values()
    for tensor in _divisors(devices):
        if any(count % tensor for count in heads):
            continue
        for context in _divisors(devices // tensor):
            if context > 16:
                continue
            rest = devices // tensor // context
            if batch % rest:
                continue
            for fsdp in _divisors(rest):
                yield Arranged(rest // fsdp, fsdp, tensor, context)


def rank(config: Config, stage: Stage, devices: int, chip: Chip) -> list[Choice]:
    """Return all arrangements: those that fit first, each kind the fastest first.

    Where two are as fast to a hundredth, the one that leaves more memory comes first.
    """
    choices = [weigh(config, stage, mesh, chip) for mesh in arrangements(config, stage, devices)]
    return sorted(choices, key=_order)


def _order(choice: Choice) -> tuple[bool, float, float]:
    seconds = float(f"{choice.time.step_s:.2g}") if choice.fits else choice.footprint.peak
    return not choice.fits, seconds, choice.footprint.peak


def _divisors(number: int) -> list[int]:
    return [n for n in range(1, number + 1) if number % n == 0]
