"""Memory that a process keeps: glibc's arenas, which grow with the threads that ask for memory."""

from __future__ import annotations

import ctypes

MMAP_THRESHOLD, ARENA_MAX = -3, -8
"""The names of these settings in glibc's ``malloc.h``: ``M_MMAP_THRESHOLD`` and ``M_ARENA_MAX``."""
ARENAS = 2
"""Arenas for all threads. By default there are up to eight for each core, and each keeps what was
once free in it, so that a page whose threads imagine, draw and serve grows as it is used."""
LARGE = 1 << 20
"""Bytes from which a block is taken from the system and given back when it is free. By default that
limit grows up to 32 MB with what is freed, and maps of steps that are past leave holes."""


def keep_small() -> bool:
    """Let all threads of this process share ``ARENAS`` arenas, and give ``LARGE`` blocks back.

    Settings of the process, for command lines only. They must come before libraries begin threads,
    and so before NumPy is imported. With other C libraries nothing happens.

    Returns:
        Whether that was possible.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    return mallopt(ARENA_MAX, ARENAS) == 1 and mallopt(MMAP_THRESHOLD, LARGE) == 1
