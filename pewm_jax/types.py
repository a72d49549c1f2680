"""The library's data types (pytrees), and the letters that name array axes.

Letters: B batch, T frames, S context frames, H W pixels, t h w latent grid, C channels,
N video tokens, M map tokens, L text tokens, D width, K heads, V map slots, F map features,
A components of an action, X Y Z voxels.

Conventions, used everywhere:

* Camera axes are OpenCV's (x right, y down, z forward). ``world_from_camera`` is a 4×4 rigid
  transform in metres. The world is gravity-aligned with z up.
* ``intrinsics`` are ``(fx, fy, cx, cy)`` in pixels, pixel centres at +0.5: the centre of the
  top-left pixel is (0.5, 0.5), an image of width W spans u in [0, W].
* Depth is z in metres (not the length of the ray); 0 means "no measurement".
* Action k leads from frame k to frame k + 1, so T frames have T − 1 actions. A planar action is
  (dx, dy, dyaw): metres forward, metres left, radians counter-clockwise; first move, then turn.
* Colours are uint8 in [0, 255] on disk and in batches, float32 in [−1, 1] inside the networks.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeAlias

import jax

Array: TypeAlias = Any
"""A JAX or NumPy array (batches start as NumPy and become JAX arrays under jit)."""
Params: TypeAlias = dict[str, Any]
"""Network parameters: plain nested dictionaries of arrays."""


def _pytree(cls):
    """Register a frozen dataclass as a pytree whose fields are all children."""
    names = [field.name for field in dataclasses.fields(cls)]
    return jax.tree_util.register_dataclass(cls, data_fields=names, meta_fields=[])


@_pytree
@dataclasses.dataclass(frozen=True)
class Camera:
    """Pinhole cameras, any leading shape.

    Attributes:
        intrinsics_4: (..., 4) fx, fy, cx, cy in pixels, centres at +0.5.
        world_from_camera: (..., 4, 4) camera-to-world, OpenCV axes, metres.
    """

    intrinsics_4: Array
    world_from_camera: Array


@_pytree
@dataclasses.dataclass(frozen=True)
class Frames:
    """Posed RGB-D frames, any leading shape before T.

    Attributes:
        rgb_THWC: (..., T, H, W, 3) uint8 in [0, 255], or float32 in [−1, 1].
        depth_THW: (..., T, H, W) float32 metres along z, 0 = no measurement.
        camera: cameras of leading shape (..., T).
    """

    rgb_THWC: Array
    depth_THW: Array
    camera: Camera


@_pytree
@dataclasses.dataclass(frozen=True)
class Control:
    """Input that steers a clip, any leading shape before T.

    Attributes:
        camera: cameras of leading shape (..., T): the observed frame's, then those to imagine.
        actions_TA: (..., T − 1, A) actions, or None if only cameras are known.
        state_A: (..., A) the agent's own state at the observed frame, such as the angles of its
            joints; None if it is unknown.
    """

    camera: Camera
    actions_TA: Array | None = None
    state_A: Array | None = None


@_pytree
@dataclasses.dataclass(frozen=True)
class Clip:
    """A training example, or a batch: frames to imagine, and frames seen before.

    Attributes:
        frames: T frames; frame 0 is observed, the others are to be generated.
        context: S earlier frames of the same episode, from which the memory is built.
        context_valid_S: (..., S) bool, False for padding, if the episode has fewer earlier frames.
        actions_TA: (..., T − 1, A) float32, action k leads from frame k to frame k + 1 of the clip;
            None if none were recorded (hand-held cameras). A = 3 is a planar action.
        extras: further arrays by name. Recorded ones are those that the world's ``batch_spec``
            names; a name is absent if the data do not have the array:

            * ``classes_TXYZ`` (..., T, n, n, n) integer class ids of the cells around the agent at
              each frame, 0 for an empty cell; with ``origin_T3`` (..., T, 3) float32 world position
              of each grid's lowest corner, metres;
            * ``context_features_ShwF`` (..., S, h, w, F) cached image features of the context;
            * ``state_A`` (..., A) the agent's own state at frame 0, such as its joints' angles.

            A stage's ``prepare`` adds what it computes from frozen weights, under names of its
            world (``worlds.objective.prepare``: ``latents_thwC``, ``readout`` and
            ``everywhere_thwC``).
    """

    frames: Frames
    context: Frames
    context_valid_S: Array
    actions_TA: Array | None = None
    extras: dict[str, Any] = dataclasses.field(default_factory=dict)

    def without_context(self) -> Clip:
        """Return a batch of clips with S = 0 context frames."""
        context = jax.tree.map(lambda x: x[:, :0], self.context)
        return dataclasses.replace(
            self, context=context, context_valid_S=self.context_valid_S[:, :0]
        )

    def with_extras(self, **arrays: Any) -> Clip:
        """Return the clip with extras added or replaced; None removes one."""
        extras = {k: v for k, v in (self.extras | arrays).items() if v is not None}
        return dataclasses.replace(self, extras=extras)


@_pytree
@dataclasses.dataclass(frozen=True)
class VoxelMap:
    """A sparse voxel feature map with static capacity (see ``pewm_jax.memory.voxel_map``).

    Attributes:
        cell_of_slot_V: (V,) int32, cell numbers in increasing order; free slots, last, hold the
            number of cells of the grid.
        features_VF: (V, F) float, maximum per cell, −inf in free slots.
        origin_3: (3,) float32, world position of the grid's lower corner, metres.
        occupied: () int32, number of slots in use.
        dropped: () int32, cells that did not fit into the capacity, summed over insertions.
        outside: () int32, points that fell outside the grid's extent.
    """

    cell_of_slot_V: Array
    features_VF: Array
    origin_3: Array
    occupied: Array
    dropped: Array
    outside: Array


@_pytree
@dataclasses.dataclass(frozen=True)
class MapTokens:
    """A fixed number of occupied cells, to which the denoiser attends.

    Attributes:
        features_MF: (..., M, F) cell features, 0 where masked.
        points_world_M3: (..., M, 3) cell centres in the world, metres.
        valid_M: (..., M) bool.
    """

    features_MF: Array
    points_world_M3: Array
    valid_M: Array


@_pytree
@dataclasses.dataclass(frozen=True)
class View:
    """The images of T cameras, rendered from points, any leading shape before T.

    Attributes:
        features_THWF: (..., T, H, W, F) features of the nearest point at each pixel, 0 without one.
        depth_THW: (..., T, H, W) its depth along z, metres, 0 without one; where only the back of
            something is known, which is not seen, the depth of that.
        seen_THW: (..., T, H, W) bool, whether a point is seen at the pixel.
    """

    features_THWF: Array
    depth_THW: Array
    seen_THW: Array


@_pytree
@dataclasses.dataclass(frozen=True)
class EncodedView:
    """The images of T cameras as latents of the codec, any leading shape before t or T.

    Attributes:
        latents_thwC: (..., t, h, w, C) latents of colour and depth, holes filled.
        seen_THW: (..., T, H, W) bool, whether a point is at the pixel.
    """

    latents_thwC: Array
    seen_THW: Array


@_pytree
@dataclasses.dataclass(frozen=True)
class MemoryReadout:
    """A memory's readout for one clip, or each clip of a batch; unused parts are None.

    Attributes:
        tokens: the points that the clip's cameras see, for attention.
        view: the memory rendered for each of the clip's cameras, at the clip's size.
        encoded: the same, encoded by the codec.
    """

    tokens: MapTokens | None = None
    view: View | None = None
    encoded: EncodedView | None = None


@_pytree
@dataclasses.dataclass(frozen=True)
class WorldState:
    """The state that a rollout carries from one clip to the next.

    Attributes:
        frame: the last frame, T = 1, rgb float32 in [−1, 1].
        map: the memory of everything seen or imagined so far: a ``VoxelMap``, or another kind
            (see ``pewm_jax.memory.interface``); in the world ``egowm`` the frames before the last,
            in ``persist`` the voxels.
    """

    frame: Frames
    map: Any
