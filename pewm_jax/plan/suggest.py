"""Rank all device meshes for a stage by the formulas for memory and time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.plan.footprint import Footprint, MeshSizes, footprint
from pewm_jax.plan.predict import Prediction, predict
from pewm_jax.train.chips import Chip
from pewm_jax.train.stages import Stage

MARGIN = 0.9
"""Share of the memory that a plan may fill; the runtime and fragmentation need the rest."""


@dataclasses.dataclass(frozen=True)
class Arrangement:
    """A device mesh, with its memory and time for a stage.

    Attributes:
        mesh: the number of devices along each axis.
        footprint: memory of one device.
        time: predicted time of a step.
        fits: whether the memory suffices.
    """

    mesh: MeshSizes
    footprint: Footprint
    time: Prediction
    fits: bool

    @property
    def flags(self) -> str:
        """The flags of ``train.py`` that choose it."""
        return " ".join(f"--train.mesh.{name} {n}" for name, n in self.mesh.sizes.items())


def has_flash(config: Config, chip: Chip) -> bool:
    """Tell whether attention can use cuDNN's fused kernel, which stores no logits."""
    gpu = "NVIDIA" in chip.device_kind
    return (
        gpu
        and config.model.dtype == "bfloat16"
        and getattr(getattr(config.model, "backbone", None), "attention", "xla") != "xla"
    )


def assess(config: Config, stage: Stage, mesh: MeshSizes, chip: Chip) -> Arrangement:
    """Compute a stage's memory and time on a mesh of one kind of device."""
    activation_bytes = 2 if config.model.dtype == "bfloat16" else 4
    needed = footprint(
        config, stage, mesh, activation_bytes=activation_bytes, flash=has_flash(config, chip)
    )
    time = predict(config, stage, mesh, chip)
    return Arrangement(mesh, needed, time, needed.peak <= MARGIN * chip.memory)


def arrangements(config: Config, stage: Stage, devices: int) -> Iterator[MeshSizes]:
    """Yield all meshes of this many devices that can share the stage's batch and heads.

    ``tensor`` divides the numbers of heads, and ``context`` is at most 16.
    """
    batch = stage.settings(config).batch
    heads = worlds.split_heads(config.model, stage).values()
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
                yield MeshSizes(rest // fsdp, fsdp, tensor, context)


def rank(config: Config, stage: Stage, devices: int, chip: Chip) -> list[Arrangement]:
    """Return all arrangements: those that fit, fastest first; then the others, smallest first.

    If the times of two agree to two digits, the one that needs less memory comes first.
    """
    choices = [assess(config, stage, mesh, chip) for mesh in arrangements(config, stage, devices)]
    return sorted(choices, key=_order)


def _order(choice: Arrangement) -> tuple[bool, float, float]:
    seconds = float(f"{choice.time.step_s:.2g}") if choice.fits else choice.footprint.peak
    return not choice.fits, seconds, choice.footprint.peak


def _divisors(number: int) -> list[int]:
    return [n for n in range(1, number + 1) if number % n == 0]
