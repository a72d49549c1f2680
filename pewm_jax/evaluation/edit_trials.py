"""Does what is placed in a world stay? Measured in its voxels, after many imagined frames.

In each trial a world begins in a recorded grid. A block of one class is put on the floor in front
of the agent, which then walks as recorded. Beside it the same walk without the block is imagined.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Config, PersistConfig, UserError
from pewm_jax.data.progress import Meter
from pewm_jax.evaluation.horizon import Walk
from pewm_jax.geometry.actions import heading
from pewm_jax.memory import class_edit, class_grid
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.models import voxel_renderer
from pewm_jax.types import Params, WorldState
from pewm_jax.worlds import persist
from pewm_jax.worlds import persist_windows as windows

AHEAD_M = (1.25, 1.75, 2.25, 0.75)
"""Distances in front of the agent at which there may be room, metres, the best first."""
BLOCK_M = (0.5, 0.5, 0.75)
"""Size of the block along x, y, z, metres."""
STAYS = 0.5
"""Share of a block's cells that must still have its class."""
SEEN = 4
"""Rays of a frame that must meet the block first for it to count as in sight."""


@dataclasses.dataclass(frozen=True)
class Trials:
    """What came of the trials.

    Attributes:
        kept_N: share of each block's cells that have its class in the end.
        shown: in how many frames a block was in sight of its camera.
        visible: in how many of these the picture is changed more there than elsewhere.
        placed: how many walks had room for a block.
        asked: how many walks there were.
    """

    kept_N: np.ndarray
    shown: int
    visible: int
    placed: int
    asked: int

    def facts(self) -> dict[str, Any]:
        """Return plain values, for a report."""
        kept = self.kept_N
        return {
            "trials": int(self.placed),
            "without_room": int(self.asked - self.placed),
            "stayed": int((kept >= STAYS).sum()),
            "share_of_trials": float((kept >= STAYS).mean()) if len(kept) else 0.0,
            "share_of_cells": float(kept.mean()) if len(kept) else 0.0,
            "frames_in_sight": int(self.shown),
            "changed_in_sight": int(self.visible),
        }


def room(model: PersistConfig, state: WorldState, floor_z: float) -> np.ndarray | None:
    """Return a box (2, 3), metres, of empty cells on the floor in front of the agent, or None."""
    cells = np.asarray(state.map.classes_XYZ)
    low, size = np.asarray(state.map.low_3), windows.cell_m(model)
    pose = np.asarray(state.frame.camera.world_from_camera)[0]
    yaw = float(heading(pose))
    for away in AHEAD_M:
        middle = pose[:2, 3] + away * np.array([np.cos(yaw), np.sin(yaw)])
        corner = np.array([*(middle - np.array(BLOCK_M[:2]) / 2), floor_z])
        first = np.round((corner - low) / size).astype(int)
        count = np.round(np.array(BLOCK_M) / size).astype(int)
        a, b = first, first + count
        if (a < 0).any() or (b > cells.shape).any():
            continue
        if (cells[a[0] : b[0], a[1] : b[1], a[2] : b[2]] == 0).all():
            return np.stack([low + first * size, low + (first + count) * size]).astype(np.float32)
    return None


def run(
    config: Config,
    params: Params,
    walks: Sequence[Walk],
    name: str = "furniture/red",
    batch: int = 8,
    chunk: int = 16,
) -> Trials:
    """Place, walk and look.

    Args:
        config: an experiment of a ``persist`` world.
        params: its weights.
        walks: one for each trial, of one length, with voxels.
        name: class of the blocks.
        batch: walks imagined at once.
        chunk: frames imagined by one call.

    Raises:
        UserError: the walks have no voxels, or there is no such class.
    """
    model: PersistConfig = config.model
    number = class_grid.number_of(model.memory, name)  # type: ignore[arg-type]
    if any(walk.first is None for walk in walks):
        raise UserError("the walks have no voxels: collect them with --voxels.")
    start = jax.jit(functools.partial(persist.start_in, model))
    imagine = functools.partial(persist.imagine, model)
    imagine = jax.jit(jax.vmap(imagine, (None, 0, 0, 0)))
    sight = jax.jit(functools.partial(_sight, model))
    ready: list[tuple[WorldState, WorldState, np.ndarray, np.ndarray]] = []
    for walk in walks:
        assert walk.first is not None
        frames = jax.tree.map(lambda x: x[-1:], walk.context)
        state = start(params, frames, *walk.first)
        floor = float(frames.camera.world_from_camera[0, 2, 3]) - model.memory.eye_m  # type: ignore[attr-defined]
        box = room(model, state, floor)
        if box is not None:
            edited = persist.edit(state, class_edit.place, model.memory, box, number)
            ready.append((state, edited, box, walk.actions_T3))
    kept, shown, visible = [], 0, 0
    steps = len(walks[0].actions_T3)
    with Meter("trials", len(ready), "trials") as meter:
        for at in range(0, len(ready), batch):
            some = ready[at : at + batch]
            filled = some + some[:1] * (batch - len(some))
            plain, edited = (_stacked([one[k] for one in filled]) for k in (0, 1))
            actions = np.stack([one[3] for one in filled])
            for first in range(0, steps, chunk):
                keys = jax.random.split(jax.random.key(at * 1000 + first), batch)
                part = actions[:, first : first + chunk]
                plain, without = imagine(params, plain, part, keys)
                edited, made = imagine(params, edited, part, keys)
            for k, (_, _, box, _) in enumerate(some):
                grid = jax.tree.map(lambda x, k=k: x[k], edited.map)
                held = np.asarray(class_edit.copy(model.memory, grid, box).classes_XYZ)
                count = round(float(np.prod(np.array(BLOCK_M) / windows.cell_m(model))))
                kept.append(float((held == number).sum()) / count)
                now = np.asarray(made.rgb_THWC[k]) - np.asarray(without.rgb_THWC[k])
                change = np.abs(now).mean(-1)
                for t in range(change.shape[0]):
                    camera = jax.tree.map(lambda x, k=k, t=t: x[k, t][None], made.camera)
                    there = np.asarray(sight(grid, camera, jnp.asarray(box)))
                    if there.sum() >= SEEN:
                        shown += 1
                        large = np.kron(there, np.ones(np.array(change[t].shape) // there.shape))
                        inside = change[t][large > 0].mean()
                        outside = change[t][large == 0].mean()
                        visible += int(inside > 2 * outside)
            meter.advance(len(some))
    return Trials(np.array(kept), shown, visible, len(ready), len(walks))


def _sight(model: PersistConfig, grid: ClassGrid, camera: Any, box_23: Any) -> Any:
    """Return (rows, columns) bool: which rays of a camera first meet a cell of a box."""
    place = camera.world_from_camera[0, :3, 3]
    first = windows.first_cell(model, grid.low_3, place)
    marked = class_edit.place(model.memory, grid, box_23, 1)
    unmarked = class_edit.place(model.memory, grid, box_23, 0)
    both = [
        voxel_renderer.look(
            model.backbone.renderer,  # type: ignore[attr-defined]
            jnp.maximum(windows.window(model, one.classes_XYZ, first), 0)[None],
            (grid.low_3 + first * windows.cell_m(model))[None],
            windows.cell_m(model),
            camera,
            (model.clip.height, model.clip.width),
        )
        for one in (marked, unmarked)
    ]
    apart = [(one.ids_L[0, ..., 0], one.distance_L[0, ..., 0]) for one in both]
    (ids, depth), (other, beyond) = apart
    return (ids != other) | (jnp.abs(depth - beyond) > 1e-3)


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(part) for part in x]), *trees)
