"""Stable Video Diffusion's U-Net, equal to ``UNetSpatioTemporalConditionModel`` of diffusers.

It predicts from noisy latents, to which the latents of the conditioning image are joined, the
embedding of that image, and three scalars. A further embedding per frame can be added to the time
embedding wherever that one modulates the network, in space and in time alike. This is how actions
steer it (arXiv 2601.15284, Eq. 5).

As a backbone (``SVDUNetBackbone``) it gets the observed image in three ways, as in the reference's
pipeline: its latents are joined to those of every frame, its embedding (CLIP's) is attended to, and
a scalar states the noise that was added before it was encoded. Two more scalars, frames per second
and the amount of motion, are settings. It has no place where a memory could be read.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Backbone, Rules
from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.models import interface as backbones
from pewm_jax.models.clip import model as clip_vision
from pewm_jax.models.clip.model import CLIPVisionConfig
from pewm_jax.models.interface import NO_READERS, Conditioning, Observed, Readers
from pewm_jax.models.svd import layers as svd_layers
from pewm_jax.models.svd.layers import GROUPS
from pewm_jax.nn import layers, placement
from pewm_jax.nn.parameters import Leaf, convolution, draw
from pewm_jax.nn.parameters import mlp as mlp_leaves
from pewm_jax.nn.parameters import norm as norm_leaves
from pewm_jax.nn.video_convolution import SAME, convolve_frames
from pewm_jax.types import Array, Params

EPS, EPS_COARSE = 1e-6, 1e-5
"""Added to the variances of residual blocks: on the way up and in levels with attention; and in
the bottom, on the way down without attention, and in the last norm."""


@dataclasses.dataclass(frozen=True)
class SVDUNetBackbone(Backbone):
    """A U-Net over space and time in the form of Stable Video Diffusion (arXiv 2311.15127).

    As a backbone it takes any number of channels: those that codec and control have. It has no
    place where a memory could be read. The defaults are as published.
    """

    SHARDING: ClassVar[Rules] = (
        (r"backbone/conv_out/kernel", P("fsdp", None)),
        (r"(backbone|image)/(.*/)?kernel", P(None, "fsdp")),
        (r"(backbone|image)/(.*/)?(bias|scale|mix)", P()),
        (r"image/(cls_token|position_embed)", P("fsdp")),
    )
    """Weights are stored split and gathered for use; each device computes its own clips."""

    in_channels: int = 8
    """Channels of the input: noisy latents and the latents of the image, joined. A world model
    takes its own number."""
    out_channels: int = 4
    """Channels of the prediction. A world model takes its own number."""
    widths: tuple[int, ...] = (320, 640, 1280, 1280)
    """Channels of each level; each level but the last halves height and width."""
    heads: tuple[int, ...] = (5, 10, 20, 20)
    """Attention heads of each level; the bottom has those of the last level."""
    attends: tuple[bool, ...] = (True, True, True, False)
    """Whether a level has attention; the bottom always has."""
    resnets: tuple[int, ...] = (2, 2, 2, 2)
    """Residual blocks of each level on the way down; one more on the way up."""
    layers: tuple[int, ...] = (1, 1, 1, 1)
    """Transformer layers per attention of each level; the bottom has those of the last level."""
    image_dim: int = 1024
    """Channels of the image embedding."""
    added: int = 3
    """Scalars besides the noise level: frames per second, motion bucket, noise of the image."""
    added_dim: int = 256
    """Channels of the sinusoid of each of these scalars; even."""
    image: CLIPVisionConfig = CLIPVisionConfig()
    """The encoder of the image that is attended to; frozen. Its embedding has `image_dim`
    channels."""
    fps: float = 7.0
    """Frames per second in the network's conditioning."""
    motion_bucket: float = 127.0
    """The amount of motion in the network's conditioning."""
    remat: bool = False
    """Recompute the activations of each residual block and attention in the backward pass: less
    memory, more work."""

    @property
    def time_dim(self) -> int:
        """Channels of the time embedding, to which a modulation is added."""
        return 4 * self.widths[0]

    def __post_init__(self):
        """Validate."""
        require(
            len(self.widths) > 0, "backbone.widths is empty: name at least one level's channels."
        )
        require_positive(self, "backbone", "in_channels", "out_channels", "image_dim", "added")
        for name in ("heads", "attends", "resnets", "layers"):
            values = getattr(self, name)
            require(
                len(values) == len(self.widths),
                f"backbone.{name} names {len(values)} levels and backbone.widths "
                f"{len(self.widths)}: name one value per level.",
            )
            require(
                name == "attends" or min(values) >= 1,
                f"backbone.{name} holds {min(values)}: use at least 1.",
            )
        for width, heads in zip(self.widths, self.heads, strict=True):
            require(
                width >= 1 and width % GROUPS == 0 and width % heads == 0,
                f"backbone.widths holds {width}, which is not a multiple of {GROUPS} groups and of "
                f"the level's {heads} heads.",
            )
        require(
            self.added_dim >= 2 and self.added_dim % 2 == 0,
            f"backbone.added_dim is {self.added_dim}: use an even number.",
        )
        require(self.fps > 0, f"backbone.fps is {self.fps}: use a number above 0.")

    def check(self, model: Any) -> None:
        """Refuse a model that does not fit the network; any size of frames does."""
        require(
            self.added == 3,
            f"backbone.added is {self.added}: a world model gives three scalars, frames per "
            "second, motion bucket and the noise of the image; use 3.",
        )
        require(
            self.image.projection == self.image_dim,
            f"backbone.image.projection is {self.image.projection} and backbone.image_dim is "
            f"{self.image_dim}: the image's embedding is attended to, so use the same.",
        )
        require(
            not model.noise.per_frame,
            "noise.per_frame is true, and this backbone takes one noise level for a clip: use "
            "false.",
        )

    def init(self, key: Array, in_channels: int, out_channels: int) -> Params:
        """Return random parameters."""
        sized = dataclasses.replace(self, in_channels=in_channels, out_channels=out_channels)
        return init(sized, key)

    def init_image(self, key: Array) -> Params:
        """Return random parameters of the image encoder."""
        return clip_vision.init(self.image, key)

    def observed(self, model: Any, params: Params, seen: Observed) -> Conditioning:
        """Condition on the observed image: its latents in every frame, its embedding, scalars.

        The embedding is that of the colours before noise was added.

        Raises:
            UserError: more than one frame was observed.
        """
        first = seen.latents_BthwC
        if first.shape[1] != 1:
            raise UserError(
                f"{first.shape[1]} frames were observed, and this backbone (svd_unet) takes "
                "one: use history 1."
            )
        batch, frames = len(first), model.latent_shape[0]
        rgb = clip_vision.preprocess(seen.rgb_BTHWC[:, 0], self.image.image_size)
        embedding = clip_vision.apply(self.image, params["image"], rgb.astype(model.dtype))
        scalars = jnp.asarray([self.fps - 1, self.motion_bucket], jnp.float32)
        scalars = jnp.broadcast_to(scalars, (batch, 2))
        return Conditioning(
            joined_BthwC=jnp.repeat(first, frames, 1),
            image_BMD=embedding[:, None],
            scalars_BK=jnp.concatenate([scalars, seen.noise_B[:, None]], 1),
        )

    def apply(
        self,
        params: Params,
        x_BthwC: Array,
        time_B: Array,
        conditioning: Conditioning,
        readers: Readers = NO_READERS,
    ) -> Array:
        """Predict from noisy latents.

        Raises:
            UserError: a memory is to be read, or the image's embedding or the scalars are missing.
        """
        if readers.block is not None or readers.added_BND is not None:
            raise UserError("this backbone (svd_unet) reads no memory: use memory.kind none.")
        if conditioning.image_BMD is None or conditioning.scalars_BK is None:
            raise UserError(
                "this backbone (svd_unet) needs the embedding of an image and three scalars: make "
                "its conditioning by worlds.world_model.condition."
            )
        dtype = x_BthwC.dtype
        latents = backbones.joined(x_BthwC, conditioning).astype(dtype)
        sized = dataclasses.replace(
            self,
            in_channels=params["conv_in"]["kernel"].shape[-2],
            out_channels=params["conv_out"]["kernel"].shape[-1],
        )
        return apply(
            sized,
            params,
            latents,
            time_B,
            conditioning.image_BMD.astype(dtype),
            conditioning.scalars_BK,
            conditioning.modulation_BtE,
        )


