"""The state of a drive and its events; pure functions, without server, threads or files.

A step is ``engine.imagine`` of one action with a key derived from the drive's seed and the step
number, so a drive is a function of its events. A step imagined ahead (``ahead``) is bit-identical
to the same step imagined on request. Requests that need more than the state (saving, recording, …)
and the updates of the page are defined here as well.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TypeAlias

import jax
import numpy as np

from pewm_jax.bodies import kinematics
from pewm_jax.config import UserError
from pewm_jax.geometry.actions import heading
from pewm_jax.play import places
from pewm_jax.play.engine import Engine
from pewm_jax.play.places import StartPoint
from pewm_jax.play.settings import Start
from pewm_jax.types import Array, Control, WorldState

MOST_PATH = 4096
"""Largest number of positions of the path."""
STILL = np.zeros(3, np.float32)
"""The null action: the present frame is imagined again."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """Event: one step, (dx, dy, dyaw): metres forward and left, radians counter-clockwise."""

    action: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Erase:
    """Event: erase the content of a box (2, 3), metres."""

    box: tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclasses.dataclass(frozen=True)
class Move:
    """Event: move or copy the content of a box.

    Attributes:
        box: its lower and upper corner, metres.
        shift: metres along x, y, z.
        turn_deg: degrees counter-clockwise, seen from above, about the middle of the box.
        leave: whether to keep the original, which makes a copy.
    """

    box: tuple[tuple[float, float, float], tuple[float, float, float]]
    shift: tuple[float, float, float]
    turn_deg: float = 0.0
    leave: bool = False


@dataclasses.dataclass(frozen=True)
class Pose:
    """Event: set the joints that the body of the agent moves to, in the following steps.

    ``joints`` are the values of its degrees of freedom, without the two of walking.
    """

    joints: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Walls:
    """Event: set whether walls stop the agent."""

    stop: bool


Event: TypeAlias = Drive | Erase | Move | Walls | Pose


@dataclasses.dataclass(frozen=True, eq=False)
class Session:
    """A drive.

    Attributes:
        place: its start point.
        world: the world: the present frame and the map.
        blind: the same drive without memory; its map is the initial one and is not read.
        planar_3: x, y, yaw of the agent, float64.
        path_P3: camera positions so far, newest last, at most ``MOST_PATH``.
        steps: number of steps made, edits included.
        seed: seed of the noise.
        walls: whether walls stop the agent.
        due: the step that ``blind`` has yet to make, and its key; None if there is none.
        observed: whether the present frame was observed, not imagined.
        said: a message about the last event.
        state_A: the state of the agent's body, if it has one.
        wished_A: the state that its joints move to.
    """

    place: StartPoint
    world: WorldState
    blind: WorldState
    planar_3: np.ndarray
    path_P3: np.ndarray
    steps: int = 0
    seed: int = 0
    walls: bool = True
    due: tuple[np.ndarray | Control, Array] | None = None
    observed: bool = False
    said: str = ""
    state_A: np.ndarray | None = None
    wished_A: np.ndarray | None = None


def begin(engine: Engine, place: StartPoint, seed: int = 0) -> Session:
    """Start a drive with the observed frames of a start point."""
    world = engine.start(place.frames)
    said = f"This is {place.name} as observed; every step from here is imagined."
    return dataclasses.replace(_initial_session(place, world, seed, said), observed=True)


def resume(
    session: Session, world: WorldState, said: str, state_A: np.ndarray | None = None
) -> Session:
    """Return a drive through another world, such as a saved one, with the same start point.

    ``state_A`` is the state of the agent's body there, if it has one.
    """
    return dataclasses.replace(
        _initial_session(session.place, world, session.seed, said, state_A), walls=session.walls
    )


def wanted(session: Session, event: Drive) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the effect of a step with collisions: ``(action, planar_3, collided)``.

    These are the action that is possible, the pose x, y, yaw after it, and whether a wall blocked
    the requested action. The action of a body is its next state; it walks forward and turns.
    """
    asked = np.asarray(event.action, np.float32)
    agent, state = session.place.agent, session.state_A
    if agent is not None and state is not None and session.wished_A is not None:
        body = agent.body
        asked = np.clip([asked[0], asked[2]], body.low[-2:], body.high[-2:])
        moved = np.array([asked[0], 0.0, asked[1]])
        after, collided = places.walk(
            session.place, session.planar_3, moved, walls=session.walls, sliding=False
        )
        action = body.toward(state, session.wished_A)
        action[-2:] = (0.0 if collided else asked[0]), asked[1]
        return action.astype(np.float32), after, collided
    after, collided = places.walk(session.place, session.planar_3, asked, walls=session.walls)
    return places.action_between(session.planar_3, after), after, collided


