"""The order of a clip's tokens: text, then video; or, split over devices, a share of each per part.

Attention does not ask in which order tokens stand. So where the mesh splits tokens into X parts,
each part gets 1/X of the text and 1/X of *every* latent frame, one after the other:

    one part     text                          frame 0          frame 1 …
    X parts      text[0] frame 0[0] frame 1[0] … | text[1] frame 0[1] frame 1[1] … | …

Then text and video come apart, and frames too, without a token leaving its device. What X does not
divide is filled up with tokens of zeros, which queries never see (``real``) and which are dropped
at the end.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from pewm_jax.models import placement
from pewm_jax.types import Array


@dataclasses.dataclass(frozen=True)
class TokenLayout:
    """How L text tokens and t·n video tokens are ordered; static.

    Attributes:
        parts: X, into how many parts they are split.
        text: L.
        frames: t, frames of video tokens.
        patches: n, video tokens of a frame.
    """

    parts: int
    text: int
    frames: int
    patches: int

    @classmethod
    def here(cls, text: int, frames: int, patches: int) -> TokenLayout:
        """Return the layout that the mesh in context asks for."""
        return cls(placement.parts("tokens"), text, frames, patches)

    @property
    def length(self) -> int:
        """Return the text tokens of a part, with what fills up."""
        return -(-self.text // self.parts)

    @property
    def wide(self) -> int:
        """Return a frame's video tokens in a part, with what fills up."""
        return -(-self.patches // self.parts)

    def spread(self, video_BNC: Array) -> Array:
        """(B, t·n, C) → (B, X·t·n', C): the share of each part of every frame, part by part."""
        if self.parts == 1:
            return video_BNC
        batch, channels = video_BNC.shape[0], video_BNC.shape[-1]
        grid = video_BNC.reshape(batch, self.frames, self.patches, channels)
        more = self.parts * self.wide - self.patches
        grid = jnp.pad(grid, ((0, 0), (0, 0), (0, more), (0, 0)))
        grid = grid.reshape(batch, self.frames, self.parts, self.wide, channels)
        spread = grid.swapaxes(1, 2).reshape(batch, -1, channels)
        return placement.constrain(spread, "batch", "tokens")

    def gather(self, video_BNC: Array) -> Array:
        """Invert ``spread``."""
        if self.parts == 1:
            return video_BNC
        batch, channels = video_BNC.shape[0], video_BNC.shape[-1]
        grid = video_BNC.reshape(batch, self.parts, self.frames, self.wide, channels)
        grid = grid.swapaxes(1, 2).reshape(batch, self.frames, -1, channels)
        return grid[:, :, : self.patches].reshape(batch, -1, channels)

    def arrange(self, tokens_BNC: Array) -> Array:
        """(B, L + t·n, C) text, then video, in their own order → in the order of this layout."""
        if self.parts == 1:
            return tokens_BNC
        text, video = jnp.split(tokens_BNC, [self.text], 1)
        more = self.parts * self.length - self.text
        return self.join(jnp.pad(text, ((0, 0), (0, more), (0, 0))), self.spread(video))

    def join(self, text_BLC: Array, video_BNC: Array) -> Array:
        """Join what ``split`` gives."""
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
            for x in jnp.split(grid, [self.length], 2)
        )
        return text, video

    def per_token(self, frames_BtC: Array) -> Array:
        """(B, t, C) of tokens in time → (B, N, C) of video tokens, each part by part."""
        return self.spread(jnp.repeat(frames_BtC, self.patches, 1))

    @property
    def is_text(self) -> np.ndarray:
        """Return (N', 1) bool over all tokens: which are text."""
        part = np.arange(self.length + self.frames * self.wide) < self.length
        return np.tile(part, self.parts)[:, None]

    @property
    def real(self) -> np.ndarray | None:
        """Return where the tokens stand that do not only fill up; None where all do not."""
        ones = np.ones((1, self.text + self.frames * self.patches, 1), np.int8)
        marks = _on_host(self, ones)[0, :, 0]
        return None if marks.all() else np.flatnonzero(marks)


def _on_host(layout: TokenLayout, tokens: np.ndarray) -> np.ndarray:
    """Do ``arrange`` with NumPy."""
    text, video = np.split(tokens, [layout.text], 1)
    more = layout.parts * layout.length - layout.text
    text = np.pad(text, ((0, 0), (0, more), (0, 0))).reshape(1, layout.parts, -1, 1)
    video = video.reshape(1, layout.frames, layout.patches, 1)
    more = layout.parts * layout.wide - layout.patches
    video = np.pad(video, ((0, 0), (0, 0), (0, more), (0, 0)))
    video = video.reshape(1, layout.frames, layout.parts, layout.wide, 1).swapaxes(1, 2)
    return np.concatenate([text, video.reshape(1, layout.parts, -1, 1)], 2).reshape(1, -1, 1)
