"""Data sets of SceneZoo: a stand-in of its interface, and the package on a file of ScanNet."""

from __future__ import annotations

import struct
import sys
import types
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.importer import ImportConfig, import_recording
from tests.data import layouts
from tests.data.two_rooms import box_views

RGBD = ("rgb", "depth", "rgb_intrinsics", "depth_intrinsics", "world_to_camera")
SMALL = 2
"""Depth images have half the width and height."""


def imported(src, out, dataset, **options):
    lines = []
    config = ImportConfig(src, out, format="scenezoo", dataset=dataset, **options)
    import_recording(config, lines.append)
    return EpisodeSource(out / "train"), "\n".join(lines)


def matrices(focal_T4):
    """Intrinsics (T, 3, 3) with pixel centres at integers."""
    found = np.tile(np.eye(3, dtype=np.float32), (len(focal_T4), 1, 1))
    found[:, [0, 1, 0, 1], [0, 1, 2, 2]] = focal_T4 - [0, 0, 0.5, 0.5]
    return found


def half_depth(walk):
    width, height = walk.size
    return box_views(walk.pose, walk.focal / SMALL, height // SMALL, width // SMALL)[1]


class Frames(SimpleNamespace):
    def __len__(self):
        return len(self.indices)


class StandIn:
    """What SceneZoo has of a data set: frame 2 has no camera."""

    def __init__(self, name, walks):
        self.name, self.walks, self.calls, self.broken = name, walks, [], ()

    def get_frames(self, sample_id, *, indices=None, items=(), rotate_to_up=True, source="phone"):
        assert not rotate_to_up
        self.calls.append((indices, items))
        if sample_id not in self.walks:
            raise FileNotFoundError(f"no {sample_id}")
        walk = self.walks[sample_id]
        known = [k for k in range(len(walk.pose)) if k != 2]
        indices = known if indices is None else indices
        if {"rgb", "depth"} & set(items) and set(indices) & set(self.broken):
            raise RuntimeError("cut\nfile")
        focal = np.tile(walk.focal, (len(indices), 1))
        found = {
            "rgb": walk.rgb[indices],
            "depth": half_depth(walk)[indices].astype(np.float32),
            "rgb_intrinsics": matrices(focal),
            "depth_intrinsics": matrices(focal / SMALL),
            "world_to_camera": np.linalg.inv(walk.pose[indices]).astype(np.float32),
        }
        found = {name: found[name] if name in items else None for name in RGBD}
        model = {"phone": "PINHOLE", "colour": "PINHOLE", "mixed": "OPENCV"}[source]
        return Frames(indices=np.array(indices), source_frame_count=12, camera_model=model, **found)


@pytest.fixture
def zoo(monkeypatch, tmp_path):
    """A module of SceneZoo's interface, with one data set of two scenes."""
    walks = {"a": layouts.hand_held(12), "b": layouts.hand_held(12, turns=-1)}
    data = StandIn("rooms", walks)
    for name in (*walks, "empty"):
        (tmp_path / "src" / "scans" / name / "files").mkdir(parents=True)

    def source(name, items=RGBD, models=("PINHOLE",), requires=()):
        return SimpleNamespace(name=name, items=items, camera_models=models, requires=requires)

    sources = {
        "rooms": (
            source("fisheye", models=("FISHEYE624",)),
            source("phone"),
            source("colour", ("rgb", "rgb_intrinsics", "world_to_camera")),
            source("mixed", models=("PINHOLE", "OPENCV")),
            source("views", requires=("room_id",)),
        ),
        "meshes": (),
    }
    sources["alias"] = sources["rooms"]

    def info(name):
        return SimpleNamespace(name=name, spec=SimpleNamespace(frame_sources=sources[name]))

    def get_dataset(name, root_dir, *, offline=False):
        assert (name, root_dir, offline) == ("rooms", tmp_path / "src", True)
        return data

    module = types.ModuleType("scenezoo")
    module.list_datasets = lambda include_aliases: sorted(sources)
    module.get_dataset_info, module.get_dataset = info, get_dataset
    monkeypatch.setitem(sys.modules, "scenezoo", module)
    return data


def test_scenes_arrive_with_poses_depth_and_intrinsics(zoo, tmp_path):
    source, lines = imported(tmp_path / "src", tmp_path / "out", "Rooms", rotate="0")
    assert [episode.name for episode in source] == ["src/a", "src/b"]
    assert "note: 1 of 12 frames of a have no camera" in lines
    kept = [k for k in range(12) if k != 2]
    for episode, walk in zip(source, zoo.walks.values(), strict=True):
        np.testing.assert_allclose(episode.world_from_camera, walk.pose[kept], atol=1e-4)
        np.testing.assert_allclose(episode.intrinsics_4, walk.focal, atol=1e-4)
        frames = episode.frames()
        np.testing.assert_array_equal(frames.rgb_THWC, walk.rgb[kept])
        depth = half_depth(walk)[kept].repeat(SMALL, 1).repeat(SMALL, 2)
        np.testing.assert_allclose(frames.depth_THW, depth, atol=6e-4)  # stored in millimetres
        assert (episode.info["dataset"], episode.info["camera"]) == ("rooms", "phone")
    upright, _ = imported(tmp_path / "src", tmp_path / "turned", "rooms")
    assert [(episode.width, episode.height) for episode in upright] == [(64, 48), (48, 64)]
    assert all(len(one or []) < 12 for one, items in zoo.calls if "rgb" in items)


def test_a_damaged_frame_is_named_and_can_be_left_out(zoo, tmp_path):
    zoo.broken = (5,)
    with pytest.raises(UserError, match="scene a, frame 5: cut file"):
        imported(tmp_path / "src", tmp_path / "out", "rooms")
    source, _ = imported(tmp_path / "src", tmp_path / "out", "rooms", skip_bad=2)
    assert [episode.length for episode in source] == [10, 10]


def test_sources_without_depth_and_given_intrinsics_are_taken(zoo, tmp_path):
    focal = (*zoo.walks["a"].focal[:2], 32.0, 24.0)
    source, _ = imported(
        tmp_path / "src", tmp_path / "out", "rooms", camera="colour", intrinsics=focal, rotate="0"
    )
    assert not source[0].has_depth
    np.testing.assert_allclose(source[0].intrinsics_4, [*focal[:2], 32.5, 24.5], atol=1e-5)
    kept = [k for k in range(12) if k != 2]
    np.testing.assert_array_equal(source[0].frames().rgb_THWC, zoo.walks["a"].rgb[kept])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"dataset": None}, "--dataset is missing: name one with posed images: alias, rooms"),
        ({"dataset": "meshes"}, "--dataset meshes: name one"),
        ({"camera": "fisheye"}, "--camera is fisheye: rooms has the sources of frames phone, col"),
        ({"camera": "views"}, "--camera is views"),
        ({"camera": "mixed"}, "a camera OPENCV is no pinhole camera"),
    ],
)
def test_what_has_no_pinhole_camera_with_a_pose_is_refused(zoo, tmp_path, options, says):
    with pytest.raises((ConfigError, UserError), match=says):
        imported(tmp_path / "src", tmp_path / "out", **{"dataset": "rooms"} | options)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_scenes_and_a_damaged_scene_are_refused(zoo, tmp_path):
    zoo.walks.clear()
    with pytest.raises(
        UserError, match=r"has no scene of rooms with frames of --camera phone.*no a"
    ):
        imported(tmp_path / "src", tmp_path / "out", "rooms")
    zoo.walks["b"] = None
    with pytest.raises(UserError, match="scene b: 'NoneType'"):
        imported(tmp_path / "src", tmp_path / "out", "rooms")


