"""What worlds of one's own return is checked by the method's name, at the first call."""

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import AssembledModel, Capabilities, ClipConfig, Config, UserError, World
from pewm_jax.registry import register
from pewm_jax.types import Frames, WorldState
from pewm_jax.worlds.control import control_of
from pewm_jax.worlds.pewm.world import PEWM
from tests.helpers import random_frames

CLIP = ClipConfig(height=16, width=16)
KEY = jax.random.key(0)
FRAMES = random_frames(np.random.default_rng(0), 3, 16, 16)
MANY = np.zeros((4, 2), int), jax.random.split(KEY, 4)


@register("world", "still")
@dataclasses.dataclass(frozen=True)
class Still(World):
    """Repeats the present frame, and returns something wrong where ``wrong`` says so."""

    clip: ClipConfig = CLIP
    wrong: str = ""

    def init(self, key):
        return {}

    def stages(self):
        return ()

    def observe(self, params, state, frames) -> Any:
        frames = as_signal(frames)
        if self.wrong == "observed":
            return frames
        if self.wrong == "all":
            return WorldState(frames, ())
        return WorldState(jax.tree.map(lambda x: x[-1:], frames), ())

    def imagine(self, params, state, control, key, *, remember=True, memory=True) -> Any:
        camera = control_of(self, state.frame.camera, control).camera
        count = len(camera.intrinsics_4) - (self.wrong == "fewer")
        rgb, depth = (
            jnp.repeat(x, count, 0) for x in (state.frame.rgb_THWC, state.frame.depth_THW)
        )
        if self.wrong == "grey":
            rgb = rgb[..., :1]
        if self.wrong == "bytes":
            rgb = rgb.astype(jnp.uint8)
        frames = Frames(rgb, depth, camera)
        if self.wrong == "imagined":
            return frames
        return state, frames.rgb_THWC if self.wrong == "array" else frames


class Dictionary(Still):
    @property
    def capabilities(self) -> Any:
        return {"edits": False}


class Edits(Still):
    @property
    def capabilities(self):
        return Capabilities(edits=True)


class Erases(Edits):
    def erase(self, params, state, box_23):
        return state


class Points(Still):
    @property
    def capabilities(self):
        return Capabilities(points=True)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Dictionary, "Dictionary.capabilities is a dict: set it to pewm_jax.config.Capabilities"),
        (Edits, "Edits.capabilities has edits=True, and Edits has no method erase and move: add"),
        (Erases, "Erases.capabilities has edits=True, and Erases has no method move: add it, or"),
        (Points, "Points has no method memory_points: add it, or set points=False."),
    ],
)
def test_wrong_capabilities_are_refused_at_the_first_use(kind, message):
    for use in (lambda: worlds.start(kind(), {}, FRAMES), lambda: Config(model=kind())):
        with pytest.raises(UserError, match=re.escape(message)):
            use()


def test_an_assembled_world_has_only_the_capabilities_of_its_methods():
    class Plain(AssembledModel):
        init = stages = observe = imagine = None  # type: ignore[assignment]

    assert PEWM().capabilities.edits
    assert PEWM().capabilities.coverage
    assert not Plain().capabilities.edits
    assert not Plain().capabilities.coverage


def test_what_is_right_passes():
    model = Still()
    state = worlds.start(model, {}, FRAMES)
    state = worlds.observe(model, {}, state, FRAMES)
    _, frames = worlds.imagine(model, {}, state, [0, 1], KEY)
    _, candidates = worlds.imagine_many(model, {}, state, *MANY)
    assert frames.depth_THW.shape == (2, 16, 16)
    assert candidates.depth_THW.shape == (4, 2, 16, 16)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("observed", "must return a WorldState; it returned a Frames."),
        ("all", "returned a state whose frame must have colours (1, 16, 16, 3): they are (3, 16,"),
    ],
)
def test_a_wrong_state_is_named(wrong, message):
    with pytest.raises(UserError, match=re.escape(f"Still.observe() {message}")):
        worlds.start(Still(wrong=wrong), {}, FRAMES)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("imagined", "must return (WorldState, Frames); it returned a Frames."),
        ("array", "returned frames that must be Frames"),
        ("fewer", "returned frames that must have colours (2, 16, 16, 3): they are (1, 16, 16, 3)"),
        ("grey", "returned frames that must have colours (2, 16, 16, 3): they are (2, 16, 16, 1)"),
        ("bytes", "returned frames that must have colours of type float32: they are uint8"),
    ],
)
def test_wrong_frames_are_named_by_every_call(wrong, message):
    model = Still(wrong=wrong)
    state = worlds.start(model, {}, FRAMES)
    message = re.escape(f"Still.imagine() {message}")
    with pytest.raises(UserError, match=message):
        worlds.imagine(model, {}, state, [0, 1], KEY)
    with pytest.raises(UserError, match=message):
        worlds.imagine_many(model, {}, state, *MANY)
