"""Pictures of cells: what is drawn is what is recorded, lit by side, distance and corners."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pewm_jax.config import ConfigError
from pewm_jax.data import render
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.loader import require_same_cells
from pewm_jax.data.make_episode import CollectConfig, make_episode, settings_of
from pewm_jax.data.show import grid_from_camera
from pewm_jax.data.voxels import PALETTE, VoxelFrames, VoxelsConfig
from pewm_jax.geometry import march
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.memory.class_grid import GridConfig
from pewm_jax.types import Camera
from pewm_jax.worlds.nomad import NomadTask
from pewm_jax.worlds.persist.world import PERSIST
from pewm_jax.worlds.pewm.world import PEWM

NAMES = VoxelsConfig(kinds="groups", colours=2).names
WHITE, BROWN = 1, 2
SIZE, CELL = 33, 0.5


def room():
    """A closed room of 8 cells, white, whose far wall is brown; the eye is in its middle."""
    grid = np.full((8, 8, 8), WHITE, np.uint8)
    grid[7] = BROWN
    grid[1:7, 1:7, 1:7] = 0
    voxels = VoxelFrames(grid[None], np.zeros((1, 3), np.float32), CELL, NAMES)
    pose = pose_from_yaw(np.full(3, 4 * CELL + 0.01), 0.0)[None].astype(np.float32)
    camera = Camera(np.asarray(intrinsics_from_fov(SIZE, SIZE, 110.0), np.float32), pose)
    return voxels, camera


def test_a_room_of_blocks_is_lit_by_side_distance_and_corner():
    voxels, camera = room()
    seen = render.draw_blocks(voxels, camera, SIZE, SIZE)
    rgb, middle = seen.rgb_THWC[0].astype(float), SIZE // 2
    np.testing.assert_allclose(seen.depth_THW[0, middle, middle], 3 * CELL - 0.01, atol=1e-4)
    assert seen.ids_THW[0, middle, middle] == BROWN
    # Light as the formula says: met across x, at 1.49 m; far from corners.
    wanted = np.array(PALETTE["brown"]) * 0.88 / (1 + (1.49 / march.HALF_M) ** 2)
    np.testing.assert_allclose(rgb[middle, middle], wanted, atol=1.0)
    floor, ceiling = rgb[-1, middle].mean(), rgb[0, middle].mean()
    assert floor > 1.3 * ceiling
    wall = rgb[middle, seen.ids_THW[0, middle] == BROWN].mean(-1)
    assert wall[0] < 0.85 * wall[len(wall) // 2]
    assert wall[-1] < 0.85 * wall[len(wall) // 2]


def test_where_nothing_is_met_there_is_no_depth():
    voxels, camera = room()
    nothing = dataclasses.replace(voxels, classes_TXYZ=np.zeros_like(voxels.classes_TXYZ))
    seen = render.draw_blocks(nothing, camera, SIZE, SIZE)
    assert (seen.rgb_THWC == render.AIR).all()
    assert not seen.depth_THW.any()
    assert (seen.ids_THW == -1).all()


@pytest.mark.slow
def test_an_episode_of_cells_shows_the_cells_it_records():
    voxels = VoxelsConfig(record=True, cell=0.25, side=64, kinds="groups", pictures="cells")
    plain = CollectConfig(Path("x"), frames=3, size=32)
    config = dataclasses.replace(plain, voxels=voxels, moving=True)
    episode = read_episode(make_episode(config, "train", 0))
    frames, cells = episode.frames(range(3)), episode.voxels(range(3))
    again = render.draw_blocks(cells, frames.camera, 32, 32)
    np.testing.assert_array_equal(again.rgb_THWC, frames.rgb_THWC)
    drawn = grid_from_camera(cells, 1, frames.camera, 32, 32)
    np.testing.assert_allclose(frames.depth_THW[1], drawn.depth_HW, atol=2e-3)
    others = dataclasses.replace(config, voxels=dataclasses.replace(voxels, pictures="surfaces"))
    house = read_episode(make_episode(others, "train", 0))
    np.testing.assert_array_equal(house.voxels(range(3)).classes_TXYZ, cells.classes_TXYZ)
    assert (house.frames([1]).rgb_THWC != frames.rgb_THWC[1:2]).any()
    assert (
        "pictures" not in settings_of(others, "train")["voxels"]
    )  # old datasets stay what they are
    assert settings_of(config, "train")["voxels"]["pictures"] == "cells"
    # A world says which pictures and which classes it expects.
    cell = (0.25, 0.25, 0.25)
    blocks = GridConfig(cell_m=cell, kinds="groups", colours=16, pictures="cells")
    expects = PERSIST(memory=blocks)
    of_surfaces = PERSIST(memory=dataclasses.replace(blocks, pictures="surfaces"))
    require_same_cells(expects, episode)
    require_same_cells(of_surfaces, house)
    with pytest.raises(ConfigError, match="has pictures of surfaces"):
        require_same_cells(expects, house)
    fewer = PERSIST(memory=dataclasses.replace(blocks, colours=8))
    with pytest.raises(ConfigError, match=r"--voxels\.kinds groups --voxels\.colours 16, and"):
        require_same_cells(fewer, episode)
    larger = PERSIST(memory=dataclasses.replace(blocks, cell_m=(0.5, 0.5, 0.5)))
    with pytest.raises(
        ConfigError, match=r"has grids of 64 cells of 0\.25 m .* --voxels\.cell 0\.5"
    ):
        require_same_cells(larger, episode)
    wider = PERSIST(memory=dataclasses.replace(blocks, recorded=72))
    with pytest.raises(ConfigError, match=r"this world needs 72 of 0\.25 m"):
        require_same_cells(wider, episode)
    # Worlds without a grid, or without any memory, read every dataset.
    for world in (PEWM(), NomadTask()):
        require_same_cells(world, episode)


def test_instances_are_not_in_pictures_of_cells():
    cells = VoxelsConfig(record=True, pictures="cells")
    with pytest.raises(ConfigError, match=r"--voxels\.pictures cells does not show"):
        CollectConfig(Path("x"), ids=True, voxels=cells)
    with pytest.raises(ConfigError, match=r"--voxels\.pictures cells needs --voxels"):
        CollectConfig(Path("x"), voxels=VoxelsConfig(pictures="cells"))
