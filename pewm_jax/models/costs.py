"""What a network costs, by the sum on paper (derived in ``docs/scaling.md``).

Each network says its own costs, beside its functions; ``pewm_jax.worlds.costs`` adds them up for a
stage of training, and ``pewm_jax.scaling`` turns them into bytes, seconds and a plan.

Every matrix product is a line: its multiply-adds for one clip, and whether training goes back
through it. A product whose input depends on something trained is done again, backwards, for the
gradient of that input; one whose weights are trained once more for theirs; and what the backward
pass recomputes (``remat``) is done once more forwards.
"""

from __future__ import annotations

import dataclasses

from pewm_jax.config import ModelConfig

SPLIT = ("tensor", "context")
"""The axes of the mesh that split a block."""
FLOAT = 4
"""Bytes of a float32."""


@dataclasses.dataclass(frozen=True)
class Product:
    """One matrix product or convolution of the step.

    Attributes:
        part: the network, as its parameters are named: ``backbone``, ``memory``, ``codec`` …
        kind: ``linear``, ``attention`` or ``convolution``: what hardware runs at different speed.
        macs: multiply-adds of one clip, forward, all layers together.
        backward: forward passes' worth of the gradients.
        again: forward passes' worth of what the backward pass computes again.
        axes: the axes of the mesh, beside the batch's, over which it is split; devices along
            others do the same work.
    """

    part: str
    kind: str
    macs: float
    backward: float = 0.0
    again: float = 0.0
    axes: tuple[str, ...] = ()

    @property
    def model(self) -> float:
        """FLOPs of one clip that the mathematics needs: forward and gradients."""
        return 2 * self.macs * (1 + self.backward)

    @property
    def hardware(self) -> float:
        """FLOPs of one clip that are done."""
        return 2 * self.macs * (1 + self.backward + self.again)


@dataclasses.dataclass(frozen=True)
class Share:
    """What one device has of a step; by default one clip on one device, in float32.

    Attributes:
        clips: clips of this device.
        tensor: parts that heads and hidden channels are split into.
        context: parts that video tokens are split into.
        wide: bytes of an activation.
        flash: whether attention's logits stay in a kernel (cuDNN's) and are not held.
    """

    clips: float = 1.0
    tensor: int = 1
    context: int = 1
    wide: int = FLOAT
    flash: bool = False


@dataclasses.dataclass(frozen=True)
class Costs:
    """What a network costs in one step on one device; all but ``products`` in bytes.

    Attributes:
        products: its matrix products, of one clip on all devices that share it.
        kept: activations kept from the forward pass for the backward pass.
        block: what the backward pass needs besides, at its peak.
        held: what a frozen network holds while it runs, before anything else is there.
        streamed: read and written by element-wise work.
        summed: added up over the devices along ``tensor``.
        gathered: gathered along ``context``, forwards.
        scattered: scattered along ``context``, backwards.
    """

    products: tuple[Product, ...] = ()
    kept: float = 0.0
    block: float = 0.0
    held: float = 0.0
    streamed: float = 0.0
    summed: float = 0.0
    gathered: float = 0.0
    scattered: float = 0.0


def video_tokens(model: ModelConfig) -> tuple[int, int]:
    """Return how many video tokens a clip has: in time, and in each of these."""
    (t, h, w), places = model.latent_shape, model.backbone.places
    return -(-t // places.patch_t), (h // places.patch) * (w // places.patch)


def video_times(model: ModelConfig) -> int:
    """Return how many time embeddings the video tokens of a clip have: one, or one per frame."""
    apart = model.control.MODULATES or model.noise.per_frame
    return video_tokens(model)[0] if apart else 1


def text_tokens(model: ModelConfig) -> int:
    """Return how many text tokens a clip has."""
    return model.backbone.text_shape[0] if model.backbone.text_shape else 0
