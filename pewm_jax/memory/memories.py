"""Memories of a world: one interface, chosen by the type of the settings.

    memory = empty(model, centre)                          # a grid around the agent
    memory = remember(model, memory, frames, features)     # posed RGB-D frames
    seen = tokens(model, memory, camera)                   # tokens that condition one clip
    sight = look(model, memory, camera)                    # what the model's reader takes of it
    view = render(model, memory, camera, height, width)    # the memory seen by cameras

============ ============================================ =====================================
kind         what it keeps                                paper
============ ============================================ =====================================
voxel        maximum of features per 3D cell              ours
none         nothing                                      NWM (own backbone, empty memory)
images       features of a few covering snapshots         Image Memory (3D-Mem)
map2d        maximum of features per place on the floor   Ours (w/ 2D-Map)
points       a coloured point per 3D cell, no features    point cloud (ablation of the map)
surfels      a coloured surfel per small cell             none: ours alone
============ ============================================ =====================================

A memory is a ``Memory`` and a module (or object) with the functions ``empty``,
``remember``, ``tokens`` and ``to_points``, as they are called below, and optionally ``render``, if
it can show more than its points, and ``erase`` and ``move``, if it can be edited. All memories are
pytrees of static size. Their tokens have the same shapes, so a reader has the same parameters with
any of them. The functions are pure and handle one world: jit and vmap them.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import registry as kinds
from pewm_jax.codecs import rgbd
from pewm_jax.config import ModelConfig, UserError, functions
from pewm_jax.memory import rendering, views
from pewm_jax.types import (
    Array,
    Camera,
    EncodedView,
    Frames,
    MapTokens,
    MemoryReadout,
    Params,
    View,
)

Memory: TypeAlias = Any
"""A pytree, of the type that the memory's ``empty`` returns."""
NEAR = 1.5
"""Imagined depths below this many times ``clip.near_m`` are no measurements."""


def empty(model: ModelConfig, centre_3: Array) -> Memory:
    """Return an empty memory.

    Args:
        model: the model.
        centre_3: (3,) world position that the grid is centred on, metres.
    """
    return functions(model.memory).empty(model, centre_3)


def remember(
    model: ModelConfig,
    memory: Memory,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
    *,
    observed: bool = True,
) -> Memory:
    """Return the memory after T more frames.

    Args:
        model: the model.
        memory: from ``empty`` or from an earlier call.
        frames: T frames, colours float in [−1, 1]; pixels without depth are ignored.
        features_ThwF: (T, h, w, F) their patch features (``encoders.features``).
        valid_T: (T,) bool; False frames are ignored.
        observed: False where the frames were imagined: of these only what is ``trusted`` is
            remembered, and memories that tell (``TELLS_IMAGINED``) are told.
    """
    if not observed:
        frames = trusted(model, frames)
    told = {"observed": observed} if model.memory.TELLS_IMAGINED else {}
    return functions(model.memory).remember(model, memory, frames, features_ThwF, valid_T, **told)


def trusted(model: ModelConfig, frames: Frames) -> Frames:
    """Return imagined frames with a depth of 0 where it is not to be remembered.

    That is beyond ``memory.imagined_far`` of ``clip.far_m`` (walls that were never seen are
    imagined at the end of the range), at the near end of the range (where a model puts what has no
    depth), and on both sides of an edge (``memory.imagined_edge``: there a depth between two
    surfaces is imagined, where nothing is).

    Args:
        model: the model.
        frames: (..., T) frames.
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
            # Beside what has no depth nothing is known of an edge.
            apart = apart & (jnp.minimum(ahead, behind) > NEAR * clip.near_m)
            sides = [(0, 0)] * depth.ndim
            sides[axis] = (1, 0)
            kept = kept & ~jnp.pad(apart, sides)
            sides[axis] = (0, 1)
            kept = kept & ~jnp.pad(apart, sides)
    return dataclasses.replace(frames, depth_THW=jnp.where(kept, depth, 0))


def tokens(model: ModelConfig, memory: Memory, camera: Camera) -> MapTokens:
    """Return the M = ``memory.tokens`` tokens that condition one clip.

    Args:
        model: the model.
        memory: what is remembered.
        camera: (T,) cameras of the clip.
    """
    return functions(model.memory).tokens(model, memory, camera)


def to_points(model: ModelConfig, memory: Memory) -> tuple[Array, Array, Array]:
    """Return the whole memory as ``(points_world_V3, features_VF, valid_V)``.

    V is static; the memory ``none`` has one slot, which is never valid.
    """
    return functions(model.memory).to_points(model, memory)


def render(
    model: ModelConfig, memory: Memory, camera: Camera, height: int, width: int
) -> rendering.View:
    """Render the memory for cameras; nearer things hide farther ones.

    Its points are drawn as wide as the cells of ``memory.cell_m``, unless it has a ``render`` of
    its own. Static shapes; the memory ``none`` shows nothing. Large memories are drawn in branches,
    of which ``jax.vmap`` runs both sides: render a batch by ``jax.lax.map``.

    Args:
        model: the model.
        memory: what is remembered.
        camera: (T,) cameras, whose intrinsics are for images of ``height`` × ``width``.
        height: height of the images, pixels.
        width: width of the images, pixels.

    Returns:
        The view; its features have ``rendered_channels(model)`` channels.
    """
    own = getattr(functions(model.memory), "render", None)
    if own is not None:
        return own(model, memory, camera, height, width)
    points, features, valid = to_points(model, memory)
    shown = features[:, : rendered_channels(model)]
    cell_m = model.memory.cell_m
    return rendering.splat_cells(points, shown, cell_m, valid, camera, height, width)


def trimmed(model: ModelConfig, memory: Memory) -> Memory:
    """Return a memory to look at and not to add to: smaller if it can be, and the same to see.

    On the host, not under jit.
    """
    own = getattr(functions(model.memory), "trimmed", None)
    return memory if own is None else own(memory)


def editable(model: ModelConfig) -> bool:
    """Tell whether boxes of the memory can be erased and moved."""
    return hasattr(functions(model.memory), "erase") and hasattr(functions(model.memory), "move")


def erase(model: ModelConfig, memory: Memory, box_23: Array) -> Memory:
    """Forget what is in a box, as if nothing had ever been seen there.

    Args:
        model: the model.
        memory: what is remembered.
        box_23: (2, 3) lower and upper corner in the world, metres; a point on an upper face is
            outside.

    Raises:
        UserError: the box is not a box, or this memory cannot be edited.
    """
    _require_editable(model)
    return functions(model.memory).erase(model, memory, box_23)


def move(
    model: ModelConfig, memory: Memory, box_23: Array, transform: Array, *, leave: bool = False
) -> Memory:
    """Move what is in a box, and what the model imagines there with it.

    Args:
        model: the model.
        memory: what is remembered.
        box_23: as for ``erase``.
        transform: (4, 4) rigid, from old to new positions, metres.
        leave: leave what is in the box where it is, too: a copy.

    Raises:
        UserError: as for ``erase``, or the transform is not a rigid 4×4.
    """
    _require_editable(model)
    return functions(model.memory).move(model, memory, box_23, transform, leave=leave)


def _require_editable(model: ModelConfig) -> None:
    """Refuse a memory without the two functions of editing."""
    if not editable(model):
        name = kinds.of(model.memory).name
        raise UserError(
            f"the memory {name!r} keeps no places that could be edited: use a model that remembers "
            "surfels or voxels."
        )


def rendered_channels(model: ModelConfig) -> int:
    """Return the channels of the pictures that ``render`` gives."""
    return model.memory.rendered_channels


def shows_colours(model: ModelConfig) -> bool:
    """Tell whether the first three channels of the memory's pictures are the colours seen."""
    return model.memory.REMEMBERS and not model.memory.KEEPS_FEATURES


