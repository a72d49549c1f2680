"""``pewm-jax evaluate``: score a trained run on held-out scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from pewm_jax import config as configuration
from pewm_jax import shipped
from pewm_jax.cli import named
from pewm_jax.cli import plugins as imports
from pewm_jax.config import Join
from pewm_jax.config import command_line as cli


@dataclasses.dataclass(frozen=True)
class Settings:
    """What may differ from the run's own configuration; what is not given stays as it is."""

    data: Path | None = None
    """Folder of the data set."""
    split: str | None = None
    """Folder inside it with the episodes to score."""
    clips: int | None = None
    """Clips scored per seed."""
    seeds: tuple[int, ...] | None = None
    """Seeds of the sampling noise, e.g. --seeds 0 1 2."""
    steps: int | None = None
    """DDIM steps."""
    chain: int | None = None
    """Clips generated one after the other in what the table scores."""
    stride: int | None = None
    """Recorded actions between two frames of a clip."""
    videos: int | None = None
    """Long rollouts shown side by side."""
    video_clips: int | None = None
    """Clips generated one after the other in a long rollout."""
    batch: int | None = None
    """Clips sampled at once."""
    none: Path | None = None
    """Run trained for as many steps without a memory (same clip and codec), which gets a row."""
    lpips: str | None = None
    """Weights of LPIPS: a file, `alex` or `vgg` of the installed package, or `off`."""
    protocol: str | None = None
    """File made by `pewm-jax protocol`, which fixes clips, context, motion, noise and horizon;
    `off` chooses them by the settings, also where the run names a file. Every report has its own,
    RUN/report/protocol.json, by which other runs can be scored."""
    fvd: str | None = None
    """FVD and KVD of whole clips: a file with weights of I3D, `on` for those of the installed
    package, or `off`. By default they are measured where those weights are installed and there is
    an accelerator: on processors it takes longer than imagining the clips."""
    mirror: int | None = None
    """Frames that the agent goes before it comes back the same way, in the mirror test of the long
    rollouts, such as 32; 0 leaves it out. By default 32 where long rollouts have 64 frames."""
    src: tuple[str, ...] | None = None
    """Encoders of SRC in the mirror test: `alex` or `vgg` of LPIPS, folders with DINOv2, or `off`.
    By default that of LPIPS, where LPIPS is measured."""
    scs: str | None = None
    """Segmenter of SCS, for episodes that were collected with --ids: a folder with SAM 2, `flow`
    (optical flow, without weights), or `off`. By default `flow`."""
    out: Path | None = None
    """Folder of the report; by default RUN/report, or RUN/report-NAME for other data than the
    run's own."""


def main(argv: Sequence[str], prog: str = "python evaluate.py") -> int:
    """Write the report, RUN/report/index.html unless told otherwise, and print its path.

    Args:
        argv: the arguments: a run's folder, and what is to differ from its settings.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    run, argv = named.take(argv, "RUN", f"Name a run folder first: {prog} runs/demo.")
    about = (
        "Score a trained run on held-out scenes and write RUN/report/index.html. Beside these "
        "settings, several processes can share the work; all must see the same folders:\n"
        f"{cli.list_flags(Join)}\n{imports.HELP}"
    )
    join, flags = cli.take(Join, argv)
    prog = f"{prog} {run}"
    settings = cli.parse(Settings, flags, default=Settings(), prog=prog, description=about)
    config = _read_config(Path(run))
    if config is not None and isinstance(config.model, configuration.CodecWorldConfig):
        if join.distributed:
            raise cli.ConfigError(
                f"{run} holds a codec: one process scores it; leave out --distributed."
            )
        cli.cache_compilation(Path(run).parent)
        return _codec(run, settings)
    # Imported here and not above: help and refusals come at once, and Ctrl-C is clean meanwhile.
    from pewm_jax.train import processes

    with processes.joined(join):
        # After joining: these imports take seconds, and JAX must not be used before it.
        from pewm_jax.eval.evaluate import evaluate

        cli.cache_compilation(Path(run).parent)
        try:
            changes = {name: value for name, value in vars(settings).items() if name != "out"}
            page = evaluate(run, out=settings.out, config=config, **changes)
        except KeyboardInterrupt:
            again = "Interrupted; finished scores are kept. Run the same command again to resume."
            raise KeyboardInterrupt(again) from None
        print(f"report: {page}")
    return 0


def _read_config(run: Path) -> configuration.Config | None:
    """Return a run's configuration; None if there is no such run."""
    file = shipped.find(run) / "config.json"
    return configuration.load(file) if file.is_file() else None


def _codec(run: str, settings: Settings) -> int:
    """Print the numbers of a codec; returns the exit code."""
    from pewm_jax.eval import codec_score

    given = {name: value for name, value in vars(settings).items() if value is not None}
    chosen = {name: given.pop(name, None) for name in ("data", "split")}
    if given:
        raise cli.ConfigError(
            f"{run} holds a codec, which is scored on the frames of --data and --split: leave out "
            f"{', '.join('--' + name for name in given)}."
        )
    print(f"numbers: {codec_score.score(run, **chosen)}")
    return 0
