"""What the world ``persist`` keeps of its frames, and what may be known of the next one."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.config import Noise, PersistConfig
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.types import Array, Camera, Params
from pewm_jax.worlds.persist.windows import Shown


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class History:
    """What the networks keep of the frames so far.

    The present voxel frame is not in ``voxels`` yet: it is encoded anew when the next one is made,
    so that what was edited counts.

    Attributes:
        voxels: of the world frames' transformer, up to the frame before the present one.
        cameras: of the camera model, up to the present frame.
        pictures: of the renderer, up to the present frame.
        action_A: the action that led to the present frame.
        shown: the picture that the present voxel frame was shown.
        start_3: int32, first cell of the present window in the world's grid.
    """

    voxels: FrameCache
    cameras: FrameCache
    pictures: FrameCache
    action_A: Array
    shown: Shown
    start_3: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Past:
    """The world before a step.

    Attributes:
        grid: the world's voxels, with their ``History``.
        shown: the present picture as the next voxel frame is shown it.
    """

    grid: ClassGrid
    shown: Shown


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Given:
    """What is known of the frame that a step leads to; None is made by the networks.

    Attributes:
        camera: its camera.
        rgb_HWC: its colours in [−1, 1], with ``depth_HW``.
        depth_HW: its depth, metres.
        classes_XYZ: its voxels, a window at ``start_3``.
        start_3: int32, where that window begins in the world's grid.
    """

    camera: Camera | None = None
    rgb_HWC: Array | None = None
    depth_HW: Array | None = None
    classes_XYZ: Array | None = None
    start_3: Array | None = None


def encoded(model: PersistConfig, params: Params, rgb_HWC: Array, depth_HW: Array) -> Array:
    """Return the latents (h, w, C) of a picture: those of its depth with them, if it has any."""
    both = rgbd.encode_rgbd(model, params, rgb_HWC[None, None], depth_HW[None, None])
    return both[0, 0, ..., : model.picture_channels]


def decoded(model: PersistConfig, params: Params, latents_hwC: Array) -> tuple[Array, Array]:
    """Return colours (H, W, 3) and depth (H, W) of a picture's latents; depth 0 without any."""
    missing = model.codec.channels - latents_hwC.shape[-1]
    latents = jnp.pad(latents_hwC, ((0, 0), (0, 0), (0, missing)))
    rgb, depth = rgbd.decode_rgbd(model, params, latents[None, None])
    return rgb[0, 0], depth[0, 0] if model.clip.depth else jnp.zeros_like(depth[0, 0])


def context(noise: Noise, x0: Array, key: Array) -> tuple[Array, Array]:
    """Return frames (1, 1, …) with the noise that given ones have, and their times."""
    times = jnp.full(x0.shape[:2], getattr(noise, "context_noise", 0.0))
    drawn = jax.random.normal(key, x0.shape, x0.dtype)
    return noise.corrupt(x0, drawn, times), times
