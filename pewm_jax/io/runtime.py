"""Set up the process of a command: glibc's ``malloc``, and the cache of compiled programs.

``keep_small`` and ``keep_large`` must run before libraries start threads, and so before NumPy is
imported. With other C libraries they do nothing.
"""

from __future__ import annotations

import ctypes
import hashlib
import platform
from pathlib import Path
from typing import Any

TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -2, -3, -4, -8
"""The names of these settings in glibc's ``malloc.h``: ``M_TRIM_THRESHOLD`` and so on."""
ARENAS = 2
"""Arenas for all threads. By default there are up to eight for each core, and each keeps what was
once free in it, so that a page whose threads imagine, draw and serve grows as it is used."""
LARGE = 1 << 20
"""Bytes from which a block is taken from the system and given back when it is free. By default that
limit grows up to 32 MB with what is freed, and maps of steps that are past leave holes."""
NEVER = -1
"""The trim threshold at which memory is never given back."""
PAD = 1 << 28
"""Bytes that are taken from the system at once."""


def keep_small() -> bool:
    """Let all threads of this process share ``ARENAS`` arenas, and give ``LARGE`` blocks back.

    For pages that are served for days.

    Returns:
        Whether that was possible.
    """
    return _set({ARENA_MAX: ARENAS, MMAP_THRESHOLD: LARGE})


def keep_large() -> bool:
    """Keep what was once taken, large blocks as well, and take it again.

    For trainings on processors. By default each large array is mapped anew at every step, and the
    system clears its pages one by one (``benchmarks/heap.py`` says what that takes).

    Returns:
        Whether that was possible.
    """
    return _set({ARENA_MAX: 1, MMAP_MAX: 0, TRIM_THRESHOLD: NEVER, TOP_PAD: PAD})


def _set(values: dict[int, int]) -> bool:
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    return all(mallopt(name, value) == 1 for name, value in values.items())


def cache_compilation(folder: str | Path) -> None:
    """Make JAX cache compiled programs in a folder, so that the next start is faster.

    There is one cache per set of processor features, for which programs are compiled. Call this
    from commands only: it sets a global option of JAX. A folder that the caller has chosen, by
    ``JAX_COMPILATION_CACHE_DIR`` or ``jax.config``, stays, and so does a cache that the caller has
    switched off (``JAX_ENABLE_COMPILATION_CACHE``).
    """
    import jax  # noqa: PLC0415 - takes seconds, and refusals do not need it

    chosen: Any = jax.config
    if chosen.jax_compilation_cache_dir or not chosen.jax_enable_compilation_cache:
        return
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else [platform.processor()]
    features = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    kind = hashlib.sha256(features.encode()).hexdigest()[:12]
    path = (Path(folder) / ".cache" / kind).resolve()
    jax.config.update("jax_compilation_cache_dir", str(path))
