"""Rendering as a memory reader: each frame's tokens get the memory rendered for its camera.

The rendered views (``view`` of a ``MemoryReadout``) are folded into the cells of the latents by
space-to-depth without encoding. Each video token gets its pixels: colours or features, depth and a
mask. A backbone that embeds its input cell by cell also gets the pixels of each cell. With
``picture`` `latents`, tokens get the codec's latents of the views (``encoded``), 0 in unseen cells,
and the mask. They are added to the embedded tokens through a layer that starts at zero, and given
to a block without attention after every block of the backbone (``RenderBlock``), by which a frozen
backbone learns to use them. A fresh reader, or an empty view, changes nothing.

Parameters, under ``render``: ``reduce`` (views of many channels), ``embed_1``, ``embed_2``,
``added``, and the stacked ``blocks``; ``cell_1`` and ``cell_2`` for backbones with cells. The
reader ``both`` has these and those of the attention.
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
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.geometry import init_stacked, pad_time
from pewm_jax.types import Array, Camera, MemoryReadout, Params, View


class RenderBlock(nn.Module):
    """Adds the rendered memory to the video tokens of the same pixels; no attention."""

    mlp_ratio: int
    """Hidden channels over the tokens' width."""
    layout: TokenLayout
    """The order of the video tokens."""

    @nn.compact
    def __call__(self, video_BND: Array, time_BE: Array, picture_BNW: Array) -> Array:
        """Return the updated video tokens (B, N, D) for the embedded view (B, N, W) at each token.

        The time embedding is (B, E), or (B, t, E), one for each token in time.
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
CELLS = ("cell_1", "cell_2")
"""The layers between the views and the cells of a backbone that embeds its input cell by cell."""

_RULES = (
    (r"memory/render/blocks/(linear|up)/kernel", P("fsdp", "tensor")),
    (r"memory/render/blocks/(linear|up)/bias", P("tensor")),
    (r"memory/render/blocks/down/kernel", P("tensor", "fsdp")),
    (r"memory/render/blocks/(down/bias|norm/(scale|bias))", REPLICATED),
    (r"memory/render/(embed_[12]|cell_[12]|added)/kernel", P(None, "fsdp")),
    (r"memory/render/(reduce/(kernel|bias)|(embed_[12]|cell_[12]|added)/bias)", REPLICATED),
)


def _settings(model: AssembledModel) -> RenderConfig:
    return model.memory.reader  # type: ignore[return-value]


def _reduces(model: AssembledModel) -> bool:
    config = _settings(model)
    return not config.READS_LATENTS and model.memory.rendered_channels > config.reduced


def pixel_channels(model: AssembledModel) -> int:
    """Return the channels of a pixel of the views: features, depth and mask."""
    return min(model.memory.rendered_channels, _settings(model).reduced) + 2


def cell_channels(model: AssembledModel) -> int:
    """Return the channels of the input of one latent cell; see ``cells``."""
    codec = model.codec
    pixels = codec.temporal * codec.spatial**2
    latents = _settings(model).READS_LATENTS
    return codec.channels + pixels if latents else pixel_channels(model) * pixels


def token_channels(model: AssembledModel) -> int:
    """Return the channels of the part of the views that belongs to one video token."""
    places = model.backbone.places
    return cell_channels(model) * places.patch_t * places.patch**2


def _embeddings(model: AssembledModel) -> dict[str, modules.Dense]:
    """Return the linear layers between views and tokens, by name."""
    config, dtype = _settings(model), jnp.dtype(model.dtype)
    found = {"embed_1": config.picture_width, "embed_2": config.picture_width}
    made = {name: modules.dense(width, dtype, name) for name, width in found.items()}
    places = model.backbone.places
    made["added"] = modules.dense(places.width, dtype, "added", zero=True)
    if places.cell_width:
        for name in CELLS:
            made[name] = modules.dense(places.cell_width, dtype, name, zero=name == CELLS[-1])
    if _reduces(model):
        made["reduce"] = modules.dense(config.reduced, dtype, "reduce")
    return made


def pictures(model: AssembledModel, params: Params, view: View) -> Array:
    """Return (B, T, H, W, C) the input of each pixel: features where seen, depth, the mask.

    Depth is also used where only the back of a surface is known. ``params`` are those under
    ``render``.
    """
    seen, dtype = view.seen_THW[..., None], jnp.dtype(model.dtype)
    features: Array = jnp.where(seen, view.features_THWF, 0).astype(dtype)
    if _reduces(model):
        features = _apply(model, params, "reduce", features)
    depth = signal_from_depth(model.clip, view.depth_THW)
    depth = jnp.where(view.depth_THW > 0, depth, 0)[..., None]
    return jnp.concatenate([x.astype(dtype) for x in (features, depth, seen)], -1)


def cells(model: AssembledModel, params: Params, readout: MemoryReadout) -> tuple[Array, Array]:
    """Return the input of each cell of the latents, and the clips that see anything.

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
    """Apply one of the layers between views and tokens."""
    return _embeddings(model)[name].apply({"params": params[name]}, x)


