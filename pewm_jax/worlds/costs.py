"""The costs of a training step: the sum over the networks that run in it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.worlds.stages import Stage

WHOLE_CLIP = Share()
"""One clip on one device."""


def of_stage(config: Config, stage: Stage, share: Share = WHOLE_CLIP) -> dict[str, Costs]:
    """Return the costs of one device's share of a step, by part of the model.

    Args:
        config: the experiment.
        stage: the stage.
        share: the device's share of the step.
    """
    return worlds.function(config.model, "costs")(config, stage, share)


def products(config: Config, stage: Stage) -> list[Product]:
    """List the matrix products of one stage's step; costs are of one clip."""
    return [product for part in of_stage(config, stage).values() for product in part.products]


def flops_per_clip(config: Config, stage: Stage) -> float:
    """Return the model FLOPs of one clip in one step.

    These are the forward pass through all networks, frozen encoders included, and the gradients
    that training needs. Recomputation is a cost of the implementation and is not counted.
    """
    return math.fsum(product.model for product in products(config, stage))


def flops_of_device(product: Product, mesh: Mapping[str, int], clips: float) -> float:
    """Return the FLOPs that one device spends on a product in a step.

    Args:
        product: the product.
        mesh: devices along each axis.
        clips: clips of a step, on all devices together.
    """
    ways = math.prod(mesh[axis] for axis in ("data", "fsdp", *product.axes))
    return clips * product.hardware / ways
