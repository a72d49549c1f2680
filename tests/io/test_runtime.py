"""What a command asks of glibc's heap: few arenas, or memory that is kept."""

import ctypes
import subprocess
import sys

import pytest

from pewm_jax.io import runtime

THREADS = 6
COUNT = f"""
import ctypes, sys, threading
from pewm_jax.io import runtime
if sys.argv[1] == "few":
    assert runtime.keep_small()
libc = ctypes.CDLL(None)
together = threading.Barrier({THREADS})

def ask():
    libc.malloc(100)
    together.wait()

threads = [threading.Thread(target=ask) for _ in range({THREADS})]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
"""
"""Prints what glibc says of its arenas after threads have all asked for memory at once."""


def arenas(how):
    done = subprocess.run(
        [sys.executable, "-c", COUNT, how], capture_output=True, text=True, check=True
    )
    return done.stdout.count("<heap nr=")


FAULTS = """
import ctypes, resource, sys
from pewm_jax.io import runtime
if sys.argv[1] == "kept":
    assert runtime.keep_large()
libc, size = ctypes.CDLL(None), 64 << 20
libc.malloc.restype = libc.memset.restype = ctypes.c_void_p

def step():
    block = ctypes.c_void_p(libc.malloc(ctypes.c_size_t(size)))
    libc.memset(block, 1, ctypes.c_size_t(size))
    libc.free(block)

step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
[step() for _ in range(4)]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
"""Prints how many pages the system clears while a large block is taken and freed four times."""
glibc = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library is not glibc"
)


@glibc
def test_large_blocks_are_kept_only_when_asked_to():
    kept, given_back = (
        int(
            subprocess.run(
                [sys.executable, "-c", FAULTS, how], capture_output=True, check=True
            ).stdout
        )
        for how in ("kept", "not")
    )
    assert kept < 100 < given_back


@glibc
def test_threads_share_keep_small_only_when_asked_to():
    assert arenas("few") <= runtime.ARENAS < arenas("many")


def test_where_there_is_nothing_to_set_it_says_so(monkeypatch):
    monkeypatch.setattr(runtime.ctypes, "CDLL", lambda _: object())
    assert not runtime.keep_small()
    assert not runtime.keep_large()
