"""The ICL-NUIM living room: a recording of others, imported as it is, and refused as it is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.data.checks import share_floating
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.geometry.cameras import unproject

RECORDING = Path(__file__).parents[3] / "shared" / "data" / "icl_livingroom"
FLAGS = ["--intrinsics", "525", "525", "319.5", "239.5", "--stride", "5", "--size", "160", "120"]
pytestmark = pytest.mark.skipif(
    not RECORDING.is_dir(), reason="the ICL-NUIM living room is not at ../shared/data"
)


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    out = tmp_path_factory.mktemp("icl")
    assert program.main(["data", "import", str(RECORDING), str(out), *FLAGS]) == 0
    return out


def test_it_imports_and_validates(imported, capsys):
    assert program.main(["data", "validate", str(imported)]) == 0
    assert "1 episodes, 43 frames, no problems" in capsys.readouterr().out
    episode = EpisodeSource(imported / "train")[0]
    assert (episode.length, episode.height, episode.width) == (43, 120, 160)
    np.testing.assert_allclose(episode.intrinsics_4, [131.25, 131.25, 80, 60])
    assert episode.actions is None


def test_the_floor_is_below_and_level(imported):
    """The world is z up: the lowest surfaces form a level floor, about a metre below the camera."""
    episode = EpisodeSource(imported / "train")[0]
    frames = episode.frames()
    height = np.asarray(unproject(frames.depth_THW, frames.camera))[..., 2]
    height = height[frames.depth_THW > 0]
    counts, edges = np.histogram(height, 60)
    floor = edges[np.argmax(counts)]
    assert -1.8 < floor < -0.4
    assert (np.abs(height - floor) < 0.15).mean() > 0.15


def test_frames_agree_with_each_other(imported):
    episode = EpisodeSource(imported / "train")[0]
    depth = episode.frames().depth_THW
    shares = [share_floating(episode, depth, k, k + 6) for k in range(0, 36, 6)]
    assert max(share for share in shares if share is not None) < 0.02


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--depth-scale", "1"], "unit is wrong"),
        (["--depth-scale", "1000000"], "unit is wrong"),
        (["--depth-scale", "5000"], "disagrees with the poses"),
        (["--intrinsics", "400", "400", "319.5", "239.5"], "disagrees with the poses"),
        (["--intrinsics", "1050", "1050", "639.5", "479.5"], "principal point"),
    ],
)
def test_it_is_refused_as_what_it_is_not(tmp_path, capsys, flags, says):
    options = FLAGS[5:] if flags[0] == "--intrinsics" else FLAGS
    assert (
        program.main(["data", "import", str(RECORDING), str(tmp_path / "out"), *options, *flags])
        == 2
    )
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert says in told[0]
    assert "icl_livingroom" in told[0]
    assert not (tmp_path / "out").exists()
