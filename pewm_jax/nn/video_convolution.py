"""3D convolutions of videos, in the form that the backend runs fastest.

Output frame t of a causal 3×3×3 convolution is a sum of three 2D convolutions, of frames t, t+1 and
t+2 of the padded video. There are five equivalent forms:

* ``volume``: one 3D convolution, for which GPUs have a kernel.
* ``stacked``: one 2D convolution of three neighbouring frames, side by side as channels. XLA's
  compiler for TPUs splits the pixels of few videos into more and copies them before and after a 3D
  convolution. Of 2D convolutions all frames are the batch: for two videos half of the memory
  traffic of an encoder, and half of its time of compilation. For one video memory is the larger,
  because its frames are padded to the 16 rows of a tile.
* ``frames``: the same, one frame after the other, each with what precedes the convolution. Only
  inputs and outputs are held for all frames. The compiler for TPUs splits the pixels of each frame
  again: the memory traffic is twice that of ``stacked``.
* ``taps``: the sum of three 2D convolutions.
* ``winograd``: four neighbouring output frames take twelve 2D convolutions. By Winograd's minimal
  filtering (1980) six suffice, applied to weighted sums of the six input frames. XLA's CPU backend
  then needs about half the time and less memory. The rounding error is three times that of a 3D
  convolution (2e-6 of the largest value), which is acceptable in float32 but not in bfloat16.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.errors import UserError
from pewm_jax.nn import target
from pewm_jax.types import Array, Params

POINTS = (0.0, 1.0, -1.0, 0.5, -2.0)
"""Points, besides infinity, at which minimal filtering evaluates polynomials. Small, well
separated numbers keep rounding errors small."""
WORTHWHILE = 256
"""Fewest output pixels of all frames for which ``winograd`` is faster."""
SAME, AFTER = ((1, 1), (1, 1)), ((0, 1), (0, 1))
"""Padding by one row or column of zeros on every side, and below and to the right alone."""
Form = Literal["auto", "frames", "stacked", "taps", "volume", "winograd"]


def convolve(how: Form, params: Params, padded_BTHWC: Array) -> Array:
    """3×3×3 convolution of a video already padded in time; zeros around the frame.

    Args:
        how: the form.
        params: ``kernel`` (3, 3, 3, C, D) and ``bias``.
        padded_BTHWC: (B, T + 2, H, W, C); its dtype is that of the computation.

    Returns:
        (B, T, H, W, D).
    """
    dtype = padded_BTHWC.dtype
    _, frames, height, width, _ = padded_BTHWC.shape
    kernel, how = params["kernel"], form(how, dtype, len(padded_BTHWC))
    if how == "volume":
        out = jax.lax.conv_general_dilated(
            padded_BTHWC,
            kernel.astype(dtype),
            (1, 1, 1),
            ((0, 0), *SAME),
            dimension_numbers=("NDHWC", "DHWIO", "NDHWC"),
        )
    elif how in ("frames", "stacked"):
        out = _stacked(padded_BTHWC, kernel.astype(dtype))
    elif how == "winograd" and (frames - 2) * height * width >= WORTHWHILE:
        out = _winograd(padded_BTHWC, kernel)
    else:
        out = _taps(padded_BTHWC, kernel.astype(dtype))
    return (out + params["bias"]).astype(dtype)


def convolve_causal(
    how: Form, params: Params, x_BTHWC: Array, past_BTHWC: Array
) -> tuple[Array, Array]:
    """3×3×3 convolution over each frame and the two before; zeros around the frame.

    ``past_BTHWC`` are the two frames before. Returns the result and the next chunk's past.
    """
    padded = jnp.concatenate([past_BTHWC, x_BTHWC], 1)
    return convolve(how, params, padded), padded[:, -2:]


def convolve_frame_by_frame(
    params: Params,
    before: Callable[..., Array],
    parts: Sequence[Array],
    past_BTHWC: Array | None,
) -> tuple[Array, Array]:
    """Return ``convolve_causal`` of ``before(*parts)``, one frame after the other.

    ``before`` maps frames of the parts, (B, T, …) each, to frames (B, T, H, W, C). If there is no
    past, the first of them is repeated.
    """
    if past_BTHWC is None:
        past_BTHWC = jnp.repeat(before(*(part[:, :1] for part in parts)), 2, axis=1)

    def body(past: Array, frame: tuple[Array, ...]) -> tuple[Array, Array]:
        padded = jnp.concatenate([past, before(*(part[:, None] for part in frame))], 1)
        return padded[:, 1:], convolve("stacked", params, padded)[:, 0]

    frames = tuple(jnp.moveaxis(part, 1, 0) for part in parts)
    past_BTHWC, out = jax.lax.scan(body, past_BTHWC, frames)
    return jnp.moveaxis(out, 0, 1), past_BTHWC


def frame_by_frame(function: Callable[[Array], Array], x_BTHWC: Array) -> Array:
    """Return a function's value for each frame (B, 1, …), computed one after the other."""
    out = jax.lax.map(lambda frame: function(frame[:, None])[:, 0], jnp.moveaxis(x_BTHWC, 1, 0))
    return jnp.moveaxis(out, 0, 1)