def gated(model: ModelConfig) -> bool:
    """Tell whether the codec's gate mixes what is decoded with what the memory looks like."""
    gate = bool(getattr(model.codec, "gate", 0))
    return gate and model.clip.depth and shows_colours(model)


def look(
    model: ModelConfig,
    memory: Memory,
    camera: Camera,
    *,
    params: Params | None = None,
    pictures: bool = False,
    view: View | None = None,
) -> MemoryReadout:
    """Return what the memory shows one clip, as far as the reader asks for it.

    Args:
        model: the model.
        memory: what is remembered.
        camera: (T,) cameras of the clip, whose intrinsics are for images of its size.
        params: the world model's parameters; those of the codec are used if the reader takes
            latents, and they may be left out if it does not.
        pictures: give the view even if the reader does not take it.
        view: what ``render`` gives for these cameras, if it was made beforehand.
    """
    reader = model.memory.reader
    seen, encoded = None, None
    if reader.READS_TOKENS:
        seen = tokens(model, memory, camera)
    if not (pictures or reader.READS_VIEW):
        view = None
    else:
        if view is None:
            view = render(model, memory, camera, model.clip.height, model.clip.width)
        features = view.features_THWF[..., : rendered_channels(model)]
        view = View(features, view.depth_THW, view.seen_THW)
        if reader.READS_LATENTS:
            encoded = encode(model, params or {}, view)
            view = view if pictures else None
    return MemoryReadout(seen, view, encoded)


def encode(model: ModelConfig, params: Params, view: View) -> EncodedView:
    """Encode a view of colours as the clip's frames are encoded.

    The codec knows whole images: a pixel that shows nothing gets colour and depth of the nearest
    pixel of its image that shows something. An image that shows nothing is grey and at
    ``clip.far_m``.

    Args:
        model: the model.
        params: the world model's parameters; those of the codec are used.
        view: (T,) images of the clip's size; the first 3 features are colours.
    """
    whole = views.fill_nearest(view)
    depth = jnp.where(whole.depth_THW > 0, whole.depth_THW, model.clip.far_m)
    latents = rgbd.encode_rgbd(model, params, whole.features_THWF[None, ..., :3], depth[None])
    return EncodedView(latents[0], view.seen_THW)


def from_context(
    model: ModelConfig,
    params: Params,
    context: Frames,
    valid_S: Array,
    features_ShwF: Array | None = None,
) -> Memory:
    """Build the memory of one world from the frames it has seen.

    The grid is centred on the last valid frame's camera.

    Args:
        model: the model.
        params: the world model's parameters; those that make features (``encoders.weights``) are
            used.
        context: S frames of one world, colours in [−1, 1].
        valid_S: (S,) bool, False frames are ignored.
        features_ShwF: (S, h, w, F) the encoder's features of the frames, if they are known.
    """
    last = jnp.argmax(jnp.where(valid_S, jnp.arange(valid_S.shape[0]), -1))
    memory = empty(model, context.camera.world_from_camera[last, :3, 3])
    if features_ShwF is None:
        features = model.memory.encoder.features(model, params, context.rgb_THWC)
    else:
        features = features_ShwF.astype(jnp.float32)
    return remember(model, memory, context, features, valid_S)


def colours(model: ModelConfig, features_VF: Array) -> np.ndarray:
    """Return (V, 3) colours in [−1, 1] in which the memory's points are drawn."""
    values = np.asarray(features_VF)
    if not model.memory.KEEPS_FEATURES or not len(values):
        return values[..., :3]
    return model.memory.encoder.colours(values)
