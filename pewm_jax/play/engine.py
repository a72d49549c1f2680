"""A world model as the few compiled programs that a drive needs, each with one shape.

Every step is one action, imagined as its own clip and stored in the memory, as in
``worlds.imagine``. So only one program is compiled, whatever keys are pressed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError, World
from pewm_jax.errors import require
from pewm_jax.types import Array, Control, Frames, Params, WorldState

_points = jax.jit(worlds.memory_points, static_argnums=0)
_erase = jax.jit(worlds.erase, static_argnums=0)
_move = jax.jit(worlds.move, static_argnums=0, static_argnames="leave")


@dataclasses.dataclass(frozen=True, eq=False)
class Engine:
    """A trained world model: its name for display, the experiment, its parameters on the device."""

    name: str
    config: Config
    params: Params

    @property
    def model(self) -> World:
        """Return the settings of the model."""
        return self.config.model

    @property
    def size(self) -> tuple[int, int]:
        """Return height and width of the images, pixels."""
        return self.model.clip.height, self.model.clip.width

    @property
    def has_memory(self) -> bool:
        """Return whether the model has a memory."""
        return self.model.capabilities.memory

    @property
    def body(self) -> str:
        """Return the name of the body whose joints steer the model; "" for planar actions."""
        return self.model.capabilities.body

    @property
    def editable(self) -> bool:
        """Return whether boxes of the map can be erased and moved."""
        return self.model.capabilities.edits

    @property
    def cell_m(self) -> float:
        """Return the size at which points of the map are drawn, metres."""
        return float(max(self.model.facts.cell_m[:2], default=0.1))

    @property
    def sampler_steps(self) -> int:
        """Return the number of sampler steps, 0 without a sampler."""
        return self.model.sample_steps

    def with_sampler_steps(self, steps: int) -> Engine:
        """Return the same model with another number of sampler steps, or raise ConfigError."""
        require(self.sampler_steps > 0, f"{self.name} has no sampler with a number of steps.")
        model = self.model.with_sample_steps(steps)
        return dataclasses.replace(self, config=dataclasses.replace(self.config, model=model))

    def start(self, frames: Frames) -> WorldState:
        """Start a world; see ``worlds.start``."""
        return worlds.start(self.model, self.params, frames)

    def imagine(self, world: WorldState, step: np.ndarray | Control, key: Array) -> WorldState:
        """Return the world after one step, including the new frame.

        A step is an action (dx, dy, dyaw), or the control of one frame.
        """
        return worlds.imagine(self.model, self.params, world, _control(step), key)[0]

    def imagine_blind(
        self, world: WorldState, step: np.ndarray | Control, key: Array
    ) -> WorldState:
        """Return the world after one step, without reading or updating the memory."""
        action = _control(step)
        return worlds.imagine(
            self.model, self.params, world, action, key, remember=False, memory=False
        )[0]

    def points(self, world: WorldState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the map: (N, 3) points in metres, (N, 3) uint8 colours, (N,) bool if observed.

        If the memory does not record which points were observed, all count as observed.
        """
        if not self.model.capabilities.points:
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, bool)
        points, features, valid, observed = _points(self.model, world)
        points, features, valid = (np.asarray(x) for x in (points, features, valid))
        colours = np.asarray(self.model.point_colours(features[valid]))
        shown = ((np.clip(colours, -1, 1) + 1) * 127.5).round().astype(np.uint8)
        seen = np.ones(len(shown), bool) if observed is None else np.asarray(observed)[valid]
        return points[valid], shown, seen

    def erase(self, world: WorldState, box_23: np.ndarray) -> WorldState:
        """Erase the content of a box from the map and from the present frame."""
        _require_box(box_23)
        return _erase(self.model, self.params, world, jnp.asarray(box_23, jnp.float32))

    def move(
        self, world: WorldState, box_23: np.ndarray, transform: np.ndarray, *, leave: bool
    ) -> WorldState:
        """Move or copy the content of a box, in the map and in the present frame."""
        _require_box(box_23)
        box, motion = (jnp.asarray(x, jnp.float32) for x in (box_23, transform))
        return _move(self.model, self.params, world, box, motion, leave=leave)


def open_engine(name: str, config: Config, params: Params) -> Engine:
    """Return an engine with its parameters on the device.

    Raises:
        UserError: the model is not a world that can be driven.
    """
    world = worlds.require_world(config.model, f"the viewer of {name}")
    if not (world.capabilities.actions or world.capabilities.body):
        raise UserError(
            f"{name} has neither planar actions (dx, dy, dyaw) nor those of a known body "
            "(control.body), which a drive needs."
        )
    return Engine(name, config, jax.tree.map(jnp.asarray, params))


def _control(step: np.ndarray | Control) -> Any:
    return step if isinstance(step, Control) else np.asarray(step, np.float32)[None]


def _require_box(box_23: np.ndarray) -> None:
    """Raise an error for an invalid box; compiled programs cannot check it."""
    box = np.asarray(box_23)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] >= box[1]).any():
        raise UserError("The box is empty: choose one in the map with a size above 0.")
