"""Programs compiled once, as commands do from one start to the next."""

import contextlib

import jax
from jax.experimental.compilation_cache import compilation_cache


@contextlib.contextmanager
def once(folder):
    """Keep compiled programs in a folder."""
    options = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    before = {name: getattr(jax.config, name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()


_COUNTERS: list["Compiled"] = []


class Compiled:
    """How many programs were compiled, or loaded from a folder of compiled ones."""

    programs = 0


def _count(event, seconds, **_):
    del seconds
    if event == "/jax/core/compile/backend_compile_duration":
        for counter in _COUNTERS:
            counter.programs += 1


jax.monitoring.register_event_duration_secs_listener(_count)


@contextlib.contextmanager
def counted():
    """Count the programs that are compiled meanwhile."""
    counter = Compiled()
    _COUNTERS.append(counter)
    try:
        yield counter
    finally:
        _COUNTERS.remove(counter)
