"""Stable Video Diffusion's U-Net as a backbone: its functions, sharding rules and costs.

The observed image reaches it in three ways, as in the reference's pipeline: its latents are joined
to those of every frame, its embedding (CLIP's) is attended to, and a scalar states the noise that
was added before it was encoded. Two more scalars, frames per second and the amount of motion, are
settings. A control that modulates adds to the time embedding of each frame (arXiv 2601.15284, Eq.
5). It has no place where a memory could be read.
"""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any, ClassVar

import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Backbone, Rules
from pewm_jax.errors import UserError, require
from pewm_jax.models import interface as backbones
from pewm_jax.models.clip import model as clip_vision
from pewm_jax.models.interface import Conditioning, Observed, Readers
from pewm_jax.models.svd import unet as svd_unet
from pewm_jax.models.svd.config import SVDUNetConfig
from pewm_jax.nn.attention import LOGITS
from pewm_jax.nn.costs import FLOAT, Costs, Product, Share
from pewm_jax.types import Array, Params

REPLICATED = P()


STREAMS = (14, 36)
"""How often element-wise work reads or writes a residual block's output: forward, backward."""

KEPT = {"resnet": 14, "attention": 80}
"""Arrays of the size of a block's output that its backward pass needs; three feed-forward layers,
with eight times as many channels inside, make up most of an attention's. A rough count."""
BLOCK = {"resnet": 30, "attention": 160}
"""The same at the peak of its own backward pass."""


@dataclasses.dataclass(frozen=True)
class SVDUNetBackbone(SVDUNetConfig, Backbone):
    """The U-Net of Stable Video Diffusion as the denoiser of a world model.

    It takes any number of channels: those that codec and control have. It has no place where a
    memory could be read.
    """

    SHARDING: ClassVar[Rules] = (
        (r"backbone/conv_out/kernel", P("fsdp", None)),
        (r"(backbone|image)/(.*/)?kernel", P(None, "fsdp")),
        (r"(backbone|image)/(.*/)?(bias|scale|mix)", REPLICATED),
        (r"image/(cls_token|position_embed)", P("fsdp")),
    )
    """Weights are stored split and gathered for use; each device computes its own clips."""

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
        return svd_unet.init(sized, key)

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
        readers: Readers,
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
        return svd_unet.apply(
            sized,
            params,
            latents,
            time_B,
            conditioning.image_BMD.astype(dtype),
            conditioning.scalars_BK,
            conditioning.modulation_BtE,
        )

    def costs(self, model: Any, share: Share, *, trained: bool) -> Costs:
        """Return the costs of the U-Net, which is trained or frozen, and of the image encoder.

        Every matrix of the tree is multiplied with as many vectors as its place has: pixels of all
        frames at its level, frames for what embeds time, one for what embeds the image. Only the
        largest level's activations and logits make the peak of the backward pass.
        """
        frames, height, width = model.latent_shape
        sized = dataclasses.replace(
            self, in_channels=model.in_channels, out_channels=model.codec.channels
        )
        sizes = _sizes(self, height, width)
        linear = convolution = times = ends = 0.0
        for path, shape in svd_unet.layout(sized).items():
            if not path.endswith("kernel"):
                continue
            macs = math.prod(shape) * _vectors(self, path, frames, sizes, modulated(model))
            if path == "conv_in/kernel":
                ends += macs
            elif len(shape) == 4 and shape[0] == 3:
                # Twice as large a picture is convolved before it is enlarged: 16 products for 36.
                up = re.fullmatch(r"up_\d+/resample/kernel", path) and _doubles(self, path, sizes)
                convolution += macs * (4 / 9 if up else 1)
            elif "/time/" in path or path.startswith(("time_embed", "added_embed")):
                times += macs
            else:
                linear += macs
        attention, largest = 0.0, 0.0
        for level in _attentions(self):
            pixels = math.prod(sizes[level])
            depth = self.layers[level]
            attention += depth * 2 * self.widths[level] * (frames * pixels**2 + pixels * frames**2)
            logits = self.heads[level] * frames * pixels**2
            largest = max(largest, 0.0 if share.flash else float(logits))
        backward, again = 1.0 + trained, float(self.remat)
        blocks = _outputs(self, frames, sizes)
        each = share.clips * share.activation_bytes
        outputs = each * sum(values for _, values in blocks)
        inside = each * sum(KEPT[kind] * values for kind, values in blocks)
        inner = each * max(BLOCK[kind] * values for kind, values in blocks)
        image = self.image
        tokens = image.tokens
        layer = (4 * image.width + 2 * image.hidden) * image.width
        seen = tokens * image.layers * layer + (tokens - 1) * image.patch**2 * 3 * image.width
        return Costs(
            products=(
                Product("backbone", "convolution", ends, float(trained)),
                Product("backbone", "convolution", convolution, backward, again),
                Product("backbone", "linear", linear, backward, again),
                Product("backbone", "attention", attention, 2.0, again + 0.5),
                Product("backbone", "linear", times, 2 * float(trained), again),
                Product("image", "linear", seen + image.width * image.projection),
                Product("image", "attention", 2 * image.layers * tokens**2 * image.width),
            ),
            kept=outputs if self.remat else inside,
            block=inner + 2 * FLOAT * share.clips * min(largest, LOGITS),
            streamed=outputs * (STREAMS[0] * (1 + again) + STREAMS[1]),
        )


