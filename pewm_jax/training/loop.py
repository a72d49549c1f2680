"""The loop: stages one after the other, resumable at any step. Everything with a clock is here.

The metrics of step k − 1 are read after step k is dispatched, batches are placed ahead, and
checkpoints are written in the background, so the devices never wait for the host.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path

import jax
from jax.sharding import Mesh

from pewm_jax import rollouts
from pewm_jax.config import Config, StageConfig, UserError
from pewm_jax.data import loader
from pewm_jax.memory import feature_cache
from pewm_jax.training import runs, sharding, stages
from pewm_jax.training.checkpoint import Checkpoints
from pewm_jax.training.feed import Feed
from pewm_jax.training.log import LiveView, MetricsLog, Pace, duration
from pewm_jax.training.signals import Stop
from pewm_jax.training.stages import Stage
from pewm_jax.training.state import TrainState, inference_params
from pewm_jax.training.step import (
    Metrics,
    abstract_state,
    compile_step,
    initial_state,
    stage_key,
)
from pewm_jax.types import Clip, Params

Preview = Callable[[Params, int, int], Path]
"""Called with inference weights, stage number and step; writes a picture and returns its path."""


def train(
    config: Config,
    *,
    preview: Preview | None = None,
    profile: int = 0,
    say: Callable[[str], None] = print,
) -> Path:
    """Train all planned stages, going on where an earlier start of the same run stopped.

    Args:
        config: the experiment; ``config.train.run`` is the folder that is written.
        preview: makes sample pictures every ``config.train.preview_every`` steps and at the end
            of a stage.
        profile: steps to trace.
        say: prints a line.

    Returns:
        The run's folder, ready for ``pewm_jax.load``.

    Raises:
        UserError: the folder is of another configuration or in use, the data do not fit, or the
            loss is not finite.
        Interrupted: Ctrl-C or SIGTERM came; everything is saved.
    """
    planned = stages.planned(config)
    _require_weights(config)
    mesh = sharding.make_mesh(arranged=config.train.mesh)
    for stage in planned:
        sharding.require_divisible(config, stage, mesh)
    run = runs.check(config)
    with runs.alone(run), Stop() as stop:
        runs.prepare(config)
        if runs.is_finished(run, config):
            say(f"{run} is already trained: nothing to do.")
            return run
        start: Callable[[], Params | None] = functools.partial(_named, config, planned[0], say)
        for stage in planned:
            trained = _train_stage(
                config, stage, mesh, run=run, start=start, preview=preview, stop=stop, say=say
            )
            start = functools.partial(_same, trained)
            if stop.number is not None and stage is not planned[-1]:
                raise stop.interrupted(stage.number, stage.settings(config).steps)
    say(f"Trained: {run / runs.WEIGHTS}")
    return run


def _same(params: Params) -> Params:
    return params


def _require_weights(config: Config) -> None:
    """Refuse networks that are not trained here and that no converted weights are named for."""
    frozen = {
        "codec.kind vae": config.codec.kind == "vae",
        "memory.encoder dinov2": config.memory.encoder == "dinov2",
    }
    for setting, wanted in frozen.items():
        if wanted and not config.train.start:
            raise UserError(
                f"{setting} needs weights that are not trained here: convert a checkpoint "
                "(python -m pewm_jax.convert --help) and name its folder by train.start."
            )


def _named(config: Config, stage: Stage, say: Callable[[str], None]) -> Params | None:
    """Return the weights that the first planned stage starts from, if any are named.

    Memory blocks that the folder may hold go on learning in stage 2. Before stage 1 they are left
    out, since they were fitted to another backbone, and said to be.
    """
    if not config.train.start:
        return None
    _, params = rollouts.load(config.train.start)
    if "memory" in params and not stage.memory:
        say(f"{config.train.start}: its memory blocks are left out; stage 2 begins with fresh ones")
        params = {name: part for name, part in params.items() if name != "memory"}
    return params


def _train_stage(
    config: Config,
    stage: Stage,
    mesh: Mesh,
    *,
    run: Path,
    start: Callable[[], Params | None],
    preview: Preview | None,
    stop: Stop,
    say: Callable[[str], None],
) -> Params:
    """Train one stage, or find it done; returns its inference weights."""
    settings = stage.settings(config)
    like = abstract_state(config, stage, mesh)
    with Checkpoints(run, config, stage, say) as checkpoints:
        done = checkpoints.latest() or 0
        if done >= settings.steps:
            params = checkpoints.restore_weights(like)
            runs.publish(run, stage, done, params)
            return params
        with (
            LiveView(f"stage {stage.number}", settings.steps, done) as view,
            MetricsLog(run, stage.number, done) as log,
        ):

            def state_to_start_from() -> TrainState:
                if not done:
                    return initial_state(config, stage, mesh, start())
                view.say(f"stage {stage.number}: going on after step {done}")
                return checkpoints.restore(like)

            worker = _Worker(config, stage, mesh, stop, view, log, checkpoints, preview)
            state = worker.run(state_to_start_from, done)
        params = inference_params(stage, state)
        checkpoints.wait()
        runs.publish(run, stage, settings.steps, params)
        return params


def _features(config: Config, stage: Stage) -> feature_cache.FeatureCache | None:
    """Open the features that are kept, where the stage needs any; not compared with weights yet."""
    if not (config.data.features and stage.memory):
        return None
    return feature_cache.read(Path(config.data.features) / "train")


@dataclasses.dataclass
class _Worker:
    """Turns one stage's state from its first to its last step."""

    config: Config
    stage: Stage
    mesh: Mesh
    stop: Stop
    view: LiveView
    log: MetricsLog
    checkpoints: Checkpoints
    preview: Preview | None
    pace: Pace = dataclasses.field(default_factory=lambda: Pace(time.monotonic()))
    shown: bool = False

    @property
    def settings(self) -> StageConfig:
        return self.stage.settings(self.config)

    def run(self, make_state: Callable[[], TrainState], done: int) -> TrainState:
        """Do the steps after ``done``, once the first batch is there; returns the last state."""
        config, settings = self.config, self.settings
        cache = _features(config, self.stage)
        batches = loader.clips(
            config,
            "train",
            seed=config.train.seed + self.stage.number,
            batch=settings.batch,
            start_step=done,
            features=cache and functools.partial(feature_cache.features, cache),
        )
        key = jax.device_put(stage_key(config, self.stage), sharding.replicated(self.mesh))
        with Feed(iter(batches), sharding.of_batch(self.mesh)) as feed:
            clip = next(feed)
            state, step_fn = self._compile(make_state, clip)
            if cache is not None:
                weights = state.params.get("encoder", {})
                where = Path(config.data.path) / "train"
                feature_cache.require_fresh(cache, config.memory, weights, where)
            self.pace = Pace(time.monotonic())
            pending: tuple[int, Metrics] | None = None
            for step in range(done + 1, settings.steps + 1):
                state, metrics = step_fn(state, clip, key)
                if pending is not None:
                    self._report(*pending)
                pending = (step, metrics)
                last = step == settings.steps
                if last or step % config.train.save_every == 0 or self.stop.number is not None:
                    self._report(*pending)
                    pending = None
                    self._save(state)
                if self.preview is not None and self._wants_preview(step):
                    self._show(state, step)
                if self.stop.number is not None and not last:
                    self._leave(step)
                if not last:
                    clip = next(feed)
        return state

    def _compile(self, make_state: Callable[[], TrainState], clip: Clip):
        """Make the state, whose first weights are compiled too, and compile the step."""
        self.view.say(f"stage {self.stage.number}: compiling the training step …")
        began = time.monotonic()
        state = make_state()
        step_fn = compile_step(self.config, self.stage, self.mesh, clip)
        took = duration(time.monotonic() - began)
        self.view.say(f"stage {self.stage.number}: compiled the training step in {took}")
        return state, step_fn

    def _report(self, step: int, metrics: Metrics) -> None:
        """Read a step's metrics, check, show and log them."""
        began = time.monotonic()
        self.checkpoints.settle()
        self.pace.pause(time.monotonic() - began)
        values = {name: float(value) for name, value in jax.device_get(metrics).items()}
        if not (math.isfinite(values["loss"]) and math.isfinite(values["grad_norm"])):
            raise UserError(self._not_finite(step, values))
        seconds = self.pace.tick(time.monotonic())
        values |= {
            "step_seconds": seconds,
            "samples_per_second": self.settings.batch / seconds,
            "flops_per_second": self.settings.batch
            * stages.flops_per_clip(self.config, self.stage)
            / seconds,
        }
        self.view.update(step, values)
        if step == 1 or step % self.config.train.log_every == 0 or step == self.settings.steps:
            self.log.write(step, values)

    def _not_finite(self, step: int, values: dict[str, float]) -> str:
        self.checkpoints.wait()
        saved = self.checkpoints.latest()
        kept = f"the checkpoint of step {saved} is intact" if saved else "nothing was saved yet"
        return (
            f"Stage {self.stage.number} stopped at step {step}: loss {values['loss']} and gradient "
            f"norm {values['grad_norm']} are not both finite ({kept}); train again in another "
            f"--train.run with a lower --train.{self.stage.name}.learning_rate."
        )

    def _wants_preview(self, step: int) -> bool:
        every = self.config.train.preview_every
        return every > 0 and (step % every == 0 or step == self.settings.steps)

    def _save(self, state: TrainState) -> None:
        began = time.monotonic()
        self.checkpoints.save(state)
        self.pace.pause(time.monotonic() - began)

    def _show(self, state: TrainState, step: int) -> None:
        if self.preview is None:
            return
        if not self.shown:
            self.view.say(f"stage {self.stage.number}: compiling the sampler for pictures …")
        self.shown = True
        began = time.monotonic()
        path = self.preview(inference_params(self.stage, state), self.stage.number, step)
        self.pace.pause(time.monotonic() - began)
        self.view.say(f"stage {self.stage.number}: sample picture {path}")

    def _leave(self, step: int) -> None:
        self.checkpoints.wait()
        raise self.stop.interrupted(self.stage.number, step)
