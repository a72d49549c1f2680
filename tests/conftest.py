"""Compile fast rather than well: tests are never timed, and compiling is most of what they do."""

import contextlib
import ctypes
import gc
import importlib.util
import mmap
import os
import signal
import sys
import tempfile
import types
from pathlib import Path

import pytest
from hypothesis import settings

from tests import properties  # noqa: F401 - registers the profiles of hypothesis

settings.load_profile("all")  # `make test` asks for the profile `quick`

QUICK = {
    "xla_backend_optimization_level": "0",
    "xla_llvm_disable_expensive_passes": "true",
    "xla_cpu_parallel_codegen_split_count": "1",  # a program in many parts takes longer in all
}


def known(flags):
    """Return those flags that this XLA has a name for: it ends a program that asks for others."""
    (folder,) = importlib.util.find_spec("jaxlib").submodule_search_locations
    with (
        max(Path(folder).glob("*.so"), key=lambda path: path.stat().st_size).open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as library,
    ):
        return {flag: value for flag, value in flags.items() if library.find(flag.encode()) >= 0}


given = os.environ.get("XLA_FLAGS", "")
if next(iter(QUICK)) not in given:  # workers inherit them, as do the programs that tests start
    quick = (f"--{flag}={value}" for flag, value in known(QUICK).items())
    os.environ["XLA_FLAGS"] = " ".join([given, *quick]).strip()

# The key of compiled programs is not the user's own.
os.environ["XDG_STATE_HOME"] = str(Path(tempfile.gettempdir()) / f"pewm-jax-tests-{os.getuid()}")

# A shell that starts the tests in the background tells them to ignore Ctrl-C, and so would every
# program that they start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

COMPILED = pytest.StashKey[tempfile.TemporaryDirectory]()


def pytest_configure(config):
    """Keep compiled programs while tests run: many compile the same ones once more.

    Each worker has a folder of its own, since JAX's files are not whole until they are written, and
    programs that tests start have none: they may be killed.
    """
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        import jax

        folder = config.stash[COMPILED] = tempfile.TemporaryDirectory(prefix="compiled-")
        jax.config.update("jax_compilation_cache_dir", folder.name)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def pytest_unconfigure(config):
    if COMPILED in config.stash:
        config.stash[COMPILED].cleanup()


FIRST = (
    "docs/test_commands.py",
    "train/test_devices.py",
    "plan/test_sums.py",
    "train/test_processes.py",
    "train/test_kills.py",
    "cli/test_train.py",
    "eval/test_evaluate.py",
    "worlds/test_calls.py",
    "worlds/pewm/test_world.py",
    "planning/test_worlds.py",
    "worlds/persist/test_world.py",
    "worlds/test_rollouts.py",
)
"""Files that take longest: begun first, so that no worker is left alone with one at the end."""


HERE = Path(__file__).parent
MAPS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")
MOST_MAPS = 25_000
"""Linux lets a process map 65,530 regions of memory. Every compiled program takes several, and one
too many ends the process."""
MOST_BYTES, MORE_BYTES = 1_200_000_000, 300_000_000
"""Memory above which a worker drops its compiled programs, and growth until it does so once more;
it may take 2 GB."""
LIMIT = [MOST_BYTES]


def resident():
    """Return the bytes of memory that this process holds."""
    return int(PAGES.read_text().split()[1]) * mmap.PAGESIZE


def pytest_runtest_teardown(item, nextitem):
    """Drop compiled programs where they take much memory; most are found on disk again."""
    if "jax" not in sys.modules or not PAGES.exists():
        return
    full = resident() > LIMIT[0]
    if not full and (nextitem is None or nextitem.path != item.path):  # to count takes a while
        with MAPS.open("rb") as file:
            full = sum(1 for _ in file) > MOST_MAPS
    if full:
        sys.modules["jax"].clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):  # a C library other than GNU's
            ctypes.CDLL(None).malloc_trim(0)
        LIMIT[0] = max(MOST_BYTES, resident() + MORE_BYTES)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Order the files for workers that take one file at a time, and find the cases that are slow.

    Of a parametrized test, ``@pytest.mark.slow(but=…)`` marks all cases except those with these
    ids, and ``@pytest.mark.slow(only=…)`` those whose ids contain one of these texts; each is a
    text or a tuple of texts.
    """
    first = {HERE / name: place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: first.get(item.path, len(first)))
    for item in items:
        mark = item.get_closest_marker("slow")
        if mark is not None and mark.kwargs:
            (how, texts), *_ = mark.kwargs.items()
            texts = (texts,) if isinstance(texts, str) else texts
            case = item.callspec.id
            if case in texts if how == "but" else not any(text in case for text in texts):
                item.own_markers.remove(mark)


@pytest.fixture
def has_cudnn(monkeypatch):
    """Name a version of cuDNN, for which JAX asks while tracing."""
    from jax._src.cudnn import fused_attention_stablehlo as cudnn

    version = types.SimpleNamespace(cudnn_get_version=lambda: 91000)
    monkeypatch.setattr(cudnn, "cuda_versions", version)