def layout(config: SVDUNetBackbone) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters."""
    return dict(_leaves(config))


def init(config: SVDUNetBackbone, key: Array) -> Params:
    """Return random parameters, float32; the tree is ``layout``'s."""
    return draw(layout(config), key, key_per_leaf=True)


def apply(
    config: SVDUNetBackbone,
    params: Params,
    latents_BThwC: Array,
    timesteps_B: Array,
    image_BMD: Array,
    added_BK: Array,
    modulation_BTE: Array | None = None,
) -> Array:
    """Predict from noisy latents: (B, T, h, w, out_channels).

    Args:
        latents_BThwC: (B, T, h, w, in_channels) scaled noisy latents and, joined to their channels,
            the latents of the image; of any size. Their dtype is that of the computation.
        timesteps_B: noise level in the network's units: log σ / 4.
        image_BMD: embedding of the image; M is 1 in the published model.
        added_BK: scalars: frames per second less 1, motion bucket, deviation of the noise that the
            image got.
        modulation_BTE: (B, T, time_dim) added to the time embedding of each frame.

    Raises:
        UserError: an argument of another shape.
    """
    _check(config, latents_BThwC, timesteps_B, image_BMD, added_BK, modulation_BTE)
    time = _time(config, params, latents_BThwC.dtype, timesteps_B, added_BK, modulation_BTE)
    levels, last = range(len(config.widths)), len(config.widths) - 1
    params = jax.tree.map(placement.constrain, params)

    def resnet(place: Params, x: Array, eps: float) -> Array:
        return _run(config, functools.partial(svd_layers.resnet, eps=eps), place, x, time)

    def attend(place: Params, k: int, x: Array, level: int) -> Array:
        if f"attend_{k}" not in place:
            return x
        run = functools.partial(
            svd_layers.attend, heads=config.heads[level], layers_=config.layers[level]
        )
        return _run(config, run, place[f"attend_{k}"], x, image_BMD)

    x = convolve_frames(params["conv_in"], latents_BThwC, 1, SAME)
    skips = [x]
    for level in levels:
        place = params[f"down_{level}"]
        eps = EPS if config.attends[level] else EPS_COARSE
        for k in range(config.resnets[level]):
            x = resnet(place[f"resnet_{k}"], x, eps)
            x = attend(place, k, x, level)
            skips.append(x)
        if level < last:
            x = convolve_frames(place["resample"], x, 2, SAME)
            skips.append(x)

    place = params["mid"]
    x = resnet(place["resnet_0"], x, EPS_COARSE)
    x = attend(place, 0, x, last)
    x = resnet(place["resnet_1"], x, EPS_COARSE)

    for step, level in enumerate(reversed(levels)):
        place = params[f"up_{step}"]
        for k in range(config.resnets[level] + 1):
            x = jnp.concatenate([x, skips.pop()], -1)
            x = resnet(place[f"resnet_{k}"], x, EPS)
            x = attend(place, k, x, level)
        if level:
            x = svd_layers.upsample(place["resample"], x, *skips[-1].shape[2:4])
    return convolve_frames(
        params["conv_out"], svd_layers.active(params["norm_out"], x, EPS_COARSE), 1, SAME
    )


