"""The part of the page that keeps: saved worlds, the video, and what can be downloaded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pewm_jax.play import requests
from pewm_jax.play.extra import viser
from pewm_jax.play.requests import Request, Shown


class FilesPanel:
    """A folder of the controls; ``show`` tells it what there is."""

    def __init__(self, server: viser.ViserServer, put: Callable[[Request], None]):
        """Add it to a page.

        Args:
            server: the page.
            put: takes what is asked for.
        """
        gui = server.gui
        with gui.add_folder("Worlds and videos", expand_by_default=False):
            name = gui.add_text("Name", "my world")
            save = gui.add_button("Save this world", icon=viser.Icon.DEVICE_FLOPPY)
            self._worlds: Any = gui.add_dropdown("Saved", ("none yet",))
            load = gui.add_button("Go on in it", icon=viser.Icon.FOLDER_OPEN)
            self._record = gui.add_button("Record a video", icon=viser.Icon.VIDEO, color="red")
            self._file = gui.add_button("Download", icon=viser.Icon.DOWNLOAD, visible=False)
        self._link: Path | None = None
        self._recording = False
        save.on_click(lambda _: put(requests.Save(name.value)))
        load.on_click(lambda _: put(requests.Load(self._worlds.value)))
        self._record.on_click(lambda _: put(requests.Record(not self._recording)))

        @self._file.on_click
        def _(event: Any) -> None:
            if self._link is not None and self._link.is_file() and event.client is not None:
                event.client.send_file_download(self._link.name, self._link.read_bytes())

    def show(self, shown: Shown) -> None:
        """Show which worlds there are, whether a video is recorded, and what was written."""
        options = shown.worlds or ("none yet",)
        if options != self._worlds.options:
            self._worlds.options = options
        if shown.recording != self._recording:
            self._recording = shown.recording
            self._record.label = "End the video" if shown.recording else "Record a video"
        if shown.link is not None:
            self._link = shown.link
            self._file.label, self._file.visible = f"Download {shown.link.name}", True
