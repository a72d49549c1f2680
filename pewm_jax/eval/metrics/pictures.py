"""Measures without a network: PSNR and SSIM of whole clips, and errors of their depth."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp

from pewm_jax.config import UserError
from pewm_jax.eval.images import WINDOW, psnr, ssim_map, unit_colours
from pewm_jax.io import tree
from pewm_jax.types import Array, Params


class Metric(Protocol):
    """Compares clips."""

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return one number per clip, (B,) float32.

        Args:
            imagined_BTHWC: (B, T, H, W, 3) floats in [−1, 1], or uint8.
            truth_BTHWC: the same shape.

        Raises:
            UserError: the clips are not alike, or not such colours.
        """
        ...


def marked(network: str, params: Params, published: str) -> str:
    """Return a network's name, with the first 8 digits of a hash of weights of one's own.

    Args:
        network: its name.
        params: its weights.
        published: ``tree.digest`` of those that need no mark, whatever file they come from.
    """
    digest = tree.digest(params)
    return network if digest == published else f"{network}-{digest[:8]}"


def colours(imagined_BTHWC: Array, truth_BTHWC: Array) -> tuple[Array, Array]:
    """Return both clips in [0, 1], clipped.

    Raises:
        UserError: they are not alike, or not colours.
    """
    if imagined_BTHWC is None or truth_BTHWC is None:
        raise UserError("there is no clip to compare: give both as (B, T, H, W, 3).")
    pair = jnp.asarray(imagined_BTHWC), jnp.asarray(truth_BTHWC)
    shapes = [clip.shape for clip in pair]
    if shapes[0] != shapes[1] or len(shapes[0]) != 5 or shapes[0][-1] != 3:
        raise UserError(
            f"clips of shapes {shapes[0]} and {shapes[1]} cannot be compared: give both as "
            "(B, T, H, W, 3)."
        )
    if 0 in shapes[0]:
        raise UserError(f"clips of shape {shapes[0]} are empty: give one picture at least.")
    for clip in pair:
        if clip.dtype != jnp.uint8 and not jnp.issubdtype(clip.dtype, jnp.floating):
            raise UserError(
                f"colours of type {clip.dtype} are not known: give floats in [−1, 1], or uint8."
            )
    return unit_colours(pair[0]), unit_colours(pair[1])


@jax.jit
def clip_psnr(imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
    """Return decibels, of the mean squared error of all pixels of a clip; see ``Metric``."""
    imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
    return psnr(jnp.square(imagined - truth).mean((1, 2, 3, 4)))


@jax.jit
def clip_ssim(imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
    """Return structural similarity, averaged over a clip's windows; see ``Metric``.

    Raises:
        UserError: also where pictures are smaller than a window.
    """
    imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
    height, width = imagined.shape[2:4]
    if min(height, width) < WINDOW:
        raise UserError(
            f"pictures of {height}×{width} pixels are too small for SSIM, whose window is "
            f"{WINDOW}×{WINDOW}."
        )
    return ssim_map(imagined, truth).mean((1, 2, 3))


PLAIN: dict[str, Metric] = {"psnr": clip_psnr, "ssim": clip_ssim}
"""The metrics of colours that need no weights."""


@jax.jit
def clip_depth_mae(imagined_BTHW: Array, truth_BTHW: Array) -> Array:
    """Return the mean absolute error, m, (B,), where both have a depth; NaN where none has.

    A clip with an imagined depth that is no number has no score: NaN.

    Args:
        imagined_BTHW: (B, T, H, W) or (B, T, H, W, 1) depths along the optical axis, m; 0 for none.
        truth_BTHW: the same shape.

    Raises:
        UserError: the clips are not alike, or no floats.
    """
    imagined, truth, both = _depths(imagined_BTHW, truth_BTHW)
    return _mean_where(both, jnp.abs(imagined - truth), imagined)


@jax.jit
def clip_depth_rel(imagined_BTHW: Array, truth_BTHW: Array) -> Array:
    """Return the mean of |d − d*| / d* (AbsRel; Eigen et al. 2014); see ``clip_depth_mae``."""
    imagined, truth, both = _depths(imagined_BTHW, truth_BTHW)
    return _mean_where(both, jnp.abs(imagined - truth) / jnp.where(both, truth, 1), imagined)


def _depths(imagined_BTHW: Array, truth_BTHW: Array) -> tuple[Array, Array, Array]:
    """Return both, and where both have a depth."""
    if imagined_BTHW is None or truth_BTHW is None:
        raise UserError("there is no depth to compare: give both as (B, T, H, W), metres.")
    imagined, truth = jnp.asarray(imagined_BTHW), jnp.asarray(truth_BTHW)
    shaped = imagined.ndim == 4 or (imagined.ndim == 5 and imagined.shape[-1] == 1)
    if imagined.shape != truth.shape or not shaped:
        raise UserError(
            f"depths of shapes {imagined.shape} and {truth.shape} cannot be compared: give both as "
            "(B, T, H, W), metres."
        )
    if 0 in imagined.shape:
        raise UserError(f"depths of shape {imagined.shape} are empty: give one picture at least.")
    for clip in (imagined, truth):
        if not jnp.issubdtype(clip.dtype, jnp.floating):
            raise UserError(f"depths of type {clip.dtype} are not known: give floats, metres.")
    return imagined, truth, (imagined > 0) & (truth > 0)


def _mean_where(mask_B: Array, values_B: Array, imagined_B: Array) -> Array:
    """Return means under a mask; NaN where that is empty, or what was imagined is not finite."""
    axes = tuple(range(1, mask_B.ndim))
    mean_B = jnp.where(mask_B, values_B, 0).sum(axes) / mask_B.sum(axes)
    return jnp.where(jnp.isfinite(imagined_B).all(axes), mean_B, jnp.nan)


DEPTHS: dict[str, Metric] = {"depth_mae": clip_depth_mae, "depth_rel": clip_depth_rel}
"""The metrics of depth, which take it in the place of colours."""
