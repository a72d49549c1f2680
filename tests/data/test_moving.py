"""Houses in which something moves: pictures and grids show one moment, and only the past counts."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from pewm_jax.data.moving import (
    FAR_M,
    NEAR_M,
    DoorLeaf,
    RobotPath,
    moving_house,
    parts_at,
    render_moving,
)
from pewm_jax.data.navigation import is_free
from pewm_jax.data.render import render
from pewm_jax.data.scenes import house
from pewm_jax.data.show import grid_from_camera
from pewm_jax.data.voxelise import record_voxels
from pewm_jax.data.voxels import VoxelsConfig
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.types import Camera

GRID = VoxelsConfig(cell=0.15, side=48)
SEED = 7


@functools.cache
def opened(seed=SEED):
    return moving_house(seed, 1.35)


def approach(leaf, frames=16):
    """Places and level cameras of an agent that comes to a door along the wall's normal."""
    across = np.array([-math.sin(leaf.yaw), math.cos(leaf.yaw)])
    across *= -np.sign(leaf.swing)  # from the side that it does not open to
    away = np.linspace(2.6, 0.9, frames)
    xy = leaf.middle_2 + away[:, None] * across
    yaw = math.atan2(-across[1], -across[0])
    pose = np.stack([pose_from_yaw(np.array([x, y, 1.25]), yaw) for x, y in xy])
    return xy, Camera(np.tile(intrinsics_from_fov(40, 40, 90.0), (frames, 1)), pose)


def doors(moving, *, stays=None):
    moves = [(k, m) for k, m in enumerate(moving.moves) if isinstance(m, DoorLeaf)]
    return [(k, leaf) for k, leaf in moves if stays is None or leaf.stays is stays]


def test_the_house_itself_stays_as_it_is():
    still, moving = house(SEED), opened()
    for field in ("vertices_V3", "faces_F3", "shading_16F"):
        np.testing.assert_array_equal(getattr(still, field), getattr(moving.scene, field))
    assert still.objects == moving.scene.objects


def test_most_doorways_have_doors_and_some_rooms_robots():
    leaves = sum(len(doors(opened(seed))) for seed in (1, SEED))
    doorways = sum(len(opened(seed).scene.metadata["doorways"]) for seed in (1, SEED))
    assert leaves >= doorways - 1
    assert any(isinstance(move, RobotPath) for seed in (1, SEED) for move in opened(seed).moves)
    assert len({leaf.stays for _, leaf in [*doors(opened(1)), *doors(opened(SEED))]}) == 2


def test_the_same_seed_moves_the_same():
    again, first = moving_house(SEED, 1.35), opened()
    xy = np.random.default_rng(0).uniform(0, 8, (20, 2))
    np.testing.assert_array_equal(again.poses(xy), first.poses(xy))
    np.testing.assert_array_equal(again.parts.vertices_V3, first.parts.vertices_V3)
    assert not np.array_equal(moving_house(1, 1.35).poses(xy)[:, :1], first.poses(xy)[:, :1])


def test_a_frame_depends_on_nothing_later():
    xy = np.random.default_rng(1).uniform(0, 8, (20, 2))
    whole = opened().poses(xy)
    other = xy.copy()
    other[12:] = 4.0
    np.testing.assert_array_equal(opened().poses(other)[:12], whole[:12])
    np.testing.assert_array_equal(opened().poses(xy[:5]), whole[:5])


def test_doors_open_for_the_agent_and_some_stay_open():
    def angles(leaf, away):
        poses = leaf.poses(leaf.middle_2 + np.array(away)[:, None] * [1.0, 0.0])
        yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - leaf.yaw
        return np.abs((yaw + np.pi) % (2 * np.pi) - np.pi)

    half = (NEAR_M + FAR_M) / 2
    (_, leaf), *_ = doors(opened())
    for stays, after in ((True, math.pi / 2), (False, 0.0)):
        one = dataclasses.replace(leaf, stays=stays)
        found = angles(one, [FAR_M + 1, half, NEAR_M, FAR_M])
        np.testing.assert_allclose(found, [0, math.pi / 4, math.pi / 2, after], atol=1e-6)


