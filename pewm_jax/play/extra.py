"""Import viser, or explain how to install it."""

from __future__ import annotations

from pewm_jax.config import UserError

try:
    import viser
    import viser.transforms
except ImportError:
    raise UserError(
        "the live viewer needs viser, which is not installed: pip install 'pewm-jax[play]'."
    ) from None

__all__ = ["viser"]
