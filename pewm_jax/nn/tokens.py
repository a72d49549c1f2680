"""Tokens of a clip: patches of latents, and the order of text and video tokens.

Text comes first, then video. Over several devices each gets a part of both.

Attention does not depend on the order of tokens. If the mesh splits tokens into X parts, each part
gets 1/X of the text and 1/X of *every* latent frame:

    one part     text                          frame 0          frame 1 …
    X parts      text[0] frame 0[0] frame 1[0] … | text[1] frame 0[1] frame 1[1] … | …

So text and video, and single frames, can be separated without moving a token between devices. If
X does not divide a count, it is padded with zero tokens. They are masked in attention (``real``)
and dropped at the end.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import AssembledModel
from pewm_jax.nn import placement
from pewm_jax.types import Array


def patchify(latents_BthwC: Array, patch: int | tuple[int, int], patch_t: int = 1) -> Array:
    """(B, t, h, w, C) → (B, t/p_t·h/p·w/p, C·p_t·p·p), channels before the patch's cells.

    ``patch`` may be two numbers, of rows and of columns.
    """
    batch, frames, height, width, channels = latents_BthwC.shape
    rows, columns = (patch, patch) if isinstance(patch, int) else patch
    t, h, w = frames // patch_t, height // rows, width // columns
    grid = latents_BthwC.reshape(batch, t, patch_t, h, rows, w, columns, channels)
    cells = channels * patch_t * rows * columns
    return grid.transpose(0, 1, 3, 5, 7, 2, 4, 6).reshape(batch, -1, cells)


def unpatchify(
    tokens_BNC: Array,
    frames: int,
    height: int,
    width: int,
    patch: int | tuple[int, int],
    patch_t: int = 1,
) -> Array:
    """Invert ``patchify`` to (B, frames, height, width, C); sizes are the latents'."""
    batch = tokens_BNC.shape[0]
    rows, columns = (patch, patch) if isinstance(patch, int) else patch
    t, h, w = frames // patch_t, height // rows, width // columns
    grid = tokens_BNC.reshape(batch, t, h, w, -1, patch_t, rows, columns)
    return grid.transpose(0, 1, 5, 2, 6, 3, 7, 4).reshape(batch, frames, height, width, -1)


