"""Functions over any memory: insert frames, render, and read what a clip's cameras see.

============ ============================================ =====================================
kind         content                                      paper
============ ============================================ =====================================
voxel        maximum of features per 3D cell              PEWM
none         nothing                                      NWM (own backbone, empty memory)
images       features of a few covering snapshots         Image Memory (3D-Mem)
map2d        maximum of features per square of the floor  PEWM (2D map)
points       a coloured point per 3D cell, no features    point cloud (ablation of the map)
surfels      a coloured surfel per small cell             –
grid         class ids of cells                           PERSIST
============ ============================================ =====================================

A memory is one class, ``config.parts.Memory``, in a file of its own. Its state is a pytree of
static size. Tokens of all memories have the same shapes, so a reader has the same parameters with
any of them. The functions are pure and handle one world: jit and vmap them.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.config import AssembledModel
from pewm_jax.memory import rendering
from pewm_jax.types import (
    Array,
    Camera,
    EncodedView,
    Frames,
    MemoryReadout,
    Params,
    View,
    WorldState,
)

Memory: TypeAlias = Any
"""A pytree, of the type that the memory's ``empty`` returns."""
NEAR = 1.5
"""Imagined depths below this many times ``clip.near_m`` count as not measured."""


def insert(
    model: AssembledModel,
    params: Params,
    memory: Memory,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
    *,
    observed: bool = True,
) -> Memory:
    """Return the memory after T more frames, colours float in [−1, 1]; see ``Memory.insert``.

    Only ``trusted`` pixels of imagined frames are inserted.
    """
    frames = frames if observed else trusted(model, frames)
    return model.memory.insert(
        model, params, memory, frames, features_ThwF, valid_T, observed=observed
    )


def trusted(model: AssembledModel, frames: Frames) -> Frames:
    """Return imagined frames (..., T) with a depth of 0 where it must not be inserted.

    These pixels are beyond ``memory.imagined_far`` of ``clip.far_m`` (unobserved walls are imagined
    at the end of the range), at the near end of the range (where models put pixels without depth),
    and on both sides of an edge (``memory.imagined_edge``), where the imagined depth lies between
    two surfaces.
    """
    settings, clip = model.memory, model.clip
    depth = jnp.asarray(frames.depth_THW)
    measured = (depth > NEAR * clip.near_m) & jnp.isfinite(depth)
    kept = measured & (depth <= settings.imagined_far * clip.far_m)
    if settings.imagined_edge:
        for axis in (-2, -1):
            ahead = jax.lax.slice_in_dim(depth, 1, None, axis=axis)
            behind = jax.lax.slice_in_dim(depth, 0, -1, axis=axis)
            apart = jnp.abs(ahead - behind) > settings.imagined_edge * jnp.minimum(ahead, behind)
            # Beside a pixel without depth there is no known edge.
            apart = apart & (jnp.minimum(ahead, behind) > NEAR * clip.near_m)
            sides = [(0, 0)] * depth.ndim
            sides[axis] = (1, 0)
            kept = kept & ~jnp.pad(apart, sides)
            sides[axis] = (0, 1)
            kept = kept & ~jnp.pad(apart, sides)
    return dataclasses.replace(frames, depth_THW=jnp.where(kept, depth, 0))


def render(
    model: AssembledModel, memory: Memory, camera: Camera, height: int, width: int
) -> rendering.View:
    """Render the memory for (T,) cameras whose intrinsics are for ``height`` × ``width`` pixels.

    Points are as wide as the cells of ``memory.cell_m``, unless the memory has its own ``render``.
    Large memories are drawn in branches, both of which ``jax.vmap`` computes: render a batch with
    ``jax.lax.map``. The features have ``model.memory.rendered_channels`` channels.
    """
    own = model.memory.render(model, memory, camera, height, width)
    if own is not None:
        return own
    points, features, valid = model.memory.to_points(model, memory)
    shown = features[:, : model.memory.rendered_channels]
    cell_m = model.memory.cell_m
    return rendering.splat_cells(points, shown, cell_m, valid, camera, height, width)


def shows_colours(model: AssembledModel) -> bool:
    """Tell whether the first three channels of the memory's pictures are the colours seen."""
    return model.memory.REMEMBERS and not model.memory.KEEPS_FEATURES


def gated(model: AssembledModel) -> bool:
    """Tell whether the codec's gate blends decoded frames with the rendered memory."""
    gate = bool(getattr(model.codec, "gate", 0))
    return gate and model.clip.depth and shows_colours(model)