def in_chunks(
    step: Callable[[Array, Params], tuple[Array, Params]], x_BTHWC: Array, first: int, size: int
) -> Array:
    """Run ``step(chunk, past) → (out, past)`` on the first frames, then on ``size`` at a time.

    The outputs are joined along time. The first chunk's past is {}. Chunks of equal shape share one
    compiled body: inside ``jit`` they are scanned, outside ``step`` is called for each.
    """
    batch, frames, *rest = x_BTHWC.shape
    out, past = step(x_BTHWC[:, :first], {})
    if frames == first:
        return out
    if not isinstance(x_BTHWC, Tracer):
        outs = [out]
        for start in range(first, frames, size):
            out, past = step(x_BTHWC[:, start : start + size], past)
            outs.append(out)
        return jnp.concatenate(outs, 1)

    def body(past: Params, chunk: Array) -> tuple[Params, Array]:
        out, past = step(chunk, past)
        return past, out

    chunks = x_BTHWC[:, first:].reshape(batch, -1, size, *rest)
    _, outs = jax.lax.scan(body, past, jnp.moveaxis(chunks, 1, 0))
    outs = jnp.moveaxis(outs, 0, 1).reshape(batch, -1, *out.shape[2:])
    return jnp.concatenate([out, outs], 1)


def require_video(x: Array, channels: int, name: str) -> None:
    """Refuse arrays that are not a batch of videos of floats with this number of channels.

    Raises:
        UserError: another shape or dtype.
    """
    if x.ndim != 5 or x.shape[-1] != channels:
        raise UserError(
            f"{name} has shape {tuple(x.shape)}: five axes are needed, batch, time, height, width "
            f"and {channels} channels last."
        )
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise UserError(f"{name} holds {x.dtype}: convert it to floats first.")


def convolve_frames(params: Params, x_BTHWC: Array, stride: int, padding: Sequence) -> Array:
    """2D convolution of every frame, ``kernel`` (3, 3, C, D) and ``bias``."""
    out = _frames(x_BTHWC, params["kernel"].astype(x_BTHWC.dtype), stride, padding)
    return (out + params["bias"]).astype(x_BTHWC.dtype)


def convolve_upsampled(params: Params, x_BTHWC: Array) -> Array:
    """Upsample frames twofold (nearest) and convolve them by ``kernel`` (3, 3, C, D) and ``bias``.

    A 3×3 window of an upsampled frame covers 2×2 different pixels. Each of the four output pixels
    of an input pixel is therefore a 2×2 convolution of the input: 16 products instead of 36, and
    the upsampled frames are not stored.
    """
    dtype, kernel = x_BTHWC.dtype, params["kernel"].astype(jnp.float32)  # for exact sums
    batch, frames, height, width, _ = x_BTHWC.shape
    rows = []
    for first in (kernel[0], kernel[1] + kernel[2]), (kernel[0] + kernel[1], kernel[2]):
        half = jnp.stack(first)
        places = []
        for left, right in (
            (half[:, 0], half[:, 1] + half[:, 2]),
            (half[:, 0] + half[:, 1], half[:, 2]),
        ):
            low, side = len(rows), len(places)
            small = jnp.stack([left, right], 1).astype(dtype)
            places.append(_frames(x_BTHWC, small, 1, ((1 - low, low), (1 - side, side))))
        rows.append(jnp.stack(places, 4))
    out = jnp.stack(rows, 3).reshape(batch, frames, 2 * height, 2 * width, -1)
    return (out + params["bias"]).astype(dtype)


def form(how: Form, dtype: jnp.dtype, videos: int, *, decodes: bool = False) -> Form:
    """Return the form of the 3D convolutions; ``auto`` depends on the target of the trace.

    ``decodes`` tells whether they are those of a decoder whose norms can be computed by frames.
    """
    if how != "auto":
        return how
    on_cpu: Form = "winograd" if dtype == jnp.float32 else "taps"
    on_tpu: Form = "frames" if decodes else "stacked" if videos > 1 else "volume"
    forms: dict[str, Form] = {"cpu": on_cpu, "tpu": on_tpu}
    return forms.get(target.current().platform, "volume")


