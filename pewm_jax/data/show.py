"""Draw an episode as one image: a contact sheet of colour and depth, and the path from above."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import cv2
import jax
import numpy as np
import tyro

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.data.voxels import VoxelFrames, measured_points, table_colours
from pewm_jax.geometry.march import through_pixels
from pewm_jax.io import atomic
from pewm_jax.types import Camera, Frames

THUMB = 128
"""Height of a thumbnail, pixels."""
MARGIN = 8
CEILING_M = 0.6
"""Points this far above the camera are omitted from the view from above, metres."""
BACKGROUND = 24
"""Grey level of the background of images."""
LIGHT = np.array([0.85, 0.7, 1.0, 0.5])
"""Brightness of faces perpendicular to x, y and z, and of the cell in which a ray begins."""
ABOVE_M = 0.5
"""Cells this far above the camera (ceilings) are omitted from the view from above, metres."""
PIXELS = 8
"""Pixels along the side of a cell in the view from above."""


@dataclasses.dataclass(frozen=True)
class ShowConfig:
    """Write a contact sheet of an episode and its path from above as a PNG."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
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
    """Draw an episode and write the image; UserError if there is no such episode."""
    source = EpisodeSource(config.path)
    if not 0 <= config.episode < len(source):
        raise UserError(
            f"--episode {config.episode}: {config.path} has {len(source)} episodes, "
            f"0 to {len(source) - 1}."
        )
    episode = source[config.episode]
    picture = (draw_voxels if config.voxels else draw)(episode, config.columns, config.rows)
    config.out.parent.mkdir(parents=True, exist_ok=True)
    done, code = cv2.imencode(".png", picture[..., ::-1])
    assert done
    atomic.write_bytes(config.out, code.tobytes())
    log(f"{config.out}: {episode.name} in {episode.scene}, {episode.length} frames.")


def draw(episode: Episode, columns: int = 8, rows: int = 2) -> np.ndarray:
    """Return an RGB image: rows of colour and depth, and below them the view from above."""
    chosen, frames, width, farthest = _sampled(episode, columns * rows)
    images = [
        np.vstack(
            [
                _thumb(frames.rgb_THWC[k], width, str(number)),
                _thumb(depth_colours(frames.depth_THW[k], farthest), width),
            ]
        )
        for k, number in enumerate(chosen)
    ]
    sheet = _sheet(images, columns)
    plan = view_from_above(episode, sheet.shape[1] - 2 * MARGIN)
    framed = cv2.copyMakeBorder(
        plan, MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_CONSTANT, value=(BACKGROUND,) * 3
    )
    return np.vstack([sheet, framed])


def _sampled(episode: Episode, most: int) -> tuple[np.ndarray, Frames, int, float]:
    """Return frames to draw: their numbers, images, width of a thumbnail, and largest depth."""
    count = min(most, episode.length)
    chosen = np.round(np.linspace(0, episode.length - 1, count)).astype(int)
    frames = episode.frames(chosen)
    width = max(1, round(THUMB * episode.width / episode.height))
    return chosen, frames, width, max(float(frames.depth_THW.max()), 1e-3)


def _sheet(images: list[np.ndarray], columns: int) -> np.ndarray:
    """Return images of one size in rows."""
    images = images + [np.full_like(images[0], BACKGROUND)] * (-len(images) % columns)
    return np.vstack([np.hstack(images[k : k + columns]) for k in range(0, len(images), columns)])


def draw_voxels(episode: Episode, columns: int = 8, rows: int = 2) -> np.ndarray:
    """Return an RGB image of grids; every frame has a column of five images.

    They are: colour; the grid as the camera sees it; the depths of both, to one scale; and the grid
    from above up to the height of the camera, x to the right, with the camera's field of view.

    Raises:
        UserError: the episode has no voxels.
    """
    chosen, frames, width, farthest = _sampled(episode, columns * rows)
    voxels, images = episode.voxels(chosen), []
    for k, number in enumerate(chosen):
        seen = grid_from_camera(voxels, k, frames.camera, episode.height, episode.width)
        plan = grid_from_above(voxels, k, frames.camera)
        column = [
            _thumb(frames.rgb_THWC[k], width, str(number)),
            _thumb(seen.rgb_HWC, width),
            _thumb(depth_colours(frames.depth_THW[k], farthest), width),
            _thumb(depth_colours(seen.depth_HW, farthest), width),
            _thumb(plan, width),
        ]
        images.append(np.vstack(column))
    return _sheet(images, columns)


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
    spots = pixels(path).tolist()
    turn = episode.info.get("return_frame")
    for k in range(len(spots) - 1):
        done = k / max(1, len(spots) - 2)
        colour = (int(255 * done), int(255 * (1 - done)), 40)
        wide = 7 if turn is not None and k < turn else 2
        cv2.line(image, spots[k], spots[k + 1], colour, wide, cv2.LINE_AA)
    cv2.circle(image, spots[0], 9, (40, 255, 40), -1, cv2.LINE_AA)
    cv2.circle(image, spots[-1], 5, (255, 40, 40), -1, cv2.LINE_AA)
    if turn is not None:
        cv2.circle(image, spots[turn], 12, (255, 255, 255), 2, cv2.LINE_AA)
    below = shape[0] - 10
    cv2.line(image, (10, below), (int(10 + scale), below), (255,) * 3, 2, cv2.LINE_AA)
    _write(image, "1 m", (10, shape[0] - 16))
    plan = np.full((shape[0], width, 3), BACKGROUND, np.uint8)
    plan[:, left : left + shape[1]] = image
    return plan


