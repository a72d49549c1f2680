"""Run ``pewm-jax evaluate``, ``protocol`` and ``compare``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from pewm_jax import config as configuration
from pewm_jax import presets, shipped
from pewm_jax.cli import parser
from pewm_jax.cli import train as training
from pewm_jax.cli.parser import Flat
from pewm_jax.config import Config, EvalConfig, Join, World
from pewm_jax.errors import ConfigError
from pewm_jax.io import runtime

JOIN = Join()
SCORED = (
    *("split", "clips", "seeds", "chain", "stride", "videos", "video_clips", "batch"),
    *("none", "lpips", "protocol", "fvd", "mirror", "src", "scs"),
)
"""Settings of ``EvalConfig`` that ``evaluate`` takes."""
CHOSEN = ("split", "clips", "seeds", "chain", "stride", "video_clips")
"""Settings of ``EvalConfig`` that ``protocol`` takes."""
if TYPE_CHECKING:
    Scored = Chosen = EvalConfig
else:
    Scored, Chosen = parser.optional(EvalConfig, *SCORED), parser.optional(EvalConfig, *CHOSEN)


UNCHANGED, UNCHOSEN = Scored(), Chosen()


@dataclasses.dataclass(frozen=True)
class EvaluateSettings:
    """Score a trained run on held-out scenes and write RUN/report/index.html.

    Settings that are not given are those of the run. Several processes can share the work; all
    must see the same folders.
    """

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder, or the name of a model that comes with the library."""
    data: Path | None = None
    """Folder of the data set."""
    scored: Flat[Scored] = UNCHANGED
    """What may differ from the run's own settings."""
    steps: int | None = None
    """Sampling steps of the denoiser."""
    out: Path | None = None
    """Folder of the report; by default RUN/report, or RUN/report-NAME for other data than the
    run's own."""
    join: Flat[Join] = JOIN
    """The processes that share the work."""

    def changes(self) -> dict[str, Any]:
        """Return what may differ from the run's settings; None for what was not given."""
        return {**vars(self.scored), "data": self.data, "steps": self.steps}


def evaluate(settings: EvaluateSettings) -> None:
    """Write the report and print its path."""
    run = settings.run
    config = _read_config(Path(run))
    if config is not None and isinstance(config.model, configuration.CodecWorldConfig):
        if settings.join.distributed:
            raise ConfigError(
                f"{run} holds a codec: one process scores it; leave out --distributed."
            )
        runtime.cache_compilation(Path(run).parent)
        _score_codec(settings)
        return
    # Imported here and not above: help and refusals are fast, and Ctrl-C is clean meanwhile.
    from pewm_jax.train import processes

    with processes.joined(settings.join):
        # After joining: these imports take seconds, and JAX must not be used before it.
        from pewm_jax.eval import evaluate as report

        runtime.cache_compilation(Path(run).parent)
        try:
            page = report.evaluate(run, out=settings.out, config=config, **settings.changes())
        except KeyboardInterrupt:
            again = "Interrupted; finished scores are kept. Run the same command again to resume."
            raise KeyboardInterrupt(again) from None
        print(f"report: {page}")


def _read_config(run: Path) -> configuration.Config | None:
    """Return a run's configuration; None if there is no such run."""
    file = shipped.find(run) / "config.json"
    return configuration.load(file) if file.is_file() else None


def _score_codec(settings: EvaluateSettings) -> None:
    """Print the numbers of a codec."""
    from pewm_jax.eval import codec_score

    given = {name: value for name, value in settings.changes().items() if value is not None}
    given |= {} if settings.out is None else {"out": settings.out}
    chosen = {name: given.pop(name, None) for name in ("data", "split")}
    if given:
        raise ConfigError(
            f"{settings.run} holds a codec, which is scored on the frames of --data and --split: "
            f"leave out {', '.join('--' + name for name in given)}."
        )
    print(f"numbers: {codec_score.score(settings.run, **chosen)}")


@dataclasses.dataclass(frozen=True)
class ProtocolSettings:
    """Choose the clips that runs are scored on and write them to a file with a hash.

    The file fixes episodes, starts, context, motion, noise and horizon before training. Settings
    that are not given are those of the preset or run. Then use `pewm-jax train …
    --evaluate.protocol FILE`, or `pewm-jax evaluate RUN --protocol FILE`.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PRESET_OR_RUN")]
    """A preset, a run, or the name of a world that a plugin registers."""
    data: Path | None = None
    """Folder of the data set."""
    chosen: Flat[Chosen] = UNCHOSEN
    """What may differ from the settings of the preset or run."""
    context: int | None = None
    """Frames observed before each clip."""
    out: Path = Path("protocol.json")
    """The file to write. An existing file with another protocol is not overwritten."""


def protocol(settings: ProtocolSettings) -> None:
    """Write a protocol's file and print its hash."""
    config = _with_changes(_settings_of(settings.name), settings)
    # Imported here and not above: help and refusals are fast.
    from pewm_jax.eval import protocol as protocols

    protocols.write_protocol(config, settings.out, print)
    print(f"protocol: {settings.out}")


def _settings_of(name: str) -> Config:
    """Return the settings of a preset, of a run, of weights of the library, or of a world."""
    file = shipped.find(name) / "config.json"
    if name not in presets.names() and file.is_file():
        config = configuration.load(file)
    elif name in presets.names():
        config = presets.load(name)
    else:
        config = training.of_world(name, presets.names(), "preset or run")
    if not isinstance(config.model, World):
        raise ConfigError(
            f"{name} trains no world model, and protocols are of rollouts: leave it to "
            "`pewm-jax evaluate`."
        )
    return config


def _with_changes(config: Config, settings: ProtocolSettings) -> Config:
    """Return the settings with those that were given in their place."""
    given = {name: value for name, value in vars(settings.chosen).items() if value is not None}
    data = {} if settings.data is None else {"path": str(settings.data)}
    data |= {} if settings.context is None else {"context": settings.context}
    return dataclasses.replace(
        config,
        data=dataclasses.replace(config.data, **data),
        evaluate=dataclasses.replace(config.evaluate, **given),
    )


@dataclasses.dataclass(frozen=True)
class CompareSettings:
    """Compare two runs that `pewm-jax evaluate` has scored by the same protocol.

    Writes a page with paired differences, 95 % intervals over houses, and pictures. A run may also
    be the folder of one of its reports. Runs that were scored by different protocols are refused.
    """

    run_a: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_A")]
    """The first run."""
    run_b: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_B")]
    """The second run."""
    also_a: tuple[str, ...] = ()
    """Runs that differ from the first in --train.seed alone: intervals over training seeds are then
    given too, apart from those over houses."""
    also_b: tuple[str, ...] = ()
    """Runs that differ from the second in --train.seed alone."""
    out: Path | None = None
    """Folder of the page; by default compare-NAME in the first run's folder."""


def compare(settings: CompareSettings) -> None:
    """Write the page and print its path."""
    # Imported here and not above: help and refusals are fast.
    from pewm_jax.eval import compare as comparison

    page = comparison.compare(
        settings.run_a,
        settings.run_b,
        out=settings.out,
        also_one=settings.also_a,
        also_two=settings.also_b,
    )
    print(f"comparison: {page}")
