"""Search for the settings of a stage that fit a chip and are fastest: ``pewm-jax plan --fit``.

The search varies rematerialization, the number of micro-batches and the mesh. Estimates from shapes
order all combinations; the chip's compiler then compiles the most promising few. After each, the
estimates of the combinations with the same rematerialization are corrected by what it measured.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from pewm_jax.config import Config, UserError
from pewm_jax.data import abstract
from pewm_jax.io import tree
from pewm_jax.io.progress import duration
from pewm_jax.plan import measure, suggest, target_compiler, topology
from pewm_jax.plan.measure import MeshSizes, StepWork
from pewm_jax.plan.suggest import Job
from pewm_jax.plan.target_compiler import StageReport
from pewm_jax.train.chips import Chip
from pewm_jax.worlds.stages import Stage

REMAT = "remat"
"""Name of the setting of a network that recomputes activations in the backward pass."""
ENOUGH = 2
"""Number of fitting combinations after which the search ends."""
GIB = 2**30


@dataclasses.dataclass(frozen=True)
class Choice:
    """A combination: rematerialization (None: the model has no such setting), batch and mesh."""

    remat: bool | None
    micro_batches: int
    mesh: MeshSizes

    def apply(self, config: Config, stage: Stage) -> Config:
        """Return the experiment with these settings."""
        config = with_remat(config, self.remat)
        settings = dataclasses.replace(stage.settings(config), micro_batches=self.micro_batches)
        mesh = dataclasses.replace(config.train.mesh, **self.mesh.sizes)
        changes: dict[str, Any] = {"mesh": mesh, stage.name: settings}
        return dataclasses.replace(config, train=dataclasses.replace(config.train, **changes))

    def flags(self, config: Config, stage: Stage) -> str:
        """Return the flags of ``pewm-jax train`` that select it."""
        flags = [f"--train.mesh.{name} {count}" for name, count in self.mesh.sizes.items()]
        flags.append(f"--train.{stage.name}.micro_batches {self.micro_batches}")
        if self.remat is not None:
            paths = [path.rpartition(".") for path in remat_settings(config.model)]
            word = REMAT if self.remat else f"no_{REMAT}"
            flags += [f"--model.{section}{dot}{word}" for section, dot, _ in paths]
        return " ".join(flags)

    def __str__(self) -> str:
        """Return a short description."""
        named = " × ".join(f"{name} {n}" for name, n in self.mesh.sizes.items() if n > 1)
        remat = {None: "", True: ", remat", False: ", no remat"}[self.remat]
        parts = self.micro_batches
        return f"{named or 'one device'}{remat}, {parts} micro-batch{'es' * (parts > 1)}"


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What is expected of a combination before it is compiled: memory of a device, time."""

    peak_bytes: float
    step_s: float


@dataclasses.dataclass(frozen=True)
class Try:
    """A combination that was compiled; ``report`` is None if the compiler failed."""

    choice: Choice
    flags: str
    estimate: Estimate
    report: StageReport | None
    error: str = ""

    @property
    def fits(self) -> bool:
        """Whether its memory suffices."""
        return self.report is not None and self.report.fits

    @property
    def summary(self) -> dict[str, Any]:
        """Return its numbers for JSON."""
        names = ("peak_bytes", "fits", "roofline_s", "bound", "mfu", "compile_s")
        return {
            "remat": self.choice.remat,
            "micro_batches": self.choice.micro_batches,
            "mesh": self.choice.mesh.sizes,
            "flags": self.flags,
            "estimated_bytes": self.estimate.peak_bytes,
            "estimated_s": self.estimate.step_s,
            **{name: self.report and getattr(self.report, name) for name in names},
            "fits": self.fits,
            "error": self.error,
        }


@dataclasses.dataclass(frozen=True)
class Search:
    """A finished search: what was compiled, in order, and the number of combinations."""

    tries: tuple[Try, ...]
    combinations: int

    @property
    def best(self) -> Try:
        """Return the fastest that fits, or else the smallest."""
        compiled = [one for one in self.tries if one.report is not None]
        return min(compiled, key=_goodness)


def _goodness(one: Try) -> tuple[bool, float]:
    """Return a key that sorts the best first."""
    assert one.report is not None
    peak = one.report.peak_bytes
    size = math.inf if peak is None else peak
    return not one.fits, (one.report.roofline_s or math.inf) if one.fits else size


