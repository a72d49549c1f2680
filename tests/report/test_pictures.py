"""Pictures, videos and charts: what is drawn is what was given."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import av
import numpy as np
import pytest
from PIL import Image

from pewm_jax.report.charts import IntervalChart, IntervalRow, Line, LineChart
from pewm_jax.report.page import Charts, Section, render
from pewm_jax.report.pictures import as_bytes, depth_colours, dim, from_above, grid, png, save_png
from pewm_jax.report.video import encode_h264, side_by_side


def plain(value, size=8):
    return np.full((size, size, 3), value, np.uint8)


def test_video_is_h264_with_every_frame_in_order():
    levels = [10, 80, 150, 220, 40]
    film = encode_h264([plain(level, 64) for level in levels])
    with av.open(io.BytesIO(film)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == len(levels)
    for frame, level in zip(frames, levels, strict=True):
        assert frame.mean() == pytest.approx(level, abs=4)


ENCODE = """
import hashlib, numpy as np
from pewm_jax.report.video import encode_h264
noise = np.random.default_rng(0).integers(0, 255, (12, 15, 20, 3)).astype(np.uint8)
film = encode_h264([picture.repeat(8, 0).repeat(8, 1) for picture in noise])
print(hashlib.sha256(film).hexdigest())
"""


def test_video_does_not_depend_on_what_the_memory_held_before():
    said = [
        subprocess.run(
            [sys.executable, "-c", ENCODE],
            env={**os.environ, "MALLOC_PERTURB_": perturb},  # glibc fills new memory with it
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for perturb in ("0", "1", "85")
    ]
    assert len(set(said)) == 1


def test_side_by_side_puts_each_version_where_its_caption_is():
    rgb = {
        name: np.stack([plain(v), plain(v)]) for name, v in {"a": 20, "b": 120, "c": 250}.items()
    }
    depth = np.ones((2, 8, 8), np.float32)
    pictures = side_by_side(
        [(name, value, depth) for name, value in rgb.items()], ["one", "two"], far_m=2.0, cell=64
    )
    assert len(pictures) == 2
    height, width, _ = pictures[0].shape
    assert height % 2 == width % 2 == 0
    y, gap, cell = 34 + 32, 8, 64
    for column, value in enumerate((20, 120, 250)):
        x = gap + column * (cell + gap) + cell // 2
        assert abs(int(pictures[0][y, x, 0]) - value) <= 1


def test_grid_shows_its_cells():
    picture = grid([("row", [plain(0), plain(200)])], ["left", "right"], cell=32)
    assert (picture == 0).all(-1).sum() >= 32 * 32
    assert (picture == 200).all(-1).sum() >= 32 * 32


def test_depth_is_brighter_when_near_and_grey_when_absent():
    shade = depth_colours(np.array([[0.5, 3.5, 0.0]], np.float32), 4.0).astype(int)
    assert shade[0, 0].sum() > shade[0, 1].sum()
    assert shade[0, 2].tolist() == [128, 128, 128]


def test_never_seen_pixels_are_grey():
    image = np.zeros((1, 2, 3), np.uint8)
    image[..., 0] = 200
    out = dim(image, np.array([[True, False]]))
    assert out[0, 0].tolist() == [200, 0, 0]
    assert len(set(out[0, 1].tolist())) == 1


def test_colours_are_clipped_to_bytes():
    assert as_bytes(np.array([-2.0, -1.0, 0.0, 1.0, 5.0])).tolist() == [0, 0, 128, 255, 255]


def test_from_above_draws_the_highest_cell_and_keeps_north_up():
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [2.0, 2.0, 0.0]])
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    picture = from_above(
        points, colours, (0.5, 0.5, 0.5), np.array([[1.0, 1.0, 1.2]]), 0.0, title="map"
    )
    assert not (picture == [255, 0, 0]).all(-1).any()
    green = np.argwhere((picture == [0, 255, 0]).all(-1)).mean(0)
    blue = np.argwhere((picture == [0, 0, 255]).all(-1)).mean(0)
    assert blue[0] < green[0]  # larger y is higher up in the picture
    assert blue[1] > green[1]  # larger x is farther right


def test_png_round_trip(tmp_path):
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    path = save_png(tmp_path / "deep" / "picture.png", image)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), image)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png(image)))), image)
    assert [p.name for p in path.parent.iterdir()] == ["picture.png"]


def painted(content, colour):
    """Return the (row, column) of the pixels of one colour, within a little."""
    picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
    return np.argwhere(np.abs(picture - colour).max(-1) < 30)


def test_chart_draws_higher_values_higher_and_breaks_at_gaps():
    lines = [
        Line.with_errors("up", "#ff0000", [1.0, 2.0, 3.0], [0.1, 0.1, None]),
        Line.with_errors("gap", "#0000ff", [1.0, None, 1.0], [0.1, None, 0.1]),
    ]
    chart = LineChart("A < B", "frame", lines, unit="dB")
    red, blue = painted(chart.png(), [255, 0, 0]), painted(chart.png(), [0, 0, 255])
    left, right = red[:, 1].min(), red[:, 1].max()
    heights = [red[abs(red[:, 1] - x) < 8, 0].mean() for x in (left, (left + right) / 2, right)]
    assert heights[0] > heights[1] > heights[2]
    assert heights[0] - heights[1] == pytest.approx(heights[1] - heights[2], abs=8)
    middle = abs(blue[:, 1] - (left + right) / 2) < (right - left) / 4
    assert len(blue)
    assert not middle.any()


def test_charts_are_equal_for_equal_values_and_have_a_dark_form():
    line = Line("a", "#ff0000", [1.0, 2.0], [0.5, None], [1.5, None])
    interval = IntervalRow("row", 1.0, 0.5, 1.5, dots=(0.8, 1.2))
    for chart in (
        LineChart("PSNR", "frame", [line], x=[0, 4], label_lines=True),
        IntervalChart("PSNR", "over houses", [interval, IntervalRow("one", 2.0, None, None)]),
    ):
        assert chart.png() == chart.png()
        light, dark = (np.asarray(Image.open(io.BytesIO(chart.png(dark=d)))) for d in (False, True))
        assert light[0, 0, :3].min() > 200
        assert dark[0, 0, :3].max() < 60


def test_chart_without_values_says_so():
    empty = LineChart("PSNR", "frame", [Line("a", "red", [None, None])])
    assert empty.is_empty
    page = render("title", [], [Section("", [Charts([empty])])])
    assert "PSNR: no clip has enough such pixels." in page