def _points(episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Return points in the world (N, 3) below the ceiling, and their colours (N, 3)."""
    frames = episode.frames(np.unique(np.linspace(0, episode.length - 1, 60).astype(int)))
    step = max(1, episode.height // 64)
    points, colours = [], []
    for k, pose in enumerate(np.asarray(frames.camera.world_from_camera)):
        world, (v, u) = measured_points(frames.depth_THW[k], episode.intrinsics_4, pose, step)
        low = world[:, 2] < float(pose[2, 3]) + CEILING_M
        points.append(world[low])
        colours.append(frames.rgb_THWC[k][v, u][low])
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


@dataclasses.dataclass(frozen=True)
class GridView:
    """A grid as a camera sees it: shaded colours, z-depth in metres, class ids (0: no hit)."""

    rgb_HWC: np.ndarray
    depth_HW: np.ndarray
    classes_HW: np.ndarray


def grid_from_camera(
    voxels: VoxelFrames, frame: int, camera: Camera, height: int, width: int
) -> GridView:
    """Return the grid of one frame as its camera, one of (T,), sees it."""
    one = Camera(camera.intrinsics_4[frame : frame + 1], camera.world_from_camera[frame][None])
    hits = _march(height, width)(
        voxels.classes_TXYZ[frame], voxels.origin_T3[frame], np.float32(voxels.cell_m), one
    )
    ids, depth, side = (
        np.asarray(x)[0, ..., 0] for x in (hits.ids_L, hits.distance_L, hits.side_L)
    )
    seen = ids > 0
    colours = table_colours(voxels.names)[ids] * LIGHT[side][..., None]
    rgb = np.where(seen[..., None], colours, BACKGROUND).astype(np.uint8)
    return GridView(rgb, np.where(seen, depth, 0).astype(np.float32), ids)


@functools.lru_cache(maxsize=4)
def _march(height: int, width: int):
    """Return the compiled march for an image size."""
    march = functools.partial(through_pixels, height=height, width=width, layers=1)
    return jax.jit(march)


def grid_from_above(voxels: VoxelFrames, frame: int, camera: Camera) -> np.ndarray:
    """Return the grid of one frame from above (RGB, x to the right, y up), with the field of view.

    Of each column the highest cell below ``ABOVE_M`` over the camera is drawn; higher cells are
    lighter.
    """
    grid, origin, cell = voxels.classes_TXYZ[frame], voxels.origin_T3[frame], voxels.cell_m
    pose = np.asarray(camera.world_from_camera[frame], np.float64)
    top = int(np.clip((pose[2, 3] + ABOVE_M - origin[2]) / cell, 1, grid.shape[2]))
    full = grid[:, :, :top] > 0
    height = np.where(full.any(2), top - 1 - full[:, :, ::-1].argmax(2), 0)
    ids = np.take_along_axis(grid[:, :, :top], height[..., None], 2)[..., 0]
    light = 0.55 + 0.45 * height / max(1, top - 1)
    colours = table_colours(voxels.names)[ids] * light[..., None]
    colours = np.where(full.any(2)[..., None], colours, BACKGROUND)
    image = np.repeat(np.repeat(colours.swapaxes(0, 1), PIXELS, 0), PIXELS, 1)
    image = np.ascontiguousarray(image[::-1], np.uint8)
    at = (pose[:2, 3] - origin[:2]) / cell * PIXELS
    fx, width = float(camera.intrinsics_4[frame][0]), 2 * float(camera.intrinsics_4[frame][2])
    for sign in (-1, 0, 1):
        way = (pose[:2, :3] @ [sign * width / 2 / fx, 0.0, 1.0]) * 2.0 / cell * PIXELS
        ends = [(round(x), round(len(image) - 1 - y)) for x, y in (at, at + way)]
        cv2.line(image, ends[0], ends[1], (255, 60, 60), 2, cv2.LINE_AA)
    return image
