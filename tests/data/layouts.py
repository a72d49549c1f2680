"""The published layouts, written by code of their own from a world whose geometry is known."""

from __future__ import annotations

import dataclasses
import gzip
import json
import pickle

import av
import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tests.data.two_rooms import HIGH, LOW, box_views

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From our world, z up, to one with y up."""
Y_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclasses.dataclass
class Walk:
    """What a hand-held camera sees in a box: exact colours and depth, poses in a z-up world."""

    rgb: np.ndarray
    depth: np.ndarray
    pose: np.ndarray
    focal: np.ndarray

    @property
    def size(self):
        return self.depth.shape[2], self.depth.shape[1]


def hand_held(frames=12, width=64, height=48, focal=None, turns=0):
    """A camera that moves, turns, nods and rolls; its images are turned clockwise by quarters."""
    t = np.linspace(0, 1, frames)
    pose = np.tile(np.eye(4), (frames, 1, 1))
    level = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x right, y down, z forward along x
    yaw, nod, roll = 0.4 + 1.2 * t, 0.15 * np.sin(5 * t), 0.1 * np.cos(4 * t) - turns * np.pi / 2
    for k in range(frames):
        heading = Rotation.from_euler("z", yaw[k]).as_matrix() @ level
        tilt = Rotation.from_euler("x", nod[k]) * Rotation.from_euler("z", roll[k])
        pose[k, :3, :3] = heading @ tilt.as_matrix()
    pose[:, :3, 3] = np.stack([2 + 1.4 * t, 1.5 + 0.8 * t, 1.2 + 0.1 * np.sin(6 * t)], -1)
    f = np.array([0.9 * width, 0.92 * width, width / 2 + 0.7, height / 2 - 0.4])
    f = f if focal is None else np.asarray(focal, float)
    rgb, depth = box_views(pose, f, height, width)
    return Walk(rgb, depth, pose, f)


def image(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    fine = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), rgb[..., ::-1], fine)


def depth_image(path, metres, scale):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.rint(metres * scale).astype(np.uint16))


def matrix(path, pose):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join("\t".join(f"{x:.9e}" for x in row) for row in pose) + "\n")


def seven_scenes(folder, walk, name="seq-01", convert=lambda pose: pose):
    """Depth and poses are those of another camera, 22 mm left, with a longer focal length.

    ``convert`` changes the poses that are written.
    """
    aside = np.eye(4)
    aside[0, 3] = -0.022
    left = walk.pose @ aside
    zoomed = np.concatenate([np.asarray(walk.focal[:2]) * 585 / 525, walk.focal[2:]])
    _, depth = box_views(left, zoomed, *walk.depth.shape[1:])
    for k, pose in enumerate(Y_DOWN @ left):
        start = folder / name / f"frame-{k:06d}"
        image(start.with_suffix(".color.png"), walk.rgb[k])
        depth_image(start.with_suffix(".depth.png"), depth[k], 1000)
        matrix(start.with_suffix(".pose.txt"), convert(pose))
    return folder


def replica(folder, walk, camera=None):
    lines = []
    for k, pose in enumerate(walk.pose):
        image(folder / "results" / f"frame{k:06d}.jpg", walk.rgb[k])
        depth_image(folder / "results" / f"depth{k:06d}.png", walk.depth[k], 6553.5)
        lines.append(" ".join(f"{x:.18e}" for x in pose.ravel()))
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    if camera:
        (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def scannet(folder, walk, small=2):
    """Depth images are smaller than the colours, with their own intrinsics."""
    tiny = walk.focal / small
    _, depth = box_views(walk.pose, tiny, walk.size[1] // small, walk.size[0] // small)
    for k, pose in enumerate(walk.pose):
        image(folder / "color" / f"{k}.jpg", walk.rgb[k])
        depth_image(folder / "depth" / f"{k}.png", depth[k], 1000)
        matrix(folder / "pose" / f"{k}.txt", pose)
    for name, (fx, fy, cx, cy) in (("color", walk.focal), ("depth", tiny)):
        k = np.array([[fx, 0, cx - 0.5, 0], [0, fy, cy - 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        matrix(folder / "intrinsic" / f"intrinsic_{name}.txt", k)
    return folder


def arkitscenes(folder, walk, scan="40753679"):
    lines, (width, height) = [], walk.size
    for k, pose in enumerate(walk.pose):
        inverse, time = np.linalg.inv(pose), 6791.113 + 0.1 * k
        turn = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        lines.append(" ".join(f"{x:.10f}" for x in (time + 0.001, *turn, *inverse[:3, 3])))
        name = f"{scan}_{time:.3f}"
        image(folder / "lowres_wide" / f"{name}.png", walk.rgb[k])
        depth_image(folder / "lowres_depth" / f"{name}.png", walk.depth[k], 1000)
        cam = folder / "lowres_wide_intrinsics" / f"{name}.pincam"
        cam.parent.mkdir(exist_ok=True)
        cam.write_text(f"{width} {height} " + " ".join(f"{x:.8f}" for x in walk.focal))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return folder


def movie(path, frames, fps=10, depth=False, **options):
    """Write uint8 colours, or 12-bit codes, as a video without loss of frames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        quiet = {"x265-params": "log-level=none" + (":lossless=1" if depth else "")}
        made = {"crf": "4"} if not depth else {}
        kind = "hevc" if depth else "libx264"
        stream = container.add_stream(kind, rate=fps, options={**(quiet if depth else {}), **made})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "gray12le" if depth else "yuv420p"
        for one in frames:
            frame = av.VideoFrame.from_ndarray(one, format="gray12le" if depth else "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def stray(folder, walk, small=2):
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    _, depth = box_views(walk.pose, walk.focal / small, *(n // small for n in walk.size[::-1]))
    for k, pose in enumerate(Y_UP @ walk.pose):
        numbers = (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())
        lines.append(f"{5 + k / 60:.6f}, {k:06d}, " + ", ".join(f"{x:.9f}" for x in numbers))
        depth_image(folder / "depth" / f"{k:06d}.png", depth[k], 1000)
        trust = np.full(depth[k].shape, 2, np.uint8)
        trust[:2] = 0
        (folder / "confidence").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "confidence" / f"{k:06d}.png"), trust)
    movie(folder / "rgb.mp4", walk.rgb, 60)
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    fx, fy, cx, cy = walk.focal
    rows = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, r)) for r in rows))
    return folder


