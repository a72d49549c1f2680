"""What a network costs, computed by formulas (derived in ``docs/scaling.md``).

Each network states its costs beside its functions. ``pewm_jax.worlds.costs`` collects them for a
stage of training, and ``pewm_jax.plan`` turns them into bytes, seconds and a plan.

Every matrix product is listed with its multiply-adds for one clip. The backward pass repeats that
work once if the gradient of the product's input is needed, once more if its weights are trained,
and once more if its forward pass is recomputed (``remat``).
"""

from __future__ import annotations

import dataclasses

from pewm_jax.config import ModelConfig

SPLIT = ("tensor", "context")
"""The mesh axes that split the work of a block."""
FLOAT = 4
"""Bytes of a float32."""


@dataclasses.dataclass(frozen=True)
class Product:
    """One matrix product or convolution of the step.

    Attributes:
        part: the network, as its parameters are named: ``backbone``, ``memory``, ``codec`` …
        kind: ``linear``, ``attention`` or ``convolution``; hardware runs them at different speeds.
        macs: multiply-adds of the forward pass of one clip, summed over all layers.
        backward: work of the gradients, in forward passes.
        again: work of what the backward pass recomputes, in forward passes.
        axes: the mesh axes, besides the batch's, that split it; devices along other axes repeat
            the same work.
    """

    part: str
    kind: str
    macs: float
    backward: float = 0.0
    again: float = 0.0
    axes: tuple[str, ...] = ()

    @property
    def model(self) -> float:
        """FLOPs of one clip without recomputation: forward pass and gradients."""
        return 2 * self.macs * (1 + self.backward)

    @property
    def hardware(self) -> float:
        """FLOPs of one clip with recomputation."""
        return 2 * self.macs * (1 + self.backward + self.again)


@dataclasses.dataclass(frozen=True)
class Share:
    """One device's share of a step; by default one clip on one device, in float32.

    Attributes:
        clips: clips per device.
        tensor: devices that share heads and hidden channels.
        context: devices that share video tokens.
        activation_bytes: bytes of one activation value.
        flash: whether a fused kernel (cuDNN's) computes attention, so that no logits are stored.
    """

    clips: float = 1.0
    tensor: int = 1
    context: int = 1
    activation_bytes: int = FLOAT
    flash: bool = False


@dataclasses.dataclass(frozen=True)
class Costs:
    """The costs of a network in one step on one device, in bytes except for ``products``.

    Attributes:
        products: its matrix products, for one clip, summed over the devices that share the clip.
        kept: activations stored by the forward pass for the backward pass.
        block: further memory at the peak of the backward pass.
        held: memory of a frozen encoder while it runs, before the denoiser starts.
        streamed: traffic to memory of element-wise work.
        summed: summed over the devices along ``tensor`` (all-reduce).
        gathered: gathered along ``context`` in the forward pass.
        scattered: reduce-scattered along ``context`` in the backward pass.
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
    """Return the video tokens of a clip: (tokens in time, tokens at each time).

    Where a backbone names no places, its tokens are the latent cells.
    """
    (t, h, w), places = model.latent_shape, model.backbone.places
    if places is None:
        return t, h * w
    return -(-t // places.patch_t), (h // places.patch) * (w // places.patch)


def video_times(model: ModelConfig) -> int:
    """Return the number of time embeddings of a clip: 1, or one per token in time."""
    apart = model.control.MODULATES or model.noise.per_frame
    return video_tokens(model)[0] if apart else 1


def text_tokens(model: ModelConfig) -> int:
    """Return how many text tokens a clip has."""
    return model.backbone.text_shape[0] if model.backbone.text_shape else 0
