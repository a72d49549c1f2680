"""Every format on its published layout: poses, depth, colours, intrinsics, and what is refused."""

from __future__ import annotations

import gzip
import json
import pickle
import shutil

import cv2
import numpy as np
import pytest

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import formats
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.formats import seven_scenes
from pewm_jax.data.formats.lerobot_features import Features
from pewm_jax.data.importer import ImportConfig, import_recording
from tests.data import layouts
from tests.data.two_rooms import box_views

FRAMES = 12
WALKS = {
    "7scenes": {"focal": (52.5, 52.5, 32, 24)},
    "replica": {"width": 60, "height": 34, "focal": (30, 30, 30, 17)},
}
WRITERS = {
    "7scenes": layouts.seven_scenes,
    "replica": layouts.replica,
    "scannet": layouts.scannet,
    "arkitscenes": layouts.arkitscenes,
    "stray": layouts.stray,
    "nomad": layouts.nomad,
    "lerobot": lambda folder, walk: layouts.lerobot(folder, [walk]),
}
SCALES = {"replica": 6553.5}
LOSSY = {"replica": 2, "scannet": 2, "stray": 6, "nomad": 2, "lerobot": 6}
"""Largest mean error of colours, in 1/255, where they are stored with loss."""


def written(tmp_path, name, **changes):
    """Write a layout; return its folder and what the camera saw."""
    if name == "lerobot":
        pytest.importorskip("pyarrow")
    walk = layouts.hand_held(FRAMES, **WALKS.get(name, {}) | changes)
    return WRITERS[name](tmp_path / "src", walk), walk


def imported(src, out, name="auto", **options):
    lines = []
    import_recording(ImportConfig(src, out, format=name, **options), lines.append)
    return EpisodeSource(out / options.get("split", "train")), "\n".join(lines)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "nomad"])
def test_poses_depth_and_colours_arrive_exactly(tmp_path, name):
    src, walk = written(tmp_path, name)
    (episode,), lines = imported(src, tmp_path / "out")
    assert f"recognised as {name}, because there is" in lines
    assert episode.length == FRAMES
    np.testing.assert_allclose(episode.world_from_camera, walk.pose, atol=1e-4)
    np.testing.assert_allclose(episode.intrinsics_4, walk.focal, atol=1e-4)
    frames = episode.frames()
    error = np.abs(frames.rgb_THWC.astype(float) - walk.rgb).mean()
    assert error <= LOSSY.get(name, 0)
    seen, scale = frames.depth_THW, SCALES.get(name, 1000)
    if name in ("scannet", "stray"):  # depth images of half the size: exact at their own pixels
        whole = layouts.box_views(walk.pose, walk.focal / 2, 24, 32)[1]
        expected = np.rint(whole * scale) / scale
        expected = expected.repeat(2, 1).repeat(2, 2)
        if name == "stray":
            expected[:, :4] = 0  # of the lowest confidence
    elif name == "7scenes":  # projected from another camera: the nearest of its pixels
        assert 0.75 < (seen > 0).mean() < 0.85  # it sees less: (525 / 585)²
        assert np.median(np.abs(seen - walk.depth)[seen > 0]) < 0.005
        return
    elif name == "lerobot":
        expected = layouts.dequantize(layouts.quantize(walk.depth))
    else:
        expected = np.rint(walk.depth * scale) / scale
    np.testing.assert_allclose(seen, expected, atol=1e-4)


def test_depth_in_other_units_is_displaced_as_far():
    depth = np.full((48, 64), 1500, np.uint16)
    depth[10:20, 30:40] = 900
    found = seven_scenes.to_colours(depth)
    np.testing.assert_array_equal(seven_scenes.to_colours(5 * depth, 5000.0), 5 * found)
    near = np.nonzero(found == 900)[1]
    assert (near.min(), near.max()) == (29, 37)  # 30 and 38 without a parallax of 1.28 pixels


