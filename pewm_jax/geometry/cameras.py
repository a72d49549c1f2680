"""Pinhole cameras: intrinsics, rigid transforms, projection, unprojection, Plücker embedding.

Works on NumPy and JAX arrays alike with any leading shape. See ``pewm_jax.types`` for the axes.

Products of positions and rotations are computed in full float32 (``matmul``, ``einsum``). JAX's
default precision is bfloat16 on TPUs and TF32 on NVIDIA GPUs, which costs 1.3 pixels and 1.6 cm.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import UserError
from pewm_jax.types import Array, Camera

Y_UP_FROM_Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""Turns our world, z up, into that of glTF and of Habitat, y up."""


def matmul(a: Array, b: Array) -> Array:
    """Return ``a @ b`` in full float32 precision on all platforms."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def einsum(equation: str, *operands: Array) -> Array:
    """Return ``jnp.einsum`` in full float32 precision on all platforms."""
    return jnp.einsum(equation, *operands, precision=jax.lax.Precision.HIGHEST)


def intrinsics_from_fov(height: int, width: int, horizontal_fov_deg: float) -> np.ndarray:
    """Return (4,) fx, fy, cx, cy of square pixels with the principal point in the middle.

    Raises:
        UserError: an argument is not a number, or is out of its range.
    """
    arguments = {"height": height, "width": width, "horizontal_fov_deg": horizontal_fov_deg}
    for name, value in arguments.items():
        require_array("intrinsics_from_fov", name, value)
    if min(height, width) < 1 or not 0 < horizontal_fov_deg < 180:
        raise UserError(
            f"intrinsics_from_fov() got height {height}, width {width} and horizontal_fov_deg "
            f"{horizontal_fov_deg}: give sizes of 1 pixel or more, and degrees between 0 and 180."
        )
    focal = width / 2 / math.tan(math.radians(horizontal_fov_deg) / 2)
    return np.array([focal, focal, width / 2, height / 2], np.float32)


def resize_intrinsics(intrinsics_4: Array, scale_x: float, scale_y: float) -> Array:
    """Scale intrinsics to an image resized by these factors (exact with centres at +0.5)."""
    return intrinsics_4 * np.array([scale_x, scale_y, scale_x, scale_y], np.float32)


def pose_from_yaw(position_3: np.ndarray, yaw: float, pitch: float = 0.0) -> np.ndarray:
    """Return the (4, 4) ``world_from_camera`` of an upright camera at a position, metres.

    The yaw is counter-clockwise from above, 0 looks along world +x; positive pitch looks up;
    radians.

    Raises:
        UserError: an argument is not a number, or the position does not have shape (3,).
    """
    require_array("pose_from_yaw", "position_3", position_3, 3)
    for name, value in (("yaw", yaw), ("pitch", pitch)):
        require_array("pose_from_yaw", name, value)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    forward = np.array([cy * cp, sy * cp, sp])
    right = np.array([sy, -cy, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position_3
    return pose.astype(np.float32)


def invert_rigid(transform: Array) -> Array:
    """Invert rigid transforms (..., 4, 4) exactly: Rᵀ and −Rᵀt."""
    rotation_inverse = jnp.swapaxes(transform[..., :3, :3], -1, -2)
    translation = matmul(-rotation_inverse, transform[..., :3, 3:])
    top = jnp.concatenate([rotation_inverse, translation], -1)
    bottom = jnp.broadcast_to(transform[..., 3:, :], (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], -2)


def relative_to_first(camera: Camera) -> Camera:
    """Express cameras (..., T) in the frame of the first of them."""
    pose = jnp.asarray(camera.world_from_camera)
    first_from_world = invert_rigid(pose[..., :1, :, :])
    return Camera(camera.intrinsics_4, matmul(first_from_world, pose))


def dot(a_3: Array, b_3: Array) -> Array:
    """Return the (...,) dot products of vectors (..., 3).

    Summed by hand: a CPU takes ten times as long to reduce an axis of three numbers.
    """
    x, y, z = (a_3[..., i] * b_3[..., i] for i in range(3))
    return x + y + z


def transform_points(transform: Array, points_3: Array) -> Array:
    """Apply rigid transforms (..., 4, 4) to points (..., P, 3)."""
    rotation, translation = transform[..., :3, :3], transform[..., :3, 3]
    return matmul(points_3, jnp.swapaxes(rotation, -1, -2)) + translation[..., None, :]


def pixel_grid(height: int, width: int) -> np.ndarray:
    """Return (H, W, 2) pixel centres (u, v): 0.5, 1.5, and so on."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], -1).astype(np.float32)


def ray_directions(intrinsics_4: Array, height: int, width: int) -> Array:
    """Return (..., H, W, 3) directions K⁻¹(u, v, 1) in the camera, z = 1 (not unit length)."""
    fx, fy, cx, cy = (intrinsics_4[..., i, None, None] for i in range(4))
    grid = pixel_grid(height, width)
    x, y = (grid[..., 0] - cx) / fx, (grid[..., 1] - cy) / fy
    return jnp.stack([x, y, jnp.ones_like(x)], -1)


def unproject(depth_HW: Array, camera: Camera) -> Array:
    """Lift depth images (..., H, W) of cameras (...) to world points (..., H, W, 3), metres.

    The points belong to the pixels' centres; they are meaningless where depth is 0.
    """
    height, width = depth_HW.shape[-2:]
    points = ray_directions(camera.intrinsics_4, height, width) * depth_HW[..., None]
    flat = points.reshape(*points.shape[:-3], height * width, 3)
    return transform_points(camera.world_from_camera, flat).reshape(points.shape)


