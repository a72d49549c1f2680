"""Blocks placed in worlds of voxels: counted cell by cell, and looked at in all frames."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import Config, UserError
from pewm_jax.eval import voxel_trials
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.types import Camera, Frames, WorldState
from pewm_jax.worlds.persist import world as persist
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.worlds.persist.tiny_persist import MODEL

FRAMES = 5


def world(cell):
    """A model of such cells whose grid is 12 m wide."""
    cells = (round(12 / cell), round(12 / cell), 8)
    memory = dataclasses.replace(MODEL.memory, cell_m=(cell,) * 3, cells=cells, eye_m=1.2)
    return dataclasses.replace(MODEL, memory=memory)


def cameras(count):
    """Cameras at the middle, 1.2 m high, that look along x."""
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[2, 3] = 1.2
    intrinsics = np.full((count, 4), 8, np.float32)
    return Camera(jnp.asarray(intrinsics), jnp.asarray(np.repeat(pose[None], count, 0)))


def frames(count, value=0.0):
    shape = (count, 16, 16)
    return Frames(jnp.full((*shape, 3), value), jnp.ones(shape), cameras(count))


@pytest.fixture
def standing(monkeypatch):
    """Worlds in which nothing happens, and pictures that are white where a grid holds anything."""

    def start_in(model, params, seen, classes, origin):
        empty = jnp.zeros(model.memory.cells, jnp.int16)
        return WorldState(seen, ClassGrid(empty, jnp.array([-6.0, -6.0, 0.0])))

    def imagine(model, params, state, actions, key):
        white = jnp.any(state.map.classes_XYZ > 0).astype(jnp.float32)
        left = jnp.arange(16) < 8
        rgb = jnp.zeros((len(actions), 16, 16, 3)) + white * left[:, None]
        return state, dataclasses.replace(frames(len(actions)), rgb_THWC=rgb)

    monkeypatch.setattr(persist, "start_in", start_in)
    monkeypatch.setattr(persist.PERSIST, "imagine", imagine)
    return monkeypatch


def walk():
    return types.SimpleNamespace(
        first=(np.zeros((2, 2, 2), np.int16), np.zeros(3, np.float32)),
        context=frames(2),
        actions_T3=np.zeros((FRAMES, 3), np.float32),
    )


@pytest.mark.parametrize("cell", [0.2, 0.25])
def test_in_a_world_where_nothing_happens_all_of_a_block_stays(standing, cell):
    config = Config(model=world(cell), train=PersistTrainConfig())
    there = np.zeros((8, 8), bool)
    there[:, :4] = True
    standing.setattr(
        voxel_trials, "_rays_on_block", lambda *_: (jnp.asarray(there), jnp.array(True))
    )
    found = voxel_trials.run(config, {}, [walk(), walk()], batch=2, chunk=3)
    np.testing.assert_array_equal(found.kept_N, 1)
    assert (found.asked, found.frames, found.within) == (2, 2 * FRAMES, 2 * FRAMES)
    assert found.shown == found.visible == 2 * FRAMES  # of both chunks


def test_enough_trials_are_enough(standing):
    config = Config(model=world(0.25), train=PersistTrainConfig())
    standing.setattr(
        voxel_trials, "_rays_on_block", lambda *_: (jnp.zeros((8, 8), bool), jnp.array(True))
    )
    boxes = iter([None, np.array([[1, 0, 0], [1.25, 0.25, 0.25]], np.float32)])
    standing.setattr(voxel_trials, "room", lambda *_: next(boxes))
    found = voxel_trials.run(config, {}, [walk(), walk(), walk()], batch=1, chunk=8, count=1)
    assert (len(found.kept_N), found.asked) == (1, 2)
    assert found.facts()["without_room"] == 1


@pytest.mark.slow
def test_what_a_camera_sees_of_a_block_and_whether_it_is_in_the_window(standing):
    model = world(0.5)
    camera = jax.tree.map(lambda x: x[0][None], cameras(1))
    grid = ClassGrid(jnp.zeros(model.memory.cells, jnp.int16), jnp.array([-6.0, -6.0, 0.0]))
    ahead = jnp.array([[1.0, -0.5, 0.5], [1.5, 0.5, 1.5]])
    there, within = voxel_trials._rays_on_block(model, grid, camera, ahead)
    assert there.any()
    assert within
    for box in (ahead - jnp.array([3.0, 0, 0]), ahead + jnp.array([4.0, 0, 0])):
        there, within = voxel_trials._rays_on_block(model, grid, camera, box)
        assert not there.any()
    assert not within  # farther than half a window


def test_a_picture_is_changed_where_the_block_is_or_not():
    there = np.zeros((4, 4), bool)
    there[1:3, 1:3] = True
    change = np.full((18, 18), 0.1)
    assert voxel_trials.block_visibility(there, change) == (True, False)
    change[6:12, 6:12] = 0.5
    assert voxel_trials.block_visibility(there, change) == (True, True)
    assert voxel_trials.block_visibility(np.ones((4, 4), bool), change) == (False, False)
    assert voxel_trials.block_visibility(there & False, change) == (False, False)


def test_what_cannot_be_tried_is_refused():
    config = Config(model=world(0.25), train=PersistTrainConfig())
    assert voxel_trials.block_class(config, [walk()]) > 0
    with pytest.raises(UserError, match="no voxels"):
        voxel_trials.block_class(config, [types.SimpleNamespace(first=None)])
    with pytest.raises(UserError, match="furniture/nothing"):
        voxel_trials.block_class(config, [walk()], "furniture/nothing")
