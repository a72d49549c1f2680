"""Image errors under masks: PSNR, SSIM, depth error; and the masks of pixels seen before.

Errors are stored as *sums under masks* (``error_sums``), so one pass over the samples yields every
table: per clip, per frame index, per mask, in any grouping. Colours are compared in [0, 1], after
the networks' [−1, 1] is shifted and clipped.

Seen-before masks say which pixels of a frame show surfaces that earlier frames have seen
(``seen_masks``). They are exact up to the sampling of the images: a pixel's true 3D point is
projected into each earlier frame and compared with that frame's true depth. No network is involved.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.geometry.cameras import project, unproject
from pewm_jax.io import tree
from pewm_jax.types import Array, Camera, Frames, Params

WINDOW, SIGMA = 11, 1.5
"""Size and standard deviation of SSIM's Gaussian window, pixels (Wang et al. 2004)."""
PSNR_CEILING = 100.0
"""PSNR of equal images, in dB; it keeps averages finite."""
MASKS = ("seen", "unseen", "all")
"""The masks: pixels seen before, pixels never seen, all pixels."""
PARTS = MASKS[:2]
"""The masks of a part of the pixels."""
MEASURED = ("squared", "colours", "ssim", "windows", "depth_abs", "depth_rel", "depths")
SUMS = (*MEASURED, "lpips", "pictures")
"""The sums returned by ``error_sums``, in order; the last two are 0 until ``with_lpips``, and count
pixels under the masks of ``PARTS`` and pictures under ``all``."""


def unit_colours(rgb: Array) -> Array:
    """Convert colours, uint8 or float in [−1, 1], to float32 in [0, 1], clipped."""
    rgb = jnp.asarray(rgb)
    if rgb.dtype == jnp.uint8:
        return rgb.astype(jnp.float32) / 255
    return jnp.clip((rgb.astype(jnp.float32) + 1) / 2, 0, 1)


def psnr(mean_squared_error: Array) -> Array:
    """Return the PSNR in dB for errors of colours in [0, 1]; at most ``PSNR_CEILING``."""
    floor = 10 ** (-PSNR_CEILING / 10)
    return -10 * jnp.log10(jnp.maximum(mean_squared_error, floor))


def gaussian_window() -> np.ndarray:
    """Return the (11,) window of SSIM, summing to one."""
    offset = np.arange(WINDOW) - WINDOW // 2
    window = np.exp(-(offset**2) / (2 * SIGMA**2))
    return (window / window.sum()).astype(np.float32)


def _band(length: int) -> np.ndarray:
    """Return the (length − 10, length) matrix that applies the window along one axis."""
    rows = length - WINDOW + 1
    band = np.zeros((rows, length), np.float32)
    for row in range(rows):
        band[row, row : row + WINDOW] = gaussian_window()
    return band


def ssim_map(a_HWC: Array, b_HWC: Array) -> Array:
    """Return structural similarity per pixel (Wang et al. 2004, Eq. 13; K1 = .01, K2 = .03).

    Both are (..., H, W, 3) colours in [0, 1], H and W at least 11. The result, (..., H − 10, W −
    10), is averaged over colours: only pixels whose whole 11 × 11 Gaussian window lies in the image
    have a value, as in the original. Its mean is the usual SSIM.
    """
    height, width = a_HWC.shape[-3:-1]
    rows, columns = jnp.asarray(_band(height)), jnp.asarray(_band(width))

    def blur(x):
        """Apply the window by two matrix products: (..., 3, H, W) to (..., 3, v, u)."""
        along_width = jnp.matmul(x, columns.T, precision="highest")
        return jnp.matmul(jnp.swapaxes(along_width, -1, -2), rows.T, precision="highest")

    a, b = (jnp.moveaxis(x, -1, -3) for x in (a_HWC, b_HWC))
    mean_a, mean_b, square_a, square_b, product = blur(jnp.stack([a, b, a * a, b * b, a * b]))
    c1, c2 = 0.01**2, 0.03**2
    variance_a, variance_b = square_a - mean_a**2, square_b - mean_b**2
    covariance = product - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (variance_a + variance_b + c2)
    return jnp.swapaxes((luminance * structure).mean(-3), -1, -2)