def test_the_agent_can_pass_open_doors_and_stands_in_none():
    moving = opened()
    leaves = [leaf for _, leaf in doors(moving)]
    width = {k: moving.parts.vertices_V3[moving.parts.faces_F3[moving.parts.object_F == k]].max()
             for k, _ in doors(moving)}  # fmt: skip
    for (_, leaf), reach in zip(doors(moving), width.values(), strict=True):
        angle = leaf.yaw + leaf.swing
        along = np.linspace(0.1, min(reach, 0.9), 8)[:, None] * [math.cos(angle), math.sin(angle)]
        assert not is_free(moving.grid, leaf.hinge_2 + along).any()
    assert is_free(moving.grid, np.array([leaf.middle_2 for leaf in leaves])).mean() > 0.7
    for move in moving.moves:
        if isinstance(move, RobotPath):
            assert is_free(moving.grid, move.poses(np.zeros((60, 2)))[:, :2, 3]).all()


def test_robots_go_on_steadily():
    (way, *_) = [move for move in opened().moves if isinstance(move, RobotPath)]
    place = way.poses(np.zeros((80, 2)))[:, :2, 3]
    steps = np.linalg.norm(np.diff(place, axis=0), axis=-1)
    assert steps.max() < 0.1201
    assert np.median(steps) > 0.11


def test_a_part_is_seen_in_front_of_what_it_hides():
    moving = opened()
    _, leaf = doors(moving)[0]
    xy, camera = approach(leaf)
    poses = moving.poses(xy)
    seen, still = render_moving(moving, poses, camera, 40, 40), render(moving.scene, camera, 40, 40)
    part = seen.ids_THW >= len(moving.scene.objects)
    assert part[0].mean() > 0.05
    assert (seen.depth_THW[part] < still.depth_THW[part]).all()
    np.testing.assert_array_equal(seen.rgb_THWC[~part], still.rgb_THWC[~part])
    assert not np.array_equal(part[0], part[-1])
    one = Camera(camera.intrinsics_4[:1], camera.world_from_camera[:1])
    alone = render(parts_at(moving, poses[0]), one, 40, 40)
    np.testing.assert_array_equal(seen.depth_THW[0][part[0]], alone.depth_THW[0][part[0]])


@pytest.mark.parametrize("stays", [True, False])
def test_a_door_that_opens_changes_its_cells_as_the_camera_sees_it(stays):
    moving = opened()
    _, leaf = doors(moving, stays=stays)[0]
    xy, camera = approach(leaf)
    there_and_back = np.concatenate([xy, xy[::-1]])
    poses = moving.poses(there_and_back)
    place = np.concatenate([camera.world_from_camera, camera.world_from_camera[::-1]])[:, :3, 3]
    voxels = record_voxels(GRID, moving.scene, 0.0, place, moving, poses)
    is_door = np.array([name.startswith("door/") for name in GRID.names])

    def door_cells(t):
        """Cells of a door in the doorway itself, in the world's numbers."""
        cells = np.argwhere(is_door[voxels.classes_TXYZ[t]]) + np.rint(
            voxels.origin_T3[t] / GRID.cell
        ).astype(int)
        near = np.abs((cells[:, :2] + 0.5) * GRID.cell - leaf.middle_2).max(1) < 0.3
        return {tuple(cell) for cell in cells[near].tolist()}

    assert len(door_cells(0)) > 15  # a closed leaf is in the way
    assert len(door_cells(15)) < 0.4 * len(door_cells(0))
    assert (door_cells(31) == door_cells(0)) is (not stays)
    seen = render_moving(moving, poses[:16], camera, 40, 40)
    for t in (0, 15):
        grid = grid_from_camera(voxels, t, camera, 40, 40)
        part = seen.ids_THW[t] >= len(moving.scene.objects)
        kinds = np.array([name.partition("/")[0] for name in GRID.names])[grid.classes_HW]
        assert np.isin(kinds[part], ["door", "robot", "doorway", "wall", "trim"]).mean() > 0.8
        beyond = seen.depth_THW[t] > np.linalg.norm(place[t, :2] - leaf.middle_2) + 0.5
        through = (grid.depth_HW == 0) | (grid.depth_HW > seen.depth_THW[t] - 0.5)
        assert through[beyond].sum() >= 0.6 * beyond.sum()
        open_now = beyond[:, 15:25].sum()
        assert (open_now > 20) == (t == 15)
