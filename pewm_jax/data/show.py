"""Draw an episode as one image: a contact sheet of colour and depth, and the path from above."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.data.voxel_pictures import grid_from_above, grid_from_camera
from pewm_jax.io import atomic

THUMB = 128
"""Height of a thumbnail, pixels."""
MARGIN = 8
CEILING_M = 0.6
"""Points this far above the camera are omitted from the view from above, metres."""
BACKGROUND, FREE = 24, 70


@dataclasses.dataclass(frozen=True)
class ShowConfig:
    """Write a contact sheet of an episode and its path from above as a PNG."""

    path: Annotated[Path, tyro.conf.Positional]
    """A split folder, e.g. data/demo/train."""
    episode: int = 0
    """Number of the episode."""
    out: Path = Path("episode.png")
    """File to write."""
    columns: int = 8
    """Thumbnails side by side."""
    rows: int = 2
    """Rows of thumbnails, each of colour over depth."""
    voxels: bool = False
    """Draw the grids around the agent instead: the camera's image, below it the grid as the camera
    would see it, below that the grid from above."""

    def __post_init__(self):
        """Validate."""
        if min(self.columns, self.rows) < 1:
            raise ConfigError("--columns and --rows must be at least 1.")
        if self.out.suffix.lower() != ".png":
            raise ConfigError(f"--out is {self.out}: give a file name that ends in .png.")


def show(config: ShowConfig, log: Callable[[str], None] = print) -> None:
    """Draw an episode and write the image.

    Raises:
        UserError: the split cannot be read, or has no such episode.
    """
    source = EpisodeSource(config.path)
    if not 0 <= config.episode < len(source):
        raise UserError(
            f"--episode {config.episode}: {config.path} has {len(source)} episodes, "
            f"0 to {len(source) - 1}."
        )
    episode = source[config.episode]
    if config.voxels:
        picture = draw_voxels(episode, config.columns, config.rows)
    else:
        picture = draw(episode, config.columns, config.rows)
    config.out.parent.mkdir(parents=True, exist_ok=True)
    done, code = cv2.imencode(".png", picture[..., ::-1])
    assert done
    with atomic.replacing(config.out) as partial:
        partial.write_bytes(code.tobytes())
    log(f"{config.out}: {episode.name} in {episode.scene}, {episode.length} frames.")


def draw(episode: Episode, columns: int = 8, rows: int = 2) -> np.ndarray:
    """Return an RGB image: rows of colour and depth, and below them the view from above."""
    count = min(columns * rows, episode.length)
    chosen = np.round(np.linspace(0, episode.length - 1, count)).astype(int)
    frames = episode.frames(chosen)
    width = max(1, round(THUMB * episode.width / episode.height))
    farthest = max(float(frames.depth_THW.max()), 1e-3)
    sheet_rows = []
    for start in range(0, count, columns):
        part = range(start, min(start + columns, count))
        colour = [_thumb(frames.rgb_THWC[i], width, str(chosen[i])) for i in part]
        depth = [_thumb(depth_colours(frames.depth_THW[i], farthest), width) for i in part]
        blank = [np.full((THUMB, width, 3), BACKGROUND, np.uint8)] * (columns - len(part))
        sheet_rows += [np.hstack(colour + blank), np.hstack(depth + blank)]
    sheet = np.vstack(sheet_rows)
    plan = view_from_above(episode, sheet.shape[1] - 2 * MARGIN)
    framed = cv2.copyMakeBorder(
        plan, MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_CONSTANT, value=(BACKGROUND,) * 3
    )
    return np.vstack([sheet, framed])


def draw_voxels(episode: Episode, columns: int = 8, rows: int = 2) -> np.ndarray:
    """Return an RGB image of grids; every frame has a column of five images.

    They are: colour; the grid as the camera sees it; the depths of both, to one scale; and the grid
    from above up to the height of the camera, x to the right, with the camera's field of view.

    Raises:
        UserError: the episode has no voxels.
    """
    count = min(columns * rows, episode.length)
    chosen = np.round(np.linspace(0, episode.length - 1, count)).astype(int)
    frames, voxels = episode.frames(chosen), episode.voxels(chosen)
    width = max(1, round(THUMB * episode.width / episode.height))
    farthest = max(float(frames.depth_THW.max()), 1e-3)
    sheet = []
    for k, number in enumerate(chosen):
        seen = grid_from_camera(voxels, k, frames.camera, episode.height, episode.width)
        plan = grid_from_above(voxels, k, frames.camera)
        images = [
            _thumb(frames.rgb_THWC[k], width, str(number)),
            _thumb(seen.rgb_HWC, width),
            _thumb(depth_colours(frames.depth_THW[k], farthest), width),
            _thumb(depth_colours(seen.depth_HW, farthest), width),
            _thumb(plan, width),
        ]
        sheet.append(np.vstack(images))
    blank = [np.full_like(sheet[0], BACKGROUND)] * (-count % columns)
    sheet += blank
    return np.vstack([np.hstack(sheet[k : k + columns]) for k in range(0, len(sheet), columns)])


def depth_colours(depth_HW: np.ndarray, farthest_m: float) -> np.ndarray:
    """Return depth (H, W) as RGB: near is bright, far is dark, no measurement is black."""
    level = (255 * np.clip(1 - depth_HW / farthest_m, 0, 1)).astype(np.uint8)
    colours = cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1].copy()
    colours[depth_HW <= 0] = 0
    return colours


def view_from_above(episode: Episode, width: int) -> np.ndarray:
    """Return the world from above (RGB, x to the right, y up) with the path drawn over it.

    Surfaces have their own colours and higher ones cover lower ones; the path goes from green to
    red. In a revisit episode a white ring marks the turn, after which the line is thinner.
    """
    points, colours = _points(episode)
    path = np.asarray(episode.world_from_camera[:, :3, 3], np.float64)
    everything = np.concatenate([points[:, :2], path[:, :2]])
    low = np.minimum(np.percentile(everything, 0.5, axis=0), path[:, :2].min(0)) - 0.3
    high = np.maximum(np.percentile(everything, 99.5, axis=0), path[:, :2].max(0)) + 0.3
    scale = min(width / (high[0] - low[0]), width / (high[1] - low[1]) * 0.6)
    shape = tuple(int(n) for n in np.ceil((high - low)[::-1] * scale))
    left = (width - shape[1]) // 2
    image = np.full((shape[0], shape[1], 3), BACKGROUND, np.uint8)

    def pixels(xy: np.ndarray) -> np.ndarray:
        column_row = (xy[:, :2] - low) * scale
        column_row[:, 1] = shape[0] - 1 - column_row[:, 1]
        return np.round(column_row).astype(int)

    at = pixels(points)
    inside = ((at >= 0) & (at < np.array(shape)[::-1])).all(1)
    order = np.argsort(points[inside, 2], kind="stable")
    at, colours = at[inside][order], colours[inside][order]
    image[at[:, 1], at[:, 0]] = colours
    image = cv2.dilate(image, np.ones((3, 3), np.uint8))
    spots = pixels(path)
    turn = episode.info.get("return_frame")
    for k in range(len(spots) - 1):
        done = k / max(1, len(spots) - 2)
        colour = (int(255 * done), int(255 * (1 - done)), 40)
        wide = turn is not None and k < turn
        _line(image, spots[k], spots[k + 1], colour, 7 if wide else 2)
    cv2.circle(image, _pixel(spots[0]), 9, (40, 255, 40), -1, cv2.LINE_AA)
    cv2.circle(image, _pixel(spots[-1]), 5, (255, 40, 40), -1, cv2.LINE_AA)
    if turn is not None:
        cv2.circle(image, _pixel(spots[turn]), 12, (255, 255, 255), 2, cv2.LINE_AA)
    _line(
        image, np.array([10, shape[0] - 10]), np.array([10 + scale, shape[0] - 10]), (255,) * 3, 2
    )
    _write(image, "1 m", (10, shape[0] - 16))
    plan = np.full((shape[0], width, 3), BACKGROUND, np.uint8)
    plan[:, left : left + shape[1]] = image
    return plan


def _points(episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Return points in the world (N, 3) below the ceiling, and their colours (N, 3)."""
    frames = episode.frames(np.unique(np.linspace(0, episode.length - 1, 60).astype(int)))
    step = max(1, episode.height // 64)
    fx, fy, cx, cy = np.asarray(episode.intrinsics_4, np.float64)
    v, u = np.mgrid[0 : episode.height : step, 0 : episode.width : step]
    rays = np.stack([(u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, np.ones(u.shape)], -1)
    points, colours = [], []
    for k, pose in enumerate(np.asarray(frames.camera.world_from_camera, np.float64)):
        depth = frames.depth_THW[k][v, u]
        world = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        kept = (depth > 0) & (world[..., 2] < pose[2, 3] + CEILING_M)
        points.append(world[kept])
        colours.append(frames.rgb_THWC[k][v, u][kept])
    return np.concatenate(points), np.concatenate(colours)


def _thumb(image: np.ndarray, width: int, text: str = "") -> np.ndarray:
    large = np.ascontiguousarray(cv2.resize(image, (width, THUMB), interpolation=cv2.INTER_NEAREST))
    if text:
        _write(large, text, (5, 15))
    large[:, -1] = large[-1] = BACKGROUND
    return large


def _write(image: np.ndarray, text: str, where: tuple[int, int]) -> None:
    for colour, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(image, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thick, cv2.LINE_AA)


def _line(
    image: np.ndarray, start: np.ndarray, end: np.ndarray, colour: tuple[int, ...], wide: int
) -> None:
    cv2.line(image, _pixel(start), _pixel(end), colour, wide, cv2.LINE_AA)


def _pixel(spot: np.ndarray) -> tuple[int, int]:
    return int(spot[0]), int(spot[1])
