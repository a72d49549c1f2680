"""A tiny untrained world in a real house, and a toy that knows the truth and compiles nothing."""

import dataclasses
import functools
import threading

import jax
import numpy as np

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import Config
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry.cameras import pose_from_yaw, unproject
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.play import engine, places, session
from pewm_jax.play.settings import Start
from pewm_jax.report.pictures import as_bytes
from pewm_jax.types import Camera, WorldState
from pewm_jax.worlds import world_model
from tests.helpers import TINY, tiny_model

MODEL = tiny_model(
    memory=SurfelConfig(
        cell_m=(0.1,) * 3,
        cells=(256, 256, 64),
        capacity=8192,
        tokens=8,
        imagined_edge=0.0,
        imagined_again=True,
    ),
    backbone=dataclasses.replace(TINY.backbone, layers=1),
    clip=dataclasses.replace(TINY.clip, frames=5),
    noise=DDPMConfig(sample_steps=1),
)
FORWARD = session.Drive((0.25, 0.0, 0.0))
LEFT = session.Drive((0.0, 0.0, float(np.pi / 6)))


@functools.cache
def an_engine():
    shapes = jax.eval_shape(functools.partial(world_model.init, MODEL), jax.random.key(0))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: rng.normal(0, 0.2, x.shape).astype(np.float32), shapes)
    return engine.open_engine("tiny", Config(model=MODEL), params)


@functools.cache
def a_place():
    return places.open_place(Start(house=2), MODEL.clip.height, MODEL.clip.width)


@functools.cache
def a_session():
    return session.begin(an_engine(), a_place())


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@dataclasses.dataclass(frozen=True, eq=False)
class Toy(engine.Engine):
    """An engine that imagines the truth, a little darker, by NumPy alone; its map is its points."""

    def start(self, frames):
        points, colours = seen(frames)
        held = {"points": points, "colours": colours, "observed": np.ones(len(points), bool)}
        return WorldState(as_signal(jax.tree.map(lambda x: x[-1:], frames)), held)

    def imagine(self, world, action_3, key):
        after = self.imagine_blind(world, action_3, key)
        points, colours = seen(after.frame)
        new = {"points": points, "colours": colours, "observed": np.zeros(len(points), bool)}
        held = {name: np.concatenate([world.map[name], new[name]]) for name in new}
        return WorldState(after.frame, held)

    def imagine_blind(self, world, action_3, key):
        pose = world.frame.camera.world_from_camera[0]
        yaw = np.arctan2(pose[1, 2], pose[0, 2])
        free = places.StartPoint("", world.frame)
        x, y, yaw = places.walk(free, np.array([*pose[:2, 3], yaw]), action_3)[0]
        there = pose_from_yaw(np.array([x, y, pose[2, 3]]), yaw)[None]
        camera = Camera(world.frame.camera.intrinsics_4, there)
        frame = as_signal(places.truth(a_place(), camera, *self.size))
        return WorldState(dataclasses.replace(frame, rgb_THWC=frame.rgb_THWC * 0.9), world.map)

    def points(self, world):
        return world.map["points"], world.map["colours"], world.map["observed"]

    def erase(self, world, box_23):
        low, high = np.asarray(box_23)
        kept = ~((world.map["points"] >= low) & (world.map["points"] < high)).all(-1)
        return WorldState(world.frame, jax.tree.map(lambda x: x[kept], world.map))

    def move(self, world, box_23, transform, *, leave):
        low, high = np.asarray(box_23)
        inside = ((world.map["points"] >= low) & (world.map["points"] < high)).all(-1)
        piece = {name: values[inside] for name, values in world.map.items()}
        piece["points"] = piece["points"] @ transform[:3, :3].T + transform[:3, 3]
        rest = world if leave else self.erase(world, box_23)
        both = {name: np.concatenate([rest.map[name], piece[name]]) for name in piece}
        return WorldState(world.frame, both)


def seen(frames):
    """The points of frames in the world, and their colours."""
    frames = dataclasses.replace(frames, rgb_THWC=as_bytes(np.asarray(frames.rgb_THWC)))
    valid = np.asarray(frames.depth_THW) > 0
    return np.asarray(unproject(frames.depth_THW, frames.camera))[valid], frames.rgb_THWC[valid]


@functools.cache
def a_toy():
    return Toy("toy", Config(model=MODEL), {})


class Telling:
    """Keeps what a driver tells."""

    def __init__(self):
        self.told, self.lock = [], threading.Lock()

    def __call__(self, shown):
        with self.lock:
            self.told.append(shown)

    @property
    def sentences(self):
        return [shown.said for shown in self.told]

    @property
    def session(self):
        return [shown.session for shown in self.told if shown.session is not None][-1]