def ahead(engine: Engine, session: Session, action: np.ndarray) -> WorldState:
    """Return the world after one action, for the argument ``made`` of ``apply``."""
    return engine.imagine(session.world, step_of(session, action), key_of(session))


def step_of(session: Session, action: np.ndarray) -> np.ndarray | Control:
    """Return an action as the model takes it: with camera and state if the agent has a body."""
    agent = session.place.agent
    if agent is None:
        return action
    planar = kinematics.advance(session.planar_3, action)
    intrinsics = np.asarray(session.world.frame.camera.intrinsics_4, np.float32)
    camera = agent.camera(planar[None], action[None], intrinsics, session.place.floor_z)
    actions = np.asarray(action, np.float32)[None]
    return Control(camera, actions, np.asarray(session.state_A, np.float32))


def apply(
    engine: Engine, session: Session, event: Event, made: WorldState | None = None
) -> Session:
    """Return the drive after an event.

    ``made`` is the result of ``ahead`` for this session and this event's action, if there is one.

    Raises:
        UserError: the box is empty, or the memory cannot be edited.
    """
    if isinstance(event, Walls):
        said = "Walls stop the agent." if event.stop else "The agent passes through walls."
        return dataclasses.replace(session, walls=event.stop, said=said)
    if isinstance(event, Pose):
        return _apply_pose(session, event)
    if isinstance(event, Drive):
        return _apply_drive(engine, session, event, made)
    return _apply_edit(engine, session, event)


def catch_up(engine: Engine, session: Session) -> Session:
    """Return the drive after also imagining its step without memory."""
    if session.due is None:
        return session
    action, key = session.due
    if not engine.has_memory:
        return dataclasses.replace(session, due=None)
    blind = engine.imagine_blind(session.blind, action, key)
    return dataclasses.replace(session, blind=blind, due=None)


def pose(session: Session) -> np.ndarray:
    """Return the present (4, 4) ``world_from_camera``."""
    return np.asarray(session.world.frame.camera.world_from_camera[0])


def _apply_drive(
    engine: Engine, session: Session, event: Drive, made: WorldState | None
) -> Session:
    forward, left, turn = event.action
    if session.place.agent is not None and left and not forward and not turn:
        return dataclasses.replace(session, said="This body does not step aside.")
    action, planar, collided = wanted(session, event)
    moves = np.abs(action if session.state_A is None else action[-2:]).max() > 1e-6
    if collided and not moves:
        return dataclasses.replace(session, said="Blocked by a wall.")
    world = ahead(engine, session, action) if made is None else made
    after = _next_session(engine, session, world, step_of(session, action), planar, "")
    if session.state_A is not None:
        after = dataclasses.replace(after, state_A=action.astype(np.float64))
    return after


def _apply_pose(session: Session, event: Pose) -> Session:
    """Set the joints that the body moves to; nothing is imagined yet."""
    agent = session.place.agent
    if agent is None or session.wished_A is None:
        raise UserError("This agent has no joints: it is a camera that moves on the ground.")
    joints = np.asarray(event.joints, np.float64)
    if joints.shape != (agent.body.size - 2,) or not np.isfinite(joints).all():
        raise UserError(
            f"A pose of the body {agent.body.name} has {agent.body.size - 2} finite numbers, one "
            "for each joint."
        )
    wished = np.clip(np.append(joints, [0.0, 0.0]), agent.body.low, agent.body.high)
    return dataclasses.replace(session, wished_A=wished, said="The body moves.")


