"""Rendering as a memory reader: each frame's tokens get what the memory looks like from there.

The memory's pictures (``view`` of a ``MemoryReadout``) are gathered into the cells of the latents
by space-to-depth and are not encoded. Each video token gets the pixels that it stands for: colours
or features, depth and a mask. Or, where ``picture`` is `latents`, it gets the latents that the
codec makes of the pictures (``encoded``), 0 in cells of which nothing is seen, and the mask. Either
is added to the embedded tokens through a layer that starts at zero, and given to a block without
attention after every block of the backbone (``render_block``), by which a frozen backbone learns to
use it. A fresh reader changes nothing, and one that sees nothing never does.

Parameters, under ``render``: ``reduce`` (pictures of many channels), ``embed_1``, ``embed_2``,
``added``, and the stacked ``blocks``.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs.pixel import fold
from pewm_jax.codecs.signals import signal_from_depth
from pewm_jax.config import AssembledModel
from pewm_jax.config.parts import Reader, Rules
from pewm_jax.errors import require, require_positive
from pewm_jax.models.interface import Readers
from pewm_jax.nn import layers, modules, placement
from pewm_jax.nn.tokens import TokenLayout, patchify, text_tokens, video_tokens
from pewm_jax.types import Array, Camera, MemoryReadout, Params, View


class RenderBlock(nn.Module):
    """Adds to video tokens what a rendered memory shows at their place; no attention."""

    mlp_ratio: int
    """Hidden channels over the tokens' width."""
    layout: TokenLayout
    """The order of the video tokens."""

    @nn.compact
    def __call__(self, video_BND: Array, time_BE: Array, picture_BNW: Array) -> Array:
        """Return the updated video tokens.

        Args:
            video_BND: (B, N, D) hidden states H.
            time_BE: (B, E) time embedding, or (B, t, E), one for each token in time.
            picture_BNW: (B, N, W) the embedded part of the picture at each token.
        """
        dtype, width = video_BND.dtype, video_BND.shape[-1]
        modulation = modules.dense(3 * width, dtype, "linear", zero=True)(nn.silu(time_BE))
        modulation = placement.constrain(modulation, "batch")
        if time_BE.ndim == 3:
            modulation = self.layout.per_token(modulation)
        shift, scale, gate = jnp.split(modulation, 3, -1)
        normed = layers.modulate(modules.layer_norm(video_BND, "norm"), shift, scale)
        joined = placement.constrain(jnp.concatenate([normed, picture_BNW], -1), "batch", "tokens")
        hidden = modules.dense(self.mlp_ratio * width, dtype, "up")(joined)
        hidden = nn.gelu(placement.constrain(hidden, "batch", "tokens", "hidden"), approximate=True)
        mixed = modules.dense(width, dtype, "down")(hidden)
        return placement.constrain(video_BND + layers.to_tokens(gate) * mixed, "batch", "tokens")


REPLICATED = P()

_RULES = (
    (r"memory/render/blocks/(linear|up)/kernel", P("fsdp", "tensor")),
    (r"memory/render/blocks/(linear|up)/bias", P("tensor")),
    (r"memory/render/blocks/down/kernel", P("tensor", "fsdp")),
    (r"memory/render/blocks/(down/bias|norm/(scale|bias))", REPLICATED),
    (r"memory/render/(embed_[12]|added)/kernel", P(None, "fsdp")),
    (r"memory/render/(reduce/(kernel|bias)|(embed_[12]|added)/bias)", REPLICATED),
)


def _settings(model: AssembledModel) -> RenderConfig:
    return model.memory.reader  # type: ignore[return-value]


def _reduces(model: AssembledModel) -> bool:
    config = _settings(model)
    return not config.READS_LATENTS and model.memory.rendered_channels > config.reduced


def pixel_channels(model: AssembledModel) -> int:
    """Return the channels of a pixel of the pictures: features, depth and mask."""
    return min(model.memory.rendered_channels, _settings(model).reduced) + 2


