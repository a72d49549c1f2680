"""Episodes in the formats of other tools, read back by the formats' own rules."""

import json
import struct

import av
import numpy as np
import pytest
import trimesh

from pewm_jax.cli import main as program
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.exports import lerobot, rlds
from tests.data import two_rooms

FRAMES, SIZE = 7, 20


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two splits; depths of one frame are missing or beyond what the formats hold."""
    folder = tmp_path_factory.mktemp("data") / "rooms"
    two_rooms.split(folder / "train", 3, frames=FRAMES, size=SIZE, info={"task": "walk"})
    two_rooms.split(folder / "revisit", 1, 1, frames=FRAMES, size=SIZE)
    return folder


def episodes(data):
    return [episode for split in ("revisit", "train") for episode in EpisodeSource(data / split)]


def run(*argv):
    return program.main(["data", "export", *map(str, argv)])


def decoded(path, form):
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format=form) for frame in container.decode(video=0)])


def psnr(one, other):
    return -10 * np.log10((((one.astype(float) - other) / 255) ** 2).mean())


@pytest.fixture(scope="module")
def robot(data, tmp_path_factory):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    folder = tmp_path_factory.mktemp("lerobot") / "set"
    assert run("lerobot", data, folder, "--fps", 5) == 0
    return folder


def test_lerobot_gives_back_the_same_arrays(data, robot):
    from pyarrow import parquet

    rows = parquet.read_table(robot / "data/chunk-000/file-000.parquet").to_pydict()
    places = parquet.read_table(robot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    rgb = decoded(robot / f"videos/{lerobot.RGB}/chunk-000/file-000.mp4", "rgb24")
    codes = decoded(robot / f"videos/{lerobot.DEPTH}/chunk-000/file-000.mp4", "gray12le")
    assert len(places) == 4
    for place, episode in zip(places, episodes(data), strict=True):
        at = slice(place["dataset_from_index"], place["dataset_to_index"])
        assert round(place[f"videos/{lerobot.RGB}/from_timestamp"] * 5) == at.start
        true = episode.frames()
        pose = np.array(rows[lerobot.POSE][at], np.float32).reshape(-1, 4, 4)
        np.testing.assert_array_equal(pose, episode.world_from_camera)
        np.testing.assert_array_equal(
            np.array(rows[lerobot.INTRINSICS][at], np.float32),
            np.tile(episode.intrinsics_4, (FRAMES, 1)),
        )
        np.testing.assert_array_equal(
            np.array(rows["action"][at], np.float32)[:-1], episode.actions
        )
        assert rows["action_id"][at][:-1] == episode.action_ids.tolist()
        assert rows["next.done"][at] == [False] * (FRAMES - 1) + [True]
        np.testing.assert_allclose(rows["timestamp"][at], np.arange(FRAMES) / 5, rtol=1e-6)
        assert psnr(rgb[at], true.rgb_THWC) > 30
        np.testing.assert_array_equal(codes[at], lerobot.depth_codes(true.depth_THW))


def test_lerobots_depth_is_exact_to_its_quantization():
    depth = np.random.default_rng(0).uniform(0.01, 10, 10_000).astype(np.float32)
    again = lerobot.depth_of_codes(lerobot.depth_codes(depth))
    step = (depth + lerobot.SHIFT_M) * np.log(13.5 / 3.51) / lerobot.CODES
    assert (np.abs(again - depth) < 0.51 * step + 1e-5).all()
    assert lerobot.depth_codes(np.array([0.0, 0.01, 10.0, 40.0])).tolist() == [0, 0, 4095, 4095]


def test_lerobots_tables_describe_the_files(robot, data):
    from pyarrow import parquet

    info = json.loads((robot / "meta/info.json").read_text())
    stats = json.loads((robot / "meta/stats.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 5)
    assert info["splits"] == {"revisit": "0:1", "train": "1:4"}
    assert (info["total_episodes"], info["total_frames"]) == (4, 4 * FRAMES)
    assert info["features"][lerobot.DEPTH]["info"]["is_depth_map"]
    rows = parquet.read_table(robot / "data/chunk-000/file-000.parquet")
    videos = {lerobot.RGB, lerobot.DEPTH}
    assert set(rows.column_names) == info["features"].keys() - videos
    assert stats.keys() == info["features"].keys()
    action = np.array(rows["action"].to_pylist())
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(0), atol=1e-6)
    np.testing.assert_allclose(stats["action"]["std"], action.std(0), atol=1e-6)
    assert stats["action"]["count"] == [4 * FRAMES]
    images = np.concatenate([e.frames().rgb_THWC for e in episodes(data)]) / 255
    np.testing.assert_allclose(
        np.array(stats[lerobot.RGB]["mean"])[:, 0, 0], images.mean((0, 1, 2)), atol=1e-6
    )
    tasks = parquet.read_table(robot / "meta/tasks.parquet").to_pydict()
    assert set(tasks["task"]) == {"", "walk"}


def test_the_package_lerobot_reads_it(robot, data):
    module = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="lerobot is not installed"
    )
    found = module.LeRobotDataset("someone/rooms", root=robot, video_backend="pyav")
    assert len(found) == 4 * FRAMES
    first = episodes(data)[0].frames([3])
    rgb = found[3][lerobot.RGB].numpy().transpose(1, 2, 0) * 255
    assert psnr(rgb, first.rgb_THWC[0]) > 30


def records(path):
    """Read a TFRecord file, and check its checksums."""
    from tensorboardX.record_writer import masked_crc32c

    content, at = path.read_bytes(), 0
    while at < len(content):
        (size,) = struct.unpack_from("<Q", content, at)
        assert masked_crc32c(content[at : at + 8]) == struct.unpack_from("<I", content, at + 8)[0]
        record = content[at + 12 : at + 12 + size]
        assert masked_crc32c(record) == struct.unpack_from("<I", content, at + 12 + size)[0]
        yield record
        at += size + 16


def message_types():
    """Return the class of ``tf.train.Example``, built from its published definition."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="e.proto", package="t", syntax="proto3")
    field = descriptor_pb2.FieldDescriptorProto

    def message(name, *fields):
        one = file.message_type.add(name=name)
        for number, (label, kind, title, of) in enumerate(fields, 1):
            one.field.add(name=title, number=number, label=label, type=kind, type_name=of)
        return one

    many, single = field.LABEL_REPEATED, field.LABEL_OPTIONAL
    message("BytesList", (many, field.TYPE_BYTES, "value", None))
    message("FloatList", (many, field.TYPE_FLOAT, "value", None))
    message("Int64List", (many, field.TYPE_INT64, "value", None))
    lists = (("bytes_list", ".t.BytesList"), ("float_list", ".t.FloatList"))
    lists = (*lists, ("int64_list", ".t.Int64List"))
    message("Feature", *((single, field.TYPE_MESSAGE, name, of) for name, of in lists))
    features = message("Features", (many, field.TYPE_MESSAGE, "feature", ".t.Features.Entry"))
    entry = features.nested_type.add(name="Entry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, label=single, type=field.TYPE_STRING)
    entry.field.add(
        name="value", number=2, label=single, type=field.TYPE_MESSAGE, type_name=".t.Feature"
    )
    message("Example", (single, field.TYPE_MESSAGE, "features", ".t.Features"))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Example"))


def test_rlds_gives_back_the_same_arrays(data, tmp_path):
    import cv2

    assert run("rlds", data, tmp_path / "set") == 0
    folder = tmp_path / "set/rooms/1.0.0"
    info = json.loads((folder / "dataset_info.json").read_text())
    splits = {split["name"]: split["shardLengths"] for split in info["splits"]}
    assert splits == {"revisit": ["1"], "train": ["3"]}
    features = json.loads((folder / "features.json").read_text())
    steps = features["featuresDict"]["features"]["steps"]["sequence"]["feature"]
    names = steps["featuresDict"]["features"].keys()
    assert {"is_first", "is_last", "is_terminal", "observation", "action", "reward"} <= names
    read = message_types()
    found = [
        read.FromString(record)
        for split in ("revisit", "train")
        for record in records(folder / f"rooms-{split}.tfrecord-00000-of-00001")
    ]
    for example, episode in zip(found, episodes(data), strict=True):
        own = dict(example.features.feature.items())
        assert own["episode_metadata/name"].bytes_list.value[0].decode() == episode.name
        true = episode.frames()
        for k, code in enumerate(own["steps/observation/image"].bytes_list.value):
            image = cv2.imdecode(np.frombuffer(code, np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(image[..., ::-1], true.rgb_THWC[k])
        for k, code in enumerate(own["steps/observation/depth"].bytes_list.value):
            image = cv2.imdecode(np.frombuffer(code, np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_allclose(image / 1000, true.depth_THW[k], atol=1e-6)
        poses = own["steps/observation/world_from_camera"].float_list.value
        poses = np.array(poses, np.float32).reshape(-1, 4, 4)
        np.testing.assert_array_equal(poses, episode.world_from_camera)
        actions = np.array(own["steps/action"].float_list.value, np.float32).reshape(FRAMES, -1)
        np.testing.assert_array_equal(actions[:-1], episode.actions)
        assert own["steps/action_id"].int64_list.value[-1] == -1
        assert own["steps/is_last"].int64_list.value == [0] * (FRAMES - 1) + [1]


@pytest.mark.parametrize("value", [0, 1, 127, 128, 300, 2**31, -1, -(2**40)])
def test_whole_numbers_are_written_as_protocol_buffers_are(value):
    record = rlds.example({"a": np.array([value])})
    assert message_types().FromString(record).features.feature["a"].int64_list.value == [value]


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_points_lie_on_the_walls(data, tmp_path, suffix):
    path = tmp_path / f"map.{suffix}"
    assert run(suffix, data / "train", path, "--point_m", 0.05) == 0
    cloud = trimesh.load(path, file_type=suffix)
    points = cloud.vertices if suffix == "ply" else next(iter(cloud.geometry.values())).vertices
    if suffix == "glb":  # y is up
        points = points[:, [0, 2, 1]] * [1, -1, 1]
    true = EpisodeSource(data / "train")[0]
    height = true.world_from_camera[0, 2, 3]
    assert len(points) > 50
    assert points[:, 2].min() > -0.1 < height
    ours = trimesh.load(path, file_type=suffix)
    assert ours is not None


def test_points_are_averaged_in_cubes():
    from pewm_jax.data.exports.points import Fusion

    cloud = Fusion(1.0)
    cloud.add(np.array([[0.2, 0.2, 0.2]]), np.array([[10, 20, 30]]))
    cloud.add(np.array([[0.4, 0.4, 0.4], [-0.5, 0, 0]]), np.array([[30, 40, 50], [1, 2, 3]]))
    points, colours = cloud.result()
    np.testing.assert_allclose(points, [[-0.5, 0, 0], [0.3, 0.3, 0.3]], atol=1e-6)
    assert colours.tolist() == [[1, 2, 3], [20, 30, 40]]


def test_a_video_holds_the_colours(data, tmp_path):
    assert run("mp4", data / "train", tmp_path / "videos") == 0
    files = sorted((tmp_path / "videos").iterdir())
    assert [file.name for file in files] == [f"train-{k:06d}.mp4" for k in range(3)]
    true = EpisodeSource(data / "train")[1].frames()
    assert psnr(decoded(files[1], "rgb24"), true.rgb_THWC) > 30


def test_rerun_holds_frames_path_and_points(data, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    path = tmp_path / "episode.rrd"
    assert run("rerun", data, path, "--episodes", 2) == 0
    content = path.read_bytes()
    assert content.startswith(b"RRF")
    for entity in ("/world/true/camera/rgb", "/world/true/camera/depth", "/world/map"):
        assert entity.encode() in content
    assert not list(tmp_path.glob("*.partial*"))


def test_what_cannot_be_written_is_one_sentence(data, tmp_path, capsys):
    (tmp_path / "old").mkdir()
    small = two_rooms.split(tmp_path / "small", 1, 1, frames=3, size=8)
    other = two_rooms.split(tmp_path / "mixed/train", 1, 1, frames=3, size=24)
    two_rooms.split(tmp_path / "mixed/valid", 1, 1, frames=3, size=32)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.json").write_text("{}")
    for argv, said in (
        (["mp4", data, tmp_path / "old"], "exists already"),
        (["mp4", data, tmp_path / "new", "--episodes", 9], "--episodes has 9"),
        (["mp4", tmp_path / "run", tmp_path / "new"], "is a run; `pewm-jax show"),
        (["mp4", tmp_path / "absent", tmp_path / "new"], "absent does not exist"),
        (["lerobot", small, tmp_path / "new"], "at least 16×16"),
        (["lerobot", tmp_path / "mixed", tmp_path / "new"], "differs from"),
        (["rlds", other, tmp_path / "new", "--name", "A b"], "use small letters"),
    ):
        assert run(*argv) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
        assert not (tmp_path / "new").exists()
