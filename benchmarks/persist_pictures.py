"""Pictures of a world of voxels: grown from one image, and an edit that stays.

    python benchmarks/persist_pictures.py runs/persist_tiny --out docs/persist

``grown.png``: a world that begins with one image, while the agent turns around once: what is
imagined, the imagined voxels in the colours of their classes, and the recorded ones beside them.
``edit.png``: a block is placed in a recorded grid; the agent walks away and comes back.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from pewm_jax import worlds
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval import voxel_trials
from pewm_jax.memory import class_grid
from pewm_jax.memory import interface as memories
from pewm_jax.report.pictures import as_bytes, grid, save_png
from pewm_jax.types import Camera
from pewm_jax.worlds import rollouts
from pewm_jax.worlds.persist import world as persist

TURN_DEG, STEP_M = 30.0, 0.25
PIXELS = 96


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is shown."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of a trained world of voxels."""
    data: Path = Path("data/persist_long")
    """Data set with voxels."""
    split: str = "revisit"
    """Folder inside it."""
    episode: int = 0
    """Number of the episode."""
    frame: int = 8
    """Frame that the worlds begin with."""
    out: Path = Path("docs/persist")
    """Folder of the pictures."""
    steps: int = 0
    """Steps of the samplers; 0 for the run's own."""


def main(settings: Settings) -> None:
    """Draw both."""
    config, params = rollouts.load_finished(settings.run)
    if settings.steps:
        noise = dataclasses.replace(config.model.noise, sample_steps=settings.steps)
        voxel_noise = dataclasses.replace(config.model.voxel_noise, sample_steps=settings.steps)
        config = config.with_model(noise=noise, voxel_noise=voxel_noise)
    model = config.model
    episode = EpisodeSource(settings.data / settings.split)[settings.episode]
    frames = jax.tree.map(jnp.asarray, episode.frames([settings.frame]))
    cells = episode.voxels([settings.frame])
    known = jnp.asarray(cells.classes_TXYZ[0]), jnp.asarray(cells.origin_T3[0])
    settings.out.mkdir(parents=True, exist_ok=True)

    look = jax.jit(functools.partial(_look, model))
    imagine = jax.jit(worlds.imagine, static_argnums=0)
    turn = np.array([0, 0, np.radians(TURN_DEG)], np.float32)
    ahead = np.array([STEP_M, 0, 0], np.float32)
    grown = jax.jit(worlds.start, static_argnums=0)(model, params, frames)
    true = jax.jit(persist.start_in, static_argnums=0)(model, params, frames, *known)
    still = np.zeros(3, np.float32)
    around = np.stack([*[turn] * 12, *[still] * 5])  # as long as the way below: compiled once
    after, made = imagine(model, params, grown, around, jax.random.key(0))
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

    eye = model.memory.eye_m
    floor = float(frames.camera.world_from_camera[0, 2, 3]) - eye
    box = voxel_trials.room(model, true, floor)
    if box is None:
        print("no room for a block in front of the agent: name another --frame.")
        return
    number = class_grid.number_of(model.memory, "furniture/red")
    edited = persist.edit(true, class_grid.place, model.memory, box, number)
    way = np.stack([still, *[turn] * 6, ahead, ahead, *[turn] * 6, ahead, ahead])
    after, made = imagine(model, params, edited, way, jax.random.key(1))
    _, plain = imagine(model, params, true, way, jax.random.key(1))
    moments = (("placed", 0), ("turning", 3), ("away", 8), ("turning back", 12), ("back", 16))
    rows = [
        ("with the block", [first, *(made.rgb_THWC[t] for _, t in moments)]),
        ("without", [first, *(plain.rgb_THWC[t] for _, t in moments)]),
        (
            "voxels in the end",
            [look(true.map, frames.camera)]
            + [look(after.map, _at(made.camera, t)) for _, t in moments],
        ),
    ]
    _save(settings.out / "edit.png", rows, ["before", *(name for name, _ in moments)])


def _look(model, grid, camera) -> jax.Array:
    """Return the cells in the colours of their classes, seen by a camera."""
    scale = jnp.asarray([PIXELS / model.clip.width] * 2 + [PIXELS / model.clip.width] * 2)
    seen = Camera(camera.intrinsics_4 * scale, camera.world_from_camera)
    view = memories.render(model, grid, seen, PIXELS, PIXELS)
    shade = jnp.clip(1.1 - view.depth_THW[0] / 8, 0.35, 1)[..., None]
    return jnp.where(view.seen_THW[0, ..., None], (view.features_THWF[0] + 1) * shade - 1, -1.0)


def _at(camera: Camera, t: int) -> Camera:
    return jax.tree.map(lambda x: x[t : t + 1], camera)


def _save(path: Path, rows, columns) -> None:
    drawn = [(name, [as_bytes(np.asarray(x)) for x in pictures]) for name, pictures in rows]
    save_png(path, grid(drawn, columns, cell=112))
    print(path)


if __name__ == "__main__":
    main(tyro.cli(Settings))
