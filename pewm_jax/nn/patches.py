"""Latents ↔ patches: the cells of a patch become the channels of a token."""

from __future__ import annotations

from pewm_jax.types import Array


def patchify(latents_BthwC: Array, patch: int, patch_t: int = 1) -> Array:
    """(B, t, h, w, C) → (B, t/p_t·h/p·w/p, C·p_t·p·p), channels before the patch's cells."""
    batch, frames, height, width, channels = latents_BthwC.shape
    grid = latents_BthwC.reshape(
        batch,
        frames // patch_t,
        patch_t,
        height // patch,
        patch,
        width // patch,
        patch,
        channels,
    )
    cells = channels * patch_t * patch * patch
    return grid.transpose(0, 1, 3, 5, 7, 2, 4, 6).reshape(batch, -1, cells)


def unpatchify(
    tokens_BNC: Array, frames: int, height: int, width: int, patch: int, patch_t: int = 1
) -> Array:
    """Invert ``patchify`` to (B, frames, height, width, C); sizes are the latents'."""
    batch = tokens_BNC.shape[0]
    grid = tokens_BNC.reshape(
        batch,
        frames // patch_t,
        height // patch,
        width // patch,
        -1,
        patch_t,
        patch,
        patch,
    )
    return grid.transpose(0, 1, 5, 2, 6, 3, 7, 4).reshape(batch, frames, height, width, -1)
