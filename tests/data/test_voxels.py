"""Grids around the agent: what is in them, how they are recorded, read and imported."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.cli import main as program
from pewm_jax.config import ArraySpec, BatchSpec, ConfigError, DataConfig, UserError
from pewm_jax.data import clips, loader
from pewm_jax.data.checks import check_episode
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import read_episode, write_episode
from pewm_jax.data.importer import import_recording, world_from_recording
from pewm_jax.data.make_episode import CollectConfig, make_episode, settings_of
from pewm_jax.data.record_format import DamagedError
from pewm_jax.data.recordings import turned
from pewm_jax.data.scenes import house
from pewm_jax.data.show import draw_voxels, grid_from_camera
from pewm_jax.data.validate import ValidateConfig, validate
from pewm_jax.data.voxelise import crop_grids, fill, lattice_of, split_at_borders
from pewm_jax.data.voxels import PALETTE, VoxelFrames, VoxelsConfig, class_ids, table_colours
from pewm_jax.geometry.cameras import unproject
from pewm_jax.houses.kinds import GROUPS, KINDS, OTHER, kind_of
from pewm_jax.worlds.pewm.world import PEWM
from tests.data.test_importer import config as import_config
from tests.data.test_importer import record
from tests.data.two_rooms import arrays, clip_at, write_split
from tests.helpers import tiny_config
from tests.properties import examples

GRID = VoxelsConfig(record=True, cell=0.2, side=40)
PLAIN = CollectConfig(Path("x"), frames=24, size=32)


@functools.cache
def walk(index=0, **options):
    """A walk through a made house, with grids."""
    config = dataclasses.replace(PLAIN, voxels=GRID, **options)
    return read_episode(make_episode(config, "train", index))


@functools.cache
def lattice(seed=0):
    return lattice_of(GRID, fill(GRID, house(seed), np.zeros(3)), np.zeros(3))


# What is in a grid.


@examples(25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 2.0, 9.0]), st.booleans())
def test_triangles_are_cut_at_the_borders_of_cells_and_nothing_is_lost(seed, size, on_borders):
    rng = np.random.default_rng(seed)
    corners = rng.normal(0, size, (5, 3, 3))
    if on_borders:  # corners on the borders, and sides along them
        corners = np.round(corners * 2) / 2
    pieces, face = split_at_borders(corners)

    def areas(triangles):
        sides = triangles[:, 1:] - triangles[:, :1]
        return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)

    np.testing.assert_allclose(np.bincount(face, areas(pieces), 5), areas(corners), atol=1e-9)
    low = np.floor(pieces.mean(1))[:, None]
    assert ((pieces >= low - 1e-6) & (pieces <= low + 1 + 1e-6)).all()


def test_every_part_of_a_house_has_a_kind():
    for seed in range(4):
        kinds = {kind_of(name) for name in house(seed).objects}
        assert OTHER not in kinds
        assert {"wall", "floor", "ceiling", "window", "doorway", "bed"} <= kinds
    assert kind_of("a_mesh_of_mine") == kind_of("room0-spaceship-0") == OTHER
    assert set(GROUPS) == set(KINDS)


def test_classes_are_kinds_in_colours():
    assert len(VoxelsConfig().names) == 1 + 16 * len(KINDS)
    named = dict(zip(GRID.names, table_colours(GRID.names), strict=True))
    assert (named["sofa/red"] == PALETTE["red"]).all()
    kind = np.full(24, KINDS.index("sofa"))
    every = VoxelsConfig(colours=24)
    found = class_ids(every, kind, np.array(list(PALETTE.values())) / 255)
    assert [every.names[k] for k in found] == [f"sofa/{colour}" for colour in PALETTE]
    few = VoxelsConfig(kinds="groups", colours=1)
    assert few.names[class_ids(few, kind[:1], np.zeros((1, 3)))[0]] == "furniture"
    assert (few.dtype, every.dtype) == (np.uint8, np.uint16)


@pytest.mark.parametrize("moving", [False, True])
def test_a_march_through_the_grid_ends_where_the_camera_sees_a_surface(moving):
    """Never behind it, as no surface is missing, and mostly in the cell before it or its own."""
    episode = walk(moving=moving)
    frames, voxels = episode.frames(), episode.voxels()
    points = np.asarray(unproject(frames.depth_THW, frames.camera))
    at = (points - voxels.origin_T3[:, None, None]) / GRID.cell
    inside = ((at > 0.2) & (at < GRID.side - 0.2)).all(-1)
    behind, near, kinds = [], [], []
    for t in range(0, 24, 3):
        seen = grid_from_camera(voxels, t, frames.camera, 32, 32)
        met = np.where(seen.classes_HW > 0, seen.depth_HW, np.inf)[inside[t]]
        depth = frames.depth_THW[t][inside[t]]
        behind.append(met - depth)
        # A cell seen at an angle begins more than its side before the surface in it.
        near.append(np.abs(met - depth) < 2 * GRID.cell)
        kinds.append(seen.classes_HW)
    assert sum(map(len, near)) > 4000
    # Surfaces are moved by up to 2 cm, which at a grazing angle is more along the ray.
    assert np.mean(np.concatenate(behind) > 0.05) < 0.01
    assert np.concatenate(behind).max() < 0.5
    assert np.mean(np.concatenate(near)) > 0.75
    wrong = [k for k in np.unique(kinds) if k and GRID.names[k].startswith(OTHER)]
    assert not wrong


def test_floors_and_rugs_lie_below_the_floor_s_height():
    cells, zero = lattice().classes_XYZ, -int(lattice().first_3[2])
    floors = [k for k, name in enumerate(GRID.names) if name.startswith(("floor/", "rug/"))]
    below, on = cells[:, :, zero - 1], cells[:, :, zero]
    assert np.isin(below, floors).sum() > 500
    assert not np.isin(on, floors).any()


def test_the_grid_goes_with_the_agent_and_the_world_stays():
    episode = walk()
    voxels, place = episode.voxels(), episode.world_from_camera[:, :3, 3]
    middle = voxels.origin_T3 + GRID.side * GRID.cell / 2
    assert np.abs(place - middle).max() <= GRID.cell / 2 + 1e-5
    low = np.rint(voxels.origin_T3 / GRID.cell).astype(int)
    assert len(np.unique(low, axis=0)) > 4
    for t in range(24):
        classes, _ = crop_grids(lattice(0), GRID.side, place[t : t + 1])
        np.testing.assert_array_equal(voxels.classes_TXYZ[t], classes[0])
    for a, b in ((0, 23), (3, 11)):  # one world in two grids
        shift = low[b] - low[a]
        there = np.argwhere(voxels.classes_TXYZ[b] > 0) + shift
        there = there[((there >= 0) & (there < GRID.side)).all(-1)]
        first, second = voxels.classes_TXYZ[a], voxels.classes_TXYZ[b]
        np.testing.assert_array_equal(first[tuple(there.T)], second[tuple((there - shift).T)])


def test_an_odd_grid_has_the_place_in_its_middle_cell():
    for x in (0.1, -0.05, 3.39):
        _, origin = crop_grids(lattice(), 5, np.array([[x, x, x]]))
        assert (np.floor((x - origin) / GRID.cell + 1e-9) == 2).all()


def test_the_same_settings_give_the_same_bytes():
    config = dataclasses.replace(PLAIN, voxels=GRID, moving=True)
    assert make_episode(config, "train", 0) == walk(moving=True).record


def test_what_is_recorded_besides_stays_the_same():
    plain = make_episode(PLAIN, "train", 0)
    bare, full = read_episode(plain), walk()
    assert not {"voxels", "voxel_origins"} & {*bare.header["arrays"], *bare.header["streams"]}
    assert set(bare.info) == {
        "policy", "camera_height_m", "floor_z_m", "step_m", "turn_deg",
    }  # fmt: skip
    np.testing.assert_array_equal(bare.frames().rgb_THWC, full.frames().rgb_THWC)
    np.testing.assert_array_equal(bare.frames().depth_THW, full.frames().depth_THW)
    assert not {"voxels", "moving"} & settings_of(PLAIN, "train").keys()
    made = settings_of(dataclasses.replace(PLAIN, voxels=GRID, moving=True), "train")
    assert made["moving"] is True
    assert made["voxels"] == {"cell": 0.2, "side": 40, "kinds": "all", "colours": 16}


# How grids are recorded and read.


def grids(frames, side=4, cell=0.5, dtype=np.uint8, seed=0):
    """Random grids about the box's agent; the box itself is no part of them."""
    rng = np.random.default_rng(seed)
    classes = rng.integers(0, 3, (frames, side, side, side)).astype(dtype)
    origin = rng.integers(-2, 3, (frames, 3)) * cell
    return VoxelFrames(classes, origin.astype(np.float32), cell, ("empty", "wall", "sofa"))


