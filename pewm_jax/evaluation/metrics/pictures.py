"""Measures without a network: PSNR and SSIM of whole clips."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp

from pewm_jax.config import UserError
from pewm_jax.evaluation.images import WINDOW, psnr, ssim_map, unit_colours
from pewm_jax.types import Array


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


def colours(imagined_BTHWC: Array, truth_BTHWC: Array) -> tuple[Array, Array]:
    """Return both clips in [0, 1], clipped.

    Raises:
        UserError: they are not alike, or not colours.
    """
    pair = jnp.asarray(imagined_BTHWC), jnp.asarray(truth_BTHWC)
    shapes = [clip.shape for clip in pair]
    if shapes[0] != shapes[1] or len(shapes[0]) != 5 or shapes[0][-1] != 3:
        raise UserError(
            f"clips of shapes {shapes[0]} and {shapes[1]} cannot be compared: give both as "
            "(B, T, H, W, 3)."
        )
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
"""The metrics that need no weights."""
