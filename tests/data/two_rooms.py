"""A world small enough to know everything about: two rooms of a closed box, seen analytically."""

from __future__ import annotations

import numpy as np

from pewm_jax.config import ActionConfig
from pewm_jax.data.clips import Choice, choose_context, cut
from pewm_jax.data.dataset import Manifest, describe_shard, write_manifest, write_shard
from pewm_jax.data.episodes import EpisodeArrays, write_episode
from pewm_jax.data.navigation import NavGrid
from pewm_jax.data.trajectories import make_trajectory
from pewm_jax.geometry.cameras import intrinsics_from_fov, ray_directions

LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([6.0, 4.0, 2.5])
CAMERA_Z = 1.25


def clip_at(config, episode, start, stride=1, frames=None):
    """The clip at given frames of an episode; its context is evenly spaced."""
    count = config.model.clip.frames if frames is None else frames
    slots = config.data.context
    chosen = Choice(start + stride * np.arange(count), choose_context(start, slots))
    return cut(episode, chosen, slots)


def two_rooms() -> NavGrid:
    """A 6 × 4 m grid cut by a wall at x = 3 with a doorway; its origin is off the world's."""
    free = np.zeros((44, 64), bool)
    free[3:41, 3:61] = True
    free[:, 31:34] = False
    free[18:26, 31:34] = True
    return NavGrid(free, np.array([-0.2, -0.2]), 0.1, 0.0)


def box_views(world_from_camera, intrinsics_4, height, width):
    """rgb and depth inside the box, exact: colours are functions of the place that is hit."""
    rays = np.asarray(ray_directions(intrinsics_4, height, width), np.float64)
    rgb, depth = [], []
    for pose in np.asarray(world_from_camera, np.float64):
        way = rays @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            exits = np.where(way > 0, HIGH - pose[:3, 3], LOW - pose[:3, 3]) / way
        z = np.where(way == 0, np.inf, exits).min(-1)
        hit = pose[:3, 3] + way * z[..., None]
        depth.append(z)
        rgb.append(np.clip(40 + 180 * hit / HIGH, 0, 255).astype(np.uint8))
    return np.stack(rgb), np.stack(depth).astype(np.float32)


def arrays(frames=12, size=16, seed=0, policy="follow", turn_around=0.0, width=None, **options):
    """What an agent sees on a walk through the box."""
    walk = make_trajectory(
        two_rooms(),
        ActionConfig(),
        frames,
        np.random.default_rng(seed),
        policy=policy,
        turn_around=turn_around,
        **options,
    )
    pose = walk.world_from_camera(CAMERA_Z)
    intrinsics = intrinsics_from_fov(size, width or size, 90.0)
    rgb, depth = box_views(pose, intrinsics, size, width or size)
    return EpisodeArrays(rgb, depth, intrinsics, pose, walk.actions, walk.action_ids)


def split(folder, episodes=4, shards=2, info=None, **options):
    """Write a finished split of box episodes; returns its folder."""
    records = [
        write_episode(arrays(seed=i, **options), f"episode-{i}", "box", info)
        for i in range(episodes)
    ]
    return write_split(folder, records, {}, shards, options.get("frames", 12) * episodes)


def write_split(folder, records, settings, shards=1, frames=0):
    """Write records as a finished split; returns its folder."""
    files = []
    for k in range(shards):
        path = folder / f"shard-{k:05d}-of-{shards:05d}.array_record"
        write_shard(path, records[k * len(records) // shards : (k + 1) * len(records) // shards])
        files.append(describe_shard(path))
    write_manifest(folder, Manifest(folder.name, tuple(files), settings, frames))
    return folder