def boxed(voxels=None, frames=12, **options):
    return dataclasses.replace(arrays(frames=frames, **options), voxels=voxels)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grids_come_back_frame_by_frame(dtype):
    voxels = grids(12, dtype=dtype)
    episode = read_episode(write_episode(boxed(voxels), "a", "box"))
    back = episode.voxels([7, 2, 7])
    np.testing.assert_array_equal(back.classes_TXYZ, voxels.classes_TXYZ[[7, 2, 7]])
    np.testing.assert_array_equal(back.origin_T3, voxels.origin_T3[[7, 2, 7]])
    assert back.classes_TXYZ.dtype == dtype
    assert episode.voxel_grid == voxels.grid
    assert (episode.voxel_grid.cell_m, episode.voxel_grid.side) == (0.5, 4)
    with pytest.raises(IndexError, match="12 frames"):
        episode.voxels([12])


def test_episodes_without_grids_say_so():
    episode = read_episode(write_episode(boxed(), "a", "box"))
    assert episode.voxel_grid is None
    with pytest.raises(UserError, match="collect it with --voxels"):
        episode.voxels()


def spoilt(**changes):
    return dataclasses.replace(grids(12), **changes)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (lambda: spoilt(classes_TXYZ=grids(11).classes_TXYZ), r"expected \(12, n, n, n\)"),
        (lambda: spoilt(classes_TXYZ=grids(12).classes_TXYZ[..., 1:]), r"expected \(12, n, n, n\)"),
        (lambda: spoilt(classes_TXYZ=grids(12).classes_TXYZ / 2), "expected uint8 or uint16"),
        (lambda: spoilt(names=("empty", "wall")), r"frame 0, voxels: class 2 is not in the table"),
        (lambda: spoilt(origin_T3=np.zeros((11, 3))), "voxel_origins"),
        (lambda: spoilt(origin_T3=np.arange(36).reshape(12, 3) / 8), "off the lattice"),
        (lambda: spoilt(cell_m=0.0), "cells of 0.0 m"),
    ],
)
def test_grids_that_cannot_be_are_not_written(wrong, says):
    with pytest.raises(UserError, match=says):
        write_episode(boxed(wrong()), "a", "box")