def test_a_missing_package_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "scenezoo", None)
    with pytest.raises(UserError, match=r"pip install 'pewm-jax\[scenes\]'"):
        imported(tmp_path, tmp_path / "out", "scannetv2")


def sens(path, walk, lost=()):
    """A ``.sens`` file of ScanNet, version 4: JPEG colours, deflated depth, camera to world."""
    (width, height), depths = walk.size, half_depth(walk)
    parts = [struct.pack("<IQ", 4, 4), b"test"]
    for fx, fy, cx, cy in (walk.focal, walk.focal / SMALL):
        k = [[fx, 0, cx - 0.5, 0], [0, fy, cy - 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        parts += [np.array(k, "<f4").tobytes(), np.eye(4, dtype="<f4").tobytes()]
    sizes = (width, height, width // SMALL, height // SMALL)
    parts.append(struct.pack("<iiIIIIfQ", 2, 1, *sizes, 1000.0, len(walk.pose)))
    poses = walk.pose.copy()
    poses[list(lost)] = -np.inf
    for k, pose in enumerate(poses):
        fine = [cv2.IMWRITE_JPEG_QUALITY, 98]
        colour = cv2.imencode(".jpg", walk.rgb[k][..., ::-1], fine)[1].tobytes()
        depth = zlib.compress(np.rint(depths[k] * 1000).astype("<u2").tobytes())
        parts.append(pose.astype("<f4").tobytes())
        parts += [struct.pack("<QQQQ", k, k, len(colour), len(depth)), colour, depth]
    path.parent.mkdir(parents=True)
    path.write_bytes(b"".join([*parts, struct.pack("<Q", 0)]))
    return path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Open3D and what it imports
def test_the_package_reads_a_file_of_scannet(tmp_path):
    pytest.importorskip("scenezoo")
    pytest.importorskip("open3d", exc_type=ImportError)
    walk = layouts.hand_held(12)
    src = tmp_path / "scannet"
    path = sens(src / "scans" / "scene0000_00" / "scene0000_00.sens", walk, lost=(4,))
    (episode,), lines = imported(src, tmp_path / "out", "scannet")
    assert "note: 1 of 12 frames of scene0000_00 have no camera" in lines
    kept = [k for k in range(12) if k != 4]
    np.testing.assert_allclose(episode.world_from_camera, walk.pose[kept], atol=1e-4)
    np.testing.assert_allclose(episode.intrinsics_4, walk.focal, atol=1e-4)
    frames = episode.frames()
    depth = half_depth(walk)[kept].repeat(SMALL, 1).repeat(SMALL, 2)
    np.testing.assert_allclose(frames.depth_THW, depth, atol=6e-4)
    assert np.abs(frames.rgb_THWC.astype(float) - walk.rgb[kept]).mean() < 2
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(UserError, match=r"scene scene0000_00: Truncated ScanNet"):
        imported(src, tmp_path / "cut", "scannetv2")
    with pytest.raises(ConfigError, match="multiscan"):
        imported(src, tmp_path / "cut", "scenenn")
    with pytest.raises(UserError, match="has no scene of 3rscan"):
        imported(src, tmp_path / "cut", "3rscan")
