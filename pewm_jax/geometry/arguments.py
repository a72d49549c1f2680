"""Checks of the arrays that public functions are given."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax.core import Tracer

from pewm_jax.config import UserError


def require_array(who: str, name: str, value: Any, *shape: Any) -> None:
    """Refuse what is no array of finite numbers of a shape.

    Values are not looked at under jit, vmap and grad; types and shapes are.

    Args:
        who: the function, for the message.
        name: the argument, for the message.
        value: what was given.
        shape: the sizes of its last axes, None for any size; more axes may come before them if the
            first is Ellipsis.

    Raises:
        UserError: it has another type or shape, or holds NaN or infinity.
    """
    free, sizes = shape[:1] == (...,), tuple(n for n in shape if n is not ...)
    if isinstance(value, Tracer):
        found, kind, values = value.shape, "f", None
    else:
        try:
            values = np.asarray(value)
        except (ValueError, TypeError):
            values = np.asarray(None)
        found, kind = values.shape, values.dtype.kind
    numbers = kind in "fiu" or "float" in str(getattr(values, "dtype", ""))
    last = found[len(found) - len(sizes) :] if sizes else ()
    fits = len(found) >= len(sizes) if free else len(found) == len(sizes)
    fits = fits and all(n in (None, m) for n, m in zip(sizes, last, strict=True))
    if not (numbers and fits):
        wanted = ", ".join(["…"] * free + ["n" if n is None else str(n) for n in sizes])
        what = f"shape {found}" if numbers else f"type {type(value).__name__}"
        form = f"numbers of shape ({wanted})" if wanted else "a number"
        raise UserError(f"{who}() got {name} of {what}: give {form}.")
    if values is not None and not np.isfinite(np.asarray(values, np.float64)).all():
        raise UserError(f"{who}() got {name} with NaN or infinity: give finite numbers.")
