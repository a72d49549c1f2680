"""Run ``pewm-jax horizon``: imagine hundreds of frames, and evaluate them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pewm_jax.errors import ConfigError
from pewm_jax.io import runtime

SPARE = 4
"""One spare walk per this many trials, because some walks have no room for a block."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Imagine long walks through held-out houses with the recorded actions, and evaluate them.

    The frames are compared with the ground truth by segment (PSNR) and as sets of windows of 16
    frames (FVD, KVD). For a voxel world, its renderer is also evaluated with the true voxels, and
    trials measure whether a block placed in it persists.
    """

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder, or the name of a model that ships with the library."""
    data: Path = Path("data/persist_long")
    """Folder of the data set; its episodes must be longer than the horizon."""
    split: str = "revisit"
    """Split: a folder inside it."""
    beside: tuple[str, ...] = ()
    """Other worlds (runs' folders or names of models that ship with the library) that imagine the
    same walks."""
    ends: tuple[int, ...] = (200, 400, 600)
    """Frames at which windows end; also the ends of the segments over which PSNR is averaged."""
    walks: int = 4
    """Number of walks, one per episode; those of one episode's trials may overlap."""
    context: int = 8
    """Number of observed frames before each walk."""
    fvd: Literal["on", "off"] = "off"
    """Measure FVD and KVD (`pip install 'pewm-jax[metrics]'`); on CPUs this takes longer than
    imagining."""
    windows: int = 4
    """Number of windows of each walk before each end."""
    trials: int = 0
    """Number of walks at whose start a block is placed in a voxel world, such as 40."""
    trial_frames: int = 64
    """Number of frames imagined after a block was placed."""
    out: Path | None = None
    """Folder of the report; by default RUN/horizon."""


def run(settings: Settings) -> None:
    """Evaluate, write RUN/horizon/horizon.html and print the scores."""
    ends = settings.ends
    if not ends or sorted(set(ends)) != list(ends) or ends[0] < 16:
        raise ConfigError(
            f"--ends is {ends}: give increasing numbers of frames, 16 or more, such as 200 400 600."
        )
    if min(settings.walks, settings.context, settings.windows, settings.trial_frames) < 1:
        raise ConfigError("--walks, --context, --windows and --trial-frames must be above 0.")
    # Imported lazily: help and errors are fast.
    from pewm_jax.eval import horizon
    from pewm_jax.eval.loaded_run import open_run

    opened = open_run(settings.run)
    others = [(name, open_run(name)) for name in settings.beside]
    runtime.cache_compilation(opened.home.parent)
    facts, videos = _measure(settings, opened, others)
    facts["protocol"] = {
        "run": settings.run,
        "weights_sha256": opened.weights_hash,
        "data": f"{settings.data}/{settings.split}",
        "walks": settings.walks,
        "observed frames": settings.context,
        "windows of each walk before each end": settings.windows,
        **{f"weights_sha256 of {name}": other.weights_hash for name, other in others},
    }
    page = horizon.write_report(settings.out or opened.home / "horizon", facts, videos, ends)
    print("\n".join(horizon.lines(facts, ends)))
    print(f"report: {page}")


def _measure(
    settings: Settings, opened: Any, others: Sequence[tuple[str, Any]]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the measurements, and (B, T, H, W, 3) frames by method, ground truth first.

    Raises:
        ConfigError: the episodes are too few or too short, or trials are requested for another
            world.
    """
    import numpy as np

    from pewm_jax.data.dataset import EpisodeSource
    from pewm_jax.data.loader import require_recorded, require_same_cells
    from pewm_jax.eval import horizon, voxel_trials
    from pewm_jax.eval.metrics.videos import read_i3d
    from pewm_jax.models.i3d import convert as i3d_weights
    from pewm_jax.worlds.persist.world import PERSIST

    i3d = read_i3d(i3d_weights.find(None), "fvd") if settings.fvd == "on" else None
    episodes = EpisodeSource(settings.data / settings.split)
    if len(episodes) < settings.walks:
        raise ConfigError(
            f"--walks is {settings.walks}, but {settings.data}/{settings.split} has "
            f"{len(episodes)} episodes: request at most as many, or collect more."
        )
    config, params, ends = opened.config, opened.params, settings.ends
    first = settings.context - 1
    chosen = [episodes[k] for k in range(settings.walks)]
    require_recorded(config.model, episodes)
    require_same_cells(config.model, chosen[0])
    walks = [horizon.read_walk(one, first, ends[-1], settings.context) for one in chosen]
    tried = _trial_walks(settings, chosen, first)
    of_voxels = isinstance(config.model, PERSIST)
    if tried:  # fail before hours of imagining
        if not of_voxels:
            raise ConfigError("--trials places blocks in a voxel world; this world has no voxels.")
        voxel_trials.block_class(config, tried)
    truth = np.stack([walk.truth_THWC for walk in walks])
    made: dict[str, Any] = {"world": horizon.imagine_walks(config, params, walks)}
    facts: dict[str, Any] = {}
    if of_voxels:
        made["without"] = horizon.imagine_walks(
            config, params, walks, memory=False, label="without voxels"
        )
        grids = [walk.classes_TXYZ for walk in walks if walk.classes_TXYZ is not None]
        if len(grids) == len(walks):
            made["known"] = horizon.imagine_walks(
                config, params, walks, known=True, label="from known grids"
            )
            made["bound"] = horizon.render_bound(config, params, walks)
            facts["autoencoder"] = voxel_trials.reconstruction_shares(config.model, params, grids)
    for name, other in others:
        made[name] = horizon.imagine_walks(other.config, other.params, walks, label=name)
    facts["psnr"] = {name: horizon.stretches(video, truth, ends) for name, video in made.items()}
    if i3d is not None:
        facts["distances"] = horizon.distances(made, truth, ends, settings.windows, i3d)
    if tried:
        facts["edits"] = voxel_trials.run(config, params, tried, count=settings.trials).facts()
    return facts, {"truth": truth, **made}


def _trial_walks(settings: Settings, chosen: Sequence[Any], first: int) -> list[Any]:
    """Return walks for the trials, spread over the episodes, including spare ones."""
    if not settings.trials:
        return []
    from pewm_jax.eval import horizon

    shortest = min(episode.length for episode in chosen)
    starts = range(first, shortest - settings.trial_frames)
    if not starts:
        raise ConfigError(
            f"--trial-frames is {settings.trial_frames}, but the shortest episode has {shortest} "
            "frames: use fewer, or collect longer episodes."
        )
    wanted = settings.trials + -(-settings.trials // SPARE)
    each = -(-wanted // len(chosen))
    places = [starts[len(starts) * k // each] for k in range(each)]
    walks = ((one, at) for at in places for one in chosen)
    return [horizon.read_walk(one, at, settings.trial_frames, 1) for one, at in walks][:wanted]
