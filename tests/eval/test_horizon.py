"""Long horizons: which frames count, what is written, what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.config import UserError
from pewm_jax.errors import ConfigError
from pewm_jax.eval import horizon, voxel_trials
from pewm_jax.models.persist import voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig


def test_stretches_are_of_their_frames_alone():
    truth = np.full((2, 6, 4, 4, 3), 100, np.uint8)
    made = truth.copy()
    made[:, 4:] += 51
    near, far = horizon.stretches(made, truth, (4, 6))
    assert near == 100
    np.testing.assert_allclose(far, -20 * np.log10(0.2), atol=1e-3)


def test_windows_are_the_last_before_an_end():
    video = np.arange(2 * 100).reshape(2, 100, 1)
    found = horizon.windows(video, 90, 2)
    assert found.shape == (4, 16, 1)
    assert found[0, 0, 0] == 58
    assert found[1, -1, 0] == 89
    assert found[2, 0, 0] == 158
    assert horizon.windows(video, 40, 4).shape == (4, 16, 1)


class Episode:
    """An episode with what is asked of it."""

    name, length = "house-0", 20
    actions = np.zeros((19, 5), np.float32)


def test_walks_that_do_not_lie_in_an_episode_are_refused():
    for start, frames, context, says in (
        (3, 17, 2, "collect longer episodes"),
        (3, 4, 5, "5 observed ones"),
        (3, 4, 2, "no planar actions"),
    ):
        with pytest.raises(UserError, match=says):
            horizon.read_walk(Episode(), start, frames, context)  # type: ignore[arg-type]


def test_the_report_says_what_was_measured(tmp_path):
    rng = np.random.default_rng(0)
    videos = {
        name: rng.integers(0, 255, (1, 20, 16, 16, 3)).astype(np.uint8)
        for name in ("truth", "world", "bound")
    }
    trials = voxel_trials.Trials(np.array([1.0, 0.4]), 7, 5, 30, 40, 3, 2.0)
    score = {"fvd": {"value": 12.0, "clips": 4}, "kvd": {"value": 0.5, "clips": 4}}
    facts = {
        "psnr": {"world": [12.0, 11.5], "bound": [20.0, 19.0]},
        "distances": {"world": {"10": score, "20": score}},
        "autoencoder": {"grids": 3, "occupied": 0.984, "filled": 0.99, "empty": 0.997},
        "edits": trials.facts(),
        "protocol": {"run": "runs/<tiny>"},
    }
    page = horizon.write_report(tmp_path, facts, videos, (10, 20))
    text = page.read_text()
    for wanted in (
        "11–20",
        "19.00",
        "runs/&lt;tiny&gt;",
        "1 of 2",
        "5 of 7",
        "30 of 40",
        "1 more walks",
        "98.4 %",
    ):
        assert wanted in text, wanted
    assert {path.name for path in tmp_path.iterdir()} == {
        "horizon.html", "horizon.json", "horizon.mp4", "horizon.png",
    }  # fmt: skip
    said = horizon.lines(facts, (10, 20))
    assert said[0] == "PSNR in dB of frames 1–10, 11–20:"
    assert "20: FVD 12, KVD 0.50" in said[-3]


def test_cells_are_given_back_with_their_class_or_count_as_wrong(monkeypatch):
    model = SimpleNamespace(backbone=SimpleNamespace(voxel_vae=VoxelVAEConfig(side=4, classes=5)))
    grids = np.zeros((voxel_trials.EVERY + 1, 6, 6, 6), np.int16)
    grids[:, 1:3, 1:5, 1:5] = 3  # within the middle: 32 of 64 cells
    grids[:, 0] = 4  # outside of it
    grids[1:-1] = 1  # frames that are not looked at
    monkeypatch.setattr(voxel_vae, "encode", lambda _config, _params, grid: grid)

    def share(decode):
        monkeypatch.setattr(voxel_vae, "decode", lambda _config, _params, grid: decode(grid))
        return voxel_trials.reconstruction_shares(model, {"voxel_vae": {}}, [grids])  # type: ignore[arg-type]

    whole = {"grids": 2, "occupied": 1.0, "filled": 1.0, "empty": 1.0}
    assert share(lambda grid: grid) == whole
    other = share(lambda grid: grid.at[:, 0].set(2))  # half of the occupied: another class
    assert other == whole | {"occupied": 0.5}
    gone = share(lambda grid: grid.at[:, 0].set(0).at[:, 3, 0].set(1))
    assert gone == whole | {"occupied": 0.5, "filled": 0.5, "empty": 1 - 4 / 32}


def test_ends_that_make_no_windows_are_refused():
    for ends in (["600", "200"], ["8"]):
        with pytest.raises(ConfigError, match="increasing numbers"):
            program.execute(["horizon", "runs/x", "--ends", *ends])
    with pytest.raises(ConfigError, match="RUN is missing"):
        program.execute(["horizon"])