def cell_channels(model: AssembledModel) -> int:
    """Return the channels of what is read at a cell of the latents; see ``cells``."""
    codec = model.codec
    pixels = codec.temporal * codec.spatial**2
    latents = _settings(model).READS_LATENTS
    return codec.channels + pixels if latents else pixel_channels(model) * pixels


def token_channels(model: AssembledModel) -> int:
    """Return the channels of the part of the pictures that one video token stands for."""
    places = model.backbone.places
    return cell_channels(model) * places.patch_t * places.patch**2


def _embeddings(model: AssembledModel) -> dict[str, modules.nn.Dense]:
    """Return the linear layers on the way from pictures to tokens, by name."""
    config, dtype = _settings(model), jnp.dtype(model.dtype)
    found = {"embed_1": config.picture_width, "embed_2": config.picture_width}
    made = {name: modules.dense(width, dtype, name) for name, width in found.items()}
    made["added"] = modules.dense(model.backbone.places.width, dtype, "added", zero=True)
    if _reduces(model):
        made["reduce"] = modules.dense(config.reduced, dtype, "reduce")
    return made


def pictures(model: AssembledModel, params: Params, view: View) -> Array:
    """Return (B, T, H, W, C) what is read of pictures: features where seen, depth, the mask.

    Depth is also read where only the back of something is known, a wall of the room next door.

    Args:
        model: the model.
        params: the reader's parameters under ``render``.
        view: (B, T) pictures; features that they hold where nothing is seen are not read.
    """
    seen, dtype = view.seen_THW[..., None], jnp.dtype(model.dtype)
    features: Array = jnp.where(seen, view.features_THWF, 0).astype(dtype)
    if _reduces(model):
        features = _apply(model, params, "reduce", features)
    depth = signal_from_depth(model.clip, view.depth_THW)
    depth = jnp.where(view.depth_THW > 0, depth, 0)[..., None]
    return jnp.concatenate([x.astype(dtype) for x in (features, depth, seen)], -1)


def cells(model: AssembledModel, params: Params, readout: MemoryReadout) -> tuple[Array, Array]:
    """Return what is read at each cell of the latents, and which clips see anything.

    Args:
        model: the model.
        params: the reader's parameters under ``render``.
        readout: of a batch; what it holds where nothing is seen is not read.

    Returns:
        ``(cells_BthwC, seen_B)``: the pixels of each cell (see ``pictures``), or its latents and
        the mask of its pixels.
    """
    fold_cells = functools.partial(fold, spatial=model.codec.spatial, temporal=model.codec.temporal)
    if not _settings(model).READS_LATENTS:
        view = readout.view
        assert view is not None
        return fold_cells(pictures(model, params, view)), view.seen_THW.any((1, 2, 3))
    encoded, dtype = readout.encoded, jnp.dtype(model.dtype)
    assert encoded is not None
    seen = fold_cells(encoded.seen_THW[..., None])
    latents = jnp.where(seen.any(-1, keepdims=True), encoded.latents_thwC, 0)
    joined = jnp.concatenate([latents.astype(dtype), seen.astype(dtype)], -1)
    return joined, encoded.seen_THW.any((1, 2, 3))


def _apply(model: AssembledModel, params: Params, name: str, x: Array) -> Array:
    """Apply one of the layers on the way from pictures to tokens."""
    return _embeddings(model)[name].apply({"params": params[name]}, x)


