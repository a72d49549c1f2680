"""What a real picture says of cells: air, surfaces and their colours, and what comes of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.config import UserError
from pewm_jax.data import render
from pewm_jax.data.voxels import VoxelFrames, table_colours
from pewm_jax.geometry import march
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw, unproject
from pewm_jax.geometry.march import through_pixels
from pewm_jax.memory import class_grid
from pewm_jax.types import Camera
from pewm_jax.worlds.persist import state as windows
from pewm_jax.worlds.persist import step as persist_step
from pewm_jax.worlds.persist import voxel_frames as persist_sight
from pewm_jax.worlds.persist import voxel_frames as persist_voxels
from pewm_jax.worlds.persist import world as persist
from tests.helpers import random_frames
from tests.worlds.persist.tiny_persist import MODEL

SIZE, CELL, COLOURS = 48, 0.5, 8
LOW = np.array([-2.0, 2.5, -2.0], np.float32)
MEMORY = dataclasses.replace(MODEL.memory, colours=COLOURS)
ROOM = dataclasses.replace(MODEL, memory=MEMORY)


def furnished():
    """A closed room, a different colour on each side, and two blocks in it."""
    grid = np.zeros((8, 8, 8), np.uint8)
    grid[0], grid[7], grid[:, 0], grid[:, 7] = 1, 7, 3, 5
    grid[:, :, 0], grid[:, :, 7] = 2, 1
    grid[5:7, 2, 1:4], grid[6, 4:6, 1] = 8, 12
    pose = pose_from_yaw(np.array([-0.9, 4.6, 0.2]), 0.1)[None].astype(np.float32)
    camera = Camera(np.asarray(intrinsics_from_fov(SIZE, SIZE, 90.0), np.float32), pose)
    voxels = VoxelFrames(grid[None], LOW[None], CELL, class_grid.names(MEMORY))
    seen = render.draw_blocks(voxels, camera, SIZE, SIZE)
    rgb = seen.rgb_THWC[0].astype(np.float32) / 127.5 - 1
    one = Camera(camera.intrinsics_4, camera.world_from_camera[0])
    return grid, rgb, seen.depth_THW[0], one


@pytest.mark.slow
def test_a_picture_tells_air_from_surfaces_and_their_colours():
    grid, rgb, depth, camera = furnished()
    evidence = persist_sight.observe_cells(ROOM, LOW, rgb, depth, camera)
    air, colour = np.asarray(evidence.air_XYZ), np.asarray(evidence.colour_XYZ)
    assert air.sum() > 30
    assert not grid[air].any()
    surface = colour >= 0
    assert surface.sum() > 60
    assert (grid[surface] > 0).mean() > 0.98
    right = (grid[surface].astype(int) - 1) % COLOURS == colour[surface]
    assert right.mean() > 0.95
    assert not (air & surface).any()
    # The cell of a block's face that is looked at, its colour, and the air beside it.
    assert colour[5, 2, 2] == 7
    assert air[4, 3, 3]


def test_every_block_that_a_ray_crosses_is_empty():
    grid, _, depth, camera = furnished()
    sight = jax.jit(persist_sight.visible_cells, static_argnums=0)
    air = np.asarray(sight(ROOM, LOW, depth, camera)[0])
    memory = dataclasses.replace(MEMORY, pictures="surfaces")
    surfaces = dataclasses.replace(ROOM, memory=memory, observation_logit=0.0)
    front = np.asarray(sight(surfaces, LOW, depth, camera)[0])  # by the middles of cells alone
    assert not grid[air].any()
    assert air.sum() > 1.1 * front.sum()
    assert (front & ~air).sum() < 0.02 * front.sum()


def test_the_agent_stands_in_cells_around_it_from_shin_to_eyes():
    model = dataclasses.replace(ROOM, body_m=0.2)
    eye = np.array([0.1, 4.75, 0.3], np.float32)  # 0.1 m behind a border in x, in a middle in y
    stood = np.asarray(persist_sight.body_cells(model, LOW, eye))
    x, y, z = (set(axis.tolist()) for axis in np.nonzero(stood))
    assert (x, y) == ({3, 4}, {4})
    floor = eye[2] - model.memory.eye_m
    heights = LOW[2] + CELL * np.arange(8)
    between = (heights + CELL > floor + persist_sight.SHIN_M) & (heights <= eye[2])
    assert z == set(np.flatnonzero(between).tolist())


@pytest.mark.parametrize("known", [class_grid.GUESSED, class_grid.OBSERVED])
def test_an_agent_corrects_a_guess_that_it_stands_in_but_no_surface_that_was_seen(known):
    model = dataclasses.replace(ROOM, body_m=0.2)
    cells = np.full((8, 8, 8), 3)
    mask = np.full((8, 8, 8), known, np.uint8)
    pose = pose_from_yaw(np.array([0.1, 4.75, 0.3]), 0.0).astype(np.float32)
    camera = Camera(np.ones(4, np.float32), pose)
    body = np.asarray(persist_sight.body_cells(model, LOW, pose[:3, 3]))
    grid, start = class_grid.ClassGrid(cells, LOW, mask_XYZ=jnp.asarray(mask)), np.zeros(3, int)
    stood = np.asarray(persist_step.stood_in(model, grid, start, cells, camera, None))
    np.testing.assert_array_equal(stood, body & (known != class_grid.OBSERVED))
    surface = np.where(np.arange(8)[:, None, None] == 3, 1, -1) * np.ones((8, 8, 8), int)
    evidence = persist_sight.ObservedCells(surface < 0, surface)
    fresh = class_grid.ClassGrid(cells, LOW, mask_XYZ=jnp.zeros((8, 8, 8), jnp.uint8))
    stood = np.asarray(persist_step.stood_in(model, fresh, start, cells, camera, evidence))
    np.testing.assert_array_equal(stood, body & (surface < 0))
    assert persist_step.stood_in(ROOM, grid, start, cells, camera, None) is None


def test_a_door_of_which_a_part_has_gone_is_unknown_until_it_is_seen_again():
    model = dataclasses.replace(ROOM, moving=("door",))
    doors = [class_grid.number_of(MEMORY, f"door/{colour}") for colour in ("red", "white")]
    cells = np.full((8, 8, 8), class_grid.number_of(MEMORY, "wall/red"))
    mask = np.full((8, 8, 8), class_grid.OBSERVED, np.uint8)
    cells[2:6, 3, 1:5], cells[2:6, 4, 5] = doors  # one leaf, of two colours, over a corner
    cells[2:6, 3, 7] = doors[0]  # another door
    mask[2, 3, 1:5] = class_grid.GUESSED
    colour = np.full((8, 8, 8), -1)
    colour[5, 3, 1] = 0  # seen where it was
    gone = np.zeros((8, 8, 8), bool)
    gone[3, 3, 2] = True
    grid = class_grid.ClassGrid(jnp.asarray(cells), LOW, mask_XYZ=jnp.asarray(mask))
    start = np.zeros(3, int)

    def forgotten(model, air):
        evidence = persist_sight.ObservedCells(jnp.asarray(air), jnp.asarray(colour))
        made = persist_sight.forget_moved(model, grid, start, evidence)
        lost = np.asarray(made.classes_XYZ) == class_grid.UNKNOWN
        np.testing.assert_array_equal(np.asarray(made.classes_XYZ)[~lost], cells[~lost])
        expected = np.where(lost, class_grid.GUESSED, mask)
        np.testing.assert_array_equal(np.asarray(made.mask_XYZ), expected)
        return lost

    leaf = np.zeros((8, 8, 8), bool)
    leaf[3:6, 3, 1:5] = leaf[2:6, 4, 5] = True
    leaf[5, 3, 1] = False
    np.testing.assert_array_equal(forgotten(model, gone), leaf)
    wall = np.zeros((8, 8, 8), bool)
    wall[0] = True  # what vanishes is no door
    for other, air in ((ROOM, gone), (model, wall), (model, np.zeros_like(gone))):
        assert not forgotten(other, air).any()


def test_cells_of_a_kind_agree_on_the_colour_of_guesses_nearby():
    model = dataclasses.replace(ROOM, colour_reach_m=1.0)  # two cells
    kinds = [name.partition("/")[0] for name in class_grid.names(MEMORY)]
    wall, floor = kinds.index("wall"), kinds.index("floor")  # in the first colour
    made = np.zeros((8, 8, 8), np.int32)
    made[:, 2] = wall
    odd = [(3, 2, 4), (0, 2, 4), (4, 6, 4)]  # amid the wall, the same but observed, and alone
    for cell in odd:
        made[cell] = wall + 1
    made[:, :, 0] = floor + 5
    nats = np.full((8, 8, 8, COLOURS), -persist_voxels.MOST_NATS)
    nats[..., 0] = 0
    for cell in odd:
        nats[cell][0], nats[cell][1] = -1, 0
    nats[:, :, 0] = 9 * (np.arange(COLOURS) == 5)
    free = np.ones((8, 8, 8), bool)
    free[0] = False
    agreed = np.asarray(persist_voxels._agreeing_colours(model, made, nats, free))
    expected = made.copy()
    expected[3, 2, 4] = wall
    np.testing.assert_array_equal(agreed, expected)
    # Sure cells convince their neighbours, as far as the reach.
    nats[:, 2, 1:, 0], nats[:, 2, 1:, 1] = 0, -0.01
    nats[3, 2, 4, 0], nats[3, 2, 4, 1] = -persist_voxels.MOST_NATS, 0
    agreed = np.asarray(persist_voxels._agreeing_colours(model, made, nats, free))
    np.testing.assert_array_equal(np.flatnonzero(agreed[1:, 2, 4] == wall + 1) + 1, range(1, 6))


def test_kinds_that_move_are_kinds_of_the_world():
    with pytest.raises(UserError, match=r"model.moving names 'wolf', and the kinds .* door"):
        dataclasses.replace(ROOM, moving=("door", "wolf"))


@pytest.mark.slow
def test_where_nothing_was_measured_nothing_is_said():
    _, rgb, depth, camera = furnished()
    evidence = persist_sight.observe_cells(ROOM, LOW, rgb, 0 * depth, camera)
    assert not np.asarray(evidence.air_XYZ).any()
    assert (np.asarray(evidence.colour_XYZ) == -1).all()


@pytest.mark.slow
def test_the_light_that_is_read_is_the_light_that_was_drawn():
    grid, rgb, depth, camera = furnished()
    way = unproject(depth, camera) - camera.world_from_camera[:3, 3]
    at = (way + camera.world_from_camera[:3, 3] - LOW) / CELL
    lit = march.light(
        grid > 0, LOW, CELL, camera.world_from_camera[:3, 3], way, np.ones(depth.shape),
        march.side_of(at),
    )  # fmt: skip
    one = Camera(camera.intrinsics_4[None], camera.world_from_camera[None])
    met = through_pixels(grid.astype(np.int32), LOW, CELL, one, SIZE, SIZE, 1).ids_L[0, ..., 0]
    wanted = table_colours(class_grid.names(MEMORY))[met] / 255 * np.asarray(lit)[..., None]
    off = np.abs((rgb + 1) / 2 - wanted).max(-1)
    # Pixels at edges mix what their rays meet; all others have the class's colour in its light.
    assert np.quantile(off, 0.8) < 0.02


@pytest.mark.slow
def test_a_world_begins_on_the_lattice_of_recorded_cells_and_with_what_it_sees():
    frames = random_frames(np.random.default_rng(0), 1, 16, 16)
    params = jax.jit(lambda: worlds.init(MODEL, jax.random.key(0)))()
    run = jax.jit(worlds.start, static_argnums=0)
    state = run(MODEL, params, frames)
    low = np.asarray(state.map.low_3)[:2] / 0.5
    np.testing.assert_allclose(low, np.round(low), atol=1e-5)
    first = np.asarray(state.map.history.start_3)
    corner = state.map.low_3 + first * 0.5
    camera = jax.tree.map(lambda x: jnp.asarray(x[0]), frames.camera)
    rgb = frames.rgb_THWC[0].astype(np.float32) / 127.5 - 1
    evidence = persist_sight.observe_cells(MODEL, corner, rgb, frames.depth_THW[0], camera)
    cells = np.asarray(windows.window(MODEL, state.map.classes_XYZ, first))
    assert np.asarray(evidence.air_XYZ).any()
    assert (np.asarray(evidence.colour_XYZ) >= 0).any()
    assert not cells[np.asarray(evidence.air_XYZ)].any()
    assert cells[np.asarray(evidence.colour_XYZ) >= 0].all()
    # A frame that was imagined says nothing of its cells.
    still = jax.jit(persist.PERSIST.imagine, static_argnums=0, static_argnames="memory")
    doubted = dataclasses.replace(MODEL, observation_logit=0.0)
    key, none = jax.random.key(0), np.zeros((1, 3), np.float32)
    one, two = (
        still(model, params, state, none, key, memory=False)[1].rgb_THWC
        for model in (MODEL, doubted)
    )
    np.testing.assert_array_equal(one, two)


@pytest.mark.slow
def test_what_is_seen_decides_between_classes_and_nothing_else_changes():
    classes = MODEL.backbone.voxel_vae.classes  # 13: of the second kind not all colours
    params = jax.jit(lambda: worlds.init(ROOM, jax.random.key(0)))()
    latents = jax.random.normal(jax.random.key(1), (1, 4, 4, 4, 3))
    before = jnp.full((8, 8, 8), -1)
    air = jnp.zeros((8, 8, 8), bool).at[:2].set(True)
    colour = jnp.full((8, 8, 8), -1).at[2:4].set(2)
    evidence = persist_sight.ObservedCells(air, colour)
    free = dataclasses.replace(ROOM, persistence_logit=0.0)
    made = np.asarray(persist_voxels.decode_classes(free, params, latents, before))
    looked = np.asarray(persist_voxels.decode_classes(free, params, latents, before, evidence))
    assert not looked[:2].any()
    assert ((looked[2:4] > 0) & ((looked[2:4] - 1) % COLOURS == 2)).all()
    np.testing.assert_array_equal(looked[4:], made[4:])
    blind = dataclasses.replace(free, observation_logit=0.0)
    np.testing.assert_array_equal(
        persist_voxels.decode_classes(blind, params, latents, before, evidence), made
    )
    given = persist_sight.evidence_logits(ROOM, evidence, classes)
    assert given.shape == (8, 8, 8, classes)
    assert float(given.max()) == ROOM.observation_logit
