"""The costs of PEWM's training stages, collected from the parts of the model."""

from __future__ import annotations

from pewm_jax.config import Config, ModelConfig, functions
from pewm_jax.models.costs import Costs, Share
from pewm_jax.worlds.stages import Stage


def costs(config: Config, stage: Stage, share: Share) -> dict[str, Costs]:
    """Return the costs of one device by part, named as the parameters are.

    Args:
        config: the experiment.
        stage: the stage.
        share: one device's share of the step.
    """
    model = config.model
    assert isinstance(model, ModelConfig)
    trained = not stage.memory
    found = {
        "backbone": functions(model.backbone).costs(model, share, trained=trained),
        "control": functions(model.control).costs(model, share, trained=trained),
        "codec": functions(model.codec).costs(model, share),
    }
    if stage.memory:
        found["memory"] = functions(model.memory.reader).costs(model, share)
        if encodes(config):
            encoder = functions(model.memory.encoder)
            found["encoder"] = encoder.costs(model, share, config.data.context)
    return found


def encodes(config: Config) -> bool:
    """Tell whether a stage with memory runs the image encoder: features are used, not cached."""
    assert isinstance(config.model, ModelConfig)
    return config.model.memory.KEEPS_FEATURES and not config.data.features
