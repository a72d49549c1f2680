"""Pictures, videos and charts: what is drawn is what was given."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import xml.etree.ElementTree as ET

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pewm_jax.report.pictures import as_bytes, depth_colours, dim, from_above, grid, png, save_png
from pewm_jax.report.plots import Line, chart, ticks
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


@given(st.floats(-100, 100), st.floats(0.001, 200))
def test_ticks_enclose_the_data(low, span):
    marks = ticks(low, low + span)
    tolerance = 1e-6 * max(1, abs(low) + span)
    assert marks[0] <= low + tolerance
    assert marks[-1] >= low + span - tolerance
    assert 2 <= len(marks) <= 12
    np.testing.assert_allclose(np.diff(marks), marks[1] - marks[0], rtol=1e-6)


def points_of(svg, kind):
    root = ET.fromstring(svg)
    return [
        [tuple(map(float, pair.split(","))) for pair in element.attrib["points"].split()]
        for element in root.iter()
        if element.tag.endswith(kind)
    ]


def test_chart_draws_higher_values_higher_and_breaks_at_gaps():
    lines = [
        Line("up", "red", [1.0, 2.0, 3.0], [0.1, 0.1, None]),
        Line("gap", "blue", [1.0, None, 2.0], [0.1, None, 0.1]),
    ]
    svg = chart("A < B", "frame", lines, unit="dB")
    rising, left, right = points_of(svg, "polyline")
    assert [x for x, _ in rising] == sorted(x for x, _ in rising)
    assert rising[0][1] > rising[1][1] > rising[2][1]
    assert rising[0][1] - rising[1][1] == pytest.approx(rising[1][1] - rising[2][1], abs=0.2)
    assert len(left) == len(right) == 1
    band = points_of(svg, "polygon")[0]
    assert min(y for _, y in band[:2]) < rising[0][1]


def test_chart_without_values_says_so():
    assert "no clip" in chart("PSNR", "frame", [Line("a", "red", [None, None], [None, None])])
