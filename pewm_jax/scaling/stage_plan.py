"""The plan of one stage on one kind of device: what the compiler and the sums on paper say."""

from __future__ import annotations

import dataclasses

from pewm_jax.config import Config
from pewm_jax.scaling import hlo, suggest
from pewm_jax.scaling.footprint import Footprint
from pewm_jax.scaling.suggest import Choice
from pewm_jax.training.chips import Chip
from pewm_jax.training.stages import Stage


@dataclasses.dataclass(frozen=True)
class Compiled:
    """What the compiler says about one stage's step, per device.

    Attributes:
        program: its products and communication.
        arguments: bytes of state and batch.
        temporary: bytes that the step needs besides.
        expected: the sum on paper for a CPU, which widens 16 bits to 32 and cuts attention in
            pieces; to be compared with.
        seconds: what compiling took.
    """

    program: hlo.Program
    arguments: float
    temporary: float
    expected: Footprint
    seconds: float

    @property
    def peak(self) -> float:
        """All together."""
        return self.arguments + self.temporary


@dataclasses.dataclass(frozen=True)
class Plan:
    """One stage on one kind of device.

    Attributes:
        config: the experiment.
        stage: the stage.
        chip: the kind of device.
        choice: the arrangement asked for, and what it takes by the sums on paper.
        compiled: what the compiler says.
        best: the best arrangements.
    """

    config: Config
    stage: Stage
    chip: Chip
    choice: Choice
    compiled: Compiled
    best: tuple[Choice, ...]

    @property
    def raised(self) -> float:
        """By what the sums are raised where the compiler finds more; never less than 1."""
        return max(1.0, self.compiled.peak / self.compiled.expected.peak)

    @property
    def peak(self) -> float:
        """Bytes on a device that decide: by the sums, more where the compiler finds more."""
        return self.choice.footprint.peak * self.raised

    @property
    def fits(self) -> bool:
        """Whether the step fits, with a margin."""
        return self.peak <= suggest.MARGIN * self.chip.memory