def error_sums(predicted: Frames, true: Frames, seen_THW: Array, unseen_THW: Array) -> Array:
    """Sum the errors of T imagined frames under each mask of pixels seen before or never seen.

    Returns (T, 3, 9): for every frame and every mask of ``MASKS`` the sums of ``SUMS``. SSIM counts
    pixels whose window lies inside the image. Depth counts pixels with both a true and a predicted
    depth (a copied frame may have holes).
    """
    guess, truth = unit_colours(predicted.rgb_THWC), unit_colours(true.rgb_THWC)
    squared_THW = ((guess - truth) ** 2).sum(-1)
    similarity = ssim_map(guess, truth)
    has_depth = (jnp.asarray(true.depth_THW) > 0) & (jnp.asarray(predicted.depth_THW) > 0)
    off_THW = jnp.abs(jnp.asarray(predicted.depth_THW) - true.depth_THW)
    relative_THW = off_THW / jnp.where(has_depth, true.depth_THW, 1)
    edge = WINDOW // 2
    per_mask = []
    for mask in (seen_THW, unseen_THW, jnp.ones_like(seen_THW)):
        inner = mask[:, edge:-edge, edge:-edge]
        measured = mask & has_depth
        sums = [
            jnp.where(mask, squared_THW, 0).sum((1, 2)),
            3 * mask.sum((1, 2)),
            jnp.where(inner, similarity, 0).sum((1, 2)),
            inner.sum((1, 2)),
            jnp.where(measured, off_THW, 0).sum((1, 2)),
            jnp.where(measured, relative_THW, 0).sum((1, 2)),
            measured.sum((1, 2)),
        ]
        sums += [jnp.zeros(len(mask))] * (len(SUMS) - len(MEASURED))
        per_mask.append(jnp.stack([s.astype(jnp.float32) for s in sums], -1))
    return jnp.stack(per_mask, 1)


error_sums_batch = jax.jit(jax.vmap(error_sums))
"""``error_sums`` over a batch of clips: (B, T, 3, 9)."""


def with_lpips(
    sums: np.ndarray, distances: np.ndarray, in_masks: np.ndarray | None = None
) -> np.ndarray:
    """Return sums (..., T, 3, 9) with LPIPS (..., T) of whole images under ``all``.

    ``in_masks`` (..., T, 2) are the sums of its map over the pixels seen before and never seen
    (``perceptual.LPIPS.in_masks``). Their count is that of the pixels, so that frames weigh as many
    pixels as they have under the mask, as for PSNR; whole images weigh the same.
    """
    sums = np.array(sums)
    sums[..., MASKS.index("all"), SUMS.index("lpips")] = distances
    sums[..., MASKS.index("all"), SUMS.index("pictures")] = 1
    if in_masks is not None:
        parts = [MASKS.index(mask) for mask in PARTS]
        sums[..., parts, SUMS.index("lpips")] = in_masks
        sums[..., parts, SUMS.index("pictures")] = sums[..., parts, SUMS.index("colours")] / 3
    return sums


TOLERANCE_M, TOLERANCE_RELATIVE = 0.05, 0.03
"""Two depths of one surface agree within the larger of 5 cm and 3 %."""


def _agrees(depth_P: Array, z_P: Array) -> Array:
    close = jnp.maximum(TOLERANCE_M, TOLERANCE_RELATIVE * z_P)
    return (depth_P > 0) & (jnp.abs(depth_P - z_P) <= close)


