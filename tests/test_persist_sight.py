"""What a real picture says of cells: air, surfaces and their colours, and what comes of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.data import block_pictures
from pewm_jax.data.voxel_frames import VoxelFrames
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.memory import class_grid
from pewm_jax.types import Camera
from pewm_jax.worlds import persist_sight, persist_voxels
from tests.persist_world import MODEL

SIZE, CELL, COLOURS = 48, 0.5, 4
LOW = np.array([-2.0, -2.0, -2.0], np.float32)
MEMORY = dataclasses.replace(MODEL.memory, colours=COLOURS, pictures="cells")
ROOM = dataclasses.replace(MODEL, memory=MEMORY)


def furnished():
    """A closed room, a different colour on each side, and two blocks in it."""
    grid = np.zeros((8, 8, 8), np.uint8)
    grid[0], grid[7], grid[:, 0], grid[:, 7] = 1, 2, 3, 4
    grid[:, :, 0], grid[:, :, 7] = 6, 1
    grid[5:7, 2, 1:4], grid[6, 4:6, 1] = 7, 8
    pose = pose_from_yaw(np.array([-0.9, 0.1, 0.2]), 0.1)[None].astype(np.float32)
    camera = Camera(np.asarray(intrinsics_from_fov(SIZE, SIZE, 90.0), np.float32), pose)
    voxels = VoxelFrames(grid[None], LOW[None], CELL, class_grid.names(MEMORY))
    seen = block_pictures.pictures(voxels, camera, SIZE, SIZE)
    rgb = seen.rgb_THWC[0].astype(np.float32) / 127.5 - 1
    one = Camera(camera.intrinsics_4, camera.world_from_camera[0])
    return grid, rgb, seen.depth_THW[0], one


def test_a_picture_tells_air_from_surfaces_and_their_colours():
    grid, rgb, depth, camera = furnished()
    sight = persist_sight.seen(ROOM, LOW, rgb, depth, camera)
    air, colour = np.asarray(sight.air_XYZ), np.asarray(sight.colour_XYZ)
    assert air.sum() > 30
    assert not grid[air].any()
    surface = colour >= 0
    assert surface.sum() > 60
    assert (grid[surface] > 0).mean() > 0.97
    right = (grid[surface].astype(int) - 1) % COLOURS == colour[surface]
    assert right.mean() > 0.8
    assert not (air & surface).any()
    # The cell of a block's face that is looked at, its colour, and the air beside it.
    assert colour[5, 2, 2] == 6 % COLOURS
    assert air[4, 3, 3]


def test_where_nothing_was_measured_nothing_is_said():
    _, rgb, depth, camera = furnished()
    sight = persist_sight.seen(ROOM, LOW, rgb, 0 * depth, camera)
    assert not np.asarray(sight.air_XYZ).any()
    assert (np.asarray(sight.colour_XYZ) == -1).all()


def test_pictures_of_surfaces_are_taken_as_they_are():
    _, rgb, depth, camera = furnished()
    plain = dataclasses.replace(
        ROOM, memory=dataclasses.replace(MEMORY, pictures="surfaces"), sight=1.0
    )
    lit, unlit = (persist_sight.seen(model, LOW, rgb, depth, camera) for model in (ROOM, plain))
    np.testing.assert_array_equal(lit.air_XYZ, unlit.air_XYZ)
    assert (np.asarray(lit.colour_XYZ) != np.asarray(unlit.colour_XYZ)).any()


def test_what_is_seen_decides_between_classes_and_nothing_else_changes():
    classes = MODEL.backbone.voxel_vae.classes  # 13: three kinds in four colours, and nothing
    params = jax.jit(lambda: worlds.init(ROOM, jax.random.key(0)))()
    latents = jax.random.normal(jax.random.key(1), (1, 4, 4, 4, 3))
    before = jnp.full((8, 8, 8), -1)
    air = jnp.zeros((8, 8, 8), bool).at[:2].set(True)
    colour = jnp.full((8, 8, 8), -1).at[2:4].set(2)
    sight = persist_sight.Sight(air, colour)
    free = dataclasses.replace(ROOM, hold=0.0)
    made = np.asarray(persist_voxels.held(free, params, latents, before))
    looked = np.asarray(persist_voxels.held(free, params, latents, before, sight))
    assert not looked[:2].any()
    assert ((looked[2:4] > 0) & ((looked[2:4] - 1) % COLOURS == 2)).all()
    np.testing.assert_array_equal(looked[4:], made[4:])
    blind = dataclasses.replace(free, sight=0.0)
    np.testing.assert_array_equal(persist_voxels.held(blind, params, latents, before, sight), made)
    given = persist_sight.advantage(ROOM, sight, classes)
    assert given.shape == (8, 8, 8, classes)
    assert float(given.max()) == ROOM.sight
