"""Start of a drive: in a house, a mesh, an episode or a recording, fitted to the model."""

from __future__ import annotations

import dataclasses
import itertools
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pewm_jax.bodies.humanoid import BODIES
from pewm_jax.config import UserError, World
from pewm_jax.data.agent import Agent, open_agent
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import DEPTH_LIMIT_M
from pewm_jax.data.importer import ImportConfig, import_recording
from pewm_jax.data.loader import require_recorded, require_same_cells
from pewm_jax.data.navigation import NavGrid, is_free, sample_free
from pewm_jax.data.recordings import read_recording
from pewm_jax.data.render import draw_blocks, render
from pewm_jax.data.simulator import Simulator, move, open_simulator
from pewm_jax.data.voxelise import record_voxels
from pewm_jax.data.voxels import VoxelsConfig
from pewm_jax.geometry.cameras import resize_intrinsics
from pewm_jax.play.settings import Start
from pewm_jax.types import Camera, Frames

LOOKS, CANDIDATES, OPEN_M, TURN = 12, 16, 3.0, np.pi / 6
"""Frames of the initial full turn; candidate start positions; radius in which free space around
them is counted, metres; start headings are multiples of this angle, radians."""


@dataclasses.dataclass(frozen=True, eq=False)
class StartPoint:
    """The first frames of a drive, and their scene.

    Attributes:
        name: name of the scene, for display.
        frames: S ≥ 1 frames of the model's size, rgb uint8; the last one is the present.
        planar_3: x, y, yaw of the present in a house or mesh, else None.
        simulator: the house or mesh, which provides the ground truth and collisions, else None.
        blocks: the cells as which the house or mesh is shown; None for its surfaces.
        agent: the body of the agent, if its degrees of freedom steer the model.
        state_A: its state at the present frame.
        floor_z: height of the floor below it, metres.
    """

    name: str
    frames: Frames
    planar_3: np.ndarray | None = None
    simulator: Simulator | None = None
    blocks: VoxelsConfig | None = None
    agent: Agent | None = None
    state_A: np.ndarray | None = None
    floor_z: float = 0.0


def open_place(
    start: Start, height: int, width: int, blocks: VoxelsConfig | None = None, body: str = ""
) -> StartPoint:
    """Open the scene in which a drive starts, for images of this size.

    Houses and meshes are shown as ``blocks``, if they are given. ``body`` is the name of the body
    that the agent has; "" for a camera that moves on the ground.

    Raises:
        UserError: the scene does not exist or cannot be used.
    """
    if start.episode:
        place = _episode(Path(start.episode), start.number, start.frames, height, width)
        return _embodied(start, place, body) if body else place
    if start.recording and body:
        raise UserError(
            f"This world is steered by the joints of a body ({body}), which a recording does not "
            "show: start in a house, or with an episode of its data."
        )
    if start.recording:
        return _recording(start, height, width)
    simulator = open_simulator(
        house_seed=start.house,
        scene=Path(start.scene) if start.scene else None,
        up=start.up,
        height=height,
        width=width,
        hfov=start.hfov,
        camera_height=start.camera_height,
    )
    planar = _start_pose(simulator.grid, np.random.default_rng(start.seed))
    around = np.tile(planar, (LOOKS, 1))
    around[:-1, 2] += 2 * np.pi * np.arange(1, LOOKS) / LOOKS
    name = Path(start.scene).name if start.scene else f"house {start.house}"
    if not body:
        poses = np.stack([simulator.world_from_camera(pose) for pose in around])
        camera = Camera(np.tile(simulator.intrinsics_4, (LOOKS, 1)), poses)
        seen = _rendered(simulator, blocks, camera, height, width)
        return StartPoint(name, seen, planar, simulator, blocks)
    agent = open_agent(body, start.camera_height)
    place = StartPoint(
        name,
        simulator.frames(around[-1:]),
        planar,
        simulator,
        agent=agent,
        state_A=agent.body.rest,
        floor_z=float(simulator.grid.floor_z),
    )
    camera = agent.camera(
        planar[None], agent.body.rest[None], simulator.intrinsics_4[None], place.floor_z
    )
    seen = truth(place, camera, height, width, (planar, agent.body.rest))
    assert seen is not None
    return dataclasses.replace(place, frames=seen)


def _embodied(start: Start, place: StartPoint, body: str) -> StartPoint:
    """Return the start in an episode whose agent has a body."""
    episode = EpisodeSource(Path(start.episode))[start.number]
    about = episode.info.get("body") or {}
    if about.get("name") != body or episode.states is None:
        raise UserError(
            f"episode {episode.name} was not recorded by the body {body}, whose joints steer this "
            f"world: use data collected with --body {body}."
        )
    agent = open_agent(body, about["scale"] * BODIES[body].eye_m)
    present = min(start.frames, episode.length) - 1
    state = np.asarray(episode.states[present], np.float64)
    planar = agent.body.planar_of(episode.world_from_camera[present], state, agent.scale)
    floor_z = float(episode.info.get("floor_z_m", 0.0))
    return dataclasses.replace(place, planar_3=planar, agent=agent, state_A=state, floor_z=floor_z)


