"""Weights that are computed where a layer uses them: adapted by low rank, or quantized.

A ``Deferred`` weight takes the place of an array in a tree of parameters. Its own arrays are the
leaves of the tree, so ``jax.lax.scan`` over stacked layers slices them, and the full weight of one
layer exists only inside the loop's body. ``astype`` and flax's modules return the full weight;
networks need no other form.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax.core.meta import AxisMetadata

from pewm_jax.types import Array

STACKED = "blocks"
"""Name of parameter subtrees whose first axis is the layer."""
Precision = Literal["int8", "fp8"]
DTYPES = {"int8": jnp.dtype(jnp.int8), "fp8": jnp.dtype(jnp.float8_e4m3fn)}
LARGEST = {"int8": 127.0, "fp8": 448.0}
"""The largest number that a quantized weight stores."""


class Deferred(AxisMetadata[Any]):
    """A weight that is computed when it is used; flax's modules call ``unbox``."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """The shape of the weight."""

    @property
    @abc.abstractmethod
    def dtype(self) -> Any:
        """The dtype of the weight."""

    @abc.abstractmethod
    def wide(self) -> Array:
        """Return the weight in float32."""

    @property
    def ndim(self) -> int:
        """The number of the weight's axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """The number of the weight's elements."""
        return math.prod(self.shape)

    def astype(self, dtype: Any) -> Array:
        """Return the weight in a dtype."""
        return self.wide().astype(dtype)

    def unbox(self) -> Array:
        """Return the weight in its own dtype."""
        return self.astype(self.dtype)

    def __jax_array__(self) -> Array:
        """Return the weight for the functions of ``jax.numpy``."""
        return self.unbox()

    def replace_boxed(self, val: Any) -> Any:
        """Return the value, which is no longer deferred."""
        return val

    def add_axis(self, index: int, params: dict[Any, Any]) -> Any:
        """Return the weight itself: it has no names of axes."""
        del index, params
        return self

    remove_axis = add_axis


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class LowRank(Deferred):
    """``base + scale · a @ b`` (Hu et al. 2021, LoRA).

    Attributes:
        base: (…, in, out) kernel of a linear layer or a convolution, stacked over layers or not.
        a: (…, in, r) like the kernel.
        b: (r, out), or (layers, r, out) if layers are stacked.
        scale: factor of the product; static.
    """

    base: Array
    a: Array
    b: Array
    scale: float = dataclasses.field(metadata={"static": True})

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the base."""
        return tuple(self.base.shape)

    @property
    def dtype(self) -> Any:
        """The dtype of the base."""
        return self.base.dtype

    def wide(self) -> Array:
        """Return the sum in float32."""
        b = self.b.astype(jnp.float32)
        taps = (1,) * (self.a.ndim - b.ndim)
        b = b.reshape(*b.shape[:-2], *taps, *b.shape[-2:])
        delta = jnp.matmul(self.a.astype(jnp.float32), b, precision="highest")
        return self.base.astype(jnp.float32) + self.scale * delta


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Quantized(Deferred):
    """A kernel in 8 bits, with one scale for each output channel (and each stacked layer).

    Attributes:
        values: int8 or float8_e4m3fn, of the weight's shape.
        scale: float32, the largest magnitude of a channel over ``LARGEST``; its other axes are 1.
        full: name of the weight's dtype before quantization; static.
    """

    values: Array
    scale: Array
    full: str = dataclasses.field(metadata={"static": True})

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the weight."""
        return tuple(self.values.shape)

    @property
    def dtype(self) -> Any:
        """The dtype before quantization."""
        return jnp.dtype(self.full)

    def wide(self) -> Array:
        """Return the dequantized weight in float32."""
        return self.values.astype(jnp.float32) * self.scale


def quantize(kernel: Any, precision: Precision, *, stacked: bool) -> Quantized:
    """Quantize a kernel (…, in, out) on the host, symmetrically for each output channel.

    int8 is within half a step, 1/254 of a channel's largest magnitude; fp8 (e4m3) is within 1/16 of
    each value, or 2⁻¹⁰/448 of the largest for values near zero.

    Args:
        kernel: the weight, not a scalar or a vector; or its shape, for that of the result.
        precision: the format.
        stacked: whether the first axis is the layer, each of which has scales of its own.
    """
    if isinstance(kernel, jax.ShapeDtypeStruct):  # a plan has no values
        kept = [n if k < stacked else 1 for k, n in enumerate(kernel.shape[:-1])]
        return Quantized(
            jax.ShapeDtypeStruct(kernel.shape, DTYPES[precision]),
            jax.ShapeDtypeStruct((*kept, kernel.shape[-1]), np.float32),
            jnp.dtype(kernel.dtype).name,
        )
    array = np.asarray(kernel)
    wide = array.astype(np.float32)
    axes = tuple(range(int(stacked), wide.ndim - 1))
    largest = np.abs(wide).max(axes, keepdims=True)
    scale = np.where(largest > 0, largest, 1.0) / np.float32(LARGEST[precision])
    scaled = wide / scale
    scaled = np.rint(scaled) if precision == "int8" else scaled
    return Quantized(
        scaled.astype(DTYPES[precision]), scale.astype(np.float32), jnp.dtype(array.dtype).name
    )


def is_stacked(path: str) -> bool:
    """Tell whether the first axis of the parameter at a path is the layer."""
    return STACKED in path.split("/")[:-1]


def is_matrix(path: str, shape: tuple[int, ...]) -> bool:
    """Tell whether the parameter at a path is a matrix or a convolution's kernel."""
    return len(shape) - is_stacked(path) >= 2
