"""The page in the browser: images, buttons, keys and the map, served by viser.

Keys are commands with a hotkey. viser's own page moves its 3D camera with the same keys; a listener
installed by the page (``KEYS``) stops these key events, so that the keys only drive.
"""

from __future__ import annotations

import contextlib
import dataclasses
import html
import io
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import ActionConfig
from pewm_jax.play import board, picking, serving, session
from pewm_jax.play.driver import Driver
from pewm_jax.play.joints import JointsPanel
from pewm_jax.play.map_view import MapView, eye_of
from pewm_jax.play.serving import viser
from pewm_jax.play.session import PageUpdate, Request
from pewm_jax.play.settings import Serve, Start
from pewm_jax.report.pictures import as_bytes

VIEW_WIDTH, PANEL_WIDTH = 540, 310
"""Widths of the images and of the controls, pixels."""
SAMPLER = ("1", "2", "4", "8", "16")
STEPS = {
    "forward": (1, 0, 0),
    "back": (-1, 0, 0),
    "turn left": (0, 0, 1),
    "turn right": (0, 0, -1),
    "step left": (0, 1, 0),
    "step right": (0, -1, 0),
}
"""The possible moves, in units of a step forward, a step left and a turn counter-clockwise."""
SIGNS = {
    "◀": "step left",
    "▲": "forward",
    "▼": "back",
    "▶": "step right",
    "↶ left": "turn left",
    "right ↷": "turn right",
}
"""The moves of the buttons."""
HOTKEYS = {
    "forward": ("W", "arrowup"),
    "back": ("S", "arrowdown"),
    "turn left": ("A", "arrowleft"),
    "turn right": ("D", "arrowright"),
    "step left": ("Q",),
    "step right": ("E",),
}
KEYS = (
    "<img alt='' style='display:none' src='data:,' onerror=\"if(!window.drives){window.drives=1;"
    "const k=/^(Key[WASDQE]|Arrow(Up|Down|Left|Right))$/;"
    "document.documentElement.addEventListener('keydown',e=>{"
    "if(k.test(e.code)&&!e.ctrlKey&&!e.metaKey&&!e.altKey&&!/^(INPUT|TEXTAREA|SELECT)$/.test(e.target.tagName))"
    '{e.stopPropagation();e.preventDefault()}})}">'
)
"""Stops the driving keys before they reach the listeners of the document, which move the 3D camera;
the listeners of the root element, which are the hotkeys, run before that."""