def readout(
    model: AssembledModel,
    memory: Memory,
    camera: Camera,
    *,
    params: Params | None = None,
    pictures: bool = False,
    view: View | None = None,
) -> MemoryReadout:
    """Return the part of the memory that the reader needs for one clip of (T,) cameras.

    ``params`` are the world model's; the codec's are used if the reader takes latents. With
    ``pictures`` the view is returned even if the reader does not take it; ``view`` is the
    rendering, if it exists already.
    """
    reader = model.memory.reader
    seen, encoded = None, None
    if reader.READS_TOKENS:
        seen = model.memory.read(model, memory, camera)
    if not (pictures or reader.READS_VIEW):
        view = None
    else:
        if view is None:
            view = render(model, memory, camera, model.clip.height, model.clip.width)
        features = view.features_THWF[..., : model.memory.rendered_channels]
        view = View(features, view.depth_THW, view.seen_THW)
        if reader.READS_LATENTS:
            encoded = encode(model, params or {}, view)
            view = view if pictures else None
    return MemoryReadout(seen, view, encoded)


def encode(model: AssembledModel, params: Params, view: View) -> EncodedView:
    """Encode a view of colours, (T,) images of the clip's size, as the clip's frames are encoded.

    The codec encodes whole images: an unseen pixel gets colour and depth of the nearest seen pixel
    of its image. An image without seen pixels is grey and at ``clip.far_m``.
    """
    whole = rendering.fill_nearest(view)
    depth = jnp.where(whole.depth_THW > 0, whole.depth_THW, model.clip.far_m)
    latents = rgbd.encode_rgbd(model, params, whole.features_THWF[None, ..., :3], depth[None])
    return EncodedView(latents[0], view.seen_THW)


def from_context(
    model: AssembledModel,
    params: Params,
    context: Frames,
    valid_S: Array,
    features_ShwF: Array | None = None,
) -> Memory:
    """Build the memory of one world from the S frames it has seen, colours in [−1, 1].

    The grid is centred on the last valid frame's camera. ``features_ShwF`` are the encoder's, if
    they are known.
    """
    last = jnp.argmax(jnp.where(valid_S, jnp.arange(valid_S.shape[0]), -1))
    memory = model.memory.empty(model, context.camera.world_from_camera[last, :3, 3])
    if features_ShwF is None:
        features = model.memory.encoder.features(model, params, context.rgb_THWC)
    else:
        features = features_ShwF.astype(jnp.float32)
    return insert(model, params, memory, context, features, valid_S)


def edited(model: AssembledModel, state: WorldState, changed: Memory) -> WorldState:
    """Return a state with an edited memory, whose present frame shows the edit.

    The next clip is conditioned on the present frame, which would otherwise still show the erased
    content. Where the renderings of the memory before and after differ, pixels are taken from the
    later one; its holes are filled with the nearest pixels. The frame is unchanged if the memory is
    not rendered in colours.
    """
    frame = state.frame
    if not shows_colours(model):
        return WorldState(frame, changed)
    size = (model.clip.height, model.clip.width)
    before, after = (render(model, m, frame.camera, *size) for m in (state.map, changed))
    apart = jnp.abs(before.features_THWF - after.features_THWF).max(-1) > 1e-3
    apart = apart | (before.seen_THW != after.seen_THW)
    apart = apart | (jnp.abs(before.depth_THW - after.depth_THW) > 1e-3)
    whole = rendering.fill_nearest(after)
    rgb = jnp.where(apart[..., None], whole.features_THWF[..., :3], frame.rgb_THWC)
    depth = jnp.where(apart, whole.depth_THW, frame.depth_THW)
    return WorldState(Frames(rgb, depth, frame.camera), changed)


class MemoryEdits:
    """The methods ``erase`` and ``move`` of assembled worlds whose memory can be edited."""

    def erase(self: Any, params: Params, state: WorldState, box_23: Array) -> WorldState:
        """Erase a box from the memory and the present frame; see ``World.erase``."""
        del params
        return edited(self, state, self.memory.erase(self, state.map, box_23))

    def move(
        self: Any,
        params: Params,
        state: WorldState,
        box_23: Array,
        transform: Array,
        *,
        leave: bool = False,
    ) -> WorldState:
        """Move the content of a box in the memory and the present frame; see ``World.move``."""
        del params
        changed = self.memory.move(self, state.map, box_23, transform, leave=leave)
        return edited(self, state, changed)