def test_a_robot_without_depth_arrives_with_its_motion(tmp_path):
    src, walk = written(tmp_path, "nomad")
    (episode,), lines = imported(src, tmp_path / "out", metres_per_step=0.3)
    assert "recognised as nomad" in lines
    assert "no depth" in lines
    assert not episode.has_depth
    assert not episode.frames().depth_THW.any()
    np.testing.assert_allclose(episode.world_from_camera[:, :2, 3], walk.pose[:, :2, 3], atol=1e-4)
    yaw = [np.arctan2(p[1, 2], p[0, 2]) for p in (*episode.world_from_camera, *walk.pose)]
    np.testing.assert_allclose(yaw[:FRAMES], yaw[FRAMES:], atol=1e-4)
    assert episode.actions.shape == (FRAMES - 1, 3)
    assert episode.info["step_m"] == 0.3
    assert EpisodeSource(tmp_path / "out" / "train").manifest.settings["depth"] == {
        "recording-src.array_record": False
    }


@pytest.mark.parametrize(("folder", "metres"), [("recon", 0.25), ("scand_v2", 0.38), ("x", None)])
def test_the_name_of_a_data_set_tells_the_length_of_a_step(tmp_path, folder, metres):
    layouts.nomad(tmp_path / folder, layouts.hand_held(3))
    (episode,), _ = imported(tmp_path / folder, tmp_path / "out")
    assert episode.info.get("step_m") == metres


def test_a_pickle_that_names_a_function_is_refused(tmp_path):
    src, _ = written(tmp_path, "nomad")
    with (src / "traj_0" / "traj_data.pkl").open("wb") as file:
        pickle.dump({"position": shutil.rmtree}, file)
    with pytest.raises(UserError, match="not a tensor type"):
        imported(src, tmp_path / "out")


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_trajectories_of_any_pickle_protocol_are_read(tmp_path, protocol):
    src, walk = written(tmp_path, "nomad")
    with (src / "traj_0" / "traj_data.pkl").open("wb") as file:
        table = {"position": walk.pose[:, :2, 3].copy(), "yaw": np.zeros(FRAMES)}
        pickle.dump(table, file, protocol)
    (episode,), _ = imported(src, tmp_path / "out")
    np.testing.assert_allclose(episode.world_from_camera[:, :2, 3], walk.pose[:, :2, 3], atol=1e-4)


@pytest.mark.parametrize("name", ["arkitscenes", "stray"])
@pytest.mark.parametrize("turns", [1, 3])
def test_sideways_scans_are_turned_upright(tmp_path, name, turns):
    src, walk = written(tmp_path, name, turns=-turns % 4)
    (episode,), _ = imported(src, tmp_path / "out")
    assert (episode.width, episode.height) == walk.size[::-1]
    up = episode.world_from_camera[:, 2, 1]  # the world's z along the camera's y, downward
    assert (up < -0.9).all()
    _, depth = box_views(episode.world_from_camera, episode.intrinsics_4, *walk.size)
    seen = episode.frames().depth_THW
    assert np.median(np.abs(seen - depth)[seen > 0]) < (0.002 if name == "arkitscenes" else 0.05)
    (as_is,), _ = imported(src, tmp_path / "flat", rotate="0")
    np.testing.assert_allclose(as_is.world_from_camera, walk.pose, atol=1e-4)


def test_intrinsics_of_each_frame_are_brought_to_one(tmp_path):
    """A phone refocuses: its frames have other focal lengths."""
    walks = [layouts.hand_held(5, focal=(58 + k, 58 + k, 32, 24 + 0.1 * k)) for k in range(5)]
    mixed = layouts.hand_held(5)
    for k, walk in enumerate(walks):
        mixed.depth[k], mixed.rgb[k] = walk.depth[k], walk.rgb[k]
    src = layouts.arkitscenes(tmp_path / "src", mixed)
    for k, path in enumerate(sorted((src / "lowres_wide_intrinsics").iterdir())):
        path.write_text("64 48 " + " ".join(str(x) for x in walks[k].focal))
    (episode,), _ = imported(src, tmp_path / "out")
    np.testing.assert_allclose(episode.intrinsics_4, walks[2].focal, atol=1e-4)
    expected, depth = box_views(mixed.pose, walks[2].focal, 48, 64)
    frames = episode.frames()
    inner = np.s_[:, 4:-4, 4:-4]
    assert np.median(np.abs(frames.depth_THW - depth)[inner]) < 0.03
    assert np.abs(frames.rgb_THWC.astype(float) - expected)[inner].mean() < 1.5


