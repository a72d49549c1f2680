"""Trials in a voxel world: whether placed blocks persist, and what the 3D VAE reconstructs.

In each trial a world starts from a recorded grid. A block of one class is placed on the floor in
front of the agent, which then moves as recorded. The same walk without the block is imagined for
comparison. Cells outside the window around the agent cannot change; inside,
``model.persistence_logit`` preserves them. The report also states how many frames had a part of the
block in their window.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.eval.horizon import RecordedWalk
from pewm_jax.geometry.actions import heading
from pewm_jax.io.progress import Meter
from pewm_jax.memory import class_grid
from pewm_jax.memory.class_grid import ClassGrid
from pewm_jax.models.persist import voxel_renderer, voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.types import Array, Params, WorldState
from pewm_jax.worlds.persist import state as windows
from pewm_jax.worlds.persist import world as persist
from pewm_jax.worlds.persist.world import PERSIST

AHEAD_M = (1.25, 1.75, 2.25, 0.75)
"""Distances in front of the agent at which a block may be placed, metres, in order of
preference."""
BLOCK_M = (0.5, 0.5, 0.75)
"""Size of the block along x, y, z, metres."""
STAYS = 0.5
"""Share of a block's cells that must still have its class."""
SEEN = 4
"""Number of rays of a frame that must hit the block first for it to count as visible."""


@dataclasses.dataclass(frozen=True)
class Trials:
    """The results of the trials.

    Attributes:
        kept_N: share of each block's cells that have its class at the end.
        shown: number of frames in which a block was visible, but did not fill the view.
        visible: number of these in which the image changed more at the block than elsewhere.
        within: number of frames in which a block was in the window that may change.
        frames: number of frames of all walks with a block.
        asked: number of walks, with or without room for a block.
    """

    kept_N: np.ndarray
    shown: int
    visible: int
    within: int
    frames: int
    asked: int
    persistence_logit: float

    def facts(self) -> dict[str, Any]:
        """Return plain values, for a report."""
        kept = self.kept_N
        return {
            "trials": len(kept),
            "without_room": self.asked - len(kept),
            "stayed": int((kept >= STAYS).sum()),
            "share_of_trials": float((kept >= STAYS).mean()) if len(kept) else 0.0,
            "share_of_cells": float(kept.mean()) if len(kept) else 0.0,
            "frames_in_sight": int(self.shown),
            "changed_in_sight": int(self.visible),
            "frames": int(self.frames),
            "frames_in_window": int(self.within),
            "persistence_logit": float(self.persistence_logit),
        }


def room(model: PERSIST, state: WorldState, floor_z: float) -> np.ndarray | None:
    """Return a box (2, 3), metres, of empty cells on the floor in front of the agent, or None."""
    cells = np.asarray(state.map.classes_XYZ)
    low, size = np.asarray(state.map.low_3), model.cell
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


def block_class(config: Config, walks: Sequence[RecordedWalk], name: str = "") -> int:
    """Return the id of the class that blocks are made of: by default the first kind of furniture.

    Raises:
        UserError: the walks have no voxels, or there is no such class.
    """
    if any(walk.first is None for walk in walks):
        raise UserError("the walks have no voxels: collect them with --voxels.")
    table = class_grid.names(config.model.memory)
    furniture = (each for each in table if each.startswith("furniture"))
    return class_grid.number_of(config.model.memory, name or next(furniture, table[-1]))


def run(
    config: Config,
    params: Params,
    walks: Sequence[RecordedWalk],
    name: str = "",
    batch: int = 8,
    chunk: int = 16,
    count: int | None = None,
) -> Trials:
    """Run the trials: place a block, imagine the walk, and measure persistence and visibility.

    There is a trial for each of the walks with voxels, of equal length, until there are ``count``.
    ``name`` is the class of the blocks and may raise, see ``block_class``. ``batch`` walks are
    imagined at once, ``chunk`` frames per call.
    """
    model: PERSIST = config.model
    number = block_class(config, walks, name)
    start = jax.jit(functools.partial(persist.start_in, model))
    imagine = jax.jit(jax.vmap(model.imagine, (None, 0, 0, 0)))
    look = jax.jit(functools.partial(_rays_on_block, model))
    ready: list[_Trial] = []
    looked = 0
    for walk in walks:
        if len(ready) == count:
            break
        looked += 1
        assert walk.first is not None
        frames = jax.tree.map(lambda x: x[-1:], walk.context)
        state = start(params, frames, *walk.first)
        floor = float(frames.camera.world_from_camera[0, 2, 3]) - model.memory.eye_m  # type: ignore[attr-defined]
        box = room(model, state, floor)
        if box is not None:
            edited = persist.edit(state, class_grid.place, model.memory, box, number)
            cells = _cells(model, edited.map, box, number)
            ready.append(_Trial(state, edited, box, walk.actions_T3, cells))
    kept, seen = [], np.zeros(3, int)
    steps = len(walks[0].actions_T3)
    with Meter("trials", len(ready), "trials") as meter:
        for at in range(0, len(ready), batch):
            some = ready[at : at + batch]
            filled = some + some[:1] * (batch - len(some))
            plain, edited = (_stack([x[k] for x in filled]) for k in (0, 1))
            actions = np.stack([trial.actions_T3 for trial in filled])
            for first in range(0, steps, chunk):
                keys = jax.random.split(jax.random.key(at * 1000 + first), batch)
                part = actions[:, first : first + chunk]
                plain, without = imagine(params, plain, part, keys)
                edited, made = imagine(params, edited, part, keys)
                change = np.abs(np.asarray(made.rgb_THWC) - np.asarray(without.rgb_THWC)).mean(-1)
                for k, trial in enumerate(some):
                    grid = jax.tree.map(lambda x, k=k: x[k], edited.map)
                    for t in range(change.shape[1]):
                        camera = jax.tree.map(lambda x, k=k, t=t: x[k, t][None], made.camera)
                        there, within = look(grid, camera, jnp.asarray(trial.box_23))
                        seen += [*block_visibility(np.asarray(there), change[k, t]), bool(within)]
            for k, trial in enumerate(some):
                grid = jax.tree.map(lambda x, k=k: x[k], edited.map)
                kept.append(_cells(model, grid, trial.box_23, number) / trial.cells)
            meter.advance(len(some))
    shown, visible, within = (int(x) for x in seen)
    frames = steps * len(ready)
    return Trials(np.array(kept), shown, visible, within, frames, looked, model.persistence_logit)


