"""Gymnasium, or an error that says how to install it."""

from __future__ import annotations

from pewm_jax.config import UserError

try:
    import gymnasium
except ImportError:
    raise UserError(
        "environments need Gymnasium, which is not installed: pip install 'pewm-jax[planning]'."
    ) from None

__all__ = ["gymnasium"]