def _apply_edit(engine: Engine, session: Session, event: Erase | Move) -> Session:
    """Edit the map, then imagine the present frame again, which fills holes."""
    if not engine.editable:
        raise UserError(
            f"The memory of {engine.name} cannot be edited: use a model whose memory is of surfels "
            "or voxels."
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
    still = STILL if session.state_A is None else np.append(session.state_A[:-2], [0.0, 0.0])
    seen, step = ahead(engine, changed, still), step_of(changed, still)
    return _next_session(engine, changed, seen, step, session.planar_3, said)


def about_middle(
    box_23: np.ndarray, shift: tuple[float, float, float], turn_deg: float
) -> np.ndarray:
    """Return the (4, 4) transform that turns about the vertical axis of a box, then shifts."""
    angle, middle = np.radians(turn_deg), np.asarray(box_23, np.float64).mean(0)
    c, s = np.cos(angle), np.sin(angle)
    transform = np.eye(4)
    transform[:2, :2] = [[c, -s], [s, c]]
    transform[:3, 3] = middle + np.asarray(shift) - transform[:3, :3] @ middle
    return transform.astype(np.float32)


def _next_session(
    engine: Engine,
    session: Session,
    world: WorldState,
    step: np.ndarray | Control,
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
        due=(step, key_of(session)) if engine.has_memory else None,
        observed=False,
        said=said,
    )


def _initial_session(
    place: StartPoint,
    world: WorldState,
    seed: int,
    said: str,
    state_A: np.ndarray | None = None,
) -> Session:
    camera = np.asarray(world.frame.camera.world_from_camera)[0]
    state, agent = place.state_A if state_A is None else state_A, place.agent
    if agent is not None and state is not None:
        planar = agent.body.planar_of(camera, state, agent.scale)
    else:
        planar = np.array([camera[0, 3], camera[1, 3], float(heading(camera))], np.float64)
    if place.planar_3 is not None and np.allclose(planar[:2], place.planar_3[:2], atol=1e-4):
        planar[:2] = place.planar_3[:2]  # exact: rounding could put the agent into a wall
    path = camera[None, :3, 3]
    return Session(
        place, world, world, planar, path, seed=seed, said=said, state_A=state, wished_A=state
    )


def key_of(session: Session) -> Array:
    """Return the random key of the next step."""
    return jax.random.fold_in(jax.random.key(session.seed), session.steps)


@dataclasses.dataclass(frozen=True)
class Begin:
    """Request: start another drive."""

    start: Start


@dataclasses.dataclass(frozen=True)
class GoTo:
    """Request: drive straight to a pose: x, y in metres, yaw in radians."""

    planar: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Sampler:
    """Request: set the number of sampler steps."""

    steps: int


@dataclasses.dataclass(frozen=True)
class Save:
    """Request: save the world to a file."""

    name: str


@dataclasses.dataclass(frozen=True)
class Load:
    """Request: load a saved world."""

    name: str


@dataclasses.dataclass(frozen=True)
class Record:
    """Request: start or end a video."""

    on: bool


@dataclasses.dataclass(frozen=True)
class Undo:
    """Request: undo the last edit."""


Request: TypeAlias = Event | Begin | GoTo | Sampler | Save | Load | Record | Undo


@dataclasses.dataclass(frozen=True, eq=False)
class PageUpdate:
    """An update of the page; parts that have not changed are None.

    Attributes:
        said: one message.
        busy: whether something is being imagined, opened or compiled.
        failed: whether the message is an error.
        picture: the board, uint8 (H, W, 3).
        session: the drive, for the map.
        engine: the model that imagines it.
        seconds: duration of the last step, from the key press to the image; None if there was none.
        recording: whether a video is being recorded.
        worlds: names of the saved worlds.
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