def project(points_world_P3: Array, camera: Camera) -> tuple[Array, Array]:
    """Project world points (..., P, 3) into cameras (...); the leading shapes broadcast.

    Returns:
        ``(uv_P2, z_P)``: pixel coordinates (centres at +0.5) and z-depth in metres. Where z is
        not positive the point is behind the camera and uv is finite but meaningless.
    """
    points = transform_points(invert_rigid(camera.world_from_camera), points_world_P3)
    z = points[..., 2]
    safe = jnp.where(z > 1e-6, z, 1.0)
    fx, fy, cx, cy = (camera.intrinsics_4[..., i, None] for i in range(4))
    return jnp.stack([points[..., 0] / safe * fx + cx, points[..., 1] / safe * fy + cy], -1), z


def plucker(camera: Camera, height: int, width: int) -> Array:
    """Return (..., H, W, 6) Plücker coordinates (o × d, d) of every pixel's ray.

    They live in the frame of the cameras' poses. The paper's Eq. 1 adds the translation to the
    direction; a direction is not moved by translation, and CameraCtrl's code, which the paper
    follows, does not add it: d = R K⁻¹ (u + ½, v + ½, 1), normalised.
    """
    return _plucker_of(_unit_directions(camera, height, width), camera)


def _unit_directions(camera: Camera, height: int, width: int) -> Array:
    """Return (..., H, W, 3) directions of length 1 in the cameras' own frames."""
    direction = ray_directions(camera.intrinsics_4, height, width)
    return direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)


def _plucker_of(direction: Array, camera: Camera) -> Array:
    """Return (o × R d, R d) of directions d in the cameras' own frames; linear in them."""
    rotation = camera.world_from_camera[..., None, :3, :3]
    direction = matmul(direction, jnp.swapaxes(rotation, -1, -2))
    origin = jnp.broadcast_to(camera.world_from_camera[..., None, None, :3, 3], direction.shape)
    return jnp.concatenate([jnp.cross(origin, direction), direction], -1)


def fold_frames(frames_TX: Array, temporal: int) -> Array:
    """Group frames by the latent frame that covers them.

    Frame 0 is repeated ``temporal`` times (the latent of the first frame covers it alone), then
    every ``temporal`` frames belong to one latent: (..., T, X) → (..., t, temporal, X) on the
    first axis of ``frames_TX`` with T = temporal·k + 1, t = k + 1.
    """
    repeated = jnp.concatenate([jnp.repeat(frames_TX[:1], temporal - 1, 0), frames_TX], 0)
    return repeated.reshape(-1, temporal, *frames_TX.shape[1:])


def camera_latents(camera: Camera, height: int, width: int, spatial: int, temporal: int) -> Array:
    """Embed the (T,) cameras of one clip at the latent rate (paper, appendix Table 4).

    The embedding is relative to the first camera; ``spatial`` pixels per latent cell are averaged,
    and ``temporal`` frames per latent frame are folded into channels.

    Returns:
        (t, h, w, 6·temporal) camera channels; 24 for CogVideoX's factor 4.
    """
    camera = relative_to_first(camera)
    direction = _unit_directions(camera, height, width)
    frames, h, w = direction.shape[0], height // spatial, width // spatial
    # The mean of rays is the ray of the mean: both parts are linear in the direction.
    direction = direction.reshape(frames, h, spatial, w, spatial, 3).mean((2, 4))
    pooled = _plucker_of(direction, camera)
    folded = jnp.moveaxis(fold_frames(pooled, temporal), 1, -2)
    return folded.reshape(*folded.shape[:-2], temporal * 6)


def require_array(who: str, name: str, value: Any, *shape: Any) -> None:
    """Raise UserError for an argument that is not an array of finite numbers of a given shape.

    Under jit, vmap and grad only types and shapes are checked, not values.

    Args:
        who: name of the function, for the message.
        name: name of the argument, for the message.
        value: the argument.
        shape: the sizes of its last axes, None for any size; if the first is Ellipsis, more axes
            may come before them.
    """
    free, sizes = shape[:1] == (...,), tuple(n for n in shape if n is not ...)
    if isinstance(value, Tracer):
        found, kind, values = value.shape, "f", None
    else:
        try:
            values = np.asarray(value)
        except (ValueError, TypeError):
            values = np.asarray(None)
        found, kind = values.shape, values.dtype.kind
    numbers = kind in "fiu" or "float" in str(getattr(values, "dtype", ""))
    last = found[len(found) - len(sizes) :] if sizes else ()
    fits = len(found) >= len(sizes) if free else len(found) == len(sizes)
    fits = fits and all(n in (None, m) for n, m in zip(sizes, last, strict=True))
    if not (numbers and fits):
        wanted = ", ".join(["…"] * free + ["n" if n is None else str(n) for n in sizes])
        what = f"shape {found}" if numbers else f"type {type(value).__name__}"
        form = f"numbers of shape ({wanted})" if wanted else "a number"
        raise UserError(f"{who}() got {name} of {what}: give {form}.")
    if values is not None and not np.isfinite(np.asarray(values, np.float64)).all():
        raise UserError(f"{who}() got {name} with NaN or infinity: give finite numbers.")
