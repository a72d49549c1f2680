"""A tab without a browser: it listens to the live viewer and presses its keys.

`python benchmarks/tab.py URL` waits until the page is ready, drives one step and says how long that
took. It speaks the language of the viser that is installed beside it.
"""

from __future__ import annotations

import contextlib
import re
import sys
import time
from collections.abc import Iterator

import msgspec
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 3.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 1.0, 0.0),
}
"""What a tab says first; the server listens to none that has not said it."""
AGENT = "/agent"
"""What moves in the map at each step."""


class Tab:
    """What the server has told so far.

    Attributes:
        keys: the names of what can be done, with what the server calls them.
        status: the line that says how things are, as HTML.
    """

    def __init__(self, connection: ClientConnection):
        self._connection = connection
        self._unpack = zstandard.ZstdDecompressor()
        self.keys: dict[str, str] = {}
        self.status = ""

    def press(self, name: str) -> None:
        """Ask for what a key does, such as ``forward (W)``."""
        message = {"type": "CommandTriggerMessage", "uuid": self.keys[name]}
        self._say(message)

    @property
    def at_wall(self) -> bool:
        """Whether the last step was stopped by a wall."""
        return "There is a wall" in self.status

    def begin(self) -> None:
        """Say where this tab's camera is, as a browser does first."""
        self._say(CAMERA)

    def _say(self, message: dict) -> None:
        self._connection.send(msgspec.msgpack.encode(message))

    def hear(self, seconds: float) -> list[dict]:
        """Return what is told next; nothing if nothing is within some seconds."""
        try:
            raw = self._connection.recv(timeout=max(seconds, 0.001))
        except TimeoutError:
            return []
        size = int.from_bytes(raw[8:16], "little")
        told = msgspec.msgpack.decode(self._unpack.decompress(raw[16 : 16 + size]))["messages"]
        for message in told:
            if message["type"] == "RegisterCommandMessage":
                self.keys[message["props"]["label"]] = message["uuid"]
            content = str(message.get("updates", {}).get("content", ""))
            if "min-height" in content:
                self.status = content
        return told

    def step(self, name: str, patience_s: float = 600.0) -> float:
        """Make a step; returns the seconds until the agent stands elsewhere, or at a wall."""
        begun = time.monotonic()
        self.press(name)
        while time.monotonic() - begun < patience_s:
            told = self.hear(1.0)
            if any(message.get("name") == AGENT for message in told):
                return time.monotonic() - begun
            if not told and self.at_wall:  # a wall that it stood at before is not told again
                return time.monotonic() - begun
        raise TimeoutError(f"{name} was not answered in {patience_s} s: {self.status}")

    def listen(self, seconds: float) -> None:
        """Take all that is told for some seconds."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.hear(left)

    def until(self, sentence: str, patience_s: float = 600.0) -> None:
        """Listen until the page says something."""
        end = time.monotonic() + patience_s
        while sentence not in self.status:
            if time.monotonic() > end:
                raise TimeoutError(f"The page did not say {sentence!r}: {self.status}")
            self.hear(1.0)


@contextlib.contextmanager
def opened(url: str) -> Iterator[Tab]:
    """Open a tab at the address of a page."""
    protocol = f"viser-v{viser.__version__}"
    there = re.sub(r"^http", "ws", url)
    with connect(there, origin=url, subprotocols=[protocol], max_size=None) as connection:
        tab = Tab(connection)
        tab.begin()
        yield tab


if __name__ == "__main__":
    with opened(sys.argv[1]) as tab:
        tab.until("Press W, A, S, D")
        print(f"{tab.step('forward (W)'):.2f}")
