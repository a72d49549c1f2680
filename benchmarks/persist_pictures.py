"""Pictures of a world of voxels: worlds from single images, and edits that stay.

    python benchmarks/persist_pictures.py runs/persist_tiny --out docs/persist

``--what`` chooses:

* ``grown``: a world that begins with one image, while the agent turns around once: what is
  imagined, the imagined voxels in the colours of their classes, and the recorded ones beside them.
* ``edit``: a block is placed in a recorded grid; the agent walks away and comes back.
* ``worlds``: 16 worlds from one image each, chosen by index: the image, the voxels from above, four
  views turned by 90°, and the truth of all of these.
* ``edits``: videos without and with an edit, made while the agent is in another room, which then
  walks there: a wall is moved, a door opened, a chair removed.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from pewm_jax import worlds
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.data.render import draw_blocks
from pewm_jax.data.voxels import VoxelFrames, table_colours
from pewm_jax.eval import voxel_edits, voxel_trials
from pewm_jax.io import atomic
from pewm_jax.memory import class_grid
from pewm_jax.memory import interface as memories
from pewm_jax.report.pictures import as_bytes, grid, save_png
from pewm_jax.report.video import encode_h264, small_frames
from pewm_jax.types import Camera
from pewm_jax.worlds import rollouts
from pewm_jax.worlds.persist import world as persist

TURN_DEG, STEP_M = 30.0, 0.25
PIXELS = 96
WORLDS, VIEWS = 16, 4
"""Worlds from single images, and views of each."""
HEADROOM_M = 0.4
"""Cells above this height over the camera, the ceiling, are left out from above."""
UNKNOWN_GREY = 96


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is shown."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of a trained world of voxels, or the name of one that ships."""
    what: tuple[Literal["grown", "edit", "worlds", "edits"], ...] = ("grown", "edit")
    """Which pictures to draw."""
    data: Path = Path("data/persist_long")
    """Data set with voxels."""
    split: str = "revisit"
    """Folder inside it."""
    episode: int = 0
    """Number of the episode, of `grown` and `edit`."""
    frame: int = 8
    """Frame that the worlds begin with, except those of `edits`."""
    out: Path = Path("docs/persist")
    """Folder of the pictures."""
    steps: int = 0
    """Steps of the samplers; 0 for the run's own."""


def main(settings: Settings) -> None:
    """Draw them."""
    config, params = rollouts.load_finished(settings.run)
    if settings.steps:
        noise = dataclasses.replace(config.model.noise, sample_steps=settings.steps)
        voxel_noise = dataclasses.replace(config.model.voxel_noise, sample_steps=settings.steps)
        config = config.with_model(noise=noise, voxel_noise=voxel_noise)
    episodes = EpisodeSource(settings.data / settings.split)
    settings.out.mkdir(parents=True, exist_ok=True)
    imagine = jax.jit(worlds.imagine, static_argnums=0)
    draw = {"grown": grown, "edit": edit, "worlds": single_images, "edits": edits}
    for what in settings.what:
        draw[what](settings, config.model, params, episodes, imagine)


def grown(settings: Settings, model, params, episodes, imagine) -> None:
    """Draw ``grown.png``."""
    frames, known = _given(episodes[settings.episode], settings.frame)
    look = jax.jit(functools.partial(_look, model))
    turn = np.array([0, 0, np.radians(TURN_DEG)], np.float32)
    begun = jax.jit(worlds.start, static_argnums=0)(model, params, frames)
    true = jax.jit(persist.start_in, static_argnums=0)(model, params, frames, *known)
    still = np.zeros(3, np.float32)
    around = np.stack([*[turn] * 12, *[still] * 5])  # as long as the way of ``edit``
    after, made = imagine(model, params, begun, around, jax.random.key(0))
    shown = [0, *range(1, 12, 2)]
    cameras = [frames.camera if t == 0 else _at(made.camera, t - 1) for t in shown]
    first = frames.rgb_THWC[0]
    rows = [
        ("imagined", [first if t == 0 else made.rgb_THWC[t - 1] for t in shown]),
        ("its voxels", [look(after.map, camera) for camera in cameras]),
        ("recorded voxels", [look(true.map, camera) for camera in cameras]),
    ]
    columns = ["given", *(f"{t * TURN_DEG:.0f}°" for t in shown[1:])]
    _save(settings.out / "grown.png", rows, columns)