@dataclasses.dataclass(frozen=True)
class RenderConfig(Reader):
    """What the memory looks like from each frame's camera, given to the video tokens there."""

    SHARDING: ClassVar[Rules] = _RULES

    READS_TOKENS: ClassVar[bool] = False
    READS_VIEW: ClassVar[bool] = True

    picture: Literal["pixels", "latents"] = "pixels"
    """What a token gets of the picture: the `pixels` that it stands for, or the `latents` that the
    codec makes of them, holes filled; these only of memories that show colours."""
    picture_width: int = 128
    """Channels of a token's part of the picture, embedded."""
    reduced: int = 8
    """Pictures of more channels are first reduced to this many, at every pixel."""
    blocks: bool = True
    """Also give the picture to a memory block after every block of the backbone; else only to its
    input."""
    mlp_ratio: int = 2
    """Hidden channels of such a block over model width."""

    @property
    def READS_LATENTS(self) -> bool:  # noqa: N802  # type: ignore[override]
        """Whether it takes the picture as the codec encodes it."""
        return self.picture == "latents"

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be folded as the pictures are, and latents of features."""
        clip, q = model.clip, model.codec.temporal
        require(
            (clip.frames - 1) % q == 0,
            f"clip.frames is {clip.frames}: the memory's pictures are folded by codec.temporal = "
            f"{q}, so use {q}k + 1 frames, or memory.reader.kind attend.",
        )
        require(
            self.picture == "pixels" or not model.memory.KEEPS_FEATURES,
            "memory.reader.picture is latents, which the codec makes of colours, and this memory "
            "shows features: use memory.kind surfels or points, or memory.reader.picture pixels.",
        )

    def init(self, model: AssembledModel, key: Array) -> Params:
        """Return random parameters, under ``render``; gates and ``added`` are zero."""
        places = model.backbone.places
        widths = {
            "embed_1": token_channels(model),
            "embed_2": self.picture_width,
            "added": self.picture_width,
            "reduce": model.memory.rendered_channels,
        }
        params: Params = {}
        for place, (name, layer) in enumerate(sorted(_embeddings(model).items())):
            example = jnp.zeros((1, widths[name]))
            params[name] = layer.init(jax.random.fold_in(key, place), example)["params"]
        if self.blocks:
            example = (
                jnp.zeros((1, 1, places.width)),
                jnp.zeros((1, places.time)),
                jnp.zeros((1, 1, self.picture_width)),
            )
            block = RenderBlock(self.mlp_ratio, TokenLayout(1, 0, 1, 1))
            params["blocks"] = jax.vmap(lambda k: block.init(k, *example)["params"])(
                jax.random.split(jax.random.fold_in(key, len(widths)), places.count)
            )
        return {"render": params}

    def prepare(
        self,
        model: AssembledModel,
        params: Params,
        readout: MemoryReadout,
        camera: Camera,
        rays_BthwC: Array,
    ) -> Readers:
        """Embed the memory's pictures; see ``readers``."""
        del camera, rays_BthwC  # the pictures are what these cameras see
        places, weights = model.backbone.places, params["render"]
        embed = functools.partial(_apply, model, weights)
        layout = TokenLayout.for_mesh(text_tokens(model), *video_tokens(model))

        read_BthwC, seen_B = cells(model, weights, readout)
        missing = -read_BthwC.shape[1] % places.patch_t
        read_BthwC = jnp.concatenate([read_BthwC[:, :1]] * missing + [read_BthwC], 1)
        patches = patchify(read_BthwC, places.patch, places.patch_t)
        picture: Array = embed("embed_2", jax.nn.silu(embed("embed_1", patches)))
        # A clip whose cameras see nothing of the memory is left alone.
        shown = (seen_B | (not model.memory.REMEMBERS))[:, None, None]
        added = layout.spread(jnp.where(shown, embed("added", picture), 0))
        if not self.blocks:
            return Readers(added_BND=added)
        picture = layout.spread(picture)
        block = RenderBlock(self.mlp_ratio, layout)

        def read(layer: Params, video: Array, time: Array) -> Array:
            out: Array = block.apply({"params": layer}, video, time, picture)
            return jnp.where(shown, out, video)

        return Readers(read, weights["blocks"], added)

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.reader", "picture_width", "reduced", "mlp_ratio")
        require(
            self.picture in ("pixels", "latents"),
            f"memory.reader.picture is {self.picture!r}; choose pixels or latents.",
        )
