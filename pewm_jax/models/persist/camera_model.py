"""The camera model of PERSIST: the camera step of an action, given the voxels around the agent.

A frame is one token: the classes of the innermost voxels and the camera before the action. The
action modulates the blocks, which attend over time. The output is the step to the next camera
(``geometry.actions``); it learns by mean squared error (arXiv 2603.03482).

Parameters: ``classes, voxels, camera, action, blocks (stacked over layers), modulate_out,
proj_out``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp

from pewm_jax.errors import UserError
from pewm_jax.geometry.actions import CAMERA_NUMBERS, CAMERA_STEP_NUMBERS
from pewm_jax.models.persist import blocks as frame_blocks
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.models.persist.config import CameraModelConfig
from pewm_jax.nn.parameters import Leaf, linear
from pewm_jax.types import Array, Params

PARTS = ("time",)
SHARDING = frame_blocks.rules("camera_model")
"""Rules over the paths of its parameters under ``camera_model``."""


def ends(config: CameraModelConfig) -> Iterator[Leaf]:
    """Yield path and shape of the parameters around the blocks."""
    width = config.blocks.width
    yield "classes/kernel", (config.classes, config.embed)
    yield from frame_blocks.mlp_shapes("voxels", config.inner**3 * config.embed, width)
    yield from frame_blocks.mlp_shapes("camera", CAMERA_NUMBERS, width)
    yield from frame_blocks.mlp_shapes("action", config.actions, width)
    yield from linear("modulate_out", width, 2 * width)
    yield from linear("proj_out", width, CAMERA_STEP_NUMBERS)


def init(config: CameraModelConfig, key: Array) -> Params:
    """Return random parameters, float32; the camera stays where it is at first."""
    params = frame_blocks.init(config.blocks, PARTS, ends(config), key)
    params["classes"]["kernel"] *= config.classes**0.5  # only one row is looked up
    return params


def empty_cache(config: CameraModelConfig, batch: int, dtype: Any = jnp.float32) -> FrameCache:
    """Return the cache before the first frame."""
    return frame_blocks.empty_cache(config.blocks, batch, 1, dtype)


def innermost(config: CameraModelConfig, classes_XYZ: Array) -> Array:
    """Return the central voxels of grids (..., X, Y, Z).

    Raises:
        UserError: a grid is smaller than ``config.inner``.
    """
    cut, whole = config.inner, classes_XYZ.shape[-3:]
    if min(whole) < cut:
        raise UserError(
            f"The voxels have shape {classes_XYZ.shape}: the camera model takes the innermost "
            f"{cut} along each axis (camera_model.inner)."
        )
    x, y, z = ((size - cut) // 2 for size in whole)
    return classes_XYZ[..., x : x + cut, y : y + cut, z : z + cut]


def apply(
    config: CameraModelConfig,
    params: Params,
    classes_BTXYZ: Array,
    camera_BTN: Array,
    actions_BTA: Array,
    *,
    dtype: Any = jnp.float32,
    cache: FrameCache | None = None,
) -> tuple[Array, FrameCache | None]:
    """Predict the steps (B, T, 6) to each frame's camera, metres and radians, with the cache.

    Args:
        classes_BTXYZ: class ids of the frame that the action leads to; the grid or its innermost
            part.
        camera_BTN: numbers of the camera before the action; see ``camera_numbers``.
        actions_BTA: the action that leads to each frame.

    Raises:
        UserError: an argument of another shape.
    """
    front = classes_BTXYZ.shape[:2]
    for name, value, size in (
        ("cameras", camera_BTN, CAMERA_NUMBERS),
        ("actions", actions_BTA, config.actions),
    ):
        if value.shape != (*front, size):
            raise UserError(f"The {name} have shape {value.shape}: give {(*front, size)}.")
    inner = innermost(config, jnp.asarray(classes_BTXYZ))
    seen = params["classes"]["kernel"].astype(dtype)[inner].reshape(*front, -1)
    x = frame_blocks.mlp(params["voxels"], seen)
    x = x + frame_blocks.mlp(params["camera"], camera_BTN.astype(dtype))
    condition = frame_blocks.mlp(params["action"], actions_BTA.astype(dtype))
    x, cache = frame_blocks.run(
        config.blocks, PARTS, params, x[:, :, None], condition, cache=cache, sides=(1,)
    )
    out = frame_blocks.project(params, x, condition)[:, :, 0].astype(jnp.float32)
    return out * jnp.asarray(config.units), cache
