"""The picture of an episode: what it shows is where it says."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.episodes import read_episode, write_episode
from pewm_jax.data.show import ShowConfig, depth_colours, draw, show, view_from_above
from tests.data.two_rooms import arrays, split


def test_a_picture_is_written(tmp_path):
    folder = split(tmp_path / "train", frames=20)
    out = tmp_path / "pictures" / "one.png"
    said = []
    show(ShowConfig(folder, 1, out, columns=5, rows=2), said.append)
    picture = cv2.imread(str(out))
    assert picture.shape[1] == 5 * 128
    assert picture.shape[0] > 4 * 128
    assert [path.name for path in out.parent.iterdir()] == ["one.png"]
    assert "episode-1 in box, 20 frames" in said[0]


def test_thumbnails_are_the_frames():
    made = arrays(frames=6, size=16)
    picture = draw(read_episode(write_episode(made, "a", "b")), columns=3, rows=2)
    for k, (row, column) in enumerate((r, c) for r in (0, 2) for c in range(3)):
        thumb = picture[row * 128 : row * 128 + 128, column * 128 : column * 128 + 128]
        np.testing.assert_array_equal(thumb[44::8, 4::8], made.rgb_THWC[k][5:])
        below = picture[(row + 1) * 128 :, column * 128 :][4:128:8, 4:128:8]
        depth = np.rint(made.depth_THW * 1000).astype(np.float32) / 1000
        np.testing.assert_array_equal(below, depth_colours(depth[k], depth.max()))


def test_near_is_brighter_than_far_and_nothing_is_black():
    colours = depth_colours(np.array([[0.5, 2.0, 7.0, 0.0]], np.float32), 8.0)[0].sum(-1)
    assert colours[0] > colours[1] > colours[2] > colours[3] == 0


def test_the_path_is_drawn_where_the_agent_went():
    """Start and end are marked; x runs to the right and y up."""
    made = arrays(frames=60, size=32, seed=1)
    episode = read_episode(write_episode(made, "a", "b", {"return_frame": 30}))
    plan = view_from_above(episode, 600).astype(int)
    green = np.argwhere((plan == [40, 255, 40]).all(-1)).mean(0)
    red = np.argwhere((plan == [255, 40, 40]).all(-1)).mean(0)
    path = made.world_from_camera[:, :3, 3]
    moved = (path[-1] - path[0])[:2]
    assert np.abs(moved).min() > 0.3  # else this says nothing
    drawn = np.array([red[1] - green[1], green[0] - red[0]])
    np.testing.assert_allclose(
        drawn / np.linalg.norm(drawn), moved / np.linalg.norm(moved), atol=0.05
    )
    white = (plan == 255).all(-1)
    plain = read_episode(write_episode(made, "a", "b"))
    assert white.sum() > (view_from_above(plain, 600) == 255).all(-1).sum()


def test_what_cannot_be_shown_is_refused(tmp_path):
    folder = split(tmp_path / "train")
    with pytest.raises(UserError, match="has 4 episodes, 0 to 3"):
        show(ShowConfig(folder, 4))
    with pytest.raises(ConfigError, match=r"ends in \.png"):
        ShowConfig(folder, out=tmp_path / "x.txt")
    with pytest.raises(ConfigError, match="at least 1"):
        ShowConfig(folder, columns=0)
