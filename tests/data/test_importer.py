"""Importing: a recording whose world is known arrives with its geometry intact, or not at all."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.import_frames import _metres, _to_store
from pewm_jax.data.importer import (
    ImportConfig,
    import_recording,
    planar_actions,
    world_from_recording,
)
from pewm_jax.data.recordings import natural_key, read_recording
from pewm_jax.geometry.cameras import unproject
from tests.data.two_rooms import HIGH, LOW, arrays, split

SIZE = 48
FOCAL = SIZE / 2  # 90 degrees
INTRINSICS = (FOCAL, FOCAL, SIZE / 2 - 0.5, SIZE / 2 - 0.5)


@pytest.fixture(scope="module")
def walk():
    return arrays(frames=24, size=SIZE, policy="walk", seed=2, turn_around=1.0)


def record(folder, made, *, style="open3d", up="-y", scale=1000.0, dtype=np.uint16):
    """Write a recording as others do: its world has another axis up."""
    colour, depth = (folder / "image", folder / "depth")
    colour.mkdir(parents=True)
    depth.mkdir()
    poses = np.linalg.inv(world_from_recording(up)) @ made.world_from_camera
    for k in range(len(poses)):
        cv2.imwrite(str(colour / f"{k:05d}.png"), made.rgb_THWC[k][..., ::-1])
        name = depth / f"{k:05d}.{'png' if dtype == np.uint16 else 'tiff'}"
        cv2.imwrite(str(name), np.rint(made.depth_THW[k] * scale).astype(dtype))
    if style == "open3d":
        lines = []
        for k, pose in enumerate(poses):
            rows = [" ".join(f"{x:.8f}" for x in row) for row in pose]
            lines += [f"{k} {k} {k + 1}", *rows]
        (folder / "trajectory.log").write_text("\n".join(lines) + "\n")
    else:
        stamps = 100 + np.arange(len(poses)) / 30
        (folder / "rgb.txt").write_text(
            "# comment\n" + "".join(f"{t:.4f} image/{k:05d}.png\n" for k, t in enumerate(stamps))
        )
        (folder / "depth.txt").write_text(
            "".join(f"{t + 0.004:.4f} depth/{k:05d}.png\n" for k, t in enumerate(stamps))
        )
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        rows = np.concatenate([stamps[:, None] - 0.003, poses[:, :3, 3], quaternions], 1)
        np.savetxt(folder / "groundtruth.txt", rows, fmt="%.6f", header="t x y z qx qy qz qw")
    return folder


def config(src, out, **options):
    return ImportConfig(src, out, **{"intrinsics": INTRINSICS, **options})


def imported(out, split_="train"):
    return EpisodeSource(out / split_)[0]


@pytest.mark.parametrize("style", ["open3d", "tum"])
@pytest.mark.parametrize("up", ["-y", "z", "x"])
def test_the_world_arrives_upright_and_exact(tmp_path, walk, style, up):
    record(tmp_path / "rec", walk, style=style, up=up)
    import_recording(config(tmp_path / "rec", tmp_path / "out", up=up), lambda _: None)
    episode = imported(tmp_path / "out")
    np.testing.assert_allclose(episode.world_from_camera, walk.world_from_camera, atol=2e-5)
    np.testing.assert_array_equal(episode.intrinsics_4, walk.intrinsics_4)
    frames = episode.frames()
    np.testing.assert_array_equal(frames.rgb_THWC, walk.rgb_THWC)
    np.testing.assert_allclose(frames.depth_THW, walk.depth_THW, atol=6e-4)
    np.testing.assert_allclose(episode.actions, walk.actions, atol=1e-4)
    assert episode.action_ids is None


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_up_axis_becomes_z_by_a_rotation(up):
    turn = world_from_recording(up)[:3, :3]
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    np.testing.assert_array_equal(turn @ axis, [0, 0, 1])
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) > 0


def test_resizing_keeps_the_geometry_and_never_blends_depth(tmp_path, walk):
    record(tmp_path / "rec", walk)
    small = config(tmp_path / "rec", tmp_path / "out", size=(24, 16), stride=2)
    import_recording(small, lambda _: None)
    episode = imported(tmp_path / "out")
    assert (episode.length, episode.height, episode.width) == (12, 16, 24)
    np.testing.assert_allclose(episode.intrinsics_4, [12, 12, 12, 8])  # 48 × 32 of 48 × 48
    frames = episode.frames()
    recorded = np.rint(walk.depth_THW[::2] * 1000) / 1000
    for k in range(12):
        assert np.isin(np.rint(frames.depth_THW[k] * 1000), np.rint(recorded[k] * 1000)).all()
    points = np.asarray(unproject(frames.depth_THW, frames.camera))
    off = np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(-1)
    # A picked pixel lies up to half of its size from the new pixel's centre.
    assert np.median(off) < 0.05


def test_other_depth_scales_and_float_images(tmp_path, walk):
    record(tmp_path / "five", walk, scale=5000.0)
    import_recording(config(tmp_path / "five", tmp_path / "a", depth_scale=5000.0), lambda _: None)
    record(tmp_path / "metres", walk, scale=1.0, dtype=np.float32)
    for path in (tmp_path / "metres" / "depth").iterdir():
        cv2.imwrite(str(path), walk.depth_THW[int(path.stem)])
    import_recording(config(tmp_path / "metres", tmp_path / "b", depth_scale=1.0), lambda _: None)
    for out in ("a", "b"):
        seen = imported(tmp_path / out).frames().depth_THW
        np.testing.assert_allclose(seen, walk.depth_THW, atol=6e-4)


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 1.0])
def test_a_saturated_pixel_is_no_measurement_at_any_scale(scale):
    image = np.full((SIZE, SIZE), round(2 * scale), np.uint16)
    image[:9], image[9:12] = 65535, 65534
    stored, per_metre = _to_store(image, scale, 65534 / scale)
    for depth in (_metres(image, scale), stored / per_metre):
        assert not depth[:9].any()
        np.testing.assert_allclose(depth[9:12], 65534 / scale)
        np.testing.assert_allclose(depth[12:], 2)


@pytest.mark.parametrize("scale", [1000.0, 5000.0])
def test_saturated_and_far_depths_arrive_as_no_measurement(tmp_path, walk, scale):
    folder = record(tmp_path / "rec", walk, scale=scale)
    for path in (folder / "depth").iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        image[:6] = 65535
        cv2.imwrite(str(path), image)
    options = {"depth_scale": scale}
    import_recording(config(folder, tmp_path / "a", **options), lambda _: None)
    seen = imported(tmp_path / "a").frames().depth_THW
    assert not seen[:, :6].any()
    np.testing.assert_allclose(seen[:, 6:], walk.depth_THW[:, 6:], atol=6e-4)
    import_recording(config(folder, tmp_path / "b", max_depth=3.00005, **options), lambda _: None)
    near = imported(tmp_path / "b").frames().depth_THW
    np.testing.assert_array_equal(near, np.where(seen > 3.0, 0, seen))
    assert ((seen > 3.0).any(), near.max() <= 3.0) == (True, True)


def test_pixel_centres_at_half_stay(tmp_path, walk):
    record(tmp_path / "rec", walk)
    half = config(
        tmp_path / "rec",
        tmp_path / "out",
        intrinsics=(FOCAL, FOCAL, SIZE / 2, SIZE / 2),
        pixel_centres="half",
    )
    import_recording(half, lambda _: None)
    np.testing.assert_array_equal(imported(tmp_path / "out").intrinsics_4, walk.intrinsics_4)


def test_recordings_are_added_and_replaced_by_name(tmp_path, walk):
    record(tmp_path / "rec", walk)
    out = tmp_path / "out"
    for name in ("b", "a"):
        import_recording(config(tmp_path / "rec", out, name=name), lambda _: None)
    assert [episode.name for episode in EpisodeSource(out / "train")] == ["b", "a"]
    assert EpisodeSource(out / "train").manifest.frames == 48
    with pytest.raises(UserError, match="already has an episode named a"):
        import_recording(config(tmp_path / "rec", out, name="a"))
    import_recording(
        config(tmp_path / "rec", out, name="a", stride=2, overwrite=True), lambda _: None
    )
    assert [episode.length for episode in EpisodeSource(out / "train")] == [24, 12]
    listed = EpisodeSource(out / "train").manifest.settings["actions"]
    assert list(listed.values()) == [True, True]
    collected = split(tmp_path / "collected" / "train")
    before = (collected / "dataset.json").read_bytes()
    with pytest.raises(UserError, match="was made by `collect`"):
        import_recording(config(tmp_path / "rec", tmp_path / "collected"))
    assert (collected / "dataset.json").read_bytes() == before


@pytest.mark.parametrize("overwrite", [False, True])
def test_an_import_that_was_killed_can_be_repeated(tmp_path, walk, monkeypatch, overwrite):
    record(tmp_path / "rec", walk)
    out = tmp_path / "out"
    again = config(tmp_path / "rec", out, name="a", stride=2, overwrite=overwrite)
    if overwrite:
        for name in ("a", "b"):
            import_recording(config(tmp_path / "rec", out, name=name), lambda _: None)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pewm_jax.data.dataset.write_manifest", killed)
        with pytest.raises(KeyboardInterrupt):
            import_recording(again, lambda _: None)
    if overwrite:  # as it is where the new shard has another size than the old one
        shard = out / "train" / "recording-a.array_record"
        shard.write_bytes(shard.read_bytes() + bytes(64))
    with pytest.raises(UserError):
        EpisodeSource(out / "train")
    import_recording(again, lambda _: None)
    lengths = [24, 12] if overwrite else [12]
    assert [episode.length for episode in EpisodeSource(out / "train")] == lengths
    if overwrite:  # what is kept must still be whole
        kept = out / "train" / "recording-b.array_record"
        kept.write_bytes(kept.read_bytes()[:-1])
        with pytest.raises(UserError, match=r"recording-b.*truncated"):
            import_recording(again, lambda _: None)


def test_the_shard_of_another_import_that_was_killed_is_taken_over(tmp_path, walk):
    record(tmp_path / "rec", walk)
    train = tmp_path / "out" / "train"
    import_recording(config(tmp_path / "rec", tmp_path / "out", name="a"), lambda _: None)
    (train / "dataset.json").unlink()
    import_recording(config(tmp_path / "rec", tmp_path / "out", name="b"), lambda _: None)
    assert [episode.name for episode in EpisodeSource(train)] == ["a", "b"]
    assert EpisodeSource(train).manifest.frames == 48
    (train / "dataset.json").rename(train / "collecting.json")
    with pytest.raises(UserError, match="unfinished collection"):
        import_recording(config(tmp_path / "rec", tmp_path / "out", name="b"), lambda _: None)


def test_a_frame_in_another_unit_is_named_by_its_file(tmp_path, walk):
    folder = record(tmp_path / "rec", walk)
    path = folder / "depth" / "00015.png"
    cv2.imwrite(str(path), np.full((SIZE, SIZE), 5, np.uint16))
    says = rf"depth.00015\.png \(counted with --stride 5\), frame 3, depth: .*{5e-3} m: the unit"
    with pytest.raises(UserError, match=says):
        import_recording(config(folder, tmp_path / "out", stride=5), lambda _: None)


def test_an_import_holds_no_more_than_its_encoded_images(tmp_path, walk):
    folder = record(tmp_path / "rec", walk)
    for name in ("image", "depth"):  # many frames of one picture
        code = (folder / name / "00000.png").read_bytes()
        for k in range(400):
            (folder / name / f"{k:05d}.png").write_bytes(code)
    pose = "\n".join(" ".join(f"{x:.8f}" for x in row) for row in walk.world_from_camera[0])
    (folder / "trajectory.log").write_text("".join(f"0 0 0\n{pose}\n" for _ in range(400)))
    big = config(folder, tmp_path / "out", up="z", size=(256, 256))
    import_recording(config(folder, tmp_path / "first", up="z", stride=100), lambda _: None)
    tracemalloc.start()
    try:
        import_recording(big, lambda _: None)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    (file,) = (tmp_path / "out" / "train").glob("*.array_record")
    assert imported(tmp_path / "out").length == 400
    checked = 400 * 128 * 128 * 4  # every second depth, in metres
    assert peak < 3 * file.stat().st_size + 3 * checked


def test_a_hand_held_camera_has_poses_and_no_actions(walk):
    assert planar_actions(walk.world_from_camera) is not None
    for change in (Rotation.from_euler("x", 3, degrees=True).as_matrix(), None):
        pose = np.array(walk.world_from_camera)
        if change is None:
            pose[::2, 2, 3] += 0.05
        else:
            pose[::2, :3, :3] @= change
        assert planar_actions(pose) is None


def keep(_):
    """Leave the recording as it is."""


def lose(name):
    return lambda folder: (folder / name).unlink()


def edit(name, old, new):
    def change(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


WRONG = {
    "an image is missing": (lose("image/00003.png"), {}, "23 colour images, 24 depth"),
    "a pose is missing": (
        lambda f: (f / "trajectory.log").write_text(
            "\n".join((f / "trajectory.log").read_text().splitlines()[:-5])
        ),
        {},
        "23 poses",
    ),
    "a line is missing": (
        lambda f: (f / "trajectory.log").write_text(
            "\n".join((f / "trajectory.log").read_text().splitlines()[:-1])
        ),
        {},
        "119 lines",
    ),
    "no number": (edit("trajectory.log", "1.00000000", "one"), {}, "expected 4 numbers"),
    "NaN": (edit("trajectory.log", "1.00000000", "nan"), {}, "frame 0, world_from_camera"),
    "no rotation": (edit("trajectory.log", "1.00000000", "2.0"), {}, "world_from_camera"),
    "no trajectory": (lose("trajectory.log"), {}, "needs one trajectory"),
    "another trajectory": (keep, {"trajectory": Path("nowhere.txt")}, "nowhere.txt exists neither"),
    "a broken image": (
        lambda f: (f / "depth" / "00004.png").write_bytes(b"no image"),
        {},
        r"00004\.png does not decode",
    ),
    "an empty image": (
        lambda f: (f / "image" / "00004.png").write_bytes(b""),
        {},
        r"00004\.png does not decode as an image; it is empty",
    ),
    "a smaller image": (
        lambda f: cv2.imwrite(str(f / "depth" / "00004.png"), np.ones((8, 8), np.uint16)),
        {},
        r"00004\.png has 8×8 pixels",
    ),
    "a colourful depth": (
        lambda f: cv2.imwrite(str(f / "depth" / "00004.png"), np.ones((SIZE, SIZE, 3), np.uint8)),
        {},
        "3 channels",
    ),
    "metres as millimetres": (keep, {"depth_scale": 1e6}, "unit is wrong"),
    "millimetres as metres": (keep, {"depth_scale": 1.0}, "unit is wrong"),
    "a wrong scale": (keep, {"depth_scale": 500.0}, "disagrees with the poses"),
    "wrong intrinsics": (
        keep,
        {"intrinsics": (1.4 * FOCAL, 1.4 * FOCAL, SIZE / 2, SIZE / 2)},
        "disagrees with the poses",
    ),
    "intrinsics of a larger image": (
        keep,
        {"intrinsics": (525.0, 525.0, 319.5, 239.5)},
        "another image size",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_refused_and_leaves_nothing(tmp_path, walk, name):
    damage, options, says = WRONG[name]
    damage(record(tmp_path / "rec", walk))
    with pytest.raises(UserError, match=says):
        import_recording(config(tmp_path / "rec", tmp_path / "out", **options), lambda _: None)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lose("rgb.txt"), r"rgb\.txt does not exist"),
        (lose("image/00002.png"), r"00002\.png does not exist"),
        (edit("rgb.txt", "100.0000 image", "late image"), "line 2: expected 1 numbers"),
        (
            lambda f: np.savetxt(f / "groundtruth.txt", np.ones((3, 7))),
            "within 0.02 s",
        ),
        (
            lambda f: np.savetxt(f / "groundtruth.txt", np.full((1, 8), 100.0)),
            "quaternion has length",
        ),
    ],
)
def test_a_wrong_tum_recording_is_refused(tmp_path, walk, damage, says):
    damage(record(tmp_path / "rec", walk, style="tum"))
    with pytest.raises(UserError, match=says):
        import_recording(config(tmp_path / "rec", tmp_path / "out"), lambda _: None)


def test_tum_frames_without_a_partner_are_left_out(tmp_path, walk):
    folder = record(tmp_path / "rec", walk, style="tum")
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[:5] + lines[6:]))
    names = [frame.colour.stem for frame in read_recording(folder)]
    assert names == [f"{k:05d}" for k in range(24) if k != 5]


def test_a_lost_pose_of_tum_is_left_out(tmp_path, walk):
    folder, lines = record(tmp_path / "rec", walk, style="tum"), []
    text = (folder / "groundtruth.txt").read_text().splitlines()
    text[6] = " ".join([text[6].split()[0], *["-inf"] * 7])
    (folder / "groundtruth.txt").write_text("\n".join(text))
    import_recording(config(folder, tmp_path / "out"), lines.append)
    assert imported(tmp_path / "out").info["left_out"] == [5]
    assert "1 frame left out because the pose is lost" in lines[0]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"stride": 0}, "stride"),
        ({"depth_scale": 0.0}, "depth-scale"),
        ({"max_depth": 0.0}, "max-depth"),
        ({"max_depth": 65.535}, "max-depth.*65.534"),
        ({"size": (0, 4)}, "size"),
        ({"intrinsics": (0.0, 1, 1, 1)}, "fx and fy"),
        ({"split": "../up"}, "split"),
        ({"name": ".hidden"}, "name"),
    ],
)
def test_settings_that_cannot_work_are_refused(tmp_path, options, says):
    with pytest.raises(ConfigError, match=says):
        config(tmp_path, tmp_path, **options)


def renamed(folder, colour, depth):
    """Rename the images of a recording, k-th by k-th."""
    for name, new in (("image", colour), ("depth", depth)):
        for k, path in enumerate(sorted((folder / name).iterdir())):
            path.rename(path.with_name(f"{new(k)}.new{path.suffix}"))
        for path in (folder / name).iterdir():
            path.rename(path.with_name(path.name.replace(".new", "")))


def test_images_are_taken_in_natural_order(tmp_path, walk):
    """1.png … 24.png: as text, 10 comes before 2."""
    record(tmp_path / "rec", walk)
    renamed(tmp_path / "rec", lambda k: f"{k + 1}", lambda k: f"frame{k + 1}.depth")
    import_recording(config(tmp_path / "rec", tmp_path / "out"), lambda _: None)
    np.testing.assert_array_equal(imported(tmp_path / "out").frames().rgb_THWC, walk.rgb_THWC)


@given(
    numbers=st.sets(st.integers(0, 10**6), min_size=1, max_size=30),
    before=st.sampled_from(["", "rgb", "frame-", "cam0_"]),
    after=st.sampled_from(["", "_colour", ".color"]),
)
def test_the_natural_order_is_that_of_the_numbers(numbers, before, after):
    files = [Path(f"{before}{number}{after}.png") for number in numbers]
    expected = [Path(f"{before}{number}{after}.png") for number in sorted(numbers)]
    assert sorted(files, key=natural_key) == expected


@pytest.mark.parametrize(
    ("colour", "depth", "fits"),
    [
        (lambda k: k + 1, lambda k: k + 1, True),
        (lambda k: k + 1, lambda k: k, True),  # counted from 1 and from 0
        (lambda k: f"{k:04}-{k * 33366}", lambda k: f"{k:04}-{k * 33371 + 7}", True),  # time stamps
        (lambda k: k + 1, lambda k: k + 1 + (k > 20), False),  # frame 22 has no depth
        (lambda k: k + (k > 3), lambda k: k, False),
        (lambda k: f"a{chr(97 + k)}", lambda k: f"b{chr(97 + k)}", True),
    ],
)
def test_colour_and_depth_of_different_numbers_are_refused(tmp_path, walk, colour, depth, fits):
    record(tmp_path / "rec", walk)
    renamed(tmp_path / "rec", colour, depth)
    if fits:
        assert len(read_recording(tmp_path / "rec")) == 24
        return
    with pytest.raises(UserError, match=r"rec has a .* image \d+ and no .* image \d+: give"):
        read_recording(tmp_path / "rec")