def _run(config: SVDUNetBackbone, layer: Callable[..., Array], *arguments: Array | Params) -> Array:
    """Run a layer, with rematerialization if the settings ask for it; each device its own clips."""
    layer = jax.checkpoint(layer) if config.remat else layer
    return placement.constrain(layer(*arguments), "batch")


def _time(
    config: SVDUNetBackbone,
    params: Params,
    dtype: jnp.dtype,
    timesteps_B: Array,
    added_BK: Array,
    modulation_BTE: Array | None,
) -> Array:
    """Return SiLU of the (B, T or 1, time_dim) embedding of level, scalars and modulation."""
    wave = layers.sinusoid(timesteps_B, config.widths[0]).astype(dtype)
    waves = layers.sinusoid(added_BK, config.added_dim).astype(dtype)
    time = layers.mlp(params["time_embed"], wave) + layers.mlp(
        params["added_embed"], waves.reshape(len(waves), -1)
    )
    time = time[:, None]
    return jax.nn.silu(time if modulation_BTE is None else time + modulation_BTE.astype(dtype))


def _check(
    config: SVDUNetBackbone,
    latents: Array,
    timesteps: Array,
    image: Array,
    added: Array,
    modulation: Array | None,
) -> None:
    """Refuse arguments that do not fit the network or each other."""
    if latents.ndim != 5 or latents.shape[-1] != config.in_channels:
        raise UserError(
            f"latents_BThwC has shape {latents.shape}: five axes are needed, batch, time, height, "
            f"width and {config.in_channels} channels last."
        )
    batch, frames = latents.shape[:2]
    backbones.require_shape("timesteps_B", timesteps, ((batch,),))
    backbones.require_shape("image_BMD", image, ((batch, "M", config.image_dim),))
    backbones.require_shape("added_BK", added, ((batch, config.added),))
    backbones.require_shape("modulation_BTE", modulation, ((batch, frames, config.time_dim),))