def test_damaged_grids_are_refused_by_frame():
    whole = write_episode(boxed(grids(12)), "a", "box")
    episode = read_episode(whole)
    offset, size = episode.header["streams"]["voxels"]["spans"][5]
    cut_short = whole[: offset + 6] + bytes(size - 6) + whole[offset + size :]
    with pytest.raises(DamagedError, match="frame 5, voxels: the grid does not decode"):
        read_episode(cut_short).voxels()
    read_episode(cut_short).voxels([4])
    for old, new, says in (
        (b'"side":4', b'"side":3', "does not decode"),
        (b'["empty","wall","sofa"]', b'["empty","wall_sofa" ] ', "class 2 is not in the table"),
        (b'"cell_m":0.5', b'"cell_m":-.5', "header does not parse"),
        (b'"cell_m":0.5', b'"cell_m":0.0', "entries of the voxels are inconsistent"),
    ):
        assert old in whole
        with pytest.raises(DamagedError, match=says):
            read_episode(whole.replace(old, new)).voxels()


def test_a_clip_has_the_grids_of_its_frames():
    voxels = grids(30)
    episode = read_episode(write_episode(boxed(voxels, frames=30), "a", "box"))
    config = tiny_config(data=DataConfig(context=3))
    clip = clip_at(config, episode, 3, stride=2)
    np.testing.assert_array_equal(clip.extras["classes_TXYZ"], voxels.classes_TXYZ[3:20:2])
    np.testing.assert_array_equal(clip.extras["origin_T3"], voxels.origin_T3[3:20:2])
    batch = clips.stack([clip, clip])
    assert batch.extras["classes_TXYZ"].shape == (2, 9, 4, 4, 4)
    assert batch.extras["origin_T3"].shape == (2, 9, 3)


@dataclasses.dataclass(frozen=True)
class Voxels(PEWM):
    """A model whose loss needs the voxels around the agent."""

    @property
    def batch_spec(self):
        shape = (self.clip.frames, 4, 4, 4)
        voxels = ("classes_TXYZ", ArraySpec(shape, "uint16"))
        return BatchSpec(extras=(voxels, ("origin_T3", ArraySpec((self.clip.frames, 3)))))


