"""What a training starts from: which stages are left, which weights and features are given."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pewm_jax import rollouts, weights
from pewm_jax.config import Config, UserError
from pewm_jax.memory import feature_cache
from pewm_jax.training import loading, processes, runs, step_folders
from pewm_jax.training.stages import Stage
from pewm_jax.types import Params


def left(run: Path, planned: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Leave out stages that a later one has built on: its checkpoints hold what they gave."""
    begun = [
        n for n, stage in enumerate(planned) if step_folders.steps(step_folders.of(run, stage.name))
    ]
    return planned[processes.agree(max(begun, default=0)) :]


def require_weights(config: Config) -> None:
    """Refuse networks that are not trained here and that no converted weights are named for."""
    frozen = {
        "codec.kind vae": config.model.codec.kind == "vae",
        "memory.encoder dinov2": config.model.memory.encoder == "dinov2",
    }
    for setting, wanted in frozen.items():
        if wanted and not config.train.start:
            raise UserError(
                f"{setting} needs weights that are not trained here: convert a checkpoint "
                "(python -m pewm_jax.convert --help) and name its folder by train.start."
            )


def named(config: Config, stage: Stage, say: Callable[[str], None]) -> Params | None:
    """Return the weights that the first planned stage starts from, if any are named.

    Memory blocks that the folder may hold go on learning in stage 2. Before stage 1 they are left
    out, since they were fitted to another backbone, and said to be.
    """
    if not config.train.start:
        return None
    file = Path(config.train.start) / runs.WEIGHTS
    params = _given(config)
    if file.exists():  # else what was read from a checkpoint is compared already
        processes.first(lambda: weights.verify(file))
    if "memory" in params and not stage.memory:
        say(f"{config.train.start}: its memory blocks are left out; stage 2 begins with fresh ones")
        params = {name: part for name, part in params.items() if name != "memory"}
    return params


def encoder(config: Config) -> Params:
    """Return the image encoder's weights as they are given, to compare kept features with."""
    if config.model.memory.encoder != "dinov2":
        return {}
    return _given(config)["encoder"]


def _given(config: Config) -> Params:
    """Return the weights of the named folder: those of its file, or else of a checkpoint."""
    folder = Path(config.train.start)
    if (folder / runs.WEIGHTS).exists():
        return rollouts.load(folder, lazily=True)[1]
    return loading.load(folder)[1]


def features(config: Config, stage: Stage) -> feature_cache.FeatureCache | None:
    """Open the features that are kept, where the stage needs any; not compared with weights yet."""
    if not (config.data.features and stage.memory):
        return None
    return feature_cache.read(Path(config.data.features) / "train")
