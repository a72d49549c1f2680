"""A thread that drives: it takes events, tells what came of them, and looks ahead while it waits.

Steps that were asked for while one is imagined are not kept: the last one wins, so that a key that
is held down and let go leaves nothing behind. All else is done in order. What goes wrong becomes
one sentence, and the world stays as it was.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.play import board, kept, places, session, ticking
from pewm_jax.play.drive_film import DriveFilm
from pewm_jax.play.engine import Engine
from pewm_jax.play.requests import (
    Begin,
    GoTo,
    Load,
    Record,
    Request,
    Sampler,
    Save,
    Shown,
    Undo,
)
from pewm_jax.play.session import Drive, Event, Session, Walls
from pewm_jax.play.settings import Start
from pewm_jax.types import WorldState

MOST_UNDO, MOST_WAITING, MOST_WAY = 4, 32, 64
"""Edits that can be undone, requests that may wait, and steps that one drag may take."""
NEWEST = ((Drive, GoTo), (Walls,), (Sampler,), (Begin,))
"""Kinds of requests of which only the newest waits: it replaces an earlier one of its group."""
PAUSE_S = 0.1
"""Seconds for a browser on the same machine to draw before the next step is imagined ahead."""
PATIENCE_S = 5.0
"""Seconds to wait for the thread at the end."""


class Driver:
    """Drives in a thread of its own; ``put`` and ``close`` may be called from any thread."""

    def __init__(
        self,
        load: Callable[[], Engine],
        start: Start,
        show: Callable[[Shown], None],
        folder: Path,
        *,
        ahead: bool = True,
    ):
        """Begin to load the model.

        Args:
            load: gives the model; called in the thread, it may take long.
            start: where the drive begins.
            show: told of everything, in the thread.
            folder: of saved worlds and videos.
            ahead: imagine the likely next steps while nobody asks for anything.
        """
        self._load, self._show, self._folder = load, show, folder
        self._looks_ahead = ahead
        self._engine: Engine | None = None
        self._session: Session | None = None
        self._made: dict[bytes, WorldState] = {}
        self._before: collections.deque[Session] = collections.deque(maxlen=MOST_UNDO)
        self._film: DriveFilm | None = None
        self._last: tuple[float, float, float] | None = None
        self._todo: collections.deque[Drive] = collections.deque()
        self._waiting: collections.deque[tuple[Request, float]] = collections.deque()
        self._changed = threading.Condition()
        self._ended = False
        self._idle = threading.Event()
        self.put(Begin(start))
        self._thread = threading.Thread(target=self._run, name="driver", daemon=True)
        self._thread.start()

    @property
    def engine(self) -> Engine | None:
        """Return the model, None while it is loaded."""
        return self._engine

    def tell(self, sentence: str) -> None:
        """Show a sentence about what cannot be done."""
        self._say(sentence, failed=True)

    def put(self, request: Request) -> None:
        """Ask for something; returns at once.

        A request replaces an earlier one of its group (``NEWEST``) that still waits. A request that
        finds ``MOST_WAITING`` others waiting is dropped, and the page says so.
        """
        with self._changed:
            group = next((kinds for kinds in NEWEST if isinstance(request, kinds)), ())
            waiting = [w for w in self._waiting if not isinstance(w[0], group)]
            dropped = len(waiting) >= MOST_WAITING
            if not dropped:
                self._idle.clear()
                self._waiting = collections.deque([*waiting, (request, time.monotonic())])
            self._changed.notify()
        if dropped:
            self.tell(
                f"{len(waiting)} requests are waiting: {type(request).__name__} was dropped. Wait "
                "until the picture changes, then ask again."
            )

    def close(self) -> None:
        """End the thread after what it is doing, and finish a video that is being recorded.

        Waits ``PATIENCE_S`` at most: what compiles is not waited for.
        """
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(PATIENCE_S)

    def wait(self, seconds: float) -> bool:
        """Wait until there is nothing left to do; tells whether that came about in time."""
        return self._idle.wait(seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._ended:
                    break
                found = self._waiting.popleft() if self._waiting else None
            if found is not None:
                self._guarded(lambda taken=found: self._take(*taken))
            elif self._todo:
                self._guarded(lambda: self._drive(self._todo.popleft(), time.monotonic()))
            elif not self._look_ahead():
                self._rest()
        self._guarded(self._end_film)

    def _rest(self) -> None:
        """Wait, using no processor, until something is asked for."""
        with self._changed:
            if not self._waiting and not self._ended:
                self._idle.set()
                self._changed.wait()

    def _asked_within(self, seconds: float) -> bool:
        """Wait a moment; tells, at once, if something is asked for."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._waiting) or self._ended, seconds)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do something; an error becomes a sentence."""
        try:
            work()
        except UserError as error:
            self._todo.clear()
            self._say(str(error), failed=True)
        except Exception as error:  # noqa: BLE001 - whatever it is, the page must go on
            self._todo.clear()
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            self._say(
                f"That failed ({type(error).__name__}: {reason}); the world is as it was.",
                failed=True,
            )

    def _take(self, request: Request, asked: float) -> None:
        """Do what one request asks for."""
        if isinstance(request, Begin):
            self._begin(request.start)
            return
        if self._session is None or self._engine is None:
            raise UserError("There is no world yet: choose a house and press New drive.")
        engine, now = self._engine, self._session
        if isinstance(request, Drive):
            self._todo.clear()
            self._drive(request, asked)
        elif isinstance(request, (Save, Load, Undo)):
            self._keep(engine, now, request)
        elif isinstance(request, GoTo):
            steps, target = engine.model.actions, np.asarray(request.planar, np.float64)
            parts = places.way(now.planar_3, target, steps.step_m, steps.turn_deg)
            if len(parts) > MOST_WAY:
                self._say(
                    f"That place is {len(parts)} steps away: driving the first {MOST_WAY}; drag "
                    "again from there."
                )
            steps_3 = parts[:MOST_WAY].tolist()
            self._todo = collections.deque(Drive((x, y, turn)) for x, y, turn in steps_3)
        elif isinstance(request, Sampler):
            self._sample_in(engine.with_sampler_steps(request.steps), now)
        elif isinstance(request, Record):
            self._begin_film() if request.on else self._end_film()
        else:
            self._edit(engine, now, request, asked)

    def _keep(self, engine: Engine, now: Session, request: Save | Load | Undo) -> None:
        """Save a world, load one, or go back to one."""
        if isinstance(request, Save):
            path = kept.save(engine, now.world, self._folder, request.name)
            self._say(f"Saved this world as {request.name!r}.", link=path)
            return
        self._todo.clear()
        if isinstance(request, Load):
            world = kept.load(engine, now.world, self._folder, request.name)
            self._before.append(now)
            self._set(session.resume(now, world, f"This is the world {request.name!r}."))
            return
        if not self._before:
            raise UserError("There is nothing to take back.")
        self._set(dataclasses.replace(self._before.pop(), said="Taken back."))

    def _sample_in(self, engine: Engine, now: Session) -> None:
        steps = engine.sampler_steps
        with self._during(f"preparing {steps} steps of the sampler"):
            self._warm(engine, now)
        self._made, self._engine = {}, engine
        self._say(f"Now imagining in {steps} steps of the sampler.")

    def _edit(self, engine: Engine, now: Session, request: Event, asked: float) -> None:
        if isinstance(request, session.Walls):
            self._session = session.apply(engine, now, request)
            self._made = {}  # other steps are possible now
            self._say(self._session.said)
            return
        with self._during("changing the map"):
            after = session.apply(engine, now, request)
        self._before.append(now)
        self._set(after, asked)
        self._catch_up()

    def _begin(self, start: Start) -> None:
        if self._engine is None:
            with self._during("loading the model"):
                self._engine = self._load()
        engine = self._engine
        with self._during("looking around"):
            place = places.open_place(start, *engine.size)
            places.require_shown(engine.model, start)
            begun = session.begin(engine, place, start.seed)
        self._end_film()
        self._before.clear()
        self._todo.clear()
        self._set(begun)
        with self._during("preparing to imagine (half a minute the first time)"):
            self._warm(engine, begun)
        self._say(f"{begun.said} Press W, A, S, D or the arrows.")

    def _warm(self, engine: Engine, now: Session) -> None:
        """Compile what a step needs, by making one ahead."""
        step = Drive((engine.model.actions.step_m, 0.0, 0.0))
        action, _, _ = session.wanted(now, step)
        made = session.ahead(engine, now, action)
        due = dataclasses.replace(now, due=(action, session.key_of(now)))
        _ = np.asarray(session.catch_up(engine, due).blind.frame.rgb_THWC)
        if engine is self._engine:
            self._made[action.tobytes()] = made

    def _drive(self, step: Drive, asked: float) -> None:
        assert self._engine is not None
        assert self._session is not None
        action, _, collided = session.wanted(self._session, step)
        if collided:
            self._todo.clear()  # the rest of the way begins elsewhere
        made = self._made.get(action.tobytes())
        after = session.apply(self._engine, self._session, step, made)
        self._last = step.action
        self._set(after, asked)
        self._catch_up()

    def _catch_up(self) -> None:
        """Imagine the step without memory, too, and then film it."""
        assert self._engine is not None
        assert self._session is not None
        if self._session.due is not None:
            self._session = session.catch_up(self._engine, self._session)
            self._say(self._session.said, picture=self._board())
        if self._film is not None:
            self._film.add(self._board())

    def _set(self, after: Session, asked: float | None = None) -> None:
        """Take a state and show it; ``asked`` is when it was asked for."""
        if self._session is None or after.world is not self._session.world:
            self._made = {}
        self._session = after
        picture = self._board()  # waits for what is being imagined
        taken = None if asked is None else time.monotonic() - asked
        self._say(after.said, picture=picture, session=after, seconds=taken)

    def _look_ahead(self) -> bool:
        """Imagine one likely next step; tells whether there was one left."""
        now, engine = self._session, self._engine
        if not self._looks_ahead or now is None or engine is None:
            return False
        model = engine.model.actions
        turn = float(np.radians(model.turn_deg))
        likely = [(model.step_m, 0.0, 0.0), (0.0, 0.0, turn), (0.0, 0.0, -turn)]
        likely = [action for action in likely if action != self._last]
        for step in ([self._last] if self._last else []) + likely:
            action, _, _ = session.wanted(now, Drive(step))
            if action.tobytes() not in self._made and np.abs(action).max() > 0:
                if self._asked_within(PAUSE_S):
                    return True
                self._guarded(lambda a=action: self._make(engine, now, a))
                return action.tobytes() in self._made
        return False

    def _make(self, engine: Engine, now: Session, action: np.ndarray) -> None:
        made = session.ahead(engine, now, action)
        _ = np.asarray(made.frame.rgb_THWC)  # waits for it
        self._made[action.tobytes()] = made

    def _board(self) -> np.ndarray:
        assert self._engine is not None
        assert self._session is not None
        return board.board(board.pictures(self._engine, self._session), self._engine.name)

    def _begin_film(self) -> None:
        self._end_film()
        self._film = DriveFilm(self._folder, self._board())
        self._say("Recording: every step becomes a frame of the video.")

    def _end_film(self) -> None:
        if self._film is None:
            return
        film, self._film = self._film, None
        path = film.close()
        self._say(f"The video is {path.name}.", link=path)

    def _during(self, text: str) -> contextlib.AbstractContextManager[None]:
        """Say what takes long, and how long it has taken."""
        return ticking.during(text, lambda said: self._say(said, busy=True))

    def _say(self, said: str, **rest) -> None:
        worlds = tuple(kept.names(self._folder))
        shown = Shown(
            said, engine=self._engine, recording=self._film is not None, worlds=worlds, **rest
        )
        with contextlib.suppress(Exception):  # a page that is gone must not stop the drive
            self._show(shown)