def nomad(folder, walk, name="traj_0"):
    """``walk`` is level; only its position and heading are written."""
    inside = folder / name
    for k in range(len(walk.pose)):
        image(inside / f"{k}.jpg", walk.rgb[k])
    yaw = np.arctan2(walk.pose[:, 1, 2], walk.pose[:, 0, 2])
    with (inside / "traj_data.pkl").open("wb") as file:
        pickle.dump({"position": walk.pose[:, :2, 3], "yaw": yaw}, file)
    return folder


def quantize(metres, low=0.01, high=10.0, shift=3.5):
    """LeRobot's codes of depth: 12 bits, even in the logarithm of depth plus a shift."""
    ends = np.log(low + shift), np.log(high + shift)
    share = (np.log(metres + shift) - ends[0]) / (ends[1] - ends[0])
    return np.clip(np.rint(share * 4095), 0, 4095).astype(np.uint16)


def dequantize(codes, low=0.01, high=10.0, shift=3.5):
    ends = np.log(low + shift), np.log(high + shift)
    return np.exp(codes / 4095 * (ends[1] - ends[0]) + ends[0]) - shift


def lerobot(folder, walks, *, depth=True, pose=True, fps=10, actions=None, states=None):
    """All episodes in one file of rows and one video per camera, as LeRobot writes small sets.

    ``actions`` (episodes, T, A) replace the two numbers episode and frame; ``states`` (episodes, T,
    S) are ``observation.state``.
    """
    import pyarrow as pa
    from pyarrow import parquet

    camera, deep = "observation.images.front", "observation.images.front_depth"
    height, width = walks[0].depth.shape[1:]
    video = {"video.fps": float(fps), "video.codec": "h264", "video.pix_fmt": "yuv420p"}
    features = {
        camera: {"dtype": "video", "shape": [height, width, 3], "info": video},
        "action": {"dtype": "float32", "shape": [2], "names": ["left", "right"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    if depth:
        about = {"is_depth_map": True, "video.depth_min": 0.01, "video.depth_max": 10.0}
        about |= {"video.shift": 3.5, "video.use_log": True, "video.pix_fmt": "gray12le"}
        features[deep] = {"dtype": "video", "shape": [height, width, 1], "info": about}
    given = {"action": actions, "observation.state": states}
    given = {name: values for name, values in given.items() if values is not None}
    for name, values in given.items():
        features[name] = {"dtype": "float32", "shape": [len(values[0][0])], "names": None}
    if pose:
        features["observation.camera_pose"] = {"dtype": "float32", "shape": [4, 4]}
        features["observation.intrinsics"] = {"dtype": "float32", "shape": [4]}
    rows, episodes, start = [], [], 0
    for e, walk in enumerate(walks):
        for k in range(len(walk.pose)):
            row = {"episode_index": e, "frame_index": k, "index": start + k, "task_index": 0}
            row |= {"timestamp": k / fps, "action": [float(e), float(k)]}
            row |= {name: [float(x) for x in values[e][k]] for name, values in given.items()}
            if pose:
                row["observation.camera_pose"] = walk.pose[k].tolist()
                row["observation.intrinsics"] = walk.focal.tolist()
            rows.append(row)
        one = {"episode_index": e, "length": len(walk.pose), "tasks": ["look around"]}
        one |= {"data/chunk_index": 0, "data/file_index": 0}
        for key in (camera, deep) if depth else (camera,):
            one |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0}
            one |= {f"videos/{key}/from_timestamp": start / fps}
            one |= {f"videos/{key}/to_timestamp": (start + len(walk.pose)) / fps}
        episodes.append(one)
        start += len(walk.pose)
    info = {"codebase_version": "v3.0", "fps": fps, "features": features}
    info |= {"total_episodes": len(walks), "total_frames": start}
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    for name in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / name).mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    file = "chunk-000/file-000.parquet"
    parquet.write_table(pa.Table.from_pylist(episodes), folder / "meta" / "episodes" / file)
    parquet.write_table(pa.Table.from_pylist(rows), folder / "data" / file)
    videos = folder / "videos"
    movie(videos / camera / "chunk-000/file-000.mp4", np.concatenate([w.rgb for w in walks]), fps)
    if depth:
        codes = quantize(np.concatenate([w.depth for w in walks]))
        movie(videos / deep / "chunk-000/file-000.mp4", codes, fps, depth=True)
    return folder


def habitat(folder, start, yaw, path=(), goal=None, category=""):
    """The box as a GLB with y up, and one episode; positions are given in our world.

    With a category the goal is that of object navigation: an object, seen from a view point.
    """
    box = trimesh.creation.box(bounds=[LOW, HIGH])
    box.invert()
    box.visual.vertex_colors = np.tile([90, 160, 200, 255], (len(box.vertices), 1))
    box.apply_transform(Y_UP)
    scene = folder / "hm3d/val/00800-TEEsavR23oF"
    scene.mkdir(parents=True)
    box.export(scene / "TEEsavR23oF.basis.glb")

    def up(point):
        return (Y_UP[:3, :3] @ np.asarray(point, float)).tolist()

    # The agent of Habitat looks along −z: a turn about y takes that to the heading.
    turn = Rotation.from_euler("y", yaw - np.pi / 2).as_quat().tolist()
    episode = {
        "episode_id": "7",
        "scene_id": "hm3d/val/00800-TEEsavR23oF/TEEsavR23oF.basis.glb",
        "start_position": up(start),
        "start_rotation": turn,
        "goals": [{"position": up(goal)}] if goal is not None else [],
    }
    table = {"episodes": [episode]}
    if category:
        view = {"agent_state": {"position": up(goal), "rotation": [0, 0, 0, 1]}, "iou": 0.2}
        on_table = {"object_id": 9, "position": up(np.add(goal, [0.3, 0, 0.8]))}
        other = {"object_id": 3, "position": up(start), "view_points": []}
        goals = [other, on_table | {"view_points": [view]}]
        table["goals_by_category"] = {f"TEEsavR23oF.basis.glb_{category}": goals}
        episode |= {"goals": [], "object_category": category}
        episode["info"] = {"closest_goal_object_id": 9}
    if len(path):
        episode["reference_path"] = [up(point) for point in path]
    content = folder / "datasets/objectnav/hm3d/v1/val/content"
    content.mkdir(parents=True)
    with gzip.open(content / "TEEsavR23oF.json.gz", "wt") as file:
        json.dump(table, file)
    return folder