def search(
    config: Config,
    stage: Stage,
    chip: Chip,
    devices: int,
    tries: int,
    log: Callable[[str], Any] = print,
    slices: int = 1,
) -> Search:
    """Compile the most promising combinations until ``ENOUGH`` fit.

    Args:
        config: the experiment; its settings of ``context`` and of the batch are kept.
        stage: the stage.
        chip: the kind of device.
        devices: number of devices.
        tries: largest number of combinations that are compiled.
        log: prints a line.
        slices: number of slices that the devices make up; ``data`` is split over them.

    Raises:
        UserError: no mesh can split the batch over the devices; or the compiler fails on all.
    """
    log(f"{stage.title}: estimating memory and time of its settings for {devices} × {chip.name} …")
    estimates = Estimates(config, stage, topology.of_slices(chip, devices, slices))
    rest = [one for one in choices(config, stage, devices) if one.mesh.data % slices == 0]
    if not rest:
        batch = stage.settings(config).batch
        raise UserError(
            f"--devices is {devices}: no mesh of them can split train.{stage.name}.batch {batch} "
            "evenly; use another number of devices, or another batch."
        )
    count, done = len(rest), list[Try]()
    while rest and len(done) < tries and sum(one.fits for one in done) < ENOUGH:
        choice = min(rest, key=estimates.order)
        rest.remove(choice)
        changed, flags = choice.apply(config, stage), choice.flags(config, stage)
        estimate = estimates(choice)
        try:
            report = target_compiler.compile_stage(changed, stage.name, chip, devices, slices)
        except UserError as error:
            found = Try(choice, flags, estimate, None, str(error))
        else:
            found = Try(choice, flags, estimate, dataclasses.replace(report, flags=flags))
        done.append(found)
        log(f"  {line(found)}")
        if found.report is not None:
            estimates.correct(choice, found.report)
    if all(one.report is None for one in done):
        raise UserError(done[-1].error)
    return Search(tuple(done), count)


def choices(config: Config, stage: Stage, devices: int) -> Iterator[Choice]:
    """Yield all combinations; each device has at least one clip of a micro-batch."""
    remats: Sequence[bool | None] = (False, True) if remat_settings(config.model) else (None,)
    batch, context = stage.settings(config).batch, config.train.mesh.context
    whole = Choice(None, 1, MeshSizes()).apply(config, stage)
    for mesh in suggest.arrangements(whole, stage, devices, context):
        clips = batch // mesh.batch
        divisors = [2**k for k in range(clips.bit_length()) if clips % 2**k == 0]
        for remat, parts in itertools.product(remats, divisors):
            yield Choice(remat, parts, mesh)


class Estimates:
    """Estimates of a stage's combinations, corrected by what was compiled."""

    def __init__(self, config: Config, stage: Stage, chip: Chip):
        self.config, self.stage, self.chip = config, stage, chip
        self.capacity = topology.capacity(chip)
        self.factors: dict[bool | None, float] = {}
        self.work = functools.cache(self._work)
        self.residuals = functools.cache(self._residuals)

    def __call__(self, choice: Choice) -> Estimate:
        """Return the estimate of a combination."""
        state, temporary = self._memory(choice)
        factor = self.factors.get(choice.remat, 1.0)
        changed = choice.apply(self.config, self.stage)
        job = Job(changed, self.stage, self.chip, self.work(choice.remat))
        return Estimate(state + factor * temporary, job.predict(choice.mesh).step_s)

    def order(self, choice: Choice) -> tuple[bool, float, int, float]:
        """Return a key that sorts the most promising first: those that may fit, by their time.

        Times that agree to two digits count as equal: then fewer micro-batches come first, whose
        products are larger, and then less memory.
        """
        found = self(choice)
        too_large = found.peak_bytes > self.capacity
        cost = found.peak_bytes if too_large else float(f"{found.step_s:.2g}")
        return too_large, cost, choice.micro_batches, found.peak_bytes

    def correct(self, choice: Choice, report: StageReport) -> None:
        """Scale the temporary memory of combinations like one by what its compiler measured."""
        measured, (_, estimated) = report.temporary_bytes, self._memory(choice)
        if measured is not None and estimated:
            self.factors[choice.remat] = measured / estimated

    def _memory(self, choice: Choice) -> tuple[float, float]:
        """Return the bytes of the state, and of gradients and activations."""
        changed = choice.apply(self.config, self.stage)
        memory = suggest.memory_of(changed, self.stage, choice.mesh)
        mesh, parts = choice.mesh, choice.micro_batches
        clips = self.stage.settings(self.config).batch / mesh.batch / parts
        activations = self.residuals(choice.remat) * clips / (mesh.tensor * mesh.context)
        return memory.state, memory.gradients * (1 + (parts > 1)) + activations

    def _work(self, remat: bool | None) -> StepWork:
        """Count the work of a step, traced for one device."""
        config = with_remat(self.config, remat)
        config = dataclasses.replace(
            config, train=dataclasses.replace(config.train, mesh=type(config.train.mesh)())
        )
        traced = measure.trace(config, self.stage, measure.virtual(1))
        return measure.work_of(config, self.stage, traced, self.chip)

    def _residuals(self, remat: bool | None) -> float:
        """Return the bytes that the forward pass keeps for the backward pass, for each clip."""
        config = with_remat(self.config, remat)
        one, two = (residual_bytes(config, self.stage, clips) for clips in (1, 2))
        return max(two - one, 0.0)