def _frames(
    x_BTHWC: Array, kernel: Array, stride: int, padding: Sequence, out: jnp.dtype | None = None
) -> Array:
    """2D convolution of every frame, returned in x's dtype or in ``out``."""
    batch, frames = x_BTHWC.shape[:2]
    y = jax.lax.conv_general_dilated(
        x_BTHWC.reshape(batch * frames, *x_BTHWC.shape[2:]),
        kernel,
        (stride, stride),
        padding,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        preferred_element_type=out,
    )
    return y.reshape(batch, frames, *y.shape[1:])


def _taps(padded_BTHWC: Array, kernel: Array) -> Array:
    """Sum of three convolutions, in float32."""
    frames, float32 = padded_BTHWC.shape[1] - 2, jnp.dtype(jnp.float32)
    inputs = [padded_BTHWC[:, k : k + frames] for k in range(3)]
    return sum(_frames(x, kernel[k], 1, SAME, float32) for k, x in enumerate(inputs))


def _stacked(padded_BTHWC: Array, kernel: Array) -> Array:
    """One convolution of every three neighbouring frames, joined along their channels."""
    frames, channels = padded_BTHWC.shape[1] - 2, padded_BTHWC.shape[-1]
    joined = jnp.concatenate([padded_BTHWC[:, k : k + frames] for k in range(3)], -1)
    flat = kernel.transpose(1, 2, 0, 3, 4).reshape(3, 3, 3 * channels, -1)
    return _frames(joined, flat, 1, SAME)


def _winograd(padded_BTHWC: Array, kernel: Array) -> Array:
    """Convolve in tiles of 4, 3 or 2 frames; tiles of one size are computed together."""
    parts, start = [], 0
    for size, count in _split(padded_BTHWC.shape[1] - 2):
        end = start + size * count
        if size == 1:
            taps = kernel.astype(padded_BTHWC.dtype)
            parts.append(_taps(padded_BTHWC[:, start : end + 2], taps))
        else:
            parts.append(_tiles(padded_BTHWC[:, start : end + 2], kernel, size))
        start = end
    return jnp.concatenate(parts, 1)


def _split(frames: int) -> list[tuple[int, int]]:
    """Split frames into tiles, as (size, count) pairs, with as few convolutions as possible."""
    fours, rest = divmod(frames, 4)
    if rest == 1 and fours:
        fours, threes, rest = (fours - 2, 3, 0) if fours > 1 else (0, 1, 2)
    else:
        threes, rest = (1, 0) if rest == 3 else (0, rest)
    return [(n, k) for n, k in ((4, fours), (3, threes), (rest, 1)) if n and k]


def _tiles(padded_BTHWC: Array, kernel: Array, size: int) -> Array:
    """Compute tiles of ``size`` output frames with size + 2 convolutions each."""
    batch, frames, height, width, _ = padded_BTHWC.shape
    count, float32 = (frames - 2) // size, jnp.dtype(jnp.float32)
    out_of, weigh, into = minimal_filter(size)
    inputs = [padded_BTHWC[:, i : i + size * (count - 1) + 1 : size] for i in range(size + 2)]
    weighed = jnp.einsum("aj,jhwcd->ahwcd", np.float32(weigh), kernel)
    products = [
        _frames(_combine(row, inputs), weighed[a].astype(padded_BTHWC.dtype), 1, SAME, float32)
        for a, row in enumerate(into)
    ]
    out = jnp.stack([_combine(row, products) for row in out_of], 2)
    return out.reshape(batch, frames - 2, height, width, -1)


@functools.cache
def minimal_filter(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float64 matrices of Winograd's F(size, 3) for a three-tap filter.

    ``out_of @ ((weigh @ kernel) * (into @ inputs))`` is the correlation of size + 2 inputs with 3
    taps. It is the transpose of Toom-Cook multiplication of polynomials: evaluate at size + 1
    points and at infinity, multiply, interpolate.

    Returns:
        out_of (size, size + 2), weigh (size + 2, 3), into (size + 2, size + 2).
    """
    points = np.array(POINTS[: size + 1])

    def evaluate(terms: int) -> np.ndarray:
        powers = points[:, None] ** np.arange(terms)
        return np.concatenate([powers, np.eye(terms)[-1:]])

    into = np.linalg.inv(evaluate(size + 2)).T
    into[np.abs(into) < 1e-12] = 0
    # Moving each row's smallest factor to the kernel makes many factors ±1.
    least = np.array([np.abs(row[row != 0]).min() for row in into])[:, None]
    return evaluate(size).T, evaluate(3) * least, into / least


def _combine(row: np.ndarray, arrays: Sequence[Array]) -> Array:
    """Weighted sum of arrays, skipping zeros."""
    terms = [x if c == 1 else float(c) * x for c, x in zip(row, arrays, strict=True) if c]
    return functools.reduce(jnp.add, terms)