def block_visibility(there_hw: np.ndarray, change_HW: np.ndarray) -> tuple[bool, bool]:
    """Return whether a block is visible, and whether the image changed more there.

    ``there_hw`` are the rays that hit the block first, ``change_HW`` the difference of pixels from
    the same walk without the block.
    """
    rows, columns = (
        np.arange(size) * rays // size
        for size, rays in zip(change_HW.shape, there_hw.shape, strict=True)
    )
    large = there_hw[rows][:, columns]
    if there_hw.sum() < SEEN or large.all():
        return False, False
    return True, bool(change_HW[large].mean() > 2 * change_HW[~large].mean())


class _Trial(NamedTuple):
    """A walk with room for a block: its world without and with the block."""

    plain: WorldState
    edited: WorldState
    box_23: np.ndarray
    actions_T3: np.ndarray
    cells: int


def _cells(model: PERSIST, grid: ClassGrid, box_23: np.ndarray, number: int) -> int:
    """Return the number of cells of a box that have a class."""
    held = class_grid.copy(model.memory, grid, jnp.asarray(box_23))
    return int((held.classes_XYZ == number).sum())


def _rays_on_block(
    model: PERSIST, grid: ClassGrid, camera: Any, box_23: Any
) -> tuple[Array, Array]:
    """Return which rays first hit a cell of a box, and whether the window contains such a cell."""
    place = camera.world_from_camera[0, :3, 3]
    first = windows.first_cell(model, grid.low_3, place)
    marked = class_grid.place(model.memory, grid, box_23, 1)
    unmarked = class_grid.place(model.memory, grid, box_23, 0)
    both = [
        voxel_renderer.cast_rays(
            model.backbone.renderer,  # type: ignore[attr-defined]
            jnp.maximum(windows.window(model, one.classes_XYZ, first), 0)[None],
            (grid.low_3 + first * model.cell)[None],
            model.cell,
            camera,
            (model.clip.height, model.clip.width),
        )
        for one in (marked, unmarked)
    ]
    apart = [(one.ids_L[0, ..., 0], one.distance_L[0, ..., 0]) for one in both]
    (ids, depth), (other, beyond) = apart
    low = grid.low_3 + first * model.cell
    high = low + model.side * model.cell
    within = jnp.all((box_23[1] > low) & (box_23[0] < high))
    return (ids != other) | (jnp.abs(depth - beyond) > 1e-3), within


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(part) for part in x]), *trees)


EVERY = 40
"""Number of frames of a walk between the grids that are evaluated."""


def reconstruction_shares(
    model: PERSIST, params: Params, grids: Sequence[np.ndarray]
) -> dict[str, float]:
    """Return the shares of cells whose class the autoencoder reconstructs.

    ``grids`` are (T, X, Y, Z) class ids of each walk's frames, 0 where there is nothing; grids
    larger than the autoencoder's are cropped at the centre. Returns ``grids``, the number of grids
    evaluated; of the occupied cells the shares ``occupied`` (with their class) and ``filled`` (as
    occupied); and ``empty``, that of empty cells.
    """
    config = model.backbone.voxel_vae  # type: ignore[attr-defined]
    again = jax.jit(functools.partial(_reconstruct, config))
    right = filled = occupied = clear = empty = count = 0
    for walk in grids:
        low = [(size - config.side) // 2 for size in walk.shape[1:]]
        x, y, z = (slice(at, at + config.side) for at in low)
        for grid in walk[::EVERY, x, y, z].astype(np.int32):
            back, there = np.asarray(again(params["voxel_vae"], grid[None])[0]), grid > 0
            right += int((back == grid)[there].sum())
            filled += int((back > 0)[there].sum())
            clear += int((back == 0)[~there].sum())
            occupied, empty = occupied + int(there.sum()), empty + int((~there).sum())
            count += 1
    return {
        "grids": count,
        "occupied": right / max(occupied, 1),
        "filled": filled / max(occupied, 1),
        "empty": clear / max(empty, 1),
    }


def _reconstruct(config: VoxelVAEConfig, params: Params, grid_BXYZ: Array) -> Array:
    return voxel_vae.decode(config, params, voxel_vae.encode(config, params, grid_BXYZ))