def test_a_lerobot_set_keeps_its_episodes_actions_and_tasks(tmp_path):
    pytest.importorskip("pyarrow")
    walks = [layouts.hand_held(frames) for frames in (9, 12)]
    src = layouts.lerobot(tmp_path / "src", walks)
    source, _ = imported(src, tmp_path / "out", "lerobot")
    assert [episode.length for episode in source] == [9, 12]
    for number, (episode, walk) in enumerate(zip(source, walks, strict=True)):
        np.testing.assert_allclose(episode.world_from_camera, walk.pose, atol=1e-4)
        expected = np.stack([np.full(episode.length - 1, number), np.arange(episode.length - 1)], 1)
        np.testing.assert_array_equal(episode.actions, expected)
        assert episode.info["task"] == "look around"
    names = tmp_path / "names.txt"
    names.write_text("episode_000001\n")
    (only,), _ = imported(src, tmp_path / "one", "lerobot", names=names, stride=2)
    np.testing.assert_array_equal(only.actions[0], [1, 0, 1, 1])  # both actions of two steps
    assert only.length == 6


def test_states_of_a_lerobot_set_arrive_and_can_be_its_actions(tmp_path):
    pytest.importorskip("pyarrow")
    rng, walks = np.random.default_rng(0), [layouts.hand_held(9)]
    actions, states = (rng.normal(size=(1, 9, 25)).astype(np.float32) for _ in range(2))
    given = {"depth": False, "pose": False, "actions": actions, "states": states}
    src = layouts.lerobot(tmp_path / "src", walks, **given)
    (episode,), _ = imported(src, tmp_path / "out", "lerobot")
    np.testing.assert_array_equal(episode.states, states[0])
    np.testing.assert_array_equal(episode.actions, actions[0, :-1])
    (episode,), _ = imported(src, tmp_path / "own", "lerobot", actions="state", stride=2)
    np.testing.assert_array_equal(episode.states, states[0, ::2])
    np.testing.assert_array_equal(episode.actions, states[0, 2::2])
    bare = layouts.lerobot(tmp_path / "bare", walks, depth=False, pose=False)
    with pytest.raises(ConfigError, match=r"--actions state: .* has no feature observation.state"):
        imported(bare, tmp_path / "x", "lerobot", actions="state")


def test_the_pose_of_a_lerobot_set_is_that_of_its_camera(tmp_path):
    images, shape = {"dtype": "video", "shape": [48, 64, 3]}, {"dtype": "float32", "shape": [7]}
    cameras = [f"observation.images.{name}" for name in ("top", "front", "front_left")]
    poses = ["action.camera_pose", "observation.ee_pose", "observation.front_left_camera_pose"]

    def pose(*names, camera="front"):
        features = dict.fromkeys(cameras, images) | dict.fromkeys(names, shape)
        about = {"codebase_version": "v3.0", "fps": 10, "features": features}
        (tmp_path / "meta").mkdir(exist_ok=True)
        (tmp_path / "meta/info.json").write_text(json.dumps(about))
        return Features(tmp_path).pose(None, f"observation.images.{camera}")

    assert pose(*poses) is None
    assert pose(*poses, camera="front_left") == poses[-1]
    assert pose(*poses, "observation.camera_pose") == "observation.camera_pose"
    assert pose("observation.pose", "observation.front_cam_pose") == "observation.front_cam_pose"
    assert pose("observation.pose", camera="top") == "observation.pose"