def test_a_split_has_one_kind_of_grid(tmp_path):
    config = tiny_config(data=DataConfig(path=str(tmp_path), context=3))
    plain, model = config, Voxels(**vars(config.model))
    config = dataclasses.replace(config, model=model)

    def split(name, *voxels):
        made = [boxed(v, frames=24, size=16, width=24, seed=k) for k, v in enumerate(voxels)]
        records = [write_episode(one, f"e{k}", "box") for k, one in enumerate(made)]
        write_split(tmp_path / name, records, {}, frames=24 * len(records))
        return next(loader.clips(config, name, seed=0, batch=len(records)))

    batch = split("same", grids(24), grids(24, seed=1))
    assert batch.extras["classes_TXYZ"].shape == (2, 9, 4, 4, 4)
    assert batch.extras["origin_T3"].shape == (2, 9, 3)
    assert next(loader.clips(plain, "same", seed=0, batch=2)).extras == {}
    other = dataclasses.replace(grids(24), names=("empty", "sofa", "wall"))
    for name, second, says in (
        ("table", other, "another table of classes .* from class 1 on"),
        ("cell", grids(24, cell=0.25), r"4³ cells of 0.25 m .* 4³ of 0.5 m"),
    ):
        with pytest.raises(UserError, match=says):
            split(name, grids(24), second)
    verdict = validate(ValidateConfig(tmp_path / "table"), lambda _: None)
    assert any("another table of classes" in problem.what for problem in verdict.problems)


def test_validation_sees_grids_of_another_place_or_order():
    episode = walk()
    assert check_episode(episode, "here") == []
    assert check_episode(walk(moving=True), "here") == []
    voxels = episode.voxels()

    def problem(**changes):
        full = boxed(frames=24)
        changed = dataclasses.replace(
            full,
            rgb_THWC=episode.frames().rgb_THWC,
            depth_THW=episode.frames().depth_THW,
            intrinsics_4=episode.intrinsics_4,
            world_from_camera=episode.world_from_camera,
            actions=episode.actions,
            voxels=dataclasses.replace(voxels, **changes),
        )
        (found,) = check_episode(read_episode(write_episode(changed, "a", "b")), "here")
        assert found.field == "voxels"
        return found.what

    flipped = voxels.classes_TXYZ[..., ::-1]
    assert "disagrees with the depth" in problem(classes_TXYZ=flipped)
    assert "disagrees with the depth" in problem(classes_TXYZ=voxels.classes_TXYZ.swapaxes(1, 2))
    away = voxels.origin_T3 + np.float32(30 * GRID.cell)
    assert "camera is not in the grid" in problem(origin_T3=away)


# Recordings of others.


def recording(folder, up, walk_arrays, voxels):
    """Write a recording with grids, in a world with another axis up."""
    record(folder, walk_arrays, up=up)
    (folder / "voxels").mkdir()
    (folder / "voxels" / "classes.json").write_text(json.dumps(voxels.names))
    back = world_from_recording(up)[:3, :3].T
    for k, (classes, origin) in enumerate(zip(voxels.classes_TXYZ, voxels.origin_T3, strict=True)):
        theirs, corner = turned(classes, origin, voxels.cell_m, back)
        file = folder / "voxels" / f"{k:05d}.npz"
        np.savez_compressed(file, classes=theirs, origin=corner, cell=voxels.cell_m)
    return folder


@pytest.fixture(scope="module")
def box_walk():
    """A walk through the box, and the box as grids: its walls, floor and ceiling."""
    made = arrays(frames=12, size=48, policy="walk", seed=2, turn_around=1.0)
    low = np.floor(made.world_from_camera[:, :3, 3] / 0.5).astype(int) - 8
    cells = np.arange(16) + low[:, :, None]  # (T, 3, n)
    x, y, z = (cells[:, axis] for axis in range(3))
    x, y, z = x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]
    near = (x >= -1) & (x <= 12) & (y >= -1) & (y <= 8) & (z >= -1) & (z <= 5)
    inner = (x >= 0) & (x < 12) & (y >= 0) & (y < 8) & (z >= 0) & (z < 5)
    wall = np.where(z < 0, 2, 1) + 0 * (x + y)
    classes = np.where(near & ~inner, wall, 0).astype(np.uint8)
    return made, VoxelFrames(classes, (low * 0.5).astype(np.float32), 0.5, ("", "wall", "floor"))