def patchify_images(images_BHWC: Array, patch: int) -> Array:
    """(B, H, W, 3) → (B, H/p·W/p, p·p·3): each patch's pixels row by row, colours innermost."""
    batch, height, width, channels = images_BHWC.shape
    grid = images_BHWC.reshape(batch, height // patch, patch, width // patch, patch, channels)
    return grid.transpose(0, 1, 3, 2, 4, 5).reshape(batch, -1, patch * patch * channels)


def video_tokens(model: AssembledModel) -> tuple[int, int]:
    """Return the video tokens of a clip: (tokens in time, tokens at each time).

    If a backbone names no places, its tokens are the latent cells.
    """
    (t, h, w), places = model.latent_shape, model.backbone.places
    if places is None:
        return t, h * w
    return -(-t // places.patch_t), (h // places.patch) * (w // places.patch)


def text_tokens(model: AssembledModel) -> int:
    """Return the number of text tokens of a clip."""
    return model.backbone.text_shape[0] if model.backbone.text_shape else 0


@dataclasses.dataclass(frozen=True)
class TokenLayout:
    """How L text tokens and t·n video tokens are ordered; static.

    Attributes:
        parts: X, number of parts that the tokens are split into.
        text: L, number of text tokens.
        frames: t, number of latent frames, counted in tokens.
        patches: n, video tokens per frame.
    """

    parts: int
    text: int
    frames: int
    patches: int

    @classmethod
    def for_mesh(cls, text: int, frames: int, patches: int) -> TokenLayout:
        """Return the layout for the current mesh."""
        return cls(placement.parts("tokens"), text, frames, patches)

    @property
    def text_per_part(self) -> int:
        """Return the text tokens of a part, with padding."""
        return -(-self.text // self.parts)

    @property
    def patches_per_part(self) -> int:
        """Return the video tokens of one frame in a part, with padding."""
        return -(-self.patches // self.parts)

    def spread(self, video_BNC: Array) -> Array:
        """(B, t·n, C) → (B, X·t·n', C): each part's share of every frame, part by part."""
        if self.parts == 1:
            return video_BNC
        batch, channels = video_BNC.shape[0], video_BNC.shape[-1]
        grid = video_BNC.reshape(batch, self.frames, self.patches, channels)
        more = self.parts * self.patches_per_part - self.patches
        grid = jnp.pad(grid, ((0, 0), (0, 0), (0, more), (0, 0)))
        grid = grid.reshape(batch, self.frames, self.parts, self.patches_per_part, channels)
        spread = grid.swapaxes(1, 2).reshape(batch, -1, channels)
        return placement.constrain(spread, "batch", "tokens")

    def gather(self, video_BNC: Array) -> Array:
        """Invert ``spread``."""
        if self.parts == 1:
            return video_BNC
        batch, channels = video_BNC.shape[0], video_BNC.shape[-1]
        grid = video_BNC.reshape(batch, self.parts, self.frames, self.patches_per_part, channels)
        grid = grid.swapaxes(1, 2).reshape(batch, self.frames, -1, channels)
        return grid[:, :, : self.patches].reshape(batch, -1, channels)

    def arrange(self, tokens_BNC: Array) -> Array:
        """(B, L + t·n, C) text then video tokens → the same tokens in the order of this layout."""
        if self.parts == 1:
            return tokens_BNC
        text, video = jnp.split(tokens_BNC, [self.text], 1)
        more = self.parts * self.text_per_part - self.text
        return self.join(jnp.pad(text, ((0, 0), (0, more), (0, 0))), self.spread(video))

    def join(self, text_BLC: Array, video_BNC: Array) -> Array:
        """Invert ``split``."""
        if self.parts == 1:
            return jnp.concatenate([text_BLC, video_BNC], 1)
        batch, channels = video_BNC.shape[0], video_BNC.shape[-1]
        both = [x.reshape(batch, self.parts, -1, channels) for x in (text_BLC, video_BNC)]
        joined = jnp.concatenate(both, 2).reshape(batch, -1, channels)
        return placement.constrain(joined, "batch", "tokens")

    def split(self, tokens_BNC: Array) -> tuple[Array, Array]:
        """Return the text and the video tokens of every part, each part by part."""
        batch, channels = tokens_BNC.shape[0], tokens_BNC.shape[-1]
        if self.parts == 1:
            text, video = jnp.split(tokens_BNC, [self.text], 1)
            return text, video
        grid = tokens_BNC.reshape(batch, self.parts, -1, channels)
        text, video = (
            placement.constrain(x.reshape(batch, -1, channels), "batch", "tokens")
            for x in jnp.split(grid, [self.text_per_part], 2)
        )
        return text, video

    def per_token(self, frames_BtC: Array) -> Array:
        """(B, t, C), one vector per token in time → (B, N, C), one per video token."""
        return self.spread(jnp.repeat(frames_BtC, self.patches, 1))

    @property
    def is_text(self) -> np.ndarray:
        """Return (N', 1) bool: True for text tokens."""
        count = self.text_per_part + self.frames * self.patches_per_part
        return np.tile(np.arange(count) < self.text_per_part, self.parts)[:, None]

    @property
    def real(self) -> np.ndarray | None:
        """Return the indices of the tokens that are not padding; None if there is no padding."""
        part = np.arange(self.parts)[:, None]
        text = part * self.text_per_part + np.arange(self.text_per_part) < self.text
        video = part * self.patches_per_part + np.arange(self.patches_per_part) < self.patches
        marks = np.concatenate([text, np.tile(video, self.frames)], 1).reshape(-1)
        return None if marks.all() else np.flatnonzero(marks)
