"""The video autoencoder (stub: layout and init first)."""

from pewm_jax.models.vae_layout import init, layout

__all__ = ["init", "layout"]
