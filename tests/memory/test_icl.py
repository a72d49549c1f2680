"""A map of the ICL-NUIM living room explains a later frame's depth where it was seen before."""

import math
from pathlib import Path

import jax
import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.codecs.signals import signal_from_rgb
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.geometry import cameras
from pewm_jax.memory import cells, voxel_map
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.types import Camera, Frames

RECORDING = Path(__file__).parents[3] / "shared" / "data" / "icl_livingroom"
FLAGS = ["--intrinsics", "525", "525", "319.5", "239.5", "--stride", "5", "--size", "160", "120"]
pytestmark = pytest.mark.skipif(
    not RECORDING.is_dir(), reason="the ICL-NUIM living room is not at ../shared/data"
)
LATER = 42
"""Frame 210 of the recording; the map is built from its frames 0 to 100."""


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    out = tmp_path_factory.mktemp("icl_map")
    assert program.main(["data", "import", str(RECORDING), str(out), *FLAGS]) == 0
    return EpisodeSource(out / "train")[0]


def build(episode, cell):
    config = VoxelConfig(
        cell_m=(cell,) * 3,
        cells=(int(12 / cell), int(12 / cell), int(6 / cell)),
        capacity=60_000,
        tokens=16,
    )
    seen = episode.frames(range(21))
    frames = Frames(signal_from_rgb(seen.rgb_THWC), seen.depth_THW, seen.camera)
    centre = np.asarray(seen.camera.world_from_camera)[0, :3, 3]
    insert = jax.jit(voxel_map.insert_frames, static_argnums=0)
    patches = config.encoder.encode({}, frames.rgb_THWC)
    voxels = insert(config, voxel_map.empty(config, centre, 6), frames, patches)
    assert int(voxels.dropped) == 0
    assert int(voxels.outside) == 0
    return config, voxels


def nearest_in_bins(uv, z, values, shape, bin_px):
    """The nearest point of each bin of the image: its depth (inf where none) and its values."""
    height, width = shape[0] // bin_px, shape[1] // bin_px
    place = np.floor(uv / bin_px).astype(int)
    inside = (z > 0.05) & (place >= 0).all(-1) & (place < (width, height)).all(-1)
    depth = np.full((height, width), np.inf)
    value = np.zeros((height, width, 3))
    for index in np.flatnonzero(inside)[np.argsort(-z[inside])]:
        u, v = place[index]
        depth[v, u], value[v, u] = z[index], values[index]
    return depth, value


def agreement(episode, cell, bin_px, shift=0.0):
    """Share of bins where the map's nearest cell is as near as the true surface, and colours."""
    config, voxels = build(episode, cell)
    points, values, valid = (np.asarray(x) for x in voxel_map.to_points(config, voxels))
    later = episode.frames([LATER])
    pose = np.array(later.camera.world_from_camera)[0]
    pose[:3, 3] += shift * pose[:3, 0]
    camera = Camera(later.camera.intrinsics_4[0], pose)
    uv, z = (np.asarray(x) for x in cameras.project(points[valid], camera))
    colours = np.asarray(config.encoder.colours(values[valid]))
    mapped, mapped_colour = nearest_in_bins(uv, z, colours, later.depth_THW.shape[1:], bin_px)
    grid = cameras.pixel_grid(*later.depth_THW.shape[1:]).reshape(-1, 2)
    rgb = np.asarray(signal_from_rgb(later.rgb_THWC[0])).reshape(-1, 3)
    true, true_colour = nearest_in_bins(
        grid, later.depth_THW[0].ravel(), rgb, later.depth_THW.shape[1:], bin_px
    )
    both = np.isfinite(mapped) & np.isfinite(true)
    tolerance = math.sqrt(3) * cell + 0.02
    close = np.abs(mapped[both] - true[both]) < tolerance
    colour_error = np.abs(mapped_colour - true_colour)[both][close].mean()
    return close.mean(), both.mean(), colour_error


@pytest.mark.parametrize(("cell", "bin_px", "least"), [(0.05, 8, 0.92), (0.25, 20, 0.75)])
def test_the_map_explains_a_later_frame(episode, cell, bin_px, least):
    """Bins are about as wide as a cell looks at 2.5 m, so that the map has no holes in them."""
    share, covered, colour_error = agreement(episode, cell, bin_px)
    assert covered > 0.8, "the recording comes back to what it saw"
    assert share > least
    assert colour_error < 0.35, "colours lie in [-1, 1]"


@pytest.mark.parametrize(("cell", "least", "most"), [(0.05, 0.9, 0.1), (0.25, 0.98, 0.45)])
def test_a_later_frames_surfaces_lie_in_occupied_cells_and_nearer_or_farther_ones_do_not(
    episode, cell, least, most
):
    """No tolerance but the cell itself; the control is the same depth off by 0.35 m."""
    config, voxels = build(episode, cell)
    occupied = np.asarray(voxels.cell_of_slot_V)
    occupied = occupied[occupied < math.prod(config.cells)]
    later = episode.frames([LATER])

    def share(offset):
        depth = np.where(later.depth_THW > 0, later.depth_THW + np.float32(offset), 0)
        seen = cells.keys(config, voxels.origin_3, cameras.unproject(depth, later.camera))
        return np.isin(np.asarray(seen)[later.depth_THW > 0], occupied).mean()

    assert share(0) > least
    assert max(share(-0.35), share(0.35)) < most


def test_from_a_wrong_place_it_does_not(episode):
    right, _, _ = agreement(episode, 0.05, 8)
    wrong, _, _ = agreement(episode, 0.05, 8, shift=0.7)
    assert wrong < right - 0.2
