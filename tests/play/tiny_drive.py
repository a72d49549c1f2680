"""A tiny untrained world in a real house, and a page's driver without the page."""

import functools
import threading

import jax
import numpy as np

from pewm_jax.config import Config, DDPMConfig, SurfelConfig
from pewm_jax.play import engine, places, session
from pewm_jax.play.settings import Start
from tests.helpers import init_world, randomise, tiny_model

MODEL = tiny_model(
    memory=SurfelConfig(
        cell_m=(0.1,) * 3,
        cells=(256, 256, 64),
        capacity=8192,
        tokens=8,
        imagined_edge=0.0,
        imagined_again=True,
    ),
    noise=DDPMConfig(sample_steps=1),
)
FORWARD = session.Drive((0.25, 0.0, 0.0))
LEFT = session.Drive((0.0, 0.0, float(np.pi / 6)))


@functools.cache
def an_engine():
    params = randomise(init_world(MODEL), scale=0.05)
    return engine.open_engine("tiny", Config(model=MODEL), params)


@functools.cache
def a_place():
    return places.open_place(Start(house=2), *an_engine().size)


@functools.cache
def a_session():
    return session.begin(an_engine(), a_place())


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


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
