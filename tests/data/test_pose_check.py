"""A wrong convention of the poses is seen from the error of reprojection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.importer import ImportConfig, import_recording
from pewm_jax.data.pose_check import PoseCheck
from tests.data import layouts

GL = np.diag([1.0, -1.0, -1.0, 1.0])
WRONG = {
    "inverted poses": (np.linalg.inv, {"invert_poses": True}),
    "cameras with y up": (lambda pose: pose @ GL, {"camera_axes": "opengl"}),
}


def checked(poses, walk):
    check, lines = PoseCheck(), []
    for k in sorted(check.choose(range(len(poses)))):
        check.add(poses[k], walk.focal, walk.rgb[k][..., ::-1], walk.depth[k], world_44=np.eye(4))
    return check, lines


def test_right_poses_have_a_small_error_and_a_picture(tmp_path):
    walk = layouts.hand_held(24)
    check, lines = checked(walk.pose, walk)
    check.report(tmp_path / "deep" / "x.png", lines.append)
    (line,) = lines
    share = float(line.split("cm, ")[1].split("%")[0])
    assert share < 0.2
    assert cv2.imread(str(tmp_path / "deep" / "x.png")).shape[1] == 4 * 64


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_is_named_and_its_option_mends_it(tmp_path, name):
    walk = layouts.hand_held(24, focal=(52.5, 52.5, 32, 24))
    convert, options = WRONG[name]
    src, lines = layouts.seven_scenes(tmp_path / "src", walk, convert=convert), []
    with pytest.raises(UserError, match="disagrees with the poses"):
        import_recording(
            ImportConfig(src, tmp_path / "out", format="7scenes", check=True), lines.append
        )
    text = "\n".join(lines)
    assert "the error is large" in text
    assert f"with {name}" in text
    assert "fits better" in text
    assert (tmp_path / "out" / "src-check.png").is_file()
    assert not (tmp_path / "out" / "train").exists()
    import_recording(
        ImportConfig(src, tmp_path / "out", format="7scenes", **options), lambda _: None
    )
    (episode,) = EpisodeSource(tmp_path / "out" / "train")
    np.testing.assert_allclose(episode.world_from_camera, walk.pose, atol=1e-4)


def test_without_depth_or_overlap_it_says_so(tmp_path):
    check, lines = PoseCheck(), []
    check.report(tmp_path / "x.png", lines.append)
    assert "no frame was read" in lines[0]
    check.choose(range(3))
    check.report(tmp_path / "x.png", lines.append)
    assert "no depth to reproject" in lines[1]
    walk = layouts.hand_held(2)
    apart = np.stack([np.eye(4), np.eye(4)])
    apart[1, 0, 3] = 1e4
    check, lines = checked(apart, walk)
    check.report(tmp_path / "x.png", lines.append)
    assert "overlap" in lines[0]
    assert not (tmp_path / "x.png").exists()