@pytest.mark.parametrize("up", ["-y", "z", "x"])
def test_recorded_grids_arrive_in_the_world_of_the_poses(tmp_path, box_walk, up):
    made, voxels = box_walk
    recording(tmp_path / "rec", up, made, voxels)
    said = []
    import_recording(import_config(tmp_path / "rec", tmp_path / "out", up=up), said.append)
    assert said[0].endswith("voxels of 16³ cells.")
    back = EpisodeSource(tmp_path / "out" / "train")[0].voxels()
    np.testing.assert_array_equal(back.classes_TXYZ, voxels.classes_TXYZ)
    np.testing.assert_allclose(back.origin_T3, voxels.origin_T3, atol=1e-5)
    assert (back.names, back.cell_m) == (voxels.names, 0.5)
    assert validate(ValidateConfig(tmp_path / "out"), said.append).problems == []


def test_recorded_grids_that_do_not_fit_are_refused(tmp_path, box_walk):
    made, voxels = box_walk
    folder = recording(tmp_path / "rec", "-y", made, voxels)
    frame, table = folder / "voxels" / "00004.npz", folder / "voxels" / "classes.json"
    good, names = frame.read_bytes(), table.read_text()

    def refused(says, **options):
        with pytest.raises(UserError, match=says):
            import_recording(import_config(folder, tmp_path / "out", **options), lambda _: None)
        frame.write_bytes(good)
        table.write_text(names)
        assert not (tmp_path / "out" / "train").exists()

    def with_(**changes):
        np.savez(frame, **{**np.load(folder / "voxels" / "00000.npz"), **changes})

    frame.unlink()
    refused(r"00004\.npz is missing")
    frame.write_bytes(good[:200])
    refused(r"00004\.npz cannot be read as a grid")
    with_(classes=np.array([object()]))
    refused(r"00004\.npz cannot be read as a grid")
    with_(classes=np.zeros((8, 8, 8), int))
    refused(r"00004\.npz has 8³ cells of 0.5 m, 00000\.npz has 16³")
    with_(classes=np.zeros((8, 8, 9), int))
    refused(r"expected integers \(n, n, n\)")
    with_(classes=np.full((16, 16, 16), 3))
    refused(r"class 3 is not in classes\.json, which names the classes 0 to 2")
    with_(origin=np.zeros(2))
    refused("origin must be 3 numbers")
    with_(origin=np.full(3, 0.2))
    refused("off the lattice")
    table.unlink()
    refused(r"classes\.json is missing")
    table.write_text('{"0": "empty"}')
    refused("must hold a JSON list")
    import_recording(import_config(folder, tmp_path / "good"), lambda _: None)
    table.write_text('["", "floor", "wall"]')
    with pytest.raises(UserError, match="another table of classes"):
        import_recording(import_config(folder, tmp_path / "good", name="b"), lambda _: None)


# The command line.


def test_the_flags_record_and_draw(tmp_path, capsys):
    out = tmp_path / "data"
    flags = ["--train=1", "--validation=0", "--test=0", "--frames=4", "--size=16", "--workers=1"]
    command = ["collect", str(out), *flags, "--voxels.side", "12"]
    assert program.main(["data", *command]) == 2
    assert "--voxels.side 12 needs --voxels" in capsys.readouterr().err
    assert program.main(["data", *command, "--voxels", "--moving", "--voxels.kinds=groups"]) == 0
    episode = EpisodeSource(out / "train")[0]
    assert (episode.voxel_grid.side, episode.voxel_grid.cell_m) == (12, 0.2)
    assert "furniture/white" in episode.voxel_grid.names
    picture = tmp_path / "voxels.png"
    assert (
        program.main(["data", "show", str(out / "train"), "--voxels", "--out", str(picture)]) == 0
    )
    drawn = cv2.imread(str(picture))
    np.testing.assert_array_equal(drawn[..., ::-1], draw_voxels(episode))
    assert drawn.shape[0] == 5 * 128
    assert len(np.unique(drawn[256:384].reshape(-1, 3), axis=0)) > 20  # depth, of many shades


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"cell": 0.0}, "--voxels.cell is 0.0"),
        ({"side": 1}, "--voxels.side is 1"),
        ({"colours": 25}, "--voxels.colours is 25"),
    ],
)
def test_grids_that_cannot_work_are_refused(wrong, says):
    with pytest.raises(ConfigError, match=says):
        VoxelsConfig(**wrong)
    with pytest.raises(ConfigError, match="generated houses"):
        CollectConfig(Path("x"), scene=(Path("a.glb"),), moving=True)
    with pytest.raises(ConfigError, match=r"with --moving use 0\.7 m or more"):
        CollectConfig(Path("x"), camera_height=0.5, moving=True)
