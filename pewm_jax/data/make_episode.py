"""Make one episode of a house or a mesh: scene, trajectory, rendered frames, encoded record.

An episode is a pure function of the settings and its index.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from pewm_jax.config import ActionConfig, ConfigError
from pewm_jax.config.launch import is_address
from pewm_jax.data import sensor
from pewm_jax.data.agent import open_agent
from pewm_jax.data.episodes import EpisodeArrays, write_episode
from pewm_jax.data.moving import MovingHouse, moving_house, render_moving
from pewm_jax.data.render import draw_blocks, render
from pewm_jax.data.simulator import HEADROOM_M, open_house, open_mesh
from pewm_jax.data.trajectories import Policy, Trajectory, make_trajectory
from pewm_jax.data.voxelise import record_voxels
from pewm_jax.data.voxels import VoxelsConfig
from pewm_jax.geometry.cameras import intrinsics_from_fov
from pewm_jax.houses.fixtures import ROBOT_HEIGHT_M
from pewm_jax.types import Camera

SPLITS = ("train", "validation", "revisit")
"""Names of the splits' folders; ``revisit`` contains the test scenes, in which the agent by default
goes out and back (``CollectConfig.test_policy``)."""
HOUSES_PER_SEED = 1_000_000
_NOT_IN_FILES = ("out", "workers", "engine", "address", "overwrite")
"""Settings that do not change the files."""
UNRECORDED = VoxelsConfig()
HANDHELD, BODY = 3, 4
"""Number that is folded into the seed of hand-held cameras."""


@dataclasses.dataclass(frozen=True)
class CollectConfig:
    """Let an agent walk through houses and write its frames as episodes.

    With --env MODULE:NAME your own environment is used instead; see `collect --env --help`.
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to write; gets train/, validation/ and revisit/."""
    train: int = 320
    """Episodes to train on."""
    validation: int = 8
    """Episodes for validation during training."""
    test: int = 24
    """Episodes in test scenes, in revisit/: out and back over the same places, unless test_policy
    is another."""
    frames: int = 96
    """Frames of an episode."""
    size: int = 64
    """Width and height of the images, pixels."""
    hfov: float = 90.0
    """Horizontal field of view, degrees."""
    camera_height: float = 1.25
    """Height of the camera above the floor, metres."""
    step_m: float = 0.25
    """Length of a forward step, metres (continuous actions: the largest)."""
    turn_deg: float = 30.0
    """Angle of a turn, degrees (continuous actions: the largest)."""
    handheld: float = 0.0
    """Share of the episodes of train/ that are filmed as by a hand-held depth camera: with a field
    of view and height of their own, pitch and roll that change slowly, and the errors of such a
    recording in colour, depth and poses (`data/sensor.py` lists them with their sizes)."""
    turn_around: float = 0.5
    """Probability of a full turn at the start of an episode; revisit episodes always have it."""
    policy: Literal["follow", "walk"] = "follow"
    """`follow`: shortest paths between far goals. `walk`: straight on up to an obstacle."""
    test_policy: Policy = "revisit"
    """Policy in test scenes: `revisit` turns around, goes out and comes back the same way; `follow`
    and `walk` as for `policy`. A revisit turns by 540 degrees in total, which takes 54 actions with
    turns of 10 degrees, so that few actions of a short episode remain for moving."""
    continuous: bool = False
    """Small continuous (dx, dy, dyaw) actions instead of forward / turn left / turn right."""
    ids: bool = False
    """Also write instance ids, and the names of the instances."""
    moving: bool = False
    """Generated houses have doors that open as the agent approaches, and patrolling robots."""
    body: Literal["", "humanoid"] = ""
    """Body of the agent: `humanoid` has 25 degrees of freedom, of which two are walking. It is seen
    by the camera on its head, which is camera_height above the floor when it stands upright. It
    pauses and moves its arms; actions are the angles of its joints at the next frame."""
    voxels: VoxelsConfig = UNRECORDED
    episodes_per_house: int = 1
    """Episodes recorded in one house before the next is generated."""
    scene: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """A mesh to walk in instead of generated houses (GLB, OBJ, PLY); may be given several times:
    the meshes are distributed over the splits; a single mesh is used for all of them."""
    up: Literal["auto", "y", "z"] = "auto"
    """Which axis of the meshes points up; `auto`: y for GLB and glTF, z for the others."""
    seed: int = 0
    """Seed of houses and trajectories."""
    workers: int = 0
    """Processes; 0 = as many as there are CPU cores. The result does not depend on it."""
    engine: Literal["processes", "ray"] = "processes"
    """Where the shards are made: in `processes` of this machine, or on a `ray` cluster (pip install
    'pewm-jax[ray]'). The result does not depend on it."""
    address: str = ""
    """With `--engine ray`: HOST:PORT of the cluster, or `auto` on one of its machines; if empty, a
    cluster of this machine alone is started."""
    shard_episodes: int = 8
    """Episodes per file."""
    overwrite: bool = False
    """Replace a dataset that was made with other settings."""

    def __post_init__(self):
        """Validate."""
        ActionConfig(self.step_m, self.turn_deg)
        positive = ("frames", "size", "shard_episodes", "episodes_per_house", "camera_height")
        for name in positive:
            if getattr(self, name) <= 0:
                raise ConfigError(f"--{dashed(name)} is {getattr(self, name)}: use 1 or more.")
        require_at_least(self, 0, "train", "validation", "test", "workers", "seed")
        if max(self.train, self.validation, self.test) > HOUSES_PER_SEED:
            raise ConfigError(f"a split can hold at most {HOUSES_PER_SEED} episodes.")
        if self.train + self.validation + self.test == 0:
            raise ConfigError("--train, --validation and --test are all 0: nothing to collect.")
        if not 1 <= self.hfov < 180:
            raise ConfigError(f"--hfov is {self.hfov}: use 1 up to below 180 degrees.")
        if self.frames < 2:
            raise ConfigError("--frames is 1: an episode needs at least 2 frames.")
        self._check_probabilities()
        self._check_moving_and_voxels()
        if self.address and self.engine != "ray":
            raise ConfigError(f"--address {self.address} needs --engine ray.")
        if self.address not in ("", "auto") and not is_address(self.address):
            raise ConfigError(
                f"--address is {self.address!r}: use HOST:PORT (a port from 1 to 65535) or auto."
            )

    def _check_probabilities(self) -> None:
        for name in ("turn_around", "handheld"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(
                    f"--{dashed(name)} is {getattr(self, name)}: use a probability, 0 to 1."
                )

    def _check_moving_and_voxels(self) -> None:
        if self.moving and self.scene:
            raise ConfigError(
                "--moving needs generated houses: a mesh of --scene has no moving parts; leave out "
                "one of the two."
            )
        if self.moving and self.camera_height < ROBOT_HEIGHT_M + HEADROOM_M:
            raise ConfigError(
                f"--camera-height is {self.camera_height}: with --moving use "
                f"{ROBOT_HEIGHT_M + HEADROOM_M:g} m or more, to be above the robots."
            )
        self._check_body()
        for field in () if self.voxels.record else dataclasses.fields(self.voxels):
            value = getattr(self.voxels, field.name)
            if value != field.default:
                raise ConfigError(f"--voxels.{field.name} {value} needs --voxels: add it.")
        if self.ids and self.voxels.pictures == "cells":
            raise ConfigError(
                "--ids records the instances of the house, which --voxels.pictures cells does not "
                "show: leave out one of the two."
            )

    def _check_body(self) -> None:
        for flag, given in (
            ("continuous", self.continuous),
            ("handheld", self.handheld > 0),
            ("voxels", self.voxels.record),
        ):
            if self.body and given:
                raise ConfigError(
                    f"--{flag} does not go together with --body {self.body}: leave out one of the "
                    "two."
                )

    @property
    def actions(self) -> ActionConfig:
        """Return the motion of one action."""
        return ActionConfig(self.step_m, self.turn_deg)

    def episodes(self, split: str) -> int:
        """Episodes of a split."""
        return {"train": self.train, "validation": self.validation, "revisit": self.test}[split]


def settings_of(config: CollectConfig, split: str) -> dict[str, Any]:
    """Return the settings that determine the bytes of a split."""
    settings = dataclasses.asdict(config)
    for name in (*_NOT_IN_FILES, "train", "validation", "test"):
        del settings[name]
    # Defaults of newer settings are left out, so that older datasets compare as equal.
    if split != "revisit" or config.test_policy == "revisit":
        del settings["test_policy"]
    if split != "train" or not config.handheld:
        del settings["handheld"]
    for name in ("moving", "body"):
        if not getattr(config, name):
            del settings[name]
    if settings["voxels"]["pictures"] == UNRECORDED.pictures:
        del settings["voxels"]["pictures"]
    if not settings["voxels"].pop("record"):
        del settings["voxels"]
    settings["scene"] = [f"{p.name} ({p.stat().st_size} bytes)" for p in config.scene]
    return {"made_by": "collect", "episodes": config.episodes(split), **settings}


def house_seed(config: CollectConfig, split: str, index: int) -> int:
    """Return the seed of an episode's house; splits never share seeds."""
    number = config.seed * HOUSES_PER_SEED + index // config.episodes_per_house
    return number * len(SPLITS) + SPLITS.index(split)


