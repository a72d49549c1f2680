"""A 2D convolution whose weight gradient is fast on CPUs too.

XLA's CPU backend computes the gradient of a kernel as a convolution with a window as large as the
picture, at about a quarter of the speed of a matrix product. Here it is the product of the output's
gradient with the input's shifted copies. Elsewhere XLA's own is used.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.types import Array

LETTERS = ("NHWC", "HWIO", "NHWC")


@jax.custom_vjp
def convolve(x_NHWC: Array, kernel_HWIO: Array) -> Array:
    """Convolve pictures with a square kernel of odd side, with zeros around the picture."""
    return jax.lax.conv_general_dilated(x_NHWC, kernel_HWIO, (1, 1), "SAME", None, None, LETTERS)


def _forward(x_NHWC: Array, kernel_HWIO: Array) -> tuple[Array, tuple[Array, Array]]:
    return convolve(x_NHWC, kernel_HWIO), (x_NHWC, kernel_HWIO)


def _backward(saved: tuple[Array, Array], out_NHWO: Array) -> tuple[Array, Array]:
    x, kernel = saved
    to_input = convolve(out_NHWO, jnp.flip(kernel, (0, 1)).swapaxes(2, 3))
    to_kernel = jax.lax.platform_dependent(
        x, kernel, out_NHWO, cpu=_by_product, default=_by_convolution
    )
    return to_input, to_kernel


def _by_product(x_NHWC: Array, kernel: Array, out_NHWO: Array) -> Array:
    side, _, inward, outward = kernel.shape
    _, height, width, _ = x_NHWC.shape
    around = side // 2
    padded = jnp.pad(x_NHWC, ((0, 0), (around, around), (around, around), (0, 0)))
    shifted = [padded[:, i : i + height, j : j + width] for i in range(side) for j in range(side)]
    columns = jnp.concatenate(shifted, -1).reshape(-1, side * side * inward)
    product = out_NHWO.reshape(-1, outward).T @ columns
    return product.T.reshape(kernel.shape)


def _by_convolution(x_NHWC: Array, kernel: Array, out_NHWO: Array) -> Array:
    def of_kernel(kernel: Array) -> Array:
        shape = (1, 1), "SAME", None, None, LETTERS
        return jax.lax.conv_general_dilated(x_NHWC, kernel, *shape)

    return jax.vjp(of_kernel, kernel)[1](out_NHWO)[0]


convolve.defvjp(_forward, _backward)