def residual_bytes(config: Config, stage: Stage, clips: int) -> float:
    """Return the bytes that the loss of so many clips keeps for its gradient, weights included."""
    config = measure.as_on_chips(config)
    params = suggest.abstract_state(config, stage).params
    given = stage.extra_weights(config.model, config.train) if stage.extra_weights else {}
    given = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), given or {})
    clip = abstract.clip(config, clips, features=stage.memory)

    def kept(params: Any, given: Any, clip: Any, key: Any) -> Any:
        trained, frozen = tree.split(params, stage.trained)

        def loss(trained: Any) -> Any:
            whole = tree.merge(trained, frozen, given)
            return stage.loss(config.model, config.train, whole, clip, key)[0]

        return jax.tree.leaves(jax.vjp(loss, trained)[1])

    key = jax.eval_shape(lambda: jax.random.key(0))
    leaves = jax.eval_shape(kept, params, given, clip, key)
    return float(math.fsum(math.prod(x.shape) * x.dtype.itemsize for x in leaves))


def remat_settings(settings: Any, prefix: str = "") -> list[str]:
    """Return the paths of all settings named ``remat`` in a model's settings."""
    found = []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name == REMAT and isinstance(value, bool):
            found.append(f"{prefix}{field.name}")
        elif _has_fields(value):
            found += remat_settings(value, f"{prefix}{field.name}.")
    return found


def with_remat(config: Config, remat: bool | None) -> Config:
    """Return an experiment whose networks all have or lack rematerialization; None changes none."""
    return config if remat is None else config.with_model(**_changes(config.model, remat))


def _changes(settings: Any, remat: bool) -> dict[str, Any]:
    """Return the fields of settings that change."""
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name == REMAT and isinstance(value, bool):
            changed[field.name] = remat
        elif _has_fields(value) and (inner := _changes(value, remat)):
            changed[field.name] = dataclasses.replace(value, **inner)
    return changed


def _has_fields(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def line(found: Try) -> str:
    """Return a line about a combination that was compiled."""
    estimate = f"estimated {found.estimate.peak_bytes / GIB:.1f} GiB"
    report = found.report
    if report is None:
        return f"{found.choice}: the compiler failed ({estimate}): {found.error}"
    peak = "unknown" if report.peak_bytes is None else f"{report.peak_bytes / GIB:.1f} GiB"
    verdict = "fits" if report.fits else "does not fit"
    time = "" if report.roofline_s is None else f", at best {duration(report.roofline_s)}"
    return f"{found.choice}: {peak}, {verdict}{time} ({estimate})"


def lines(found: Search) -> Iterator[str]:
    """Yield the lines of a search, for the terminal."""
    best = found.best
    yield f"  compiled {len(found.tries)} of {found.combinations} combinations of settings"
    yield from (f"    {line(one)}" for one in found.tries)
    yield f"  {'best' if best.fits else 'none fits; the smallest'}: {best.flags}"