def scenes_of(config: CollectConfig, split: str) -> tuple[Path, ...]:
    """Return the meshes of a split: disjoint between splits if there are enough of them."""
    scenes = config.scene
    used = [name for name in SPLITS if config.episodes(name)]
    if len(scenes) < len(used):
        return scenes
    order = np.random.default_rng(config.seed).permutation(len(scenes))
    # One mesh for every small split, the others for the first (largest) one.
    position = used.index(split)
    chosen = order[: len(scenes) - len(used) + 1] if position == 0 else [order[-position]]
    return tuple(scenes[i] for i in sorted(chosen))


def make_episode(config: CollectConfig, split: str, index: int) -> bytes:
    """Return the record of one episode; UserError if a mesh does not load or has no floor."""
    moving: MovingHouse | None = None
    if config.scene:
        scenes = scenes_of(config, split)
        scene, grid = _mesh(scenes[index % len(scenes)], config.up, config.camera_height)
    elif config.moving:
        moving = _moving(house_seed(config, split, index), config.camera_height)
        scene, grid = moving.scene, moving.grid
    else:
        scene, grid = _house(house_seed(config, split, index), config.camera_height)
    policy: Policy = config.test_policy if split == "revisit" else config.policy
    agent = open_agent(config.body, config.camera_height) if config.body else None
    walk = make_trajectory(
        grid,
        config.actions,
        config.frames if agent is None else agent.frames(config.frames),
        np.random.default_rng([config.seed, SPLITS.index(split), index]),
        policy=policy,
        turn_around=config.turn_around,
        continuous=config.continuous,
    )
    size = config.size, config.size
    by_hand = _hand(config, split, index)
    camera, height = _filmed(config, walk, grid.floor_z, by_hand)
    states = None
    if agent is not None:
        rng = np.random.default_rng([config.seed, SPLITS.index(split), index, BODY])
        walk, states = agent.act(walk, config.frames, rng)
        camera = agent.camera(walk.planar_T3, states, camera.intrinsics_4, grid.floor_z)
    pose = np.asarray(camera.world_from_camera)
    parts = None if moving is None else moving.poses(walk.planar_T3[:, :2])
    voxels = None
    if config.voxels.record:
        floor_z = float(grid.floor_z) if config.scene else 0.0
        voxels = record_voxels(config.voxels, scene, floor_z, pose[:, :3, 3], moving, parts)
    if voxels is not None and config.voxels.pictures == "cells":
        seen = draw_blocks(voxels, camera, *size)
    elif moving is not None and parts is not None:
        seen = render_moving(moving, parts, camera, *size)
    else:
        seen = render(scene, camera, *size)
    bodies = None
    if agent is not None and states is not None:
        first = len(scene.objects) + (0 if moving is None else len(moving.moves))
        agent.render_over(seen, walk.planar_T3, states, camera, grid.floor_z, first)
        bodies = {"name": config.body, "scale": round(agent.scale, 6), "ids": agent.ids(first)}
    recorded = sensor.record(by_hand, seen.rgb_THWC, seen.depth_THW, pose)
    arrays = EpisodeArrays(
        recorded.rgb_THWC,
        recorded.depth_THW,
        camera.intrinsics_4,
        recorded.pose_T44,
        walk.actions,
        walk.action_ids,
        seen.ids_THW if config.ids else None,
        voxels,
        states,
    )
    info: dict[str, Any] = {
        "policy": policy,
        "camera_height_m": round(height, 6),
        "floor_z_m": round(float(grid.floor_z), 6),
        "step_m": config.step_m,
        "turn_deg": config.turn_deg,
    }
    optional = {
        "objects": list(scene.objects) if config.ids else None,
        "moving": config.moving or None,
        "body": bodies,
        "handheld": by_hand is not None or None,
        "pictures": None if _usual_pictures(config) else config.voxels.pictures,
        "return_frame": walk.return_frame,
    }
    info |= {name: value for name, value in optional.items() if value is not None}
    return write_episode(arrays, f"{split}-{index:06d}", scene.name, info)