def modulated(model: Any) -> bool:
    """Tell whether every frame has a time embedding of its own."""
    return bool(model.control.MODULATES)


def _sizes(config: SVDUNetConfig, height: int, width: int) -> list[tuple[int, int]]:
    """Return the pixels (rows, columns) of each level."""
    sizes = [(height, width)]
    for _ in config.widths[1:]:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    return sizes


def _doubles(config: SVDUNetConfig, path: str, sizes: list[tuple[int, int]]) -> bool:
    """Tell whether a level on the way up leads to one exactly twice its size."""
    level = len(config.widths) - 1 - int(path.split("/", maxsplit=1)[0].removeprefix("up_"))
    return tuple(2 * side for side in sizes[level]) == sizes[level - 1]


def _level(config: SVDUNetConfig, path: str) -> int:
    """Return the level at which a layer works, that of its result where the size changes."""
    name, last = path.split("/", maxsplit=1)[0], len(config.widths) - 1
    resampled = "/resample/" in path
    if name.startswith("down_"):
        return int(name.removeprefix("down_")) + resampled
    if name.startswith("up_"):
        return last - int(name.removeprefix("up_")) - resampled
    return last if name == "mid" else 0


def _vectors(
    config: SVDUNetConfig, path: str, frames: int, sizes: list[tuple[int, int]], apart: bool
) -> float:
    """Return how many vectors of a clip a matrix is multiplied with."""
    if path.startswith(("added_embed", "time_embed")):
        return 1
    if "/time/" in path:
        return frames if apart else 1
    if "/frame_embed/" in path:
        return frames  # of all clips of a batch together
    if "/attn2/" in path:  # of one token, to which all weight goes
        return 0 if path.endswith(("to_q/kernel", "to_k/kernel")) else 1
    return frames * math.prod(sizes[_level(config, path)])


def _attentions(config: SVDUNetConfig) -> list[int]:
    """List the levels of all attentions."""
    found = [len(config.widths) - 1]  # at the bottom
    for level, attends in enumerate(config.attends):
        found += [level] * (attends * (2 * config.resnets[level] + 1))
    return found


def _outputs(
    config: SVDUNetConfig, frames: int, sizes: list[tuple[int, int]]
) -> list[tuple[str, float]]:
    """Return the kind and the number of values of what each block gives."""

    def values(level: int) -> float:
        return float(frames * math.prod(sizes[level]) * config.widths[level])

    found = [("attention", values(level)) for level in _attentions(config)]
    last = len(config.widths) - 1
    for level, count in enumerate(config.resnets):
        found += [("resnet", values(level))] * (2 * count + 1 + 2 * (level == last))
    return found
