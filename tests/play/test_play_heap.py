"""Threads share few of glibc's arenas once the command has asked for it."""

import ctypes
import subprocess
import sys

import pytest

from pewm_jax.play import heap

THREADS = 6
COUNT = f"""
import ctypes, sys, threading
from pewm_jax.play import heap
if sys.argv[1] == "few":
    assert heap.keep_small()
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


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library is not glibc")
def test_threads_share_keep_small_only_when_asked_to():
    assert arenas("few") <= heap.ARENAS < arenas("many")


def test_where_there_is_nothing_to_set_it_says_so(monkeypatch):
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda _: object())
    assert not heap.keep_small()
