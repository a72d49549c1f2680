"""What model families share: the inputs of a backbone, and published autoencoders as codecs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config import AssembledModel
from pewm_jax.config.parts import Codec, Rules
from pewm_jax.errors import UserError
from pewm_jax.types import Array, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Conditioning:
    """The inputs of a denoiser besides the noisy latents; a field that is None is unused.

    Attributes:
        joined_BthwC: concatenated to the channels of the noisy latents.
        modulation_BtE: added to the time embedding, per latent frame.
        tokens_BLC: text tokens, or other tokens of the same width.
        image_BMD: tokens of the observed image, of a width of their own.
        scalars_BK: numbers that are embedded as the time is, such as frames per second.
        known_BthwC: latents of known frames; zeros at the others.
        known_Bt: (B, t) bool, the known latent frames; sampling keeps them.
        fps: frames per second, one number, where positions in time depend on it.
    """

    joined_BthwC: Array | None = None
    modulation_BtE: Array | None = None
    tokens_BLC: Array | None = None
    image_BMD: Array | None = None
    scalars_BK: Array | None = None
    known_BthwC: Array | None = None
    known_Bt: Array | None = None
    fps: Array | None = None


@dataclasses.dataclass(frozen=True)
class Observed:
    """The observed frames of a batch of clips, with which every clip begins.

    Attributes:
        latents_BthwC: their latents, encoded as a condition.
        rgb_BTHWC: their colours in [−1, 1], before any noise was added.
        noise_B: deviation of the noise that was added to the colours that are encoded.
    """

    latents_BthwC: Array
    rgb_BTHWC: Array
    noise_B: Array


@dataclasses.dataclass(frozen=True)
class Readers:
    """The functions with which a backbone reads the memory, for one batch of clips.

    A reader's ``prepare`` makes it.

    Attributes:
        block: ``(params of one place, video_BND, time_BE) -> video_BND``, run at each of the
            backbone's places on the video tokens, in the order of ``nn.tokens``; or None.
            ``time_BE`` may be (B, t, E), one embedding for each token in time.
        params: the parameters of ``block``, stacked over places.
        added_BND: added to the embedded video tokens before the first block.
        added_BthwC: added to the embedded input at every latent cell; only for backbones with
            ``places.cell_width``, which is C.
    """

    block: Callable[[Any, Array, Array], Array] | None = None
    params: Any = None
    added_BND: Array | None = None
    added_BthwC: Array | None = None


NO_READERS = Readers()
"""No memory is read."""


def observed(model: AssembledModel, params: Params, seen: Observed) -> Conditioning:
    """Turn the observed frames into inputs of the backbone, by its own ways if it has any.

    By default the latents are joined to the input, zero for the frames to be imagined. There are
    ``settings.shown_channels(model)`` joined channels. ``params`` are the world model's; those
    under ``image`` are the backbone's to use.
    """
    own = model.backbone.observed(model, params, seen)
    if own is not None:
        return own
    first = seen.latents_BthwC
    missing = model.latent_shape[0] - first.shape[1]
    padding = jnp.zeros((len(first), missing, *first.shape[2:]), first.dtype)
    return Conditioning(joined_BthwC=jnp.concatenate([first, padding], 1))


def joined(x_BthwC: Array, conditioning: Conditioning) -> Array:
    """Return the noisy latents with the conditioning concatenated to their channels."""
    if conditioning.joined_BthwC is None:
        return x_BthwC
    return jnp.concatenate([x_BthwC, conditioning.joined_BthwC], -1)


def held(conditioning: Conditioning, latents_BthwC: Array) -> Array:
    """Return latents with the known ones in their places, where a backbone says which are known."""
    if conditioning.known_Bt is None or conditioning.known_BthwC is None:
        return latents_BthwC
    there = conditioning.known_Bt[:, :, None, None, None]
    return jnp.where(there, conditioning.known_BthwC, latents_BthwC)


def require_shape(name: str, value: Array | None, forms: tuple[tuple[int | str, ...], ...]) -> None:
    """Refuse an argument of none of these shapes; a letter means any size, and None is accepted.

    Raises:
        UserError: it has another shape.
    """
    if value is None or any(_fits(value.shape, form) for form in forms):
        return
    texts = " or ".join(f"({', '.join(map(str, form))})" for form in forms)
    raise UserError(f"{name} has shape {tuple(value.shape)}: it must be {texts}.")


def _fits(shape: tuple[int, ...], form: tuple[int | str, ...]) -> bool:
    return len(form) == len(shape) and all(
        isinstance(side, str) or side == size for side, size in zip(form, shape, strict=True)
    )


class PublishedVAE(Codec):
    """A published autoencoder as a codec: colour and depth by the same frozen weights.

    A subclass has the setting ``latent_channels`` and, if depth is optional, ``depth``.
    """

    SHARDING: ClassVar[Rules] = (
        (r"codec/.*/kernel", P(None, "fsdp")),
        (r"codec/.*/(scale|bias|mix)", P()),
    )
    """Weights are stored sharded and gathered for use; each device encodes its own clips."""
    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True
    latent_channels: Any
    depth: Any = True

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth, which is encoded as a grey image."""
        return self.latent_channels * self.depth