class Page:
    """A page served at ``url`` with its driver; ``close`` ends it."""

    def __init__(
        self,
        load: Callable[[], Any],
        start: Start,
        serve: Serve,
        folder: Path,
        name: str,
        log: Callable[[str], None] = lambda _: None,
    ):
        """Serve the page, and start loading the model.

        Args:
            load: returns the model, an ``Engine``.
            start: the start of the drive.
            serve: address, port and names.
            folder: folder of saved worlds and videos.
            name: name of the model, for the title.
            log: receives the page's address, its progress and its errors.

        Raises:
            ConfigError: the page cannot be served at the address.
        """
        self._start, self._seconds, self._tell = start, None, Terminal(log)
        self._server = serving.server(serve, log)
        # Sharing would ask an external server for a public address; this page stays local.
        self._server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
        self.url = f"http://{serving.here(serve.host)}:{self._server.get_port()}"
        log(f"drive: {self.url}  (Ctrl-C ends)")
        if serving.warning(serve):
            log(serving.warning(serve))
        self._map = MapView(self._server)
        gui = self._server.gui
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(96, 200, 255)
        )
        gui.set_panel_label(f"pewm_jax · {name}")
        view = gui.add_panel()
        with view.add_tab("What is seen"):
            self._view = gui.add_image(board.waiting("opening …"), format="jpeg", jpeg_quality=90)
        view.dock_left()
        view.set_width(VIEW_WIDTH)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        self._status = gui.add_html("")
        self._busy = gui.add_progress_bar(100, animated=True, visible=False)
        gui.add_html(KEYS)
        self.driver = Driver(load, start, self.show, folder, ahead=serve.ahead)
        self._add_driving()
        self._joints = JointsPanel(self._server, self._put)
        self._shown: tuple[Any, int] = (None, 0)
        self._add_editing()
        self._add_starting()
        self._files = FilesPanel(self._server, self._put)
        if self.driver.engine is not None:  # it loaded while the page was being built
            self._show_choices(PageUpdate("", engine=self.driver.engine))

    def close(self) -> None:
        """End the drive and the server."""
        self.driver.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def show(self, shown: PageUpdate) -> None:
        """Show an update of the driver; called in its thread."""
        self._seconds = shown.seconds if shown.seconds is not None else self._seconds
        self._tell(shown)
        with self._server.atomic():
            if shown.picture is not None:
                self._view.image = shown.picture
            self._busy.visible = shown.busy
            self._status.content = status_line(shown, self._seconds, len(self._map.points))
        if shown.session is not None and shown.engine is not None:
            seen = as_bytes(np.asarray(shown.session.world.frame.rgb_THWC[0]))
            self._map.show(shown.engine, shown.session, seen)
        self._show_choices(shown)

    def _put(self, request: Request) -> None:
        self.driver.put(request)

    def _act(self, name: str) -> None:
        """Request one of ``STEPS``."""
        forward, left, turn = STEPS[name]
        actions = self._actions()
        angle = math.radians(actions.turn_deg)
        self._put(session.Drive((forward * actions.step_m, left * actions.step_m, turn * angle)))

    def _actions(self) -> Any:
        engine = self.driver.engine
        return ActionConfig() if engine is None else engine.model.actions

    def _add_driving(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Drive"):
            gui.add_html(
                "<div style='padding:0 12px 4px;opacity:.75;font-size:12.5px;line-height:1.45'>"
                "<b>W S</b> or <b>↑ ↓</b> go, <b>A D</b> or <b>← →</b> turn, <b>Q E</b> step aside."
                " Or drag the camera in the map by its arrows and ring.</div>"
            )
            for name, signs in (("Go", ("◀", "▲", "▼", "▶")), ("Turn", ("↶ left", "right ↷"))):
                group = gui.add_button_group(name, signs)
                group.on_click(lambda event: self._act(SIGNS[event.target.value]))
            walls = gui.add_checkbox("Walls stop me", initial_value=True)
            walls.on_update(lambda _: self._put(session.Walls(walls.value)))
            follow = gui.add_checkbox("The map follows me", initial_value=True)
            follow.on_update(lambda _: setattr(self._map, "follow", follow.value))
            ceiling = gui.add_checkbox("Show ceilings", initial_value=False)
            ceiling.on_update(lambda _: self._redraw("ceiling", ceiling.value))
            tint = gui.add_checkbox("Mark imagined points", initial_value=False)
            tint.on_update(lambda _: self._redraw("tint", tint.value))
            above = gui.add_button("Look from above", icon=viser.Icon.EYE)
            above.on_click(lambda _: self._map.look_from_above())
        for name, keys in HOTKEYS.items():
            for key in keys:
                command = gui.add_command(f"{name} ({key})", hotkey=key)  # type: ignore[arg-type]
                command.on_trigger(lambda _, name=name: self._act(name))

        @self._map.handle.on_update
        def _(event: Any) -> None:
            if event.phase == "end":
                self._put(session.GoTo(self._map.dragged()))

    def _redraw(self, name: str, value: bool) -> None:
        setattr(self._map, name, value)
        self._map.redraw()

    def _add_editing(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        self._editing = gui.add_folder("Edit the world")
        with self._editing:
            gui.add_html(
                "<div style='padding:0 12px 4px;opacity:.75;font-size:12.5px;line-height:1.45'>"
                "<b>Shift + drag</b> a rectangle in the map, or <b>shift + click</b>, to choose a "
                "box. Drag the green box to its new place.</div>"
            )
            self._middle = gui.add_vector3("Middle", (0.0, 0.0, 0.0), step=0.05)
            self._size = gui.add_vector3("Size", (0.9, 0.9, 1.1), step=0.05, min=(0.05, 0.05, 0.05))
            for part in (self._middle, self._size):
                part.on_update(self._typed)
            erase = gui.add_button("Erase", icon=viser.Icon.ERASER, color="red")
            move = gui.add_button("Move to the green box", icon=viser.Icon.ARROWS_MOVE)
            copy = gui.add_button("Copy to the green box", icon=viser.Icon.COPY)
            undo = gui.add_button("Undo", icon=viser.Icon.ARROW_BACK_UP, color="gray")
        erase.on_click(lambda _: self._edit("erase"))
        move.on_click(lambda _: self._edit("move"))
        copy.on_click(lambda _: self._edit("copy"))
        undo.on_click(lambda _: self._put(session.Undo()))

        @scene.on_rect_select(modifier="shift")
        def _(event: Any) -> None:
            eye = eye_of(event.client.camera)
            box = picking.in_rectangle(self._map.points, eye, event.screen_min, event.screen_max)
            self._choose(box)

        @scene.on_click(modifier="shift")
        def _(event: Any) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            self._choose(picking.at_click(self._map.points, origin, direction))

    def _choose(self, box_23: np.ndarray | None) -> None:
        """Select a box and write its numbers into the fields."""
        self._map.choose(box_23)
        if box_23 is not None:
            x, y, z = (round(float(v), 2) for v in box_23.mean(0))
            self._middle.value = (x, y, z)
            x, y, z = (round(float(v), 2) for v in box_23[1] - box_23[0])
            self._size.value = (x, y, z)

    def _typed(self, event: Any) -> None:
        """Select the box typed by a user; ignore values written by the page itself."""
        if event.client is not None:
            middle, half = np.array(self._middle.value), np.array(self._size.value) / 2
            self._map.choose(np.stack([middle - half, middle + half]))

    def _edit(self, how: str) -> None:
        if self._map.box_23 is None:
            self.driver.tell("Choose a box first: shift + drag a rectangle in the map.")
            return
        low, high = self._map.box_23.tolist()
        box = (tuple(low), tuple(high))
        if how == "erase":
            self._put(session.Erase(box))
        else:
            shift, turn = self._map.moved()
            self._put(session.Move(box, shift, turn, leave=how == "copy"))
        self._map.choose(None)

    def _add_starting(self) -> None:
        gui, start = self._server.gui, self._start
        given = start.scene or start.episode or start.recording
        with gui.add_folder("Begin elsewhere", expand_by_default=False):
            sources = ("a generated house", *([Path(given).name] if given else []))
            source = gui.add_dropdown("From", sources, initial_value=sources[-1])
            house = gui.add_number("House", start.house, min=0, step=1)
            seed = gui.add_number("Seed", start.seed, min=0, step=1)
            begin = gui.add_button("New drive", icon=viser.Icon.PLAYER_PLAY)
            steps: Any = gui.add_dropdown("Sampling steps", SAMPLER)

        def anew(_: Any) -> None:
            changes: dict[str, Any] = {"house": int(house.value), "seed": int(seed.value)}
            if source.value == sources[0]:
                changes |= {"scene": "", "episode": "", "recording": ""}
            self._map.choose(None)
            self._put(session.Begin(dataclasses.replace(start, **changes)))

        begin.on_click(anew)
        steps.on_update(lambda event: event.client and self._put(session.Sampler(int(steps.value))))

        self._steps = steps

    def _show_joints(self, now: session.Session | None) -> None:
        """Set the sliders where the joints were not set by them: another drive, Load, Undo."""
        if now is None or now.wished_A is None:
            return
        place, steps = self._shown
        if now.place is not place or now.steps < steps or not now.steps:
            self._joints.set(now.wished_A[:-2])
        self._shown = now.place, now.steps

    def _show_choices(self, shown: PageUpdate) -> None:
        """Show the available sampling steps, worlds and files, and what this model can do."""
        if not hasattr(self, "_files"):  # the page is still being built
            return
        count = str(shown.engine.sampler_steps) if shown.engine is not None else "0"
        if shown.engine is not None:
            self._editing.visible = shown.engine.editable
            self._joints.show(shown.engine.body)
            self._show_joints(shown.session)
            self._steps.visible = count != "0"
        if count not in ("0", self._steps.value):
            self._steps.options = tuple(sorted({*SAMPLER, count}, key=int))
            self._steps.value = count
        self._files.show(shown)


SAY_AGAIN_S = 10.0
"""Seconds after which the terminal repeats the message of the present work."""


class Terminal:
    """Prints the page's present work and its errors to the terminal."""

    def __init__(self, log: Callable[[str], None]):
        self._log, self._phase, self._reported = log, "", 0.0

    def __call__(self, shown: PageUpdate) -> None:
        """Print an update of the driver if it is new."""
        phase = shown.said.partition(" …")[0] if shown.busy or shown.failed else ""
        late = shown.busy and time.monotonic() - self._reported >= SAY_AGAIN_S
        if phase and (phase != self._phase or late):
            self._log(shown.said if shown.busy else f"error: {phase}")
            self._reported = time.monotonic()
        if self._phase.startswith("Preparing") and not phase:
            self._log("Ready.")
        self._phase = phase


def status_line(shown: PageUpdate, seconds: float | None, points: int) -> str:
    """Return the status line as HTML.

    ``seconds`` is the duration of the last step, if there was one; ``points`` the number of points
    shown in the map.
    """
    colour = "#ff8a80" if shown.failed else "#60c8ff" if shown.busy else "#7fe0a0"
    said = html.escape(shown.said)
    facts = []
    if shown.engine is not None and shown.engine.sampler_steps:
        facts.append(f"{shown.engine.sampler_steps} sampling steps")
    if seconds is not None:
        facts.append(f"last step {seconds:.2f} s")
    if points:
        facts.append(f"{points:,} points")
    if shown.recording:
        facts.append("<span style='color:#ff8a80'>● recording</span>")
    return (
        "<div style='padding:2px 12px 6px;min-height:74px'>"
        f"<div style='display:flex;gap:8px;line-height:1.35;font-size:14px'>"
        f"<span style='color:{colour}'>●</span><span>{said or 'Ready.'}</span></div>"
        "<div style='opacity:.6;font-size:12px;margin:6px 0 0 17px'>"
        f"{' · '.join(facts)}</div></div>"
    )


class FilesPanel:
    """The controls of saved worlds and videos; ``show`` updates them."""

    def __init__(self, server: viser.ViserServer, put: Callable[[Request], None]):
        """Add it to a page; ``put`` receives the requests."""
        gui = server.gui
        with gui.add_folder("Worlds and videos", expand_by_default=False):
            name = gui.add_text("Name", "my world")
            save = gui.add_button("Save this world", icon=viser.Icon.DEVICE_FLOPPY)
            self._worlds: Any = gui.add_dropdown("Saved", ("none yet",))
            load = gui.add_button("Open it", icon=viser.Icon.FOLDER_OPEN)
            self._record = gui.add_button("Record a video", icon=viser.Icon.VIDEO, color="red")
            self._file = gui.add_button("Download", icon=viser.Icon.DOWNLOAD, visible=False)
        self._link: Path | None = None
        self._recording = False
        save.on_click(lambda _: put(session.Save(name.value)))
        load.on_click(lambda _: put(session.Load(self._worlds.value)))
        self._record.on_click(lambda _: put(session.Record(not self._recording)))

        @self._file.on_click
        def _(event: Any) -> None:
            if self._link is not None and self._link.is_file() and event.client is not None:
                event.client.send_file_download(self._link.name, self._link.read_bytes())

    def show(self, shown: PageUpdate) -> None:
        """Show the saved worlds, whether a video is being recorded, and the last file written."""
        options = shown.worlds or ("none yet",)
        if options != self._worlds.options:
            self._worlds.options = options
        if shown.recording != self._recording:
            self._recording = shown.recording
            self._record.label = "End the video" if shown.recording else "Record a video"
        if shown.link is not None:
            self._link = shown.link
            self._file.label, self._file.visible = f"Download {shown.link.name}", True
