"""A world model, compiled: the few programs that a drive needs, each of one shape.

Every step is one action, imagined as a clip of its own and remembered, as ``worlds.imagine`` does.
So there is one program to compile, whatever keys are pressed.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, ModelConfig, UserError
from pewm_jax.errors import require
from pewm_jax.memory import memories, views
from pewm_jax.types import Array, Frames, Params, WorldState

_points = jax.jit(memories.to_points, static_argnums=0)
_erase = jax.jit(memories.erase, static_argnums=0)
_move = jax.jit(memories.move, static_argnums=0, static_argnames="leave")


@dataclasses.dataclass(frozen=True, eq=False)
class Engine:
    """A trained world model.

    Attributes:
        name: for people.
        config: the experiment.
        params: its parameters, on the device.
    """

    name: str
    config: Config
    params: Params

    @property
    def model(self) -> ModelConfig:
        """The settings of the model."""
        return self.config.model

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images, pixels."""
        return self.model.clip.height, self.model.clip.width

    @property
    def forgets(self) -> bool:
        """Whether there is a memory to go without."""
        return self.model.memory.REMEMBERS

    @property
    def editable(self) -> bool:
        """Whether boxes of the map can be erased and moved."""
        return memories.editable(self.model)

    @property
    def sampler_steps(self) -> int:
        """Steps of the sampler, 0 if it has none."""
        return int(getattr(self.model.noise, "sample_steps", 0))

    def with_sampler_steps(self, steps: int) -> Engine:
        """Return the same model with another number of the sampler's steps.

        Raises:
            ConfigError: the sampler cannot take so many.
        """
        require(self.sampler_steps > 0, f"{self.name} has no steps of a sampler to choose.")
        noise = dataclasses.replace(self.model.noise, sample_steps=steps)  # type: ignore[call-arg]
        model = dataclasses.replace(self.model, noise=noise)
        return dataclasses.replace(self, config=dataclasses.replace(self.config, model=model))

    def start(self, frames: Frames) -> WorldState:
        """Begin a world; see ``worlds.start``."""
        return worlds.start(self.model, self.params, frames)

    def imagine(self, world: WorldState, action_3: np.ndarray, key: Array) -> WorldState:
        """Return the world after one action (dx, dy, dyaw); its frame is what is seen then."""
        action = np.asarray(action_3, np.float32)[None]
        return worlds.imagine(self.model, self.params, world, action, key)[0]

    def imagine_blind(self, world: WorldState, action_3: np.ndarray, key: Array) -> WorldState:
        """Return the same, the memory neither looked at nor added to."""
        action = np.asarray(action_3, np.float32)[None]
        return worlds.imagine(
            self.model, self.params, world, action, key, remember=False, memory=False
        )[0]

    def points(self, world: WorldState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the map: (N, 3) points in metres, (N, 3) uint8 colours, (N,) bool if observed.

        Where a memory does not tell, everything counts as observed.
        """
        points, features, valid = (np.asarray(x) for x in _points(self.model, world.map))
        colours = memories.colours(self.model, features[valid])
        shown = ((np.clip(colours, -1, 1) + 1) * 127.5).round().astype(np.uint8)
        observed = getattr(world.map, "observed_V", None)
        told = np.ones(len(shown), bool) if observed is None else np.asarray(observed)[valid]
        return points[valid], shown, told

    def erase(self, world: WorldState, box_23: np.ndarray) -> WorldState:
        """Forget what is in a box, in the map and in the present picture."""
        _require_box(box_23)
        changed = _erase(self.model, world.map, jnp.asarray(box_23, jnp.float32))
        return _looked_at(self.model, world, changed)

    def move(
        self, world: WorldState, box_23: np.ndarray, transform: np.ndarray, *, leave: bool
    ) -> WorldState:
        """Move or copy what is in a box, in the map and in the present picture."""
        _require_box(box_23)
        box, motion = (jnp.asarray(x, jnp.float32) for x in (box_23, transform))
        changed = _move(self.model, world.map, box, motion, leave=leave)
        return _looked_at(self.model, world, changed)


def open_engine(name: str, config: Config, params: Params) -> Engine:
    """Return an engine, its parameters on the device.

    Raises:
        UserError: these are no parameters of a world that can be driven.
    """
    if not isinstance(config.model, ModelConfig):
        raise UserError(
            f"{name} is no world that imagines RGB-D frames and remembers them; drive a run of a "
            "world model, such as small."
        )
    if not config.model.clip.depth:
        raise UserError(
            f"{name} imagines no depth (clip.depth), so there is no map to drive in; take a run "
            "with depth."
        )
    return Engine(name, config, jax.tree.map(jnp.asarray, params))


@functools.partial(jax.jit, static_argnums=0)
def _looked_at(model: ModelConfig, world: WorldState, changed: memories.Memory) -> WorldState:
    """Return a world with a changed map, whose present frame shows the change.

    The next clip is imagined from the present frame, too: what was erased would be copied from it.
    So its pixels are taken from the map where the map looks different now; holes are filled with
    what is nearest to them. Memories that cannot be looked at in colours leave the frame as it is.
    """
    frame = world.frame
    if not memories.shows_colours(model):
        return WorldState(frame, changed)
    size = (model.clip.height, model.clip.width)
    before, after = (memories.render(model, m, frame.camera, *size) for m in (world.map, changed))
    apart = jnp.abs(before.features_THWF - after.features_THWF).max(-1) > 1e-3
    apart = apart | (before.seen_THW != after.seen_THW)
    apart = apart | (jnp.abs(before.depth_THW - after.depth_THW) > 1e-3)
    whole = views.fill_nearest(after)
    rgb = jnp.where(apart[..., None], whole.features_THWF[..., :3], frame.rgb_THWC)
    depth = jnp.where(apart, whole.depth_THW, frame.depth_THW)
    return WorldState(Frames(rgb, depth, frame.camera), changed)


def _require_box(box_23: np.ndarray) -> None:
    """Refuse what is no box, which compiled programs do not check."""
    box = np.asarray(box_23)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] >= box[1]).any():
        raise UserError("The box has no inside: choose one in the map with a size above 0.")
