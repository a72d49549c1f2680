"""Plücker embedding of cameras, per pixel and per latent cell.

The paper's Eq. 1 adds the translation to the direction; a direction is not moved by translation,
and CameraCtrl's code, which the paper follows, does not add it: d = R K⁻¹ (u + ½, v + ½, 1),
normalised, and the embedding is (o × d, d).
"""

from __future__ import annotations

import jax.numpy as jnp

from pewm_jax.geometry.cameras import matmul, ray_directions, relative_to_first
from pewm_jax.types import Array, Camera


def plucker(camera: Camera, height: int, width: int) -> Array:
    """Return (..., H, W, 6) Plücker coordinates (o × d, d) of every pixel's ray.

    Args:
        camera: cameras (...); the embedding lives in the frame their poses are given in.
        height: image height in pixels.
        width: image width in pixels.
    """
    return _moved(_unit_directions(camera, height, width), camera)


def _unit_directions(camera: Camera, height: int, width: int) -> Array:
    """Return (..., H, W, 3) directions of length 1 in the cameras' own frames."""
    direction = ray_directions(camera.intrinsics_4, height, width)
    return direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)


def _moved(direction: Array, camera: Camera) -> Array:
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
    """Embed the cameras of one clip at the latent rate (paper, appendix Table 4).

    Args:
        camera: (T,) cameras; they are made relative to the first one here.
        height: image height in pixels.
        width: image width in pixels.
        spatial: pixels per latent cell, averaged.
        temporal: frames per latent frame, folded into channels.

    Returns:
        (t, h, w, 6·temporal) camera channels; 24 for CogVideoX's factor 4.
    """
    camera = relative_to_first(camera)
    direction = _unit_directions(camera, height, width)
    frames, h, w = direction.shape[0], height // spatial, width // spatial
    # The mean of rays is the ray of the mean: both parts are linear in the direction.
    direction = direction.reshape(frames, h, spatial, w, spatial, 3).mean((2, 4))
    pooled = _moved(direction, camera)
    folded = jnp.moveaxis(fold_frames(pooled, temporal), 1, -2)
    return folded.reshape(*folded.shape[:-2], temporal * 6)