def blocks_of(model: World) -> VoxelsConfig | None:
    """Return the cells as which a world's places are shown; None if it was trained on surfaces."""
    memory: Any = getattr(model, "memory", None)
    if not getattr(memory, "CLASSES", False) or memory.pictures != "cells":
        return None
    return VoxelsConfig(
        record=True,
        cell=memory.cell_m[0],
        side=memory.recorded,
        kinds=memory.kinds,
        colours=memory.colours,
        pictures="cells",
    )


def require_shown(model: World, start: Start) -> None:
    """Refuse to start a drive with other images than the world was trained on.

    Raises:
        UserError: the world was trained on images of blocks, but the drive starts with surfaces.
    """
    if start.episode:
        require_recorded(model, EpisodeSource(Path(start.episode)))
    memory: Any = getattr(model, "memory", None)
    if not getattr(memory, "CLASSES", False):
        return
    if start.episode:
        require_same_cells(model, EpisodeSource(Path(start.episode))[start.number])
    elif start.recording and memory.pictures == "cells":
        raise UserError(
            "This world was trained on images of blocks, but recordings show surfaces: start in a "
            "generated house or a mesh, or with an episode of its data, such as --episode "
            "data/persist/revisit."
        )


def truth(
    place: StartPoint,
    camera: Camera,
    height: int,
    width: int,
    posture: tuple[np.ndarray, np.ndarray] | None = None,
) -> Frames | None:
    """Return the ground truth of (T,) cameras, or None if it is unknown.

    ``posture`` is the pose x, y, yaw and the state of the agent's body, which is then in the
    pictures.
    """
    if place.simulator is None:
        return None
    host = Camera(np.asarray(camera.intrinsics_4), np.asarray(camera.world_from_camera))
    if posture is None or place.agent is None:
        return _rendered(place.simulator, place.blocks, host, height, width)
    seen = render(place.simulator.scene, host, height, width)
    planar, state = (np.repeat(x[None], len(host.world_from_camera), 0) for x in posture)
    place.agent.render_over(seen, planar, state, host, place.floor_z, 0)
    return Frames(seen.rgb_THWC, _measured(seen.depth_THW), host)


def _rendered(
    simulator: Simulator, blocks: VoxelsConfig | None, camera: Camera, height: int, width: int
) -> Frames:
    """Return what (T,) cameras see of a house or mesh, as blocks or as surfaces."""
    scene = simulator.scene
    if blocks is None:
        seen = render(scene, camera, height, width)
        return Frames(seen.rgb_THWC, _measured(seen.depth_THW), camera)
    eye = np.asarray(camera.world_from_camera)[:, :3, 3]
    voxels = record_voxels(blocks, scene, float(simulator.grid.floor_z), eye)
    seen = draw_blocks(voxels, camera, height, width)
    return Frames(seen.rgb_THWC, seen.depth_THW, camera)


def _measured(depth: np.ndarray) -> np.ndarray:
    """Return depth with 0 where an episode's depth cannot be recorded."""
    return np.where(depth <= DEPTH_LIMIT_M, depth, np.float32(0))


def walk(
    place: StartPoint,
    planar_3: np.ndarray,
    action_3: np.ndarray,
    *,
    walls: bool = True,
    sliding: bool = True,
) -> tuple[np.ndarray, bool]:
    """Return the next planar pose, and whether a wall blocked the move.

    The agent slides along walls, if ``sliding``. An agent outside the free area (after driving
    through walls) can go anywhere.
    """
    simulator = place.simulator
    if walls and simulator is not None and bool(is_free(simulator.grid, planar_3[:2])):
        return move(simulator.grid, planar_3, action_3, sliding=sliding)
    x, y, yaw = np.asarray(planar_3, np.float64)
    dx, dy, dyaw = np.asarray(action_3, np.float64)
    ahead = np.array([np.cos(yaw) * dx - np.sin(yaw) * dy, np.sin(yaw) * dx + np.cos(yaw) * dy])
    return np.array([x + ahead[0], y + ahead[1], _wrap_angle(yaw + dyaw)]), False


def action_between(before_3: np.ndarray, after_3: np.ndarray) -> np.ndarray:
    """Return the (3,) float32 action dx, dy, dyaw from one planar pose to another."""
    (dx, dy), yaw = after_3[:2] - before_3[:2], before_3[2]
    c, s = np.cos(yaw), np.sin(yaw)
    turn = _wrap_angle(after_3[2] - yaw)
    return np.array([c * dx + s * dy, c * dy - s * dx, turn], np.float32)


