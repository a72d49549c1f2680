"""Parts of the page: the status line, its copy in the terminal, and the panel of saved files."""

from __future__ import annotations

import html
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pewm_jax.play import session
from pewm_jax.play.extra import viser
from pewm_jax.play.session import PageUpdate, Request

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

    Args:
        shown: the update of the driver.
        seconds: duration of the last step, if there was one.
        points: number of points shown in the map.
    """
    colour = "#ff8a80" if shown.failed else "#60c8ff" if shown.busy else "#7fe0a0"
    said = html.escape(shown.said)
    facts = []
    if shown.engine is not None and shown.engine.sampler_steps:
        facts.append(f"{shown.engine.sampler_steps} sampler steps")
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
        """Add it to a page.

        Args:
            server: the page.
            put: receives the requests.
        """
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