def edit(settings: Settings, model, params, episodes, imagine) -> None:
    """Draw ``edit.png``."""
    frames, known = _given(episodes[settings.episode], settings.frame)
    look = jax.jit(functools.partial(_look, model))
    true = jax.jit(persist.start_in, static_argnums=0)(model, params, frames, *known)
    floor = float(frames.camera.world_from_camera[0, 2, 3]) - model.memory.eye_m
    box = voxel_trials.room(model, true, floor)
    if box is None:
        print("no room for a block in front of the agent: name another --frame.")
        return
    turn = np.array([0, 0, np.radians(TURN_DEG)], np.float32)
    ahead, still = np.array([STEP_M, 0, 0], np.float32), np.zeros(3, np.float32)
    number = class_grid.number_of(model.memory, "furniture/red")
    edited = persist.edit(true, class_grid.place, model.memory, box, number)
    way = np.stack([still, *[turn] * 6, ahead, ahead, *[turn] * 6, ahead, ahead])
    after, made = imagine(model, params, edited, way, jax.random.key(1))
    _, plain = imagine(model, params, true, way, jax.random.key(1))
    first = frames.rgb_THWC[0]
    moments = (("placed", 0), ("turning", 3), ("away", 8), ("turning back", 12), ("back", 16))
    last = [look(after.map, _at(made.camera, t)) for _, t in moments]
    rows = [
        ("with the block", [first, *(made.rgb_THWC[t] for _, t in moments)]),
        ("without", [first, *(plain.rgb_THWC[t] for _, t in moments)]),
        ("voxels in the end", [look(true.map, frames.camera), *last]),
    ]
    _save(settings.out / "edit.png", rows, ["before", *(name for name, _ in moments)])


def single_images(settings: Settings, model, params, episodes, imagine) -> None:
    """Draw ``worlds.png``: world k begins with frame ``--frame`` of episode k, and so on anew."""
    start = jax.jit(worlds.start, static_argnums=0)
    turn = np.array([0, 0, np.radians(TURN_DEG)], np.float32)
    quarter = round(360 / VIEWS / TURN_DEG)
    rows = []
    for number in range(WORLDS):
        episode = episodes[number % len(episodes)]
        at = settings.frame + number // len(episodes) * settings.frame
        frames, _ = _given(episode, at)
        recorded = episode.voxels([at])
        after, made = imagine(
            model, params, start(model, params, frames), np.stack([turn] * 12), jax.random.key(0)
        )
        views = [quarter * (k + 1) - 1 for k in range(VIEWS)]
        cameras = jax.tree.map(lambda x, views=views: np.asarray(x)[views], made.camera)
        same = VoxelFrames(
            np.repeat(recorded.classes_TXYZ, VIEWS, 0),
            np.repeat(recorded.origin_T3, VIEWS, 0),
            recorded.cell_m,
            recorded.names,
        )
        truth = draw_blocks(same, cameras, model.clip.height, model.clip.width).rgb_THWC
        eye = np.asarray(frames.camera.world_from_camera)[0, :3, 3]
        true = class_grid.ClassGrid(recorded.classes_TXYZ[0], recorded.origin_T3[0])
        row = [frames.rgb_THWC[0], from_above(model, after.map, eye)]
        row += [made.rgb_THWC[t] for t in views]
        row += [from_above(model, true, eye), *truth]
        rows.append((f"{number}", row))
    turned = [f"{90 * (k + 1)}°" for k in range(VIEWS)]
    columns = ["image", "from above", *turned, "truth", *turned]
    _save(settings.out / "worlds.png", rows, columns, cell=80)