def test_a_lerobot_set_without_depth_and_pose_says_what_it_is_good_for(tmp_path):
    pytest.importorskip("pyarrow")
    walks = [layouts.hand_held(6)]
    src = layouts.lerobot(tmp_path / "src", walks, depth=False, pose=False)
    (episode,), lines = imported(src, tmp_path / "out", "lerobot")
    assert "no feature holds the camera's pose" in lines
    assert (episode.has_depth, episode.info["poses"]) == (False, "unknown")
    with pytest.raises(ConfigError, match="has no such feature"):
        imported(src, tmp_path / "x", "lerobot", pose="observation.pose")
    info = json.loads((src / "meta/info.json").read_text())
    (src / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(UserError, match=r"version v2\.1"):
        imported(src, tmp_path / "x", "lerobot")


def test_episodes_of_habitat_are_rendered_along_their_way(tmp_path):
    path = [(3.0, 2.0, 0.0), (3.0, 3.0, 0.0)]
    src = layouts.habitat(tmp_path / "src", (2, 2, 0.0), 0.5, path)
    (episode,), lines = imported(src, tmp_path / "out", size=(48, 32), camera_height=1.1)
    assert "recognised as habitat" in lines
    first = episode.world_from_camera[0]
    np.testing.assert_allclose(first[:3, 3], [2, 2, 1.1], atol=1e-4)
    np.testing.assert_allclose(first[:3, 2], [np.cos(0.5), np.sin(0.5), 0], atol=1e-4)
    np.testing.assert_allclose(episode.world_from_camera[-1, :3, 3], [3, 3, 1.1], atol=1e-4)
    _, depth = box_views(episode.world_from_camera, episode.intrinsics_4, 32, 48)
    np.testing.assert_allclose(episode.frames().depth_THW, depth, atol=1e-4)
    assert episode.actions is not None
    steps = np.linalg.norm(episode.actions[:, :2], axis=1)
    assert steps.max() < 0.2501


def test_an_episode_of_habitat_walks_to_its_goal(tmp_path):
    src = layouts.habitat(tmp_path / "src", (2, 2, 0.0), 2.0, goal=(4.5, 3.0, 0.0))
    (episode,), _ = imported(src, tmp_path / "out", size=(32, 32))
    np.testing.assert_allclose(episode.world_from_camera[-1, :2, 3], [4.5, 3.0], atol=0.1)
    next(src.rglob("*.glb")).unlink()
    with pytest.raises(UserError, match="has no mesh TEEsavR23oF"):
        imported(src, tmp_path / "x", "habitat")


def test_an_object_goal_of_habitat_is_found_by_its_category(tmp_path):
    src = layouts.habitat(tmp_path / "src", (2, 2, 0.0), 2.0, (), (4.5, 3.0, 0.0), "chair")
    (episode,), _ = imported(src, tmp_path / "out", size=(32, 32))
    np.testing.assert_allclose(episode.world_from_camera[-1, :2, 3], [4.5, 3.0], atol=0.1)


@pytest.mark.parametrize(
    ("start", "goal", "says"),
    [
        ((2, 2, 0), None, "has no reference path and no goal away from its start"),
        ((2, 2, 0), (2, 2, 0), "has no reference path and no goal away from its start"),
        ((50, 2, 0), (2, 2, 0), r"starts 4\d\.\d m from where an agent can stand"),
        ((2, 2, 0), (50, 2, 0), r"has its goal 4\d\.\d m from where an agent can stand"),
        ((2, 2, 9.0), (3, 3, 9.0), "starts where no floor is"),
        ((2, 2, 0), (3, 3, 2.6), "has its goal on another storey"),
    ],
)
def test_an_episode_of_habitat_without_a_way_is_left_out_and_named(tmp_path, start, goal, says):
    src = layouts.habitat(tmp_path / "src", start, 0.5, goal=goal)
    with pytest.raises(UserError, match=says) as refused:
        imported(src, tmp_path / "out", "habitat", size=(32, 32))
    assert "\n" not in str(refused.value)
    path = next(src.rglob("*.json.gz"))
    with gzip.open(path, "rt") as file:
        (lost,) = json.load(file)["episodes"]
    walked = lost | {
        "episode_id": "8",
        "start_position": [2, 0, -2],
        "reference_path": [[3, 0, -2]],
    }
    with gzip.open(path, "wt") as file:
        json.dump({"episodes": [lost, walked]}, file)
    source, lines = imported(src, tmp_path / "out", "habitat", size=(32, 32))
    assert [episode.length > 1 for episode in source] == [True]
    assert "note: 1 of 2 episodes are left out; first: episode 7" in lines


def test_every_format_is_recognised_and_nothing_is_not(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="none of the known layouts"):
        formats.recognise(tmp_path / "empty")
    with pytest.raises(UserError, match="is not a folder"):
        formats.recognise(tmp_path / "nowhere")
    assert formats.names()[0] == "auto"
    assert len(formats.names()) == 12
    for name in formats.names()[1:]:
        found = formats.named(name)
        assert name == found.NAME
        assert found.LAYOUT
        with pytest.raises(UserError):
            found.entries(ImportConfig(tmp_path / "empty", tmp_path, format=name))


def test_options_of_another_format_are_refused(tmp_path):
    src, _ = written(tmp_path, "7scenes")
    with pytest.raises(ConfigError, match="--metres-per-step is not used by the format 7scenes"):
        imported(src, tmp_path / "out", "7scenes", metres_per_step=1.0)


def lose(pattern, number=3):
    return lambda src: sorted(src.rglob(pattern))[number].unlink()


def truncate(pattern, number=3):
    def change(src):
        path = sorted(src.rglob(pattern))[number]
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return change


def shrink(pattern, number=3):
    def change(src):
        path = sorted(src.rglob(pattern))[number]
        cv2.imwrite(str(path), np.ones((8, 8), np.uint16 if "depth" in str(path) else np.uint8))

    return change


def cut_video(src):
    path = next(src.rglob("*.mp4"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


BAD = {
    ("7scenes", "a missing image"): (lose("*.color.png"), "12 depth images, 12 poses"),
    ("7scenes", "a missing pose"): (lose("*.pose.txt"), "pose.txt is missing"),
    ("7scenes", "a truncated image"): (truncate("*.color.png"), "damaged or truncated"),
    ("7scenes", "a truncated depth"): (truncate("*.depth.png"), "damaged or truncated"),
    ("7scenes", "a smaller image"): (shrink("*.color.png"), "has 8×8 pixels"),
    ("7scenes", "a broken pose"): (truncate("*.pose.txt"), "words where 16 numbers"),
    ("replica", "a missing depth"): (lose("depth*.png"), "12 colour images, 11 depth images"),
    ("replica", "a truncated image"): (truncate("frame*.jpg"), "damaged or truncated"),
    ("replica", "too few poses"): (truncate("traj.txt", 0), r"expected 16 numbers|has \d poses"),
    ("scannet", "a missing image"): (lose("color/*.jpg"), "11 colour images"),
    ("scannet", "a truncated image"): (truncate("color/*.jpg"), "damaged or truncated"),
    ("scannet", "no intrinsics"): (lose("intrinsic_color.txt", 0), "--intrinsics"),
    ("arkitscenes", "a missing depth"): (lose("lowres_depth/*.png"), "no depth image within"),
    ("arkitscenes", "a missing camera"): (lose("*.pincam"), "pincam cannot be read"),
    ("arkitscenes", "no trajectory"): (lose("*.traj", 0), "has no .traj"),
    ("stray", "a missing depth"): (lose("depth/*.png"), "11 depth images"),
    ("stray", "a truncated video"): (cut_video, "cannot be decoded as a video|has no frame"),
    ("nomad", "a missing image"): (lose("*.jpg"), "11 images, 12 poses"),
    ("nomad", "a truncated image"): (truncate("*.jpg"), "damaged or truncated"),
    ("nomad", "a truncated pickle"): (truncate("*.pkl", 0), "only arrays of numbers are read"),
    ("lerobot", "a missing video"): (lose("*.mp4", 0), "does not exist"),
    ("lerobot", "a truncated video"): (cut_video, "cannot be decoded as a video|has no frame"),
    ("lerobot", "truncated rows"): (truncate("data/**/*.parquet", 0), "cannot be read as Parquet"),
}


@pytest.mark.parametrize(("name", "what"), BAD)
def test_bad_data_are_refused_in_one_sentence_and_leave_nothing(tmp_path, name, what):
    src, _ = written(tmp_path, name)
    damage, says = BAD[name, what]
    damage(src)
    with pytest.raises(UserError, match=says) as refused:
        imported(src, tmp_path / "out", name)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["7scenes", "scannet", "replica"])
def test_bad_frames_are_left_out_up_to_a_number(tmp_path, name):
    src, walk = written(tmp_path, name)
    images = {"7scenes": "*.color.png", "scannet": "color/*.jpg", "replica": "frame*.jpg"}[name]
    truncate(images, 2)(src)
    lose(images, 5)(src)
    with pytest.raises(UserError, match=r"nothing was added.*--skip_bad N"):
        imported(src, tmp_path / "out", name, skip_bad=1)
    (episode,), lines = imported(src, tmp_path / "out", name, skip_bad=2)
    assert "2 frames left out as bad; first:" in lines
    assert episode.length == FRAMES - 2
    gone = episode.info["left_out"]
    kept = [k for k in range(FRAMES) if k not in gone]
    np.testing.assert_allclose(episode.world_from_camera, walk.pose[kept], atol=1e-4)


LOST = {
    "7scenes": lambda src: layouts.matrix(
        sorted(src.rglob("*.pose.txt"))[4], np.full((4, 4), -np.inf)
    ),
    "scannet": lambda src: layouts.matrix(src / "pose" / "4.txt", np.full((4, 4), -np.inf)),
    "replica": lambda src: rewrite(src / "traj.txt", 4, " ".join(["nan"] * 16)),
    "arkitscenes": lambda src: rewrite(src / "lowres_wide.traj", 4, None),
    "stray": lambda src: rewrite(src / "odometry.csv", 5, "5.1, 4" + ", nan" * 7),
}


def rewrite(path, number, text):
    """Replace a line of a file, or remove it."""
    lines = path.read_text().splitlines()
    lines[number : number + 1] = [] if text is None else [text]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("name", LOST)
def test_a_frame_with_a_lost_pose_is_left_out_and_named(tmp_path, name):
    src, walk = written(tmp_path, name)
    LOST[name](src)
    (episode,), lines = imported(src, tmp_path / "out", name)
    assert "1 frame left out because the pose is lost; first: " in lines
    assert episode.info["left_out"] == [4]
    np.testing.assert_allclose(episode.world_from_camera, np.delete(walk.pose, 4, 0), atol=1e-4)


@pytest.mark.parametrize(("rows", "lost"), [([5], [4]), (range(8, 13), [*range(7, 12)])])
def test_frames_without_a_line_of_odometry_are_lost(tmp_path, rows, lost):
    src, walk = written(tmp_path, "stray")
    for row in sorted(rows, reverse=True):
        rewrite(src / "odometry.csv", row, None)
    (episode,), lines = imported(src, tmp_path / "out", "stray")
    assert f"{len(lost)} frame" in lines
    assert "left out because the pose is lost" in lines
    assert episode.info["left_out"] == lost
    expected = np.delete(walk.pose, lost, 0)
    np.testing.assert_allclose(episode.world_from_camera, expected, atol=1e-4)


def test_a_folder_of_several_scans_is_one_import(tmp_path):
    walk = layouts.hand_held(6, **WALKS["7scenes"])
    for name in ("seq-02", "seq-01"):
        layouts.seven_scenes(tmp_path / "chess", walk, name)
    source, lines = imported(tmp_path / "chess", tmp_path / "out")
    assert [episode.name for episode in source] == ["chess/seq-01", "chess/seq-02"]
    assert "2 episodes, 12 frames" in lines
    only, _ = imported(tmp_path / "chess" / "seq-02", tmp_path / "one")
    assert [episode.name for episode in only] == ["seq-02"]


def test_a_depth_image_of_another_size_is_a_bad_frame(tmp_path):
    src, _ = written(tmp_path, "7scenes")
    shrink("*.depth.png", 5)(src)
    with pytest.raises(UserError, match=r"color\.png \(depth\) has 8×8 pixels"):
        imported(src, tmp_path / "out", "7scenes")
    (episode,), _ = imported(src, tmp_path / "out", "7scenes", skip_bad=1)
    assert episode.info["left_out"] == [5]


def test_a_format_of_a_plugin_is_one_class(tmp_path):
    from pewm_jax.data.formats.seven_scenes import SevenScenes
    from pewm_jax.registry import _KINDS, register

    class Mine(SevenScenes):
        NAME = "mine"

    import dataclasses

    register("format", "mine", dataclasses.dataclass(frozen=True)(Mine))
    try:
        src, _ = written(tmp_path, "7scenes")
        (episode,), _ = imported(src, tmp_path / "out", "mine")
        assert episode.info["format"] == "mine"
    finally:
        del _KINDS["format", "mine"]
