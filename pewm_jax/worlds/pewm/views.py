"""Views of one memory, each camera rendered once for all candidates that are ever compared.

Discrete actions lead to the same places by many ways, and the candidates of a search resemble each
other the more the longer it lasts. What a memory shows depends on the camera alone, so it is kept.
Equal means equal to a millionth of a metre: the same turns in another order differ in their last
bits. The views are those of the rounded cameras, whatever was asked for before.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import ModelConfig
from pewm_jax.memory import interface as memories
from pewm_jax.types import Array, Camera, Params, View, WorldState
from pewm_jax.worlds.control import control_of

FINE = 2.0**-20
"""Numbers of cameras are rounded to multiples of this, about a millionth of a metre."""
AT_ONCE = 8
"""Cameras that one call renders at most. The program has this size, however many are missing."""
MOST = 512 * 2**20
"""Bytes of views that are kept; when there would be more, all are forgotten."""


class Views:
    """The views of one memory; a callable that remembers. On the host, not under jit.

    Args:
        model: the model.
        state: the world whose memory is looked at.
    """

    def __init__(self, model: ModelConfig, state: WorldState):
        self.model, self.state = model, state
        self.rendered = 0
        self._known: dict[bytes, list[np.ndarray]] = {}
        self._form: Any = None
        self._bytes = 0

    def __call__(self, controls: Any) -> View:
        """Return (K, clips, T) views of K controls, as ``pewm_many.imagine_many`` takes them."""
        asked = jax.device_get(_cameras(self.model, self.state.frame.camera, controls))
        rounded = [_rounded(x) for x in _flat(asked)]
        names = [b"".join(x[n].tobytes() for x in rounded) for n in range(len(rounded[0]))]
        wanted = dict.fromkeys(names)
        if len(wanted.keys() | self._known.keys()) * self._bytes > MOST:
            self._known = {}
        first = {name: number for number, name in reversed(list(enumerate(names)))}
        missing = [first[name] for name in wanted if name not in self._known]
        while missing:
            now, missing = missing[:AT_ONCE], missing[AT_ONCE:]
            self._render([names[n] for n in now], Camera(*(x[now] for x in rounded)))
        leading = asked.world_from_camera.shape[:-2]
        stacked = [np.stack(one) for one in zip(*(self._known[n] for n in names), strict=True)]
        shaped = [x.reshape(*leading, *x.shape[1:]) for x in stacked]
        return jax.tree.unflatten(self._form, shaped)

    def _render(self, names: list[bytes], camera: Camera) -> None:
        filled = jax.tree.map(lambda x: np.resize(x, (AT_ONCE, *x.shape[1:])), camera)
        shown = jax.device_get(_rendered(self.model, self.state.map, filled, len(names)))
        leaves, self._form = jax.tree.flatten(shown)
        self._bytes = sum(leaf[0].nbytes for leaf in leaves)
        for number, name in enumerate(names):
            self._known[name] = [leaf[number] for leaf in leaves]
        self.rendered += len(names)


def views(model: ModelConfig, params: Params, state: WorldState) -> Views | None:
    """Return what renders a world's memory for candidates; None if its model looks at no picture.

    See ``worlds.views``.
    """
    pictures = memories.gated(model) or model.memory.reader.READS_VIEW
    return Views(model, state) if pictures and "memory" in params else None


def _flat(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the intrinsics and the poses of all cameras."""
    return camera.intrinsics_4.reshape(-1, 4), camera.world_from_camera.reshape(-1, 4, 4)


def _rounded(x: np.ndarray) -> np.ndarray:
    return (np.round(x / FINE) * FINE + 0.0).astype(np.float32)  # + 0: no zero has a sign


@functools.partial(jax.jit, static_argnums=0)
def _rendered(model: ModelConfig, memory: Any, camera: Camera, count: Array) -> View:
    """Render the first ``count`` of (n,) cameras one after the other; the other views are 0."""

    def render(number: Array) -> View:
        one = jax.tree.map(lambda x: x[number][None], camera)
        return memories.render(model, memory, one, model.clip.height, model.clip.width)

    def add(number: Array, pictures: View) -> View:
        return jax.tree.map(lambda all_, x: all_.at[number].set(x[0]), pictures, render(number))

    like = jax.eval_shape(render, 0)
    room = jax.tree.map(
        lambda x: jnp.zeros((len(camera.intrinsics_4), *x.shape[1:]), x.dtype), like
    )
    return jax.lax.fori_loop(0, count, add, room)


@functools.partial(jax.jit, static_argnums=0)
def _cameras(model: ModelConfig, present: Camera, controls: Any) -> Camera:
    """Return (K, clips, T) cameras: of each clip the present one, and those that follow."""
    asked = jax.vmap(lambda control: control_of(model, present, control).camera)(controls)
    length = model.clip.frames - 1
    count, steps = asked.world_from_camera.shape[:2]
    missing = -steps % length

    def cut(now: jax.Array, x_KN: jax.Array) -> jax.Array:
        still = jnp.repeat(x_KN[:, -1:], missing, 1)
        after = jnp.concatenate([x_KN, still], 1).reshape(count, -1, length, *x_KN.shape[2:])
        before = jnp.broadcast_to(now[None], (count, 1, *now.shape[1:]))
        firsts = jnp.concatenate([before, after[:, :-1, -1]], 1)
        return jnp.concatenate([firsts[:, :, None], after], 2)

    return jax.tree.map(cut, present, asked)
