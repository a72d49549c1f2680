"""What a training starts from: the stages still to train, given weights, kept features."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pewm_jax import rollouts, weights
from pewm_jax.config import Config, UserError, kinds
from pewm_jax.memory import feature_cache
from pewm_jax.training import loading, processes, runs, step_folders
from pewm_jax.training.stages import Stage
from pewm_jax.types import Params


def remaining_stages(run: Path, planned: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Return the planned stages from the last one that has a checkpoint.

    Earlier ones are done: the checkpoints of the later stage hold their weights.
    """
    begun = [
        n for n, stage in enumerate(planned) if step_folders.steps(step_folders.of(run, stage.name))
    ]
    return planned[processes.agree(max(begun, default=0)) :]


def require_weights(config: Config) -> None:
    """Refuse networks that are never trained, if ``train.start`` names no weights for them."""
    model = config.model
    for where, part in (("codec", model.codec), ("memory.encoder", model.memory.encoder)):
        setting = f"{where} of kind {kinds.of(part).name}"
        if part.CONVERTED and not config.train.start:
            raise UserError(
                f"{setting} needs weights that are not trained here: convert a checkpoint "
                "(python -m pewm_jax.convert --help) and name its folder by train.start."
            )


def read_weights(config: Config, stage: Stage, say: Callable[[str], None]) -> Params | None:
    """Return the weights in ``train.start``, mapped into memory; None if it is empty.

    Memory blocks in them are trained further in stage 2. Stage 1 drops them, and says so: they were
    fitted to another backbone.
    """
    if not config.train.start:
        return None
    file = Path(config.train.start) / runs.WEIGHTS
    params = _given(config)
    if file.exists():  # a checkpoint has been verified while reading
        processes.first(lambda: weights.verify(file))
    if "memory" in params and not stage.memory:
        say(f"{config.train.start}: its memory blocks are left out; stage 2 begins with fresh ones")
        params = {name: part for name, part in params.items() if name != "memory"}
    return params


def encoder(config: Config) -> Params:
    """Return the image encoder's weights in ``train.start``, to compare kept features with."""
    if not config.model.memory.encoder.CONVERTED:
        return {}
    return _given(config)["encoder"]


def _given(config: Config) -> Params:
    """Return the weights in ``train.start``: those of its file, or else of a checkpoint."""
    folder = Path(config.train.start)
    if (folder / runs.WEIGHTS).exists():
        return rollouts.load_finished(folder, lazily=True)[1]
    return loading.load(folder)[1]


def features(config: Config, stage: Stage) -> feature_cache.FeatureCache | None:
    """Open the kept features if the stage uses any, without comparing them with the weights."""
    if not (config.data.features and stage.memory):
        return None
    return feature_cache.read(Path(config.data.features) / "train")
