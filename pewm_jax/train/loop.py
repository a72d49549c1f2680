"""The training loop: stages in sequence, resumable at any step; the only module with a clock.

The metrics of step k − 1 are read after step k is dispatched, batches are placed ahead, and
checkpoints are written in the background, so the devices never wait for the host.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NoReturn

import jax
from jax.sharding import Mesh

from pewm_jax.config import Config, StageConfig, UserError
from pewm_jax.data import loader
from pewm_jax.data.loader import BadRecords
from pewm_jax.io.progress import duration
from pewm_jax.memory import feature_cache
from pewm_jax.train import flops, loading, processes, runs, sharding, sinks
from pewm_jax.train.checkpoint import Checkpoints
from pewm_jax.train.feed import (
    Feed,
    Prepared,
    prepared_seed,
    rows_of,
    start_digest,
    uses_prepared,
)
from pewm_jax.train.log import LiveView, MetricsLog, Pace, Profile
from pewm_jax.train.signals import Stop
from pewm_jax.train.step import (
    Metrics,
    TrainState,
    abstract_state,
    compile_step,
    inference_params,
    initial_state,
    load_extra_weights,
    noise_key,
    start_params,
)
from pewm_jax.train.watch import Preview, Samples, Watch
from pewm_jax.types import Clip, Params
from pewm_jax.worlds import lora
from pewm_jax.worlds.stages import Stage

_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
"""Error numbers of a full or failing disk."""


def train(
    config: Config,
    *,
    preview: Preview | None = None,
    profile: int = 0,
    log: Callable[[str], None] = print,
) -> Path:
    """Train all planned stages, resuming an earlier start of the same run.

    Args:
        config: the experiment; ``config.train.run`` is the output folder.
        preview: makes sample pictures every ``config.train.preview_every`` steps and at the end of
            a stage.
        profile: number of steps to trace in each stage (``log.Profile``).
        log: prints a line.

    Returns:
        The run's folder, ready for ``pewm_jax.load``.

    Raises:
        UserError: the folder belongs to another configuration or is in use, the data do not fit, or
            the loss is not finite.
        Interrupted: after Ctrl-C or SIGTERM, once everything is saved. (If saving takes longer than
            ``train.grace_s``, or at a second signal, the process exits itself.)
    """
    config = runs.resumed(config, log if processes.is_primary() else _silent)
    planned = runs.planned(config)
    lora.require_base(config)
    loading.require_weights(config)
    sinks.require_packages(config)  # fail before the data are prepared
    mesh = sharding.make_mesh(arranged=config.train.mesh)
    for stage in planned:
        sharding.require_divisible(config, stage, mesh)
    run = runs.check(config)
    bad = BadRecords(config.data.bad_records)
    alone, agreed = jax.process_count() == 1, processes.Votes().cast
    with (
        processes.on_process_0(runs.alone(run)),
        Stop(config.train.grace_s, agreed=agreed, alone=alone) as stop,
    ):
        processes.run_on_process_0(lambda: str(runs.prepare(config)))
        if processes.run_on_process_0(lambda: runs.is_finished(run, config)):
            log(f"{run} is already trained: nothing to do.")
            return run
        weights: Params | None = None
        for stage in loading.remaining_stages(run, planned):
            worker = _Worker(config, stage, mesh, run, stop, bad, preview, profile, log, weights)
            weights = None  # freed once the state is made from them
            weights = worker.train()
            if stop.requested and stage is not planned[-1]:
                raise stop.interrupted(stage.title, stage.settings(config).steps)
    log(f"Trained: {run / runs.WEIGHTS}")
    return run


def _print_error(line: str) -> None:
    """Print an error of this process to stderr; stdout belongs to process 0."""
    print(line, file=sys.stderr, flush=True)


def _silent(line: str) -> None:
    del line


@dataclasses.dataclass
class _Worker:
    """Trains one stage.

    Attributes:
        start: weights of the previous stage; None to use those in ``train.start``, if any.
    """

    config: Config
    stage: Stage
    mesh: Mesh
    path: Path
    stop: Stop
    bad: BadRecords
    preview: Preview | None
    profile: int
    log: Callable[[str], None]
    start: Params | None = None

    checkpoints: Checkpoints = dataclasses.field(init=False)
    view: LiveView = dataclasses.field(init=False)
    watch: Watch = dataclasses.field(init=False)
    samples: Samples = dataclasses.field(init=False)

    def __post_init__(self):
        self.like = abstract_state(self.config, self.stage, self.mesh)

    @property
    def settings(self) -> StageConfig:
        return self.stage.settings(self.config)

    def train(self) -> Params:
        """Train the stage unless it is done; return its inference weights (``lora.stored``)."""
        config, stage, run, steps = self.config, self.stage, self.path, self.settings.steps
        with Checkpoints(run, config, stage, self.log) as self.checkpoints, self._writing():
            self.stop.at_once, self.stop.kept = True, self._saved_phrase
            done = self.checkpoints.latest() or 0
            if done >= steps:
                params = self.checkpoints.restore_weights(self.like)
                self.checkpoints.publish(params)
                return params
            with (
                LiveView(stage.title, steps, done) as self.view,
                MetricsLog(run, stage, done, config) as metrics_log,
            ):
                self.bad.log = self.view.log if processes.is_primary() else _print_error
                devices = self.mesh.size
                self.watch = Watch(
                    config, stage, run, done, devices, self.view, metrics_log, self.bad
                )
                self.samples = Samples(
                    config, stage, self.preview, self.view.log, self.stop.unless_requested
                )
                state = self.run(done)
            params = lora.stored(stage, inference_params(stage, state))
            self.checkpoints.publish(params)
            return params

    def run(self, done: int) -> TrainState:
        """Run the steps after ``done`` and return the last state."""
        config, settings = self.config, self.settings
        cache = loading.features(config, self.stage)
        where = sharding.of_batch(self.mesh)
        batches = loader.clips(
            config,
            "train",
            seed=self.stage.data_seed(config),
            batch=settings.batch,
            start_step=done,
            features=cache and functools.partial(feature_cache.features, cache),
            bad=self.bad,
            rows=rows_of(where, settings.batch),
        )
        make_key = functools.partial(noise_key, config, self.stage)
        key = jax.jit(make_key, out_shardings=sharding.replicated(self.mesh))()
        traced = Profile(
            self.path,
            self.stage,
            steps=self.profile if processes.is_primary() else 0,
            first=done + 1,
            last=settings.steps,
            log=self.view.log,
        )
        batches, state = iter(batches), None
        if uses_prepared(config, self.stage):
            state = self._make_state(done)
            batches = self._prepare(done, state)
        with Feed(batches, where, settings.batch) as feed, closing(traced):
            clip = next(feed)
            state, step_fn = self._compile(done, clip, state)
            if cache is not None:
                split = Path(config.data.path) / "train"
                processes.run_on_process_0(
                    lambda: feature_cache.require_fresh(
                        cache, config.model.memory.encoder, loading.encoder(config), split
                    )
                )
            self.watch.pace = Pace(time.monotonic())
            pending: tuple[int, Metrics] | None = None
            for step in range(done + 1, settings.steps + 1):
                with traced.around(step):
                    state, metrics = step_fn(state, clip, key)
                self.stop.at_once = False
                if pending is not None:
                    self._report(*pending)
                pending = (step, metrics)
                self.watch.pace.pause(traced.after(step, metrics))
                last, stop = step == settings.steps, self.stop.due()
                save = last or stop or step % config.train.save_every == 0
                show = self.samples.due(step) and not stop
                if save or show:
                    self._report(step, metrics, state if show else None)
                    pending = None
                if save:
                    self._save(state)
                if last:
                    break
                following = None if stop else self.stop.unless_requested(feed.__next__)
                if following is None:
                    self._leave(step, state, pending)
                clip = following
        return state

    def _prepare(self, done: int, state: TrainState) -> Iterator[Clip]:
        """Prepare clips, independently of interruptions, and yield batches of them."""
        seed = self.stage.data_seed(self.config)
        batch = self.settings.batch

        def read(first: int) -> Iterator[Clip]:
            chosen = prepared_seed(self.config, self.stage)
            return loader.clips(
                self.config, "train", seed=chosen, batch=batch, bad=self.bad, start_step=first
            )

        digest = ""
        if self.config.data.prepared_path:
            digest = start_digest(self.path, self.stage, state.params, done)
        clips = Prepared(self.config, self.stage, state.params, read, done, digest)
        if not clips.fill(self.stop.unless_requested):
            raise self.stop.interrupted(self.stage.title, done)
        return clips.draw(batch, seed)

    def _compile(self, done: int, clip: Clip, state: TrainState | None):
        """Make the state (its initialization is compiled, too) and compile the step."""
        self.view.log(f"{self.stage.title}: compiling the training step …")
        began = time.monotonic()
        state = self._make_state(done) if state is None else state
        extra = load_extra_weights(self.config, self.stage, self.mesh)
        step_fn = compile_step(self.config, self.stage, self.mesh, clip, extra)
        self.watch.flops = flops.of_stage(self.config, self.stage, clip, extra).total
        took = duration(time.monotonic() - began)
        self.view.log(f"{self.stage.title}: compiled the training step in {took}")
        return state, step_fn

    def _make_state(self, done: int) -> TrainState:
        """Return the stage's initial state, or restore the checkpoint of step ``done``."""
        config, stage = self.config, self.stage
        start, self.start = self.start, None
        if stage.stored or (start is None and not done):
            base = loading.read_weights(config, stage, self.log)
            # Stages with adapters pass on what they trained, without the start weights.
            start = base if start is None or base is None else lora.overlay(base, start)
        if not done:
            return initial_state(config, stage, self.mesh, start)
        self.view.log(f"{stage.title}: resuming after step {done}")
        if not stage.stored or start is None:
            return self.checkpoints.restore(self.like)
        return self.checkpoints.restore(self.like, start_params(config, stage, self.like, start))

    def _report(self, step: int, metrics: Metrics, sampled: TrainState | None = None) -> None:
        """Read, check, show and log a step's metrics; make samples if a state is passed."""
        with self._paused():
            self.checkpoints.settle()
        values = self.watch.read(step, metrics, self._final_saved_phrase)
        samples: dict[str, float] = {}
        if sampled is not None:
            with self._paused():
                params = inference_params(self.stage, sampled)
                bound = lora.bind(self.config.model, self.config.train.lora, params)
                samples = self.samples.make(bound, step)
        self.watch.write(step, values | samples, always=bool(samples))

    def _save(self, state: TrainState) -> None:
        with self._paused():
            self.checkpoints.save(state)

    def _leave(self, step: int, state: TrainState, pending: tuple[int, Metrics] | None) -> NoReturn:
        """Save the state and raise ``Interrupted``."""
        if pending is not None:
            self._report(*pending)
        self._save(state)
        self.checkpoints.wait()
        raise self.stop.interrupted(self.stage.title, step)

    def _saved_phrase(self) -> str:
        """Return a phrase that names the newest checkpoint on disk."""
        step, title = self.checkpoints.latest(), self.stage.title
        if step is not None:
            return f"{title}'s checkpoint of step {step} is intact"
        first = self.stage.number == 1
        return "nothing was saved yet" if first else f"nothing of {title} was saved yet"

    def _final_saved_phrase(self) -> str:
        self.checkpoints.wait()
        return self._saved_phrase()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise errors of a full or failing disk as ``UserError``, naming the newest checkpoint."""
        try:
            yield
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise UserError(
                f"{error.filename or self.path} cannot be written ({error.strerror}); "
                f"{self._final_saved_phrase()}: free space there, then run the same command "
                "again to resume."
            ) from None

    @contextmanager
    def _paused(self) -> Iterator[None]:
        """Exclude the body of the ``with`` statement from the step time."""
        began = time.monotonic()
        yield
        self.watch.pace.pause(time.monotonic() - began)
