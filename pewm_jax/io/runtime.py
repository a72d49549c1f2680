"""Process setup of a command: glibc's ``malloc``, and JAX's compilation cache.

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
"""Numbers of these parameters in glibc's ``malloc.h``: ``M_TRIM_THRESHOLD`` and so on."""
ARENAS = 2
"""Number of arenas for all threads. By default there are up to eight per core, and each keeps its
freed memory, so the memory use of a page with threads for imagining, drawing and serving grows over
time."""
LARGE = 1 << 20
"""Size in bytes from which blocks are mapped separately and returned to the system when freed. The
default threshold grows up to 32 MB as blocks are freed; then freed maps leave holes in the heap."""
NEVER = -1
"""The trim threshold at which memory is never returned to the system."""
PAD = 1 << 28
"""Number of bytes requested from the system at once."""


def keep_small() -> bool:
    """Limit this process to ``ARENAS`` malloc arenas, and return freed blocks from ``LARGE`` bytes.

    For servers that run for days. Returns whether the settings were accepted.
    """
    return _set({ARENA_MAX: ARENAS, MMAP_THRESHOLD: LARGE})


def keep_large() -> bool:
    """Keep freed memory in the process, including large blocks, and reuse it.

    For training on CPUs. By default each large array is mapped again at every step, and the system
    zeroes its pages one by one (``benchmarks/heap.py`` measures the cost). Returns whether the
    settings were accepted.
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

    There is one cache per set of CPU features, because programs are compiled for them. Call this
    from commands only: it sets a global option of JAX. A cache folder chosen by the caller
    (``JAX_COMPILATION_CACHE_DIR`` or ``jax.config``) is kept, and so is a cache that the caller has
    disabled (``JAX_ENABLE_COMPILATION_CACHE``).
    """
    import jax  # noqa: PLC0415 - takes seconds, and error paths do not need it

    chosen: Any = jax.config
    if chosen.jax_compilation_cache_dir or not chosen.jax_enable_compilation_cache:
        return
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else [platform.processor()]
    features = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    kind = hashlib.sha256(features.encode()).hexdigest()[:12]
    path = (Path(folder) / ".cache" / kind).resolve()
    jax.config.update("jax_compilation_cache_dir", str(path))