def from_above(model, grid_: class_grid.ClassGrid, eye_3: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8: the cells around the agent from above, without the ceiling.

    The agent is in the middle; a window's side is shown; x is to the right and y up. Unknown cells
    are grey, and the agent's own cell is red.
    """
    cell, side = model.cell, model.side
    cells, low = np.asarray(grid_.classes_XYZ).astype(int), np.asarray(grid_.low_3)
    at = np.floor((eye_3 - low) / cell).astype(int)
    top = min(int((eye_3[2] + HEADROOM_M - low[2]) / cell), cells.shape[2])
    colours = table_colours(class_grid.names(model.memory))
    pictured = np.full((side, side, 3), UNKNOWN_GREY, np.uint8)
    for x in range(side):
        for y in range(side):
            i, j = at[0] - side // 2 + x, at[1] - side // 2 + y
            if not (0 <= i < cells.shape[0] and 0 <= j < cells.shape[1]):
                continue
            column = cells[i, j, :top]
            filled = np.flatnonzero(column > 0)
            if len(filled):
                shade = 0.55 + 0.45 * (filled[-1] + 1) / top
                pictured[side - 1 - y, x] = colours[column[filled[-1]]] * shade
            elif (column == class_grid.EMPTY).any():
                pictured[side - 1 - y, x] = 0
    pictured[side - 1 - side // 2, side // 2] = 220, 40, 40
    scale = max(model.clip.width // side, 1)
    return np.repeat(np.repeat(pictured, scale, 0), scale, 1)


def edits(settings: Settings, model, params, episodes, imagine) -> None:
    """Write a video and a strip for each kind of edit, ``edit_wall.mp4`` and so on."""
    start = jax.jit(persist.start_in, static_argnums=0)
    for kind in voxel_edits.KINDS:
        episode, plan = voxel_edits.first_plan(model, episodes, kind)
        if episode is None or plan is None:
            print(f"{kind}: no walk leads from another room to one; collect more episodes.")
            continue
        frames, known = _given(episode, plan.start)
        plain = start(model, params, frames, *known)
        changed = voxel_edits.apply(model, plain, plan)
        actions = np.asarray(episode.actions)[plan.start : plan.end]
        made = [
            as_bytes(
                np.asarray(imagine(model, params, state, actions, jax.random.key(2))[1].rgb_THWC)
            )
            for state in (plain, changed)
        ]
        truth = episode.frames(range(plan.start + 1, plan.end + 1)).rgb_THWC
        first = np.asarray(episode.frames([plan.start]).rgb_THWC)
        names = ("before the edit", plan.about, "truth, not edited")
        films = [
            (n, np.concatenate([first, x])) for n, x in zip(names, (*made, truth), strict=True)
        ]
        pictures = [x[: x.shape[0] // 2 * 2, : x.shape[1] // 2 * 2] for x in small_frames(films)]
        with atomic.replacing(settings.out / f"edit_{kind}.mp4") as partial:
            partial.write_bytes(encode_h264(pictures, 6))
        shown = _shown_frames(plan.changed_T)
        rows = [(name, [film[t] for t in shown]) for name, film in films]
        _save(settings.out / f"edit_{kind}.png", rows, [f"{t}" for t in shown])
        print(f"{kind}: {episode.name}, frames {plan.start} to {plan.end}, {plan.about}")


def _shown_frames(changed_T: np.ndarray) -> list[int]:
    """Return the first frame, and the seven in which the edit changes most pixels."""
    return [0, *sorted((np.argsort(-changed_T, kind="stable")[:7] + 1).tolist())]


def _given(episode: Episode, frame: int):
    """Return a frame (1,), and the recorded grid around it with its lowest corner."""
    cells = episode.voxels([frame])
    known = jnp.asarray(cells.classes_TXYZ[0]), jnp.asarray(cells.origin_T3[0])
    return jax.tree.map(jnp.asarray, episode.frames([frame])), known


def _look(model, grid_, camera) -> jax.Array:
    """Return the cells in the colours of their classes, seen by a camera."""
    scale = jnp.asarray([PIXELS / model.clip.width] * 2 + [PIXELS / model.clip.width] * 2)
    seen = Camera(camera.intrinsics_4 * scale, camera.world_from_camera)
    view = memories.render(model, grid_, seen, PIXELS, PIXELS)
    shade = jnp.clip(1.1 - view.depth_THW[0] / 8, 0.35, 1)[..., None]
    return jnp.where(view.seen_THW[0, ..., None], (view.features_THWF[0] + 1) * shade - 1, -1.0)


def _at(camera: Camera, t: int) -> Camera:
    return jax.tree.map(lambda x: x[t : t + 1], camera)


def _save(path: Path, rows, columns, cell: int = 112) -> None:
    drawn = [(name, [as_bytes(np.asarray(x)) for x in pictures]) for name, pictures in rows]
    save_png(path, grid(drawn, columns, cell=cell))
    print(path)


if __name__ == "__main__":
    main(tyro.cli(Settings))
