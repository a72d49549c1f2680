"""What a process says when a training of several ends, in one sentence.

When another process dies, JAX ends this one from a thread of its own, with pages of C++ on standard
error and no way for Python to speak. So in a job of several processes standard error passes through
a small program (this file, run by itself), which puts one sentence in the place of such pages.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

GONE = (
    "Another process of this training is gone, or cannot be reached: see what the others say, and "
    "start all of them again to go on from the last checkpoint."
)
_FATAL = re.compile(
    rb"^[EF]\d{4} [\d:.]+ +\d+ (coordination_service|coordination_service_agent|client)\.(cc|h):"
)
_ERROR = b"error: "
_DRAIN_S = 5.0


@contextlib.contextmanager
def one_sentence() -> Iterator[Callable[[], None]]:
    """Pass standard error through the filter for a while, that of C++ included.

    Yields:
        A function to call when the process has said all: from then on, and after, it is silent.
        (JAX's thread may notice what was just told in a sentence, and would tell it in pages.)
    """
    sys.stderr.flush()
    before = os.dup(2)
    said = threading.Event()
    # A session of its own: Ctrl-C in a terminal is for the training, not for this.
    filtering = subprocess.Popen(  # noqa: S603 - this very file
        [sys.executable, "-I", "-S", __file__], stdin=subprocess.PIPE, start_new_session=True
    )
    assert filtering.stdin is not None
    os.dup2(filtering.stdin.fileno(), 2)
    filtering.stdin.close()
    try:
        yield said.set
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        after = os.open(os.devnull, os.O_WRONLY) if said.is_set() else before
        os.dup2(after, 2)
        for handle in {before, after}:
            os.close(handle)
        with contextlib.suppress(subprocess.TimeoutExpired):
            filtering.wait(_DRAIN_S)


def filtered(lines: Iterator[bytes]) -> Iterator[bytes]:
    """Pass lines on until the first error, and nothing after it.

    Args:
        lines: what a process writes to standard error.

    Returns:
        The same lines; in the place of the first that JAX ends the process with, ``GONE``.
    """
    for line in lines:
        fatal = bool(_FATAL.match(line))
        yield _ERROR + GONE.encode() + b"\n" if fatal else line
        if fatal or line.startswith(_ERROR):
            for _ in lines:
                pass


if __name__ == "__main__":
    for passed in filtered(iter(sys.stdin.buffer.readline, b"")):
        sys.stderr.buffer.write(passed)
        sys.stderr.buffer.flush()
