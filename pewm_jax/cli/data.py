"""Run ``pewm-jax data`` and ``pewm-jax memory``, and select the settings of some commands."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from pewm_jax.cli.parser import Arguments


def collect_arguments(argv: Sequence[str], prog: str) -> Arguments:
    """Return the arguments of ``data collect``; with ``--env``, those for a user's environment."""
    if any(word.split("=")[0] == "--env" for word in argv):
        from pewm_jax.data.collect_env import CollectEnvConfig

        return Arguments({"settings": (CollectEnvConfig, None)}, hint=f"{prog} --env")
    from pewm_jax.data.make_episode import CollectConfig

    return Arguments({"settings": (CollectConfig, None)}, renamed={"--voxels": "--voxels.record"})


def collect(settings: Any) -> None:
    """Run ``data collect``."""
    from pewm_jax.data.make_episode import CollectConfig

    with _resumable():
        if isinstance(settings, CollectConfig):
            from pewm_jax.data.collect import collect as collect_houses

            collect_houses(settings)
        else:
            from pewm_jax.data.collect_env import collect_env

            collect_env(settings)


def import_recording(settings: Any) -> None:
    """Run ``data import``."""
    from pewm_jax.data import importer

    importer.import_recording(settings)


def validate(settings: Any) -> int:
    """Run ``data validate``; return 1 if there are problems."""
    from pewm_jax.data.validate import validate as find_problems

    return 1 if find_problems(settings).problems else 0


def show(settings: Any) -> None:
    """Run ``data show``."""
    from pewm_jax.data.show import show as draw

    draw(settings)


def cache_features(settings: Any) -> None:
    """Run ``memory cache``."""
    from pewm_jax.memory.feature_cache import cache

    with _resumable():
        cache(settings)


@contextlib.contextmanager
def _resumable() -> Iterator[None]:
    """Print after Ctrl-C that the same command resumes."""
    try:
        yield
    except KeyboardInterrupt:
        again = "Interrupted; run the same command again to resume."
        raise KeyboardInterrupt(again) from None
