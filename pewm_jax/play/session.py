"""The drive itself: state in, event in, state out. No server, no threads, nothing on disk.

A step is ``engine.imagine`` of one action with a key made of the drive's seed and the number of the
step. So a drive is a function of its events: what was imagined ahead (``ahead``) is what would have
been imagined when asked for, bit for bit, or it is not used.
"""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import jax
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.geometry.actions import heading
from pewm_jax.play import places
from pewm_jax.play.engine import Engine
from pewm_jax.play.places import Place
from pewm_jax.types import Array, WorldState

MOST_PATH = 4096
"""Positions of the path that are kept."""
STILL = np.zeros(3, np.float32)
"""The action that stays: what is seen is imagined anew."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """Event: one step.

    Attributes:
        action: dx, dy, dyaw: metres forward, metres left, radians counter-clockwise.
    """

    action: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Erase:
    """Event: forget what is in a box (2, 3), metres."""

    box: tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclasses.dataclass(frozen=True)
class Move:
    """Event: move or copy what is in a box.

    Attributes:
        box: its lower and upper corner, metres.
        shift: metres along x, y, z.
        turn_deg: degrees counter-clockwise, seen from above, about the middle of the box.
        leave: leave it where it is, too.
    """

    box: tuple[tuple[float, float, float], tuple[float, float, float]]
    shift: tuple[float, float, float]
    turn_deg: float = 0.0
    leave: bool = False


@dataclasses.dataclass(frozen=True)
class Walls:
    """Event: let walls stop the agent, or not."""

    stop: bool


Event: TypeAlias = Drive | Erase | Move | Walls


@dataclasses.dataclass(frozen=True, eq=False)
class Session:
    """A drive.

    Attributes:
        place: where it began.
        world: the world: the present frame and the map.
        blind: the same drive without memory; its map is the first and is not looked at.
        planar_3: x, y, yaw of the agent, float64.
        path_P3: camera positions so far, newest last, at most ``MOST_PATH``.
        steps: steps made, edits included.
        seed: of the noise.
        walls: whether walls stop the agent.
        due: the action that ``blind`` has yet to make, and its key; None if there is none.
        observed: whether the present frame was really seen, not imagined.
        said: one sentence on what happened last.
    """

    place: Place
    world: WorldState
    blind: WorldState
    planar_3: np.ndarray
    path_P3: np.ndarray
    steps: int = 0
    seed: int = 0
    walls: bool = True
    due: tuple[np.ndarray, Array] | None = None
    observed: bool = False
    said: str = ""


def begin(engine: Engine, place: Place, seed: int = 0) -> Session:
    """Begin a drive with what was seen of a place."""
    world = engine.start(place.frames)
    said = f"This is {place.name}, as it was really seen: drive on, and it is imagined."
    return dataclasses.replace(_begun(place, world, seed, said), observed=True)


def resume(session: Session, world: WorldState, said: str) -> Session:
    """Return a drive through another world, in the same place: one that was kept in a file."""
    return dataclasses.replace(
        _begun(session.place, world, session.seed, said), walls=session.walls
    )


def wanted(session: Session, event: Drive) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return what a step would do: ``(action_3, planar_3, collided)``.

    That is the action that is free, the pose x, y, yaw after it, and whether a wall is in its way.
    """
    asked = np.asarray(event.action, np.float32)
    after, collided = places.walk(session.place, session.planar_3, asked, walls=session.walls)
    return places.action_between(session.planar_3, after), after, collided


def ahead(engine: Engine, session: Session, action_3: np.ndarray) -> WorldState:
    """Return the world that one action leads to; ``apply`` takes it as ``made``."""
    return engine.imagine(session.world, action_3, key_of(session))


def apply(
    engine: Engine, session: Session, event: Event, made: WorldState | None = None
) -> Session:
    """Return the drive after an event.

    Args:
        engine: the model.
        session: the drive so far.
        event: what is asked for.
        made: what ``ahead`` gave for this session and this event's action, if it was asked before.

    Raises:
        UserError: a box without inside, or a memory that cannot be edited.
    """
    if isinstance(event, Walls):
        said = "Walls stop you." if event.stop else "You go through walls; beyond all is imagined."
        return dataclasses.replace(session, walls=event.stop, said=said)
    if isinstance(event, Drive):
        return _driven(engine, session, event, made)
    return _edited(engine, session, event)