@dataclasses.dataclass(frozen=True)
class RenderConfig(Reader):
    """The memory rendered for each frame's camera, added to the video tokens of the same pixels."""

    SHARDING: ClassVar[Rules] = _RULES

    READS_TOKENS: ClassVar[bool] = False
    READS_VIEW: ClassVar[bool] = True

    picture: Literal["pixels", "latents"] = "pixels"
    """Input of a token: its `pixels` of the rendered memory, or the codec's `latents` of them,
    holes filled; latents only for memories that show colours."""
    picture_width: int = 128
    """Channels of a token's embedded part of the rendered memory."""
    reduced: int = 8
    """Renderings with more channels are first reduced to this number, at every pixel."""
    blocks: bool = True
    """Also give the rendering to a memory block after every block of the backbone; else only to its
    input."""
    mlp_ratio: int = 2
    """Hidden channels of such a block over model width."""

    @property
    def READS_LATENTS(self) -> bool:  # noqa: N802  # type: ignore[override]
        """Whether it takes the view as latents of the codec."""
        return self.picture == "latents"

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be folded as the views are, and latents of features."""
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
            "cell_1": cell_channels(model),
            "cell_2": places.cell_width,
        }
        params: Params = {}
        layers = _embeddings(model)
        names = [*sorted(set(layers) - set(CELLS)), *(name for name in CELLS if name in layers)]
        for place, name in enumerate(names):
            # Layers without cells have the keys of versions that had no others.
            number = place + len(widths) * (name in CELLS)
            example = jnp.zeros((1, widths[name]))
            params[name] = layers[name].init(jax.random.fold_in(key, number), example)["params"]
        if self.blocks:
            example = (
                jnp.zeros((1, 1, places.width)),
                jnp.zeros((1, places.time)),
                jnp.zeros((1, 1, self.picture_width)),
            )
            block = RenderBlock(self.mlp_ratio, TokenLayout(1, 0, 1, 1))
            blocks_key = jax.random.fold_in(key, len(widths) - len(CELLS))
            params["blocks"] = init_stacked(block, blocks_key, places.count, example)
        return {"render": params}

    def prepare(
        self,
        model: AssembledModel,
        params: Params,
        readout: MemoryReadout,
        camera: Camera,
        rays_BthwC: Array,
    ) -> Readers:
        """Embed the memory's views."""
        del camera, rays_BthwC  # the views are those of these cameras
        places, weights = model.backbone.places, params["render"]
        embed = functools.partial(_apply, model, weights)
        layout = TokenLayout.for_mesh(text_tokens(model), *video_tokens(model))

        read_BthwC, seen_B = cells(model, weights, readout)
        patches = patchify(pad_time(read_BthwC, places.patch_t), places.patch, places.patch_t)
        picture: Array = embed("embed_2", jax.nn.silu(embed("embed_1", patches)))
        # A clip whose cameras see nothing of the memory is not changed.
        shown = (seen_B | (not model.memory.REMEMBERS))[:, None, None]
        added = layout.spread(jnp.where(shown, embed("added", picture), 0))
        at_cells = None
        if places.cell_width:
            at_cells = embed("cell_2", jax.nn.silu(embed("cell_1", read_BthwC)))
            at_cells = jnp.where(shown[..., None, None], at_cells, 0)
        if not self.blocks:
            return Readers(added_BND=added, added_BthwC=at_cells)
        picture = layout.spread(picture)
        block = RenderBlock(self.mlp_ratio, layout)

        def read(layer: Params, video: Array, time: Array) -> Array:
            out: Array = block.apply({"params": layer}, video, time, picture)
            return jnp.where(shown, out, video)

        return Readers(read, weights["blocks"], added, at_cells)

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.reader", "picture_width", "reduced", "mlp_ratio")
        require(
            self.picture in ("pixels", "latents"),
            f"memory.reader.picture is {self.picture!r}; choose pixels or latents.",
        )


@dataclasses.dataclass(frozen=True)
class BothConfig(AttentionConfig, RenderConfig):
    """Cross-attention, then rendering, at every injection point."""

    SHARDING: ClassVar[Rules] = (*AttentionConfig.SHARDING, *RenderConfig.SHARDING)

    READS_TOKENS: ClassVar[bool] = True
    READS_VIEW: ClassVar[bool] = True

    def init(self, model: AssembledModel, key: Array) -> Params:
        """Return random parameters of both; the attention's are those that it has alone."""
        rendering = RenderConfig.init(self, model, jax.random.fold_in(key, 1))
        return {**AttentionConfig.init(self, model, key), **rendering}

    def prepare(
        self,
        model: AssembledModel,
        params: Params,
        readout: MemoryReadout,
        camera: Camera,
        rays_BthwC: Array,
    ) -> Readers:
        """Prepare both."""
        attend = AttentionConfig.prepare(self, model, params, readout, camera, rays_BthwC)
        render = RenderConfig.prepare(self, model, params, readout, camera, rays_BthwC)
        if render.block is None:
            return dataclasses.replace(
                attend, added_BND=render.added_BND, added_BthwC=render.added_BthwC
            )

        def read(layer: Params, video: Array, time: Array) -> Array:
            assert attend.block is not None
            assert render.block is not None
            video = attend.block(layer["attend"], video, time)
            return render.block(layer["render"], video, time)

        stacked = {"attend": attend.params, "render": render.params}
        return Readers(read, stacked, render.added_BND, render.added_BthwC)

    def check(self, model: Any) -> None:
        """Refuse what either of the two refuses."""
        AttentionConfig.check(self, model)
        RenderConfig.check(self, model)

    def __post_init__(self):
        """Validate."""
        AttentionConfig.__post_init__(self)
        RenderConfig.__post_init__(self)