def way(before_3: np.ndarray, after_3: np.ndarray, step_m: float, turn_deg: float) -> np.ndarray:
    """Return (n, 3) equal actions from one planar pose to another, at most one step each."""
    far = float(np.linalg.norm(after_3[:2] - before_3[:2]))
    turn = _wrap_angle(float(after_3[2] - before_3[2]))
    parts = int(max(np.ceil(far / step_m - 1e-6), np.ceil(abs(turn) / np.radians(turn_deg) - 1e-6)))
    share = np.linspace(0, 1, parts + 1)[:, None]
    poses = before_3 + share * (np.array([*after_3[:2], before_3[2] + turn]) - before_3)
    actions = [action_between(a, b) for a, b in itertools.pairwise(poses)]
    return np.stack(actions) if actions else np.zeros((0, 3), np.float32)


def forward_way(
    before_3: np.ndarray, after_3: np.ndarray, step_m: float, turn_deg: float
) -> np.ndarray:
    """Return (n, 3) actions that turn to a place, walk there, and turn to its heading."""
    (dx, dy), far = after_3[:2] - before_3[:2], float(np.linalg.norm(after_3[:2] - before_3[:2]))
    course = float(np.arctan2(dy, dx)) if far > 1e-6 else float(after_3[2])
    corners = [
        before_3,
        np.array([*before_3[:2], course]),
        np.array([*after_3[:2], course]),
        np.asarray(after_3, np.float64),
    ]
    ways = [way(a, b, step_m, turn_deg) for a, b in itertools.pairwise(corners)]
    return np.concatenate(ways)


def fitted(frames: Frames, height: int, width: int) -> Frames:
    """Centre-crop NumPy frames to an aspect ratio, and resize them and their intrinsics."""
    tall, wide = frames.depth_THW.shape[1:]
    if (tall, wide) == (height, width):
        return frames
    high, broad = min(tall, round(wide * height / width)), min(wide, round(tall * width / height))
    top, left = (tall - high) // 2, (wide - broad) // 2
    rgb = frames.rgb_THWC[:, top : top + high, left : left + broad]
    depth = frames.depth_THW[:, top : top + high, left : left + broad]
    rows = ((np.arange(height) + 0.5) * high / height).astype(int)
    columns = ((np.arange(width) + 0.5) * broad / width).astype(int)
    how = cv2.INTER_AREA if high > height else cv2.INTER_LINEAR
    small = np.stack([cv2.resize(image, (width, height), interpolation=how) for image in rgb])
    moved = frames.camera.intrinsics_4 - np.array([0, 0, left, top], np.float32)
    intrinsics = resize_intrinsics(moved, width / broad, height / high)
    camera = Camera(intrinsics, frames.camera.world_from_camera)
    return Frames(small, depth[:, rows][:, :, columns], camera)


def _episode(folder: Path, number: int, count: int, height: int, width: int) -> StartPoint:
    source = EpisodeSource(folder)
    if number >= len(source):
        raise UserError(
            f"--number {number}: {folder} has {len(source)} episodes, 0 to {len(source) - 1}."
        )
    episode = source[number]
    seen = episode.frames(range(min(count, episode.length)))
    return StartPoint(episode.name, fitted(seen, height, width))


def _recording(start: Start, height: int, width: int) -> StartPoint:
    folder = Path(start.recording)
    stride = max(1, len(read_recording(folder)) // start.frames)
    assert start.intrinsics is not None
    with tempfile.TemporaryDirectory() as made:
        config = ImportConfig(
            folder,
            Path(made),
            start.intrinsics,
            depth_scale=start.depth_scale,
            stride=stride,
            up=start.recording_up,
        )
        import_recording(config, log=lambda _: None)
        place = _episode(Path(made) / config.split, 0, start.frames, height, width)
    return dataclasses.replace(place, name=folder.resolve().name)


def _start_pose(grid: NavGrid, rng: np.random.Generator) -> np.ndarray:
    """Return the pose x, y, yaw with the most free space among candidates, facing that space."""
    free = grid.centre_of(np.argwhere(grid.free_YX))
    places = sample_free(grid, rng, CANDIDATES)
    around = [free[np.linalg.norm(free - place, axis=-1) < OPEN_M] - place for place in places]
    best = int(np.argmax([len(one) for one in around]))
    x, y = around[best].mean(0)
    return np.array([*places[best], round(np.arctan2(y, x) / TURN) * TURN])


def _wrap_angle(angle: float) -> float:
    """Return an angle in (−π, π]."""
    return float(np.pi - (np.pi - angle) % (2 * np.pi))
