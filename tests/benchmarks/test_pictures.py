"""The scripts behind the pictures and tables of the pages of EgoWM and PERSIST."""

import sys
from pathlib import Path

import cv2
import pytest

from pewm_jax.cli import main as program

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def humanoid(tmp_path_factory):
    """Walks of a body with arms through two houses."""
    folder = tmp_path_factory.mktemp("humanoid")
    collect = f"data collect {folder} --body humanoid --train 0 --validation 0 --test 2 --frames 24"
    walks = "--step_m 0.12 --turn_deg 10 --turn_around 0 --test_policy follow"
    assert program.main([*collect.split(), *walks.split()]) == 0
    return folder


@pytest.mark.slow
def test_videos_of_the_humanoid_show_every_kind_of_actions(humanoid, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import egowm_videos

    flags = ["--out", str(tmp_path), "--data", str(humanoid), "--clips", "1", "--chain", "1"]
    monkeypatch.setattr(sys, "argv", ["egowm_videos.py", "egowm-humanoid", *flags])
    egowm_videos.main()
    assert capsys.readouterr().out.startswith("clip 0: ")
    assert {path.name for path in tmp_path.iterdir()} == {"clip00.png", "clip00.mp4"}
    picture = cv2.imread(str(tmp_path / "clip00.png"))
    rows = 5  # ground truth, true actions, another clip's, arms alone, walking alone
    assert picture.shape[0] > rows * 64
    assert picture.std() > 0
    sys.modules.pop("egowm_videos")


@pytest.mark.slow
def test_steering_is_printed_with_its_margins(humanoid, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import egowm_steering

    flags = ["--data", str(humanoid), "--clips", "2", "--chain", "1", "--colours"]
    monkeypatch.setattr(sys, "argv", ["egowm_steering.py", "egowm-humanoid", *flags])
    egowm_steering.main()
    said = capsys.readouterr().out
    assert "2 clips" in said
    for row in ("true actions", "another clip's actions", "the observed frame, repeated"):
        assert row in said
    sys.modules.pop("egowm_steering")


@pytest.mark.slow
def test_pictures_of_a_world_of_voxels_are_drawn(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import persist_pictures

    data = tmp_path / "data"
    collect = f"data collect {data} --moving --train 0 --validation 0 --test 1 --frames 27"
    voxels = "--voxels --voxels.kinds groups --voxels.colours 8 --voxels.pictures cells"
    cells = "--voxels.cell 0.25 --voxels.side 40"
    assert program.main([*collect.split(), *voxels.split(), *cells.split()]) == 0
    monkeypatch.setattr(persist_pictures, "WORLDS", 1)
    what = ("grown", "edit", "worlds")
    settings = persist_pictures.Settings("persist", what=what, data=data, out=tmp_path, steps=1)
    persist_pictures.main(settings)
    for name in what:
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 0
    sys.modules.pop("persist_pictures")
