"""What a driver is asked for beside the events of a session, and what it tells."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TypeAlias

import numpy as np

from pewm_jax.play.engine import Engine
from pewm_jax.play.session import Event, Session
from pewm_jax.play.settings import Start


@dataclasses.dataclass(frozen=True)
class Begin:
    """Event: begin a drive elsewhere."""

    start: Start


@dataclasses.dataclass(frozen=True)
class GoTo:
    """Event: drive straight to a place: x, y in metres, yaw in radians."""

    planar: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Sampler:
    """Event: imagine with another number of the sampler's steps."""

    steps: int


@dataclasses.dataclass(frozen=True)
class Save:
    """Event: keep the world in a file."""

    name: str


@dataclasses.dataclass(frozen=True)
class Load:
    """Event: go on in a world that was kept."""

    name: str


@dataclasses.dataclass(frozen=True)
class Record:
    """Event: begin a video, or end it."""

    on: bool


@dataclasses.dataclass(frozen=True)
class Undo:
    """Event: take the last edit back."""


Request: TypeAlias = Event | Begin | GoTo | Sampler | Save | Load | Record | Undo


@dataclasses.dataclass(frozen=True, eq=False)
class Shown:
    """What the page shows; parts that have not changed are None.

    Attributes:
        said: one sentence.
        busy: whether something is being imagined, opened or compiled.
        failed: whether the sentence says what went wrong.
        picture: the board, uint8 (H, W, 3).
        session: the drive, for the map.
        engine: the model that imagines it.
        seconds: what the last step took, from the key to the picture; None if there was none.
        recording: whether a video is being recorded.
        worlds: names of the worlds that can be loaded.
        link: a file that was written.
    """

    said: str
    busy: bool = False
    failed: bool = False
    picture: np.ndarray | None = None
    session: Session | None = None
    engine: Engine | None = None
    seconds: float | None = None
    recording: bool = False
    worlds: tuple[str, ...] = ()
    link: Path | None = None
