"""Convolutions of pictures and of cubic grids, in the form that the backend runs fastest.

XLA's CPU backend computes the gradient of a kernel as a convolution with a window as large as the
picture or grid, at about a quarter of the speed of a matrix product (2D). Here it is the product of
the output's gradient with the input's shifted copies. In 3D the forward pass is such a product too:
the 27 shifted copies of the grid are laid side by side and multiplied at once; the gradient of the
input is the convolution of the output's gradient with the reversed kernel. Elsewhere XLA's own
convolutions are used. ``benchmarks/voxel_vae.py`` measures both. ``nn.video_convolution`` has those
of videos.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp

from pewm_jax.types import Array, Params

PICTURES = ("NHWC", "HWIO", "NHWC")
GRIDS = ("NXYZC", "XYZIO", "NXYZC")
GROUP = 2**21
"""Numbers in the shifted copies of a group of pictures."""
Form = Literal["auto", "xla", "products"]
"""How a 3D convolution is computed: by XLA, as products, or as products on a CPU alone."""


@jax.custom_vjp
def convolve(x_NHWC: Array, kernel_HWIO: Array) -> Array:
    """Convolve pictures with a square kernel of odd side, with zeros around the picture."""
    return jax.lax.conv_general_dilated(x_NHWC, kernel_HWIO, (1, 1), "SAME", None, None, PICTURES)


def _convolve_forward(x_NHWC: Array, kernel_HWIO: Array) -> tuple[Array, tuple[Array, Array]]:
    return convolve(x_NHWC, kernel_HWIO), (x_NHWC, kernel_HWIO)


def _convolve_backward(saved: tuple[Array, Array], out_NHWO: Array) -> tuple[Array, Array]:
    x, kernel = saved
    to_input = convolve(out_NHWO, jnp.flip(kernel, (0, 1)).swapaxes(2, 3))
    to_kernel = jax.lax.platform_dependent(
        x, kernel, out_NHWO, cpu=_kernel_by_product, default=_kernel_by_convolution
    )
    return to_input, to_kernel


def _kernel_by_product(x_NHWC: Array, kernel: Array, out_NHWO: Array) -> Array:
    """Sum over groups of pictures, so that the copies of a group fit a processor's cache."""
    side, _, inward, outward = kernel.shape
    count, height, width, _ = x_NHWC.shape
    around = side // 2

    def of_group(x: Array, out: Array) -> Array:
        padded = jnp.pad(x, ((0, 0), (around, around), (around, around), (0, 0)))
        shifted = [
            padded[:, i : i + height, j : j + width] for i in range(side) for j in range(side)
        ]
        beside = jnp.concatenate(shifted, -1).reshape(-1, side * side * inward)
        return out.reshape(-1, outward).T @ beside

    wanted = max(1, GROUP // (height * width * side * side * inward))
    size = max(k for k in range(1, min(wanted, count) + 1) if count % k == 0)
    if size == count:
        product = of_group(x_NHWC, out_NHWO)
    else:
        groups = (x.reshape(-1, size, *x.shape[1:]) for x in (x_NHWC, out_NHWO))
        start = jnp.zeros((outward, side * side * inward), jnp.float32)
        product, _ = jax.lax.scan(
            lambda total, group: (total + of_group(*group), None), start, tuple(groups)
        )
    return product.T.reshape(kernel.shape).astype(kernel.dtype)


def _kernel_by_convolution(x_NHWC: Array, kernel: Array, out_NHWO: Array) -> Array:
    def of_kernel(kernel: Array) -> Array:
        shape = (1, 1), "SAME", None, None, PICTURES
        return jax.lax.conv_general_dilated(x_NHWC, kernel, *shape)

    return jax.vjp(of_kernel, kernel)[1](out_NHWO)[0]


convolve.defvjp(_convolve_forward, _convolve_backward)


def convolve_layer(weights: Params, x_NHWC: Array) -> Array:
    """Apply a convolution with its bias; the frame is padded with zeros."""
    kernel, bias = (weights[name].astype(x_NHWC.dtype) for name in ("kernel", "bias"))
    if kernel.shape[0] == 1:
        return x_NHWC @ kernel[0, 0] + bias
    return convolve(x_NHWC, kernel) + bias


def convolve_grid(x_NXYZC: Array, kernel_XYZIO: Array, form: Form = "auto") -> Array:
    """Convolve grids with a cubic kernel of odd side, with zeros around the grid.

    The form does not change the result, up to rounding.
    """
    if kernel_XYZIO.shape[0] == 1:
        return x_NXYZC @ kernel_XYZIO[0, 0, 0]
    return _in_form(form, by_xla, by_products, x_NXYZC, kernel_XYZIO)


def by_xla(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    """Compute ``convolve_grid`` by XLA."""
    return jax.lax.conv_general_dilated(x_NXYZC, kernel_XYZIO, (1, 1, 1), "SAME", None, None, GRIDS)


@jax.custom_vjp
def by_products(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    """Compute ``convolve_grid`` as a product with the shifted copies."""
    columns = _columns(x_NXYZC, kernel_XYZIO.shape[0])
    return columns @ kernel_XYZIO.reshape(-1, kernel_XYZIO.shape[-1])


def _grid_forward(x_NXYZC: Array, kernel_XYZIO: Array) -> tuple[Array, tuple[Array, Array]]:
    return by_products(x_NXYZC, kernel_XYZIO), (x_NXYZC, kernel_XYZIO)


def _grid_backward(saved: tuple[Array, Array], out_NXYZO: Array) -> tuple[Array, Array]:
    x, kernel = saved
    to_input = by_products(out_NXYZO, jnp.flip(kernel, (0, 1, 2)).swapaxes(3, 4))
    columns = _columns(x, kernel.shape[0])
    outward = kernel.shape[-1]
    product = out_NXYZO.reshape(-1, outward).T @ columns.reshape(-1, columns.shape[-1])
    return to_input, product.T.reshape(kernel.shape)


by_products.defvjp(_grid_forward, _grid_backward)


def _columns(x_NXYZC: Array, side: int, stride: int = 1) -> Array:
    """Return (N, X, Y, Z, side³·C): what lies under the kernel at each place, or at every second.

    It is gathered along one axis after the other.
    """
    around = side // 2
    x = x_NXYZC
    for axis in (3, 2, 1):  # the last axis' copies lie innermost, as in the kernel
        padding = [(0, 0)] * 5
        padding[axis] = (around, around)
        padded, end = jnp.pad(x, padding), x.shape[axis] + 1 - stride
        taps = [jax.lax.slice_in_dim(padded, k, k + end, stride, axis) for k in range(side)]
        x = jnp.concatenate(taps, -1)
    return x


def halve_grid(x_NXYZC: Array, kernel_XYZIO: Array, form: Form = "auto") -> Array:
    """Convolve with a kernel of side 3 at every second place along each axis.

    The places are those with even numbers, as in torch with a padding of 1. Sides are even.
    """
    return _in_form(form, _halve_by_xla, _halve_by_products, x_NXYZC, kernel_XYZIO)


def _in_form(form: Form, by_xla: Any, by_products: Any, *arrays: Array) -> Array:
    if form == "auto":
        return jax.lax.platform_dependent(*arrays, cpu=by_products, default=by_xla)
    return (by_xla if form == "xla" else by_products)(*arrays)


def _halve_by_xla(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    return jax.lax.conv_general_dilated(
        x_NXYZC, kernel_XYZIO, (2, 2, 2), ((1, 1),) * 3, None, None, GRIDS
    )


def _halve_by_products(x_NXYZC: Array, kernel_XYZIO: Array) -> Array:
    return _columns(x_NXYZC, 3, 2) @ kernel_XYZIO.reshape(-1, kernel_XYZIO.shape[-1])
