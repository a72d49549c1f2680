"""Weights in 8 bits for inference: int8, or fp8 (e4m3), with one scale for each output channel.

The kernels of linear layers and convolutions of the denoiser, the memory's reader and the control
are kept in 8 bits and computed layer by layer where they are used (``nn.deferred``); computation
stays in the model's precision. Other parameters, and the networks that turn pixels into latents or
features and back, stay as they are.
"""

from __future__ import annotations

from typing import Any, get_args

import jax
import jax.numpy as jnp

from pewm_jax.config import Task, UserError
from pewm_jax.errors import require
from pewm_jax.io import tree
from pewm_jax.nn import deferred
from pewm_jax.nn.deferred import Precision
from pewm_jax.types import Params
from pewm_jax.worlds import lora

WHOLE = ("codec", "encoder", "image", "text", "voxel_vae")
"""Branches of the parameters that are not quantized."""


def quantize(model: Task, params: Params, precision: str) -> Params:
    """Return parameters with kernels in 8 bits, on the host; unchanged if ``precision`` is "".

    Raises:
        UserError: the precision is unknown, or no network of the model can take such weights.
    """
    if not precision:
        return params
    known = get_args(Precision)
    require(
        precision in known,
        f"quantize is {precision!r}: choose one of {', '.join(map(repr, known))}.",
    )
    leaves, count = tree.flatten(params), 0
    for path, leaf in leaves.items():
        part = path.removeprefix(lora.OF_DRAFT).split("/", maxsplit=1)[0]
        floats = jnp.issubdtype(leaf.dtype, jnp.floating)
        if part in WHOLE or not (floats and deferred.is_matrix(path, leaf.shape)):
            continue
        if lora.takes_deferred(model, path):
            stacked = deferred.is_stacked(path)
            leaves[path] = deferred.quantize(leaf, precision, stacked=stacked)  # type: ignore[arg-type]
            count += 1
    if not count:
        raise UserError(
            f"quantize is {precision!r}, and none of the weights can be kept in 8 bits: only "
            "networks of this library take such weights; leave it out."
        )
    return tree.unflatten(leaves)


def bytes_of(params: Any) -> int:
    """Return the memory of parameters in bytes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(params))
