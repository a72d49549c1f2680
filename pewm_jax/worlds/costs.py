"""What a training step costs: the sum over the networks that run in it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pewm_jax.config import Config, functions
from pewm_jax.models.costs import Costs, Product, Share
from pewm_jax.worlds.stages import Stage

ONE = Share()
"""One clip on one device."""


def of_stage(config: Config, stage: Stage, share: Share = ONE) -> dict[str, Costs]:
    """Return what one device's share of a step costs, by the part of the model.

    Args:
        config: the experiment.
        stage: the stage.
        share: what the device has of it.
    """
    return functions(config.model).costs(config, stage, share)


def products(config: Config, stage: Stage) -> list[Product]:
    """List the matrix products of one stage's step; costs are of one clip."""
    return [line for part in of_stage(config, stage).values() for line in part.products]


def flops_per_clip(config: Config, stage: Stage) -> float:
    """Return the FLOPs of one clip in one step that the mathematics needs.

    Forward through everything, frozen encoders included, and the gradients that are needed; what
    is recomputed is a cost of the implementation and not counted.
    """
    return math.fsum(product.model for product in products(config, stage))


def flops_of_device(product: Product, mesh: Mapping[str, int], clips: float) -> float:
    """Return the FLOPs that one device does for a product.

    Args:
        product: the product.
        mesh: devices along each axis.
        clips: clips of a step, of all devices.
    """
    ways = math.prod(mesh[axis] for axis in ("data", "fsdp", *product.axes))
    return clips * product.hardware / ways