def _leaves(config: SVDUNetBackbone) -> Iterator[Leaf]:
    widths, time = config.widths, config.time_dim
    last = len(widths) - 1

    def attend(where: str, level: int) -> Iterator[Leaf]:
        sizes = widths[level], config.image_dim, config.layers[level]
        return svd_layers.attend_leaves(where, *sizes)

    yield from convolution("conv_in", (3, 3), config.in_channels, widths[0])
    yield from mlp_leaves("time_embed", widths[0], time, time)
    yield from mlp_leaves("added_embed", config.added * config.added_dim, time, time)
    skips = [widths[0]]
    inside = widths[0]
    for level, width in enumerate(widths):
        where = f"down_{level}"
        for k in range(config.resnets[level]):
            yield from svd_layers.resnet_leaves(f"{where}/resnet_{k}", inside, width, time)
            if config.attends[level]:
                yield from attend(f"{where}/attend_{k}", level)
            inside = width
            skips.append(width)
        if level < last:
            yield from convolution(f"{where}/resample", (3, 3), width, width)
            skips.append(width)
    yield from svd_layers.resnet_leaves("mid/resnet_0", inside, inside, time)
    yield from attend("mid/attend_0", last)
    yield from svd_layers.resnet_leaves("mid/resnet_1", inside, inside, time)
    for step, level in enumerate(reversed(range(len(widths)))):
        where, width = f"up_{step}", widths[level]
        for k in range(config.resnets[level] + 1):
            yield from svd_layers.resnet_leaves(
                f"{where}/resnet_{k}", inside + skips.pop(), width, time
            )
            if config.attends[level]:
                yield from attend(f"{where}/attend_{k}", level)
            inside = width
        if level:
            yield from convolution(f"{where}/resample", (3, 3), width, width)
    yield from norm_leaves("norm_out", inside)
    yield from convolution("conv_out", (3, 3), inside, config.out_channels)
