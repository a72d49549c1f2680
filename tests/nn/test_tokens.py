"""The order of tokens split over devices: reversible, with every frame in every part."""

import numpy as np
import pytest

from pewm_jax.nn.tokens import TokenLayout

layouts = pytest.mark.parametrize(
    "layout",
    [
        TokenLayout(parts=1, text=3, frames=2, patches=5),
        TokenLayout(parts=2, text=4, frames=3, patches=6),
        TokenLayout(parts=4, text=1, frames=2, patches=6),
    ],
    ids=["whole", "even", "uneven"],
)


def tokens_of(layout):
    """Tokens that say who they are: text −1, −2 …, video 1, 2 …"""
    text = -1 - np.arange(layout.text)
    video = 1 + np.arange(layout.frames * layout.patches)
    return np.concatenate([text, video]).astype(np.float32)[None, :, None]


@layouts
def test_tokens_come_back_and_only_zeros_are_added(layout):
    plain = tokens_of(layout)
    arranged = np.asarray(layout.arrange(plain))
    assert arranged.shape[1] % layout.parts == 0
    flat = arranged[0, :, 0]
    where = np.flatnonzero(flat)
    assert sorted(flat[where]) == sorted(plain[0, :, 0])
    np.testing.assert_array_equal(layout.real, where if len(where) < len(flat) else None)
    assert (flat[layout.is_text[:, 0]] <= 0).all()
    assert (flat[~layout.is_text[:, 0]] >= 0).all()
    text, video = layout.split(arranged)
    np.testing.assert_array_equal(layout.join(text, video), arranged)
    np.testing.assert_array_equal(layout.gather(video), plain[:, layout.text :])
    np.testing.assert_array_equal(video, layout.spread(plain[:, layout.text :]))


@layouts
def test_every_part_has_its_share_of_every_frame(layout):
    video = np.asarray(layout.split(layout.arrange(tokens_of(layout)))[1])
    shares = video.reshape(layout.parts, layout.frames, layout.patches_per_part)
    for frame in range(layout.frames):
        first = 1 + frame * layout.patches
        held = shares[:, frame].ravel()
        np.testing.assert_array_equal(held[: layout.patches], first + np.arange(layout.patches))
