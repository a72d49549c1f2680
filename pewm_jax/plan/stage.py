"""The plan of one stage on one kind of device, from the compiler and from formulas."""

from __future__ import annotations

import dataclasses

from pewm_jax.config import Config
from pewm_jax.plan import hlo, suggest
from pewm_jax.plan.footprint import Footprint
from pewm_jax.plan.suggest import Arrangement
from pewm_jax.train.chips import Chip
from pewm_jax.train.stages import Stage


@dataclasses.dataclass(frozen=True)
class Compiled:
    """What the compiler reports about one stage's step, per device.

    Attributes:
        program: its products and communication.
        arguments: bytes of state and batch.
        temporary: bytes of temporary memory and new outputs.
        expected: the formula's result for a CPU, which computes 16-bit values in 32 bits and
            attention in blocks; for comparison.
        seconds: time of compilation.
    """

    program: hlo.Program
    arguments: float
    temporary: float
    expected: Footprint
    seconds: float

    @property
    def peak(self) -> float:
        """Peak memory in bytes."""
        return self.arguments + self.temporary


@dataclasses.dataclass(frozen=True)
class Plan:
    """One stage on one kind of device.

    Attributes:
        config: the experiment.
        stage: the stage.
        chip: the kind of device.
        choice: the requested arrangement, with its memory and time by the formulas.
        compiled: the compiler's report; None where the step was not compiled.
        best: the best arrangements.
    """

    config: Config
    stage: Stage
    chip: Chip
    choice: Arrangement
    compiled: Compiled | None
    best: tuple[Arrangement, ...]

    @property
    def raised(self) -> float:
        """The factor, at least 1, by which a compiled program exceeds the formula."""
        if self.compiled is None:
            return 1.0
        return max(1.0, self.compiled.peak / self.compiled.expected.peak)

    @property
    def peak(self) -> float:
        """Peak bytes on a device: the formula's result times ``raised``."""
        return self.choice.footprint.peak * self.raised

    @property
    def fits(self) -> bool:
        """Whether the step fits into memory with a margin."""
        return self.peak <= suggest.MARGIN * self.chip.memory
