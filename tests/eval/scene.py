"""A room whose every view is known in closed form, recordings of it, and models that know it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import ActionConfig, ClipConfig, Config, DataConfig, EvalConfig, TrainConfig
from pewm_jax.data.dataset import Manifest, describe_shard, write_manifest, write_shard
from pewm_jax.data.episodes import EpisodeArrays, write_episode
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry.actions import discrete_table, integrate
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw, ray_directions
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.types import Camera, Frames
from pewm_jax.worlds.pewm.world import PEWM

SIZE = 16


def tiny(tmp, **evaluate):
    """A configuration small enough to sample in a second."""
    settings = {"clips": 4, "seeds": (0, 1), "videos": 1, "video_clips": 2, "batch": 2}
    return Config(
        model=PEWM(
            clip=ClipConfig(frames=5, height=SIZE, width=SIZE),
            backbone=DiTBackbone(
                layers=1, heads=1, head_dim=16, text_length=1, text_dim=8, time_dim=16
            ),
            memory=VoxelConfig(
                cell_m=(0.25, 0.25, 0.25),
                cells=(32, 32, 8),
                capacity=256,
                tokens=16,
                reader=AttentionConfig(heads=4, head_dim=8),
            ),
            noise=DDPMConfig(sample_steps=2),
        ),
        data=DataConfig(path=str(tmp / "data"), context=6),
        train=TrainConfig(run=str(tmp / "run")),
        evaluate=EvalConfig(**{**settings, **evaluate}),
    )


def look(pose, intrinsics, offset=0.0, size=SIZE):
    """Render the room |x| < 4, |y| < 3, 0 < z < 2.6: colours in [0, 1] and z-depth."""
    d = ray_directions(intrinsics, size, size) @ pose[:3, :3].T
    low, high = jnp.array([-4.0, -3.0, 0.0]), jnp.array([4.0, 3.0, 2.6])
    steps = jnp.where(d > 0, high - pose[:3, 3], low - pose[:3, 3])
    depth = (steps / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)).min(-1)
    points = pose[:3, 3] + d * depth[..., None]
    waves = points @ jnp.array([[1.9, 0.3, 0.7], [0.5, 2.1, 0.2], [0.4, 0.8, 2.3]])
    return 0.5 + 0.4 * jnp.sin(2 * waves + offset), depth


NAMES = ["room0-living-wall0", *(f"room0-picture-{k}" for k in range(8))]
"""Instances of the room: its shell, and eight pictures, one in each octant of the view around."""


def instances(poses, intrinsics, depth):
    """Return (T, H, W) instance ids: what is near the height of the eyes is a picture."""
    found = []
    for pose, depth_HW in zip(np.asarray(poses), np.asarray(depth), strict=True):
        rays = np.asarray(ray_directions(intrinsics, *depth_HW.shape)) @ pose[:3, :3].T
        points = pose[:3, 3] + rays * depth_HW[..., None]
        octant = np.int32(4 * (np.arctan2(points[..., 1], points[..., 0]) / np.pi + 1)) % 8
        found.append(np.where(abs(points[..., 2] - 1.25) < 0.5, 1 + octant, 0))
    return np.stack(found).astype(np.int32)


def walk(length, seed):
    """Discrete actions: look around, go, turn, come back."""
    rng = np.random.default_rng(seed)
    actions = [1] * 6 + [0] * 2 + [1] * 3 + [0] * 2 + [2] * 6 + [0] * 4
    while len(actions) < length - 1:
        actions.append(int(rng.integers(1, 3)))
    return np.array(actions[: length - 1])


def record(index, length=24, size=SIZE, scene=None, nod=0.0, ids=False):
    """One episode of the room; from frame 14 on the camera is pitched by ``nod`` radians.

    With ``ids`` it has those of ``instances``.
    """
    turns = walk(length, index)
    pose = pose_from_yaw(np.array([-0.5, 0.1 * index, 1.25]), 0.4 * index)
    moves = discrete_table(ActionConfig())[turns]
    poses = np.asarray(integrate(pose, moves))
    if nod:
        cos, sin = np.cos(nod), np.sin(nod)
        poses = poses.copy()
        poses[14:, :3, :3] = poses[14:, :3, :3] @ [[1, 0, 0], [0, cos, -sin], [0, sin, cos]]
        moves, turns = None, None
    intrinsics = intrinsics_from_fov(size, size, 90.0)
    colour, depth = jax.vmap(lambda p: look(p, intrinsics, 0.0, size))(poses)
    arrays = EpisodeArrays(
        np.rint(np.asarray(colour) * 255).astype(np.uint8),
        np.asarray(depth),
        intrinsics,
        poses,
        moves,
        None if turns is None else turns.astype(np.int32),
        instances(poses, intrinsics, depth) if ids else None,
    )
    info = {"return_frame": 12} | ({"objects": NAMES} if ids else {})
    return write_episode(arrays, f"room-{index}/revisit", scene or f"room-{index}", info)


def write_split(folder, episodes=2, **kwargs):
    """Publish a split of such recordings."""
    shard = folder / "shard-00000-of-00001.array_record"
    write_shard(shard, [record(i, **kwargs) for i in range(episodes)])
    write_manifest(folder, Manifest(folder.name, (describe_shard(shard),), {}, 24 * episodes))
    return folder


def knowing_rollout(config, params, state, actions, key, *, memory=True, late=0):
    """A model that knows the room by heart if it may use its map, and dreams noise otherwise.

    ``late`` delays what it shows by so many frames: the off-by-one that must be noticed.
    """
    pose = state.frame.camera.world_from_camera[0]
    intrinsics = state.frame.camera.intrinsics_4[0]
    poses = integrate(pose, actions)
    shown = poses[1 - late : poses.shape[0] - late]
    colour, depth = jax.vmap(
        lambda p: look(p, intrinsics, params["offset"], config.model.clip.height)
    )(shown)
    noise = jax.random.uniform(key, colour.shape)
    rgb = 2 * (colour if memory else noise) - 1
    camera = Camera(jnp.broadcast_to(intrinsics, (len(poses) - 1, 4)), poses[1:])
    frames = Frames(rgb, depth if memory else depth + 1, camera)
    last = jax.tree.map(lambda leaf: leaf[-1:], frames)
    return type(state)(last, state.map), frames
