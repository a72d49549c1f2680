"""A 3D convolution as matrix products, forward and backward.

XLA's CPU backend computes the gradient of a 3D kernel as a convolution with a window as large as
the grid. Here the 27 shifted copies of the grid are laid side by side and multiplied at once, and
both gradients are such products too: the input's is the convolution of the output's gradient with
the kernel turned round, the kernel's is the product of the copies with the output's gradient.
``benchmarks/voxel_vae.py`` measures both.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp

from pewm_jax.types import Array

LETTERS = ("NXYZC", "XYZIO", "NXYZC")
Form = Literal["auto", "xla", "products"]
"""How a convolution is computed: by XLA, as products, or as products on a CPU alone."""


def convolve(x_NXYZC: Array, kernel_XYZIO: Array, form: Form = "auto") -> Array:
    """Convolve grids with a cubic kernel of odd side, with zeros around the grid.

    Args:
        x_NXYZC: grids.
        kernel_XYZIO: the kernel, in the dtype of the grids.
        form: how it is computed; the result is the same up to rounding.
    """
    if kernel_XYZIO.shape[0] == 1:
        return x_NXYZC @ kernel_XYZIO[0, 0, 0]
    if form == "auto":
        return jax.lax.platform_dependent(x_NXYZC, kernel_XYZIO, cpu=by_products, default=by_xla)
    return (by_xla if form == "xla" else by_products)(x_NXYZC, kernel_XYZIO)


def by_xla(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    """Compute ``convolve`` by XLA."""
    return jax.lax.conv_general_dilated(
        x_NXYZC, kernel_XYZIO, (1, 1, 1), "SAME", None, None, LETTERS
    )


@jax.custom_vjp
def by_products(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    """Compute ``convolve`` as a product with the shifted copies."""
    columns = _columns(x_NXYZC, kernel_XYZIO.shape[0])
    return columns @ kernel_XYZIO.reshape(-1, kernel_XYZIO.shape[-1])


def _forward(x_NXYZC: Array, kernel_XYZIO: Array) -> tuple[Array, tuple[Array, Array]]:
    return by_products(x_NXYZC, kernel_XYZIO), (x_NXYZC, kernel_XYZIO)


def _backward(saved: tuple[Array, Array], out_NXYZO: Array) -> tuple[Array, Array]:
    x, kernel = saved
    to_input = by_products(out_NXYZO, jnp.flip(kernel, (0, 1, 2)).swapaxes(3, 4))
    columns = _columns(x, kernel.shape[0])
    outward = kernel.shape[-1]
    product = out_NXYZO.reshape(-1, outward).T @ columns.reshape(-1, columns.shape[-1])
    return to_input, product.T.reshape(kernel.shape)


by_products.defvjp(_forward, _backward)


def _columns(x_NXYZC: Array, side: int) -> Array:
    """Return (N, X, Y, Z, side³·C): what lies under the kernel at each place."""
    around = side // 2
    x = x_NXYZC
    for axis in (3, 2, 1):  # the last axis' copies lie innermost, as in the kernel
        padding = [(0, 0)] * 5
        padding[axis] = (around, around)
        padded, count = jnp.pad(x, padding), x.shape[axis]
        taps = [jax.lax.slice_in_dim(padded, tap, tap + count, axis=axis) for tap in range(side)]
        x = jnp.concatenate(taps, -1)
    return x


def halved(x_NXYZC: Array, kernel_XYZIO: Array, form: Form = "auto") -> Array:
    """Convolve with a kernel of side 3 at every second place along each axis.

    The places are those with even numbers, as in torch with a padding of 1. Sides are even.
    """
    if form == "auto":
        return jax.lax.platform_dependent(
            x_NXYZC, kernel_XYZIO, cpu=_halved_by_products, default=_halved_by_xla
        )
    halve = _halved_by_xla if form == "xla" else _halved_by_products
    return halve(x_NXYZC, kernel_XYZIO)


def _halved_by_xla(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    return jax.lax.conv_general_dilated(
        x_NXYZC, kernel_XYZIO, (2, 2, 2), ((1, 1),) * 3, None, None, LETTERS
    )


def _halved_by_products(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    """Gather every second place's columns, along one axis after the other."""
    x = x_NXYZC
    for axis in (3, 2, 1):
        padding = [(0, 0)] * 5
        padding[axis] = (1, 1)
        padded, count = jnp.pad(x, padding), x.shape[axis]
        taps = [jax.lax.slice_in_dim(padded, tap, tap + count - 1, 2, axis) for tap in range(3)]
        x = jnp.concatenate(taps, -1)
    return x @ kernel_XYZIO.reshape(-1, kernel_XYZIO.shape[-1])