def _usual_pictures(config: CollectConfig) -> bool:
    return config.voxels.pictures == UNRECORDED.pictures


def _hand(config: CollectConfig, split: str, index: int) -> np.random.Generator | None:
    """Return what the errors of a hand-held camera depend on; None for the robot's camera."""
    rng = np.random.default_rng([config.seed, SPLITS.index(split), index, HANDHELD])
    return rng if split == "train" and rng.random() < config.handheld else None


def _filmed(
    config: CollectConfig, walk: Trajectory, floor_z: float, rng: np.random.Generator | None
) -> tuple[Camera, float]:
    """Return the (T,) cameras of a walk, and their height above the floor, metres.

    ``rng`` is that of a hand-held camera, None for the robot's.
    """
    hfov, height = config.hfov, config.camera_height
    if rng is not None:
        hfov = rng.uniform(*sensor.HFOV_DEG)
        height -= rng.uniform(0, min(sensor.LOWER_M, height / 2))
    pose = walk.world_from_camera(floor_z + height)
    if rng is not None:
        pose[:, :3, :3] = pose[:, :3, :3] @ sensor.tilts(rng, config.frames)
    return Camera(intrinsics_from_fov(config.size, config.size, hfov), pose), height


_house = functools.lru_cache(maxsize=1)(open_house)
_mesh = functools.lru_cache(maxsize=2)(open_mesh)


@functools.lru_cache(maxsize=1)
def _moving(seed: int, camera_height: float) -> MovingHouse:
    return moving_house(seed, agent_height_m=camera_height + HEADROOM_M)


def dashed(name: str) -> str:
    """Return a setting's name in its command-line form."""
    return name.replace("_", "-")


def require_at_least(config: Any, least: int, *names: str) -> None:
    """Raise ConfigError for settings below a number."""
    for name in names:
        value = getattr(config, name)
        if value < least:
            raise ConfigError(f"--{dashed(name)} is {value}: use {least} or more.")
