"""Run ``pewm-jax evaluate``, ``protocol`` and ``compare``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from pewm_jax import config as configuration
from pewm_jax import registry as kinds
from pewm_jax import shipped
from pewm_jax.cli import parser
from pewm_jax.cli import train as training
from pewm_jax.cli.parser import Flat
from pewm_jax.config import EvalConfig, Join, World
from pewm_jax.errors import ConfigError
from pewm_jax.io import runtime

JOIN = Join()
SCORED = (
    *("split", "clips", "seeds", "chain", "stride", "videos", "video_clips", "batch"),
    *("none", "lpips", "protocol", "fvd", "mirror", "src", "scs", "quantize"),
    *("long", "long_frames", "beside", "mechanisms"),
)
"""Settings of ``EvalConfig`` that are flags of ``evaluate``."""
CHOSEN = ("split", "clips", "seeds", "chain", "stride", "video_clips")
"""Settings of ``EvalConfig`` that are flags of ``protocol``."""
if TYPE_CHECKING:
    Scored = Chosen = EvalConfig
else:
    Scored, Chosen = parser.optional(EvalConfig, *SCORED), parser.optional(EvalConfig, *CHOSEN)


UNCHANGED, UNCHOSEN = Scored(), Chosen()


@dataclasses.dataclass(frozen=True)
class EvaluateSettings:
    """Evaluate a trained run on held-out scenes and write RUN/report/index.html.

    The defaults are the settings of the run. Several processes can share the work; all must see the
    same folders.
    """

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder, or the name of a model that ships with the library."""
    data: Path | None = None
    """Folder of the data set."""
    scored: Flat[Scored] = UNCHANGED
    """Settings that override those of the run."""
    steps: int | None = None
    """Sampling steps of the denoiser."""
    out: Path | None = None
    """Folder of the report; by default RUN/report, or RUN/report-NAME for other data than the run's
    own."""
    join: Flat[Join] = JOIN
    """The processes that share the work."""

    def changes(self) -> dict[str, Any]:
        """Return the overrides of the run's settings; None for those not given."""
        return {**vars(self.scored), "data": self.data, "steps": self.steps}


def evaluate(settings: EvaluateSettings) -> None:
    """Write the report and print its path."""
    run = settings.run
    config = _read_config(Path(run))
    if config is not None and kinds.of(config.model).name == "codec":
        if settings.join.distributed:
            raise ConfigError(
                f"{run} contains a codec, which one process evaluates: omit --distributed."
            )
        runtime.cache_compilation(shipped.home(run).parent)
        _score_codec(settings)
        return
    # Imported lazily: help and errors are fast, and Ctrl-C is clean meanwhile.
    from pewm_jax.train import processes

    with processes.joined(settings.join):
        # After joining: these imports take seconds, and JAX must not be used before it.
        from pewm_jax.eval import evaluate as report

        runtime.cache_compilation(shipped.home(run).parent)
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


def _given(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that are not None."""
    return {name: value for name, value in settings.items() if value is not None}


def _score_codec(settings: EvaluateSettings) -> None:
    """Print the scores of a codec."""
    from pewm_jax.eval import codec_score

    unsupported = _given({**settings.changes(), "out": settings.out})
    chosen = {name: unsupported.pop(name, None) for name in ("data", "split", "lpips", "fvd")}
    if unsupported:
        raise ConfigError(
            f"{settings.run} contains a codec, which is evaluated on the frames of --data and "
            f"--split, by --lpips and --fvd: omit {', '.join('--' + name for name in unsupported)}."
        )
    print(f"numbers: {codec_score.score(settings.run, **chosen)}")


@dataclasses.dataclass(frozen=True)
class ProtocolSettings:
    """Choose the clips of an evaluation and write them to a file with a hash.

    The file fixes episodes, starts, context, motion, noise and horizon before training. The
    defaults are the settings of the preset or run. Then use `pewm-jax train …
    --evaluate.protocol FILE`, or `pewm-jax evaluate RUN --protocol FILE`.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PRESET_OR_RUN")]
    """A preset, a run, or the name of a world that a plugin registers."""
    data: Path | None = None
    """Folder of the data set."""
    chosen: Flat[Chosen] = UNCHOSEN
    """Settings that override those of the preset or run."""
    context: int | None = None
    """Number of frames observed before each clip."""
    out: Path = Path("protocol.json")
    """The file to write. An existing file with another protocol is not overwritten."""


def protocol(settings: ProtocolSettings) -> None:
    """Write a protocol file and print its hash."""
    config, _ = training.settings_of(settings.name, "preset or run")
    if not isinstance(config.model, World):
        raise ConfigError(
            f"{settings.name} trains no world model, but protocols are for rollouts: use "
            "`pewm-jax evaluate` without one."
        )
    data = {"path": settings.data and str(settings.data), "context": settings.context}
    config = dataclasses.replace(
        config,
        data=dataclasses.replace(config.data, **_given(data)),
        evaluate=dataclasses.replace(config.evaluate, **_given(vars(settings.chosen))),
    )
    # Imported lazily: help and errors are fast.
    from pewm_jax.eval import protocol as protocols

    protocols.write_protocol(config, settings.out, print)
    print(f"protocol: {settings.out}")


@dataclasses.dataclass(frozen=True)
class CompareSettings:
    """Compare two runs that `pewm-jax evaluate` has scored with the same protocol.

    Writes a page with paired differences, 95 % intervals over houses, and images. Instead of a run,
    the folder of one of its reports can be given. Runs with different protocols are an error.
    """

    run_a: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_A")]
    """The first run."""
    run_b: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_B")]
    """The second run."""
    also_a: tuple[str, ...] = ()
    """Runs that differ from the first only in --train.seed; adds intervals over training seeds,
    separate from those over houses."""
    also_b: tuple[str, ...] = ()
    """Runs that differ from the second only in --train.seed."""
    out: Path | None = None
    """Folder of the page; by default compare-NAME in the first run's folder."""


def compare(settings: CompareSettings) -> None:
    """Write the page and print its path."""
    # Imported lazily: help and errors are fast.
    from pewm_jax.eval import compare as comparison

    page = comparison.compare(
        settings.run_a,
        settings.run_b,
        out=settings.out,
        also_one=settings.also_a,
        also_two=settings.also_b,
    )
    print(f"comparison: {page}")
