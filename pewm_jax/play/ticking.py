"""Saying, once a second, that something takes long."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

TICK_S = 1.0
"""Seconds between two messages."""


@contextlib.contextmanager
def during(text: str, say: Callable[[str], None]) -> Iterator[None]:
    """Say what takes long, and how long it has taken, while the block runs.

    Args:
        text: what is being done.
        say: told, also from another thread.
    """
    begun, ended = time.monotonic(), threading.Event()
    say(f"{text.capitalize()} …")

    def tick() -> None:
        while not ended.wait(TICK_S):
            say(f"{text.capitalize()} … {time.monotonic() - begun:.0f} s")

    ticker = threading.Thread(target=tick, name="ticker", daemon=True)
    ticker.start()
    try:
        yield
    finally:
        ended.set()
        ticker.join()
