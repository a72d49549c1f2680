"""Memory that a process keeps: glibc's arenas, which grow with the threads that ask for memory."""

from __future__ import annotations

import ctypes

ARENA_MAX = -8
"""The name of this setting in glibc's ``malloc.h``, ``M_ARENA_MAX``."""
ARENAS = 2
"""Arenas for all threads. By default there are up to eight for each core, and each keeps what was
once free in it, so that a page whose threads imagine, draw and serve grows as it is used."""


def few_arenas() -> bool:
    """Let all threads of this process share ``ARENAS`` arenas; tells whether that was possible.

    A setting of the process, for command lines only. It must come before libraries begin threads,
    and so before NumPy is imported. With other C libraries nothing happens.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    return mallopt(ARENA_MAX, ARENAS) == 1