def catch_up(engine: Engine, session: Session) -> Session:
    """Return the drive after what is seen without memory was imagined, too."""
    if session.due is None:
        return session
    action, key = session.due
    if not engine.forgets:
        return dataclasses.replace(session, due=None)
    blind = engine.imagine_blind(session.blind, action, key)
    return dataclasses.replace(session, blind=blind, due=None)


def pose(session: Session) -> np.ndarray:
    """Return the present (4, 4) ``world_from_camera``."""
    return np.asarray(session.world.frame.camera.world_from_camera[0])


def _driven(engine: Engine, session: Session, event: Drive, made: WorldState | None) -> Session:
    action, planar, collided = wanted(session, event)
    if collided and not np.abs(action).max() > 1e-6:
        return dataclasses.replace(session, said="There is a wall: turn, or go another way.")
    world = ahead(engine, session, action) if made is None else made
    return _after(engine, session, world, action, planar, "")


def _edited(engine: Engine, session: Session, event: Erase | Move) -> Session:
    """Change the map, then look again from where the agent is: holes are imagined."""
    if not engine.editable:
        raise UserError(
            f"The memory of {engine.name} keeps no places that could be edited: drive a model that "
            "remembers surfels or voxels."
        )
    box = np.asarray(event.box, np.float32)
    before = len(engine.points(session.world)[0])
    if isinstance(event, Erase):
        world = engine.erase(session.world, box)
        said = f"Erased {before - len(engine.points(world)[0])} points of the map."
    else:
        transform = about_middle(box, event.shift, event.turn_deg)
        world = engine.move(session.world, box, transform, leave=event.leave)
        done = "Copied" if event.leave else "Moved"
        said = f"{done} the box; the map has {len(engine.points(world)[0])} points."
    changed = dataclasses.replace(session, world=world)
    seen = ahead(engine, changed, STILL)
    return _after(engine, changed, seen, STILL, session.planar_3, said)


def about_middle(
    box_23: np.ndarray, shift: tuple[float, float, float], turn_deg: float
) -> np.ndarray:
    """Return the (4, 4) transform that turns upright about a box's middle, then shifts."""
    angle, middle = np.radians(turn_deg), np.asarray(box_23, np.float64).mean(0)
    c, s = np.cos(angle), np.sin(angle)
    transform = np.eye(4)
    transform[:2, :2] = [[c, -s], [s, c]]
    transform[:3, 3] = middle + np.asarray(shift) - transform[:3, :3] @ middle
    return transform.astype(np.float32)


def _after(
    engine: Engine,
    session: Session,
    world: WorldState,
    action: np.ndarray,
    planar: np.ndarray,
    said: str,
) -> Session:
    here = np.asarray(world.frame.camera.world_from_camera)[0, :3, 3]
    return dataclasses.replace(
        session,
        world=world,
        planar_3=planar,
        path_P3=np.concatenate([session.path_P3, here[None]])[-MOST_PATH:],
        steps=session.steps + 1,
        due=(action, key_of(session)) if engine.forgets else None,
        observed=False,
        said=said,
    )


def _begun(place: Place, world: WorldState, seed: int, said: str) -> Session:
    camera = np.asarray(world.frame.camera.world_from_camera)[0]
    planar = np.array([camera[0, 3], camera[1, 3], float(heading(camera))], np.float64)
    if place.planar_3 is not None and np.allclose(planar[:2], place.planar_3[:2], atol=1e-4):
        planar = place.planar_3.copy()  # of which rounding has not put the agent into a wall
    return Session(place, world, world, planar, camera[None, :3, 3], seed=seed, said=said)


def key_of(session: Session) -> Array:
    """Return the randomness of the next step."""
    return jax.random.fold_in(jax.random.key(session.seed), session.steps)