def visible_in(points_world_P3: Array, depth_HW: Array, camera: Camera) -> Array:
    """Return which points (P,) are visible in a depth image.

    A point is visible if it projects inside the image, in front of the camera, and its depth agrees
    with the image there: either with the nearest pixel, or with 1/depth interpolated between the
    four surrounding pixels. (On a plane 1/depth is linear in the image. So a floor seen at a
    grazing angle is recognised, although its depth changes by more than the tolerance from row to
    row.) Depths are z, metres; 0 = no measurement.
    """
    height, width = depth_HW.shape
    uv, z = project(points_world_P3, camera)
    u, v = uv[:, 0], uv[:, 1]
    inside = (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)

    # One gather for the four pixels around a point, which include the nearest.
    padded = jnp.pad(depth_HW, 1, mode="edge")
    four = [padded[i : i + height + 1, j : j + width + 1] for i in (0, 1) for j in (0, 1)]
    left, top = jnp.floor(u - 0.5), jnp.floor(v - 0.5)
    across, down = u - 0.5 - left, v - 0.5 - top
    row = jnp.clip(top + 1, 0, height).astype(jnp.int32)
    column = jnp.clip(left + 1, 0, width).astype(jnp.int32)
    corners = jnp.moveaxis(jnp.stack(four, -1)[row, column], -1, 0)
    upper, lower = (jnp.where(across < 0.5, corners[i], corners[i + 1]) for i in (0, 2))
    nearest = jnp.where(down < 0.5, upper, lower)
    weights = jnp.stack(
        [(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across]
    )
    measured = (corners > 0).all(0)
    inverse = (weights / jnp.where(corners > 0, corners, 1)).sum(0)
    between = jnp.where(measured, 1 / inverse, 0)
    return inside & (_agrees(nearest, z) | _agrees(between, z))


def seen_masks(target: Frames, context: Frames) -> tuple[Array, Array]:
    """Return the bool masks ``(seen_THW, unseen_THW)`` of the pixels seen before and never seen.

    Both arguments have true depth and poses. A pixel without depth is in neither.
    """
    depth_THW = jnp.asarray(target.depth_THW)
    points = unproject(depth_THW, target.camera).reshape(-1, 3)

    def look(seen_P, frame):
        depth_HW, camera = frame
        return seen_P | visible_in(points, depth_HW, camera), None

    none = jnp.zeros(points.shape[0], bool)
    frames = (jnp.asarray(context.depth_THW), jax.tree.map(jnp.asarray, context.camera))
    seen_P, _ = jax.lax.scan(look, none, frames)
    measured = depth_THW > 0
    seen_THW = seen_P.reshape(depth_THW.shape) & measured
    return seen_THW, measured & ~seen_THW


seen_masks_batch = jax.jit(jax.vmap(seen_masks))
"""``seen_masks`` over a batch of clips."""


class Metric(Protocol):
    """Compares clips."""

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return one number per clip, (B,) float32.

        Args:
            imagined_BTHWC: (B, T, H, W, 3) floats in [−1, 1], or uint8.
            truth_BTHWC: the same shape.

        Raises:
            UserError: the clips differ in shape, or are not such colours.
        """
        ...


def name_with_hash(network: str, params: Params, published: str) -> str:
    """Return a network's name, with 8 digits of the hash of weights that are not published.

    ``published`` is ``tree.digest`` of the published weights, which is independent of the file
    format.
    """
    digest = tree.digest(params)
    return network if digest == published else f"{network}-{digest[:8]}"


def colours(imagined_BTHWC: Array, truth_BTHWC: Array) -> tuple[Array, Array]:
    """Return both clips in [0, 1], clipped.

    Raises:
        UserError: they differ in shape, or are not colours.
    """
    if imagined_BTHWC is None or truth_BTHWC is None:
        raise UserError("no clips to compare: give both as (B, T, H, W, 3).")
    pair = jnp.asarray(imagined_BTHWC), jnp.asarray(truth_BTHWC)
    shapes = [clip.shape for clip in pair]
    if shapes[0] != shapes[1] or len(shapes[0]) != 5 or shapes[0][-1] != 3:
        raise UserError(
            f"clips of shapes {shapes[0]} and {shapes[1]} cannot be compared: give both as "
            "(B, T, H, W, 3)."
        )
    if 0 in shapes[0]:
        raise UserError(f"clips of shape {shapes[0]} are empty: give at least one image.")
    for clip in pair:
        if clip.dtype != jnp.uint8 and not jnp.issubdtype(clip.dtype, jnp.floating):
            raise UserError(
                f"colours of type {clip.dtype} are not supported: give floats in [−1, 1], or uint8."
            )
    return unit_colours(pair[0]), unit_colours(pair[1])


@jax.jit
def clip_psnr(imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
    """Return PSNR in dB, of the mean squared error of all pixels of a clip; see ``Metric``."""
    imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
    return psnr(jnp.square(imagined - truth).mean((1, 2, 3, 4)))


@jax.jit
def clip_ssim(imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
    """Return structural similarity, averaged over a clip's windows; see ``Metric``.

    Raises:
        UserError: also if images are smaller than a window.
    """
    imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
    height, width = imagined.shape[2:4]
    if min(height, width) < WINDOW:
        raise UserError(
            f"images of {height}×{width} pixels are too small for SSIM, whose window is "
            f"{WINDOW}×{WINDOW}."
        )
    return ssim_map(imagined, truth).mean((1, 2, 3))


PLAIN: dict[str, Metric] = {"psnr": clip_psnr, "ssim": clip_ssim}
"""The metrics of colours that need no weights."""


@jax.jit
def clip_depth_mae(imagined_BTHW: Array, truth_BTHW: Array) -> Array:
    """Return the mean absolute error, m, (B,), where both have a depth; NaN if none has.

    Both are (B, T, H, W) or (B, T, H, W, 1) depths along the optical axis, m; 0 for none. A clip
    with an imagined depth that is not finite has no score: NaN.

    Raises:
        UserError: the clips differ in shape, or are not floats.
    """
    imagined, truth, both = _depths(imagined_BTHW, truth_BTHW)
    return _mean_where(both, jnp.abs(imagined - truth), imagined)


@jax.jit
def clip_depth_rel(imagined_BTHW: Array, truth_BTHW: Array) -> Array:
    """Return the mean of |d − d*| / d* (AbsRel; Eigen et al. 2014); see ``clip_depth_mae``."""
    imagined, truth, both = _depths(imagined_BTHW, truth_BTHW)
    return _mean_where(both, jnp.abs(imagined - truth) / jnp.where(both, truth, 1), imagined)


def _depths(imagined_BTHW: Array, truth_BTHW: Array) -> tuple[Array, Array, Array]:
    """Return both, and the mask where both have a depth."""
    if imagined_BTHW is None or truth_BTHW is None:
        raise UserError("no depth to compare: give both as (B, T, H, W), metres.")
    imagined, truth = jnp.asarray(imagined_BTHW), jnp.asarray(truth_BTHW)
    shaped = imagined.ndim == 4 or (imagined.ndim == 5 and imagined.shape[-1] == 1)
    if imagined.shape != truth.shape or not shaped:
        raise UserError(
            f"depths of shapes {imagined.shape} and {truth.shape} cannot be compared: give both as "
            "(B, T, H, W), metres."
        )
    if 0 in imagined.shape:
        raise UserError(f"depths of shape {imagined.shape} are empty: give at least one image.")
    for clip in (imagined, truth):
        if not jnp.issubdtype(clip.dtype, jnp.floating):
            raise UserError(f"depths of type {clip.dtype} are not supported: give floats, metres.")
    return imagined, truth, (imagined > 0) & (truth > 0)


def _mean_where(mask_B: Array, values_B: Array, imagined_B: Array) -> Array:
    """Return means under a mask; NaN if the mask is empty or an imagined value is not finite."""
    axes = tuple(range(1, mask_B.ndim))
    mean_B = jnp.where(mask_B, values_B, 0).sum(axes) / mask_B.sum(axes)
    return jnp.where(jnp.isfinite(imagined_B).all(axes), mean_B, jnp.nan)


DEPTHS: dict[str, Metric] = {"depth_mae": clip_depth_mae, "depth_rel": clip_depth_rel}
"""The metrics of depth, which take depths instead of colours."""
