"""Process setup of a command: glibc's ``malloc``, and JAX's compilation cache.

``keep_small`` and ``keep_large`` must run before libraries start threads, and so before NumPy is
imported. With other C libraries they do nothing.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import sys
from pathlib import Path
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io.seals import Seals, read_key

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
ENTRY = "-cache"
"""End of the names of compiled programs in JAX's cache."""
COMPILED = "/jax/core/compile/backend_compile_duration"
"""JAX's event after a program was compiled, and kept."""
SMALL_TOO = (
    ("jax_persistent_cache_min_compile_time_secs", 1.0, 0.0),
    ("jax_persistent_cache_min_entry_size_bytes", 0, -1),
)
"""Option, JAX's default and ours: programs that compile fast are kept, too; together they take
seconds."""


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
    """Make JAX keep compiled programs in a folder, so that the next start compiles nothing.

    Programs are kept in ``folder/.cache``, apart for each user, version of JAX and set of CPU
    features.
    JAX's own key of a program contains its operations, the compiler's version and options, and the
    device. A kept program is machine code, so only those are loaded that this user's processes have
    written and nobody has changed (``io.seals``); others are removed, and one line says so.

    Call this from commands and scripts only: it sets global options of JAX. A cache folder chosen
    by the caller (``JAX_COMPILATION_CACHE_DIR`` or ``jax.config``) is kept, and so is a cache that
    the caller has disabled (``JAX_ENABLE_COMPILATION_CACHE``).

    Raises:
        UserError: ``folder`` is no path.
    """
    if not isinstance(folder, str | os.PathLike):
        raise UserError(
            f"cache_compilation() got a folder of type {type(folder).__name__}: pass a path, such "
            "as 'runs'."
        )
    import jax  # noqa: PLC0415 - takes seconds, and error paths do not need it

    chosen: Any = jax.config
    if chosen.jax_compilation_cache_dir or not chosen.jax_enable_compilation_cache:
        return
    try:
        key = read_key()
        path = (Path(folder) / ".cache" / _kind(jax, key)).resolve()
        seals = Seals(path, ENTRY, key)
        removed = seals.remove_foreign()
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        print(f"Compiled programs are not kept: {error}.", file=sys.stderr, flush=True)
        return
    if removed:
        were = "program is" if removed == 1 else "programs are"
        print(
            f"{removed} compiled {were} damaged or not from this user, and compiled anew: {path}",
            file=sys.stderr,
            flush=True,
        )
    jax.config.update("jax_compilation_cache_dir", str(path))
    for name, default, ours in SMALL_TOO:
        if getattr(jax.config, name) == default:
            jax.config.update(name, ours)

    def seal(event: str, duration_secs: float, **_: Any) -> None:
        del duration_secs
        if event == COMPILED:
            seals.add_new()

    jax.monitoring.register_event_duration_secs_listener(seal)


def _kind(jax: Any, key: bytes) -> str:
    """Return a name for the CPU's features, the versions of JAX and this user."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else [platform.processor()]
    features = next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
    versions = jax.__version__, jax.lib.__version__
    named = "\n".join((features, *versions)).encode() + hashlib.sha256(key).digest()
    return hashlib.sha256(named).hexdigest()[:12]
