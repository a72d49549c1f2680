"""A thread that drives: it handles requests, reports their results, and imagines steps ahead.

Of the steps requested while one is being imagined, only the newest is kept, so that releasing a key
stops the drive. Other requests are handled in order. An error becomes one message, and the world
stays as it was.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.play import board, places, saved, session
from pewm_jax.play.engine import Engine
from pewm_jax.play.saved import DriveFilm
from pewm_jax.play.session import (
    Begin,
    Drive,
    Event,
    GoTo,
    Load,
    PageUpdate,
    Pose,
    Record,
    Request,
    Sampler,
    Save,
    Session,
    Undo,
    Walls,
)
from pewm_jax.play.settings import Start
from pewm_jax.types import WorldState

MOST_UNDO, MOST_WAITING, MOST_WAY = 4, 32, 64
"""Largest number of edits that can be undone, of queued requests, and of steps per drag."""
NEWEST = ((Drive, GoTo, Pose), (Walls,), (Sampler,), (Begin,))
"""Groups of requests of which only the newest is kept in the queue."""
PAUSE_S = 0.1
"""Seconds given to a browser on the same machine to draw before the next step is imagined ahead."""
PATIENCE_S = 5.0
"""Seconds to wait for the thread on exit."""


class Driver:
    """Drives in its own thread; ``put`` and ``close`` may be called from any thread."""

    def __init__(
        self,
        load: Callable[[], Engine],
        start: Start,
        show: Callable[[PageUpdate], None],
        folder: Path,
        *,
        ahead: bool = True,
    ):
        """Start loading the model.

        Args:
            load: returns the model; called in the thread, as it may take long.
            start: the start of the drive.
            show: receives all updates, in the thread.
            folder: folder of saved worlds and videos.
            ahead: whether to imagine likely next steps while the queue is empty.
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
        """Return the model, or None while it is loading."""
        return self._engine

    def tell(self, sentence: str) -> None:
        """Show an error message."""
        self._log(sentence, failed=True)

    def put(self, request: Request) -> None:
        """Queue a request; return immediately.

        A request replaces an earlier one of its group (``NEWEST``) that is still queued. If
        ``MOST_WAITING`` others are queued, the request is dropped and the page shows a message.
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
                "until the image changes, then try again."
            )

    def close(self) -> None:
        """Stop the thread after its present work, and finish a video that is being recorded.

        Waits at most ``PATIENCE_S``, because compilations may take longer.
        """
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(PATIENCE_S)

    def wait(self, seconds: float) -> bool:
        """Wait until all requests are done; return whether that happened in time."""
        return self._idle.wait(seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._ended:
                    break
                found = self._waiting.popleft() if self._waiting else None
            if found is not None:
                self._run_safely(lambda taken=found: self._take(*taken))
            elif self._todo:
                self._run_safely(lambda: self._drive(self._todo.popleft(), time.monotonic()))
            elif not self._look_ahead():
                self._wait_for_request()
        self._run_safely(self._end_film)

    def _wait_for_request(self) -> None:
        """Sleep until a request arrives."""
        with self._changed:
            if not self._waiting and not self._ended:
                self._idle.set()
                self._changed.wait()

    def _request_within(self, seconds: float) -> bool:
        """Wait up to some seconds for a request; return whether one has arrived."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._waiting) or self._ended, seconds)

    def _run_safely(self, work: Callable[[], None]) -> None:
        """Call a function; show its error as a message."""
        try:
            work()
        except UserError as error:
            self._todo.clear()
            self._log(str(error), failed=True)
        except Exception as error:  # noqa: BLE001 - no error may stop the page
            self._todo.clear()
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            self._log(
                f"That failed ({type(error).__name__}: {reason}); the world is unchanged.",
                failed=True,
            )

    def _take(self, request: Request, asked: float) -> None:
        """Handle one request."""
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
            self._save_load_or_undo(engine, now, request)
        elif isinstance(request, GoTo):
            steps, target = engine.model.actions, np.asarray(request.planar, np.float64)
            way = places.way if now.place.agent is None else places.forward_way
            parts = way(now.planar_3, target, steps.step_m, steps.turn_deg)
            if len(parts) > MOST_WAY:
                self._log(
                    f"That place is {len(parts)} steps away: driving the first {MOST_WAY} steps. "
                    "Drag again from there."
                )
            steps_3 = parts[:MOST_WAY].tolist()
            self._todo = collections.deque(Drive((x, y, turn)) for x, y, turn in steps_3)
        elif isinstance(request, Pose):
            self._move_joints(session.apply(engine, now, request))
        elif isinstance(request, Sampler):
            self._sample_in(engine.with_sampler_steps(request.steps), now)
        elif isinstance(request, Record):
            self._begin_film() if request.on else self._end_film()
        else:
            self._edit(engine, now, request, asked)

    def _move_joints(self, now: Session) -> None:
        """Make as many steps as the joints of the body need to reach the wished ones."""
        assert now.place.agent is not None
        assert now.state_A is not None
        assert now.wished_A is not None
        self._session = now
        count = now.place.agent.body.frames_to(now.state_A, now.wished_A)
        self._todo = collections.deque([Drive((0.0, 0.0, 0.0))] * min(count, MOST_WAY))

    def _save_load_or_undo(self, engine: Engine, now: Session, request: Save | Load | Undo) -> None:
        """Save a world, load one, or undo an edit."""
        if isinstance(request, Save):
            path = saved.save(engine, now.world, self._folder, request.name, now.state_A)
            self._log(f"Saved this world as {request.name!r}.", link=path)
            return
        self._todo.clear()
        if isinstance(request, Load):
            world = saved.load(engine, now.world, self._folder, request.name)
            state = saved.posture(self._folder, request.name)
            self._before.append(now)
            self._set(session.resume(now, world, f"This is the world {request.name!r}.", state))
            return
        if not self._before:
            raise UserError("There is nothing to undo.")
        self._set(dataclasses.replace(self._before.pop(), said="Undone."))

    def _sample_in(self, engine: Engine, now: Session) -> None:
        steps = engine.sampler_steps
        with self._busy(f"preparing {steps} steps of the sampler"):
            self._warm(engine, now)
        self._made, self._engine = {}, engine
        self._log(f"Now imagining in {steps} steps of the sampler.")

    def _edit(self, engine: Engine, now: Session, request: Event, asked: float) -> None:
        if isinstance(request, session.Walls):
            self._session = session.apply(engine, now, request)
            self._made = {}  # the steps imagined ahead may be invalid now
            self._log(self._session.said)
            return
        with self._busy("changing the map"):
            after = session.apply(engine, now, request)
        self._before.append(now)
        self._set(after, asked)
        self._catch_up()

    def _begin(self, start: Start) -> None:
        if self._engine is None:
            with self._busy("loading the model"):
                self._engine = self._load()
        engine = self._engine
        with self._busy("looking around"):
            places.require_shown(engine.model, start)
            blocks = places.blocks_of(engine.model)
            place = places.open_place(start, *engine.size, blocks, engine.body)
            begun = session.begin(engine, place, start.seed)
        self._end_film()
        self._before.clear()
        self._todo.clear()
        self._set(begun)
        with self._busy("preparing to imagine (half a minute the first time)"):
            self._warm(engine, begun)
        self._log(f"{begun.said} Press W, A, S, D or the arrows.")

    def _warm(self, engine: Engine, now: Session) -> None:
        """Compile the programs of a step by imagining one ahead."""
        step = Drive((engine.model.actions.step_m, 0.0, 0.0))
        action, _, _ = session.wanted(now, step)
        made = session.ahead(engine, now, action)
        due = (session.step_of(now, action), session.key_of(now))
        due = dataclasses.replace(now, due=due)
        _ = np.asarray(session.catch_up(engine, due).blind.frame.rgb_THWC)
        if engine is self._engine:
            self._made[action.tobytes()] = made

    def _drive(self, step: Drive, asked: float) -> None:
        assert self._engine is not None
        assert self._session is not None
        action, _, collided = session.wanted(self._session, step)
        if collided:
            self._todo.clear()  # the remaining steps assumed another position
        made = self._made.get(action.tobytes())
        after = session.apply(self._engine, self._session, step, made)
        self._last = step.action
        self._set(after, asked)
        self._catch_up()

    def _catch_up(self) -> None:
        """Imagine the step without memory as well, and then record it."""
        assert self._engine is not None
        assert self._session is not None
        if self._session.due is not None:
            self._session = session.catch_up(self._engine, self._session)
            self._log(self._session.said, picture=self._board())
        if self._film is not None:
            self._film.add(self._board())

    def _set(self, after: Session, asked: float | None = None) -> None:
        """Set the state and show it; ``asked`` is the time of the request."""
        if self._session is None or after.world is not self._session.world:
            self._made = {}
        self._session = after
        picture = self._board()  # waits for the imagined frame
        taken = None if asked is None else time.monotonic() - asked
        self._log(after.said, picture=picture, session=after, seconds=taken)

    def _look_ahead(self) -> bool:
        """Imagine one likely next step; return whether there was one left."""
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
                if self._request_within(PAUSE_S):
                    return True
                self._run_safely(lambda a=action: self._make(engine, now, a))
                return action.tobytes() in self._made
        return False

    def _make(self, engine: Engine, now: Session, action: np.ndarray) -> None:
        made = session.ahead(engine, now, action)
        _ = np.asarray(made.frame.rgb_THWC)  # wait for it
        self._made[action.tobytes()] = made

    def _board(self) -> np.ndarray:
        assert self._engine is not None
        assert self._session is not None
        return board.board(board.pictures(self._engine, self._session), self._engine.name)

    def _begin_film(self) -> None:
        self._end_film()
        self._film = DriveFilm(self._folder, self._board())
        self._log("Recording: every step becomes a frame of the video.")

    def _end_film(self) -> None:
        if self._film is None:
            return
        film, self._film = self._film, None
        path = film.close()
        self._log(f"The video is {path.name}.", link=path)

    def _busy(self, text: str) -> contextlib.AbstractContextManager[None]:
        """Show the present work, and its duration."""
        return ticking(text, lambda said: self._log(said, busy=True))

    def _log(self, said: str, **rest) -> None:
        worlds = tuple(saved.names(self._folder))
        shown = PageUpdate(
            said, engine=self._engine, recording=self._film is not None, worlds=worlds, **rest
        )
        with contextlib.suppress(Exception):  # a closed page must not stop the drive
            self._show(shown)


TICK_S = 1.0
"""Seconds between two messages."""


@contextlib.contextmanager
def ticking(text: str, log: Callable[[str], None]) -> Iterator[None]:
    """Report the present work and its duration once a second, also from another thread."""
    begun, ended = time.monotonic(), threading.Event()
    log(f"{text.capitalize()} …")

    def tick() -> None:
        while not ended.wait(TICK_S):
            log(f"{text.capitalize()} … {time.monotonic() - begun:.0f} s")

    ticker = threading.Thread(target=tick, name="ticker", daemon=True)
    ticker.start()
    try:
        yield
    finally:
        ended.set()
        ticker.join()
