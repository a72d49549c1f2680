"""A client of the live viewer without a browser: it receives the page's messages and presses keys.

`python benchmarks/tab.py URL` waits until the page is ready, drives one step and prints how long
that took. It uses the protocol of the installed version of viser.
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
"""The first message of a client; the server ignores clients that have not sent it."""
AGENT = "/agent"
"""The scene node that moves at each step."""


class Tab:
    """A connection to the viewer, with the state that the server has sent.

    Attributes:
        keys: the names of the commands, with their identifiers.
        status: the status line, as HTML.
    """

    def __init__(self, connection: ClientConnection):
        self._connection = connection
        self._unpack = zstandard.ZstdDecompressor()
        self.keys: dict[str, str] = {}
        self.status = ""

    def press(self, name: str) -> None:
        """Trigger a command, such as ``forward (W)``."""
        message = {"type": "CommandTriggerMessage", "uuid": self.keys[name]}
        self._say(message)

    @property
    def at_wall(self) -> bool:
        """Whether the last step was stopped by a wall."""
        return "Blocked by a wall" in self.status

    def begin(self) -> None:
        """Send the camera, as a browser does first."""
        self._say(CAMERA)

    def _say(self, message: dict) -> None:
        self._connection.send(msgspec.msgpack.encode(message))

    def hear(self, seconds: float) -> list[dict]:
        """Return the next messages; none if none arrive within some seconds."""
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
        """Make a step; return the seconds until the agent has moved or is blocked by a wall."""
        begun = time.monotonic()
        self.press(name)
        while time.monotonic() - begun < patience_s:
            told = self.hear(1.0)
            if any(message.get("name") == AGENT for message in told):
                return time.monotonic() - begun
            if not told and self.at_wall:  # the same status is not sent twice
                return time.monotonic() - begun
        raise TimeoutError(f"no answer to {name} within {patience_s} s: {self.status}")

    def listen(self, seconds: float) -> None:
        """Receive messages for some seconds."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.hear(left)

    def until(self, sentence: str, patience_s: float = 600.0) -> None:
        """Receive messages until the status line contains a sentence."""
        end = time.monotonic() + patience_s
        while sentence not in self.status:
            if time.monotonic() > end:
                raise TimeoutError(f"the status line never contained {sentence!r}: {self.status}")
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
