"""Train in a small file system that fills up, then go on with space again.

Run as ``python full_disk.py FOLDER`` with a small file system mounted at FOLDER; prints
one line of JSON: by what the full disk met first, what was told, what was left, what came after.
"""

import contextlib
import io
import json
import sys
from pathlib import Path

import pytest

from pewm_jax.cli import parser as cli
from pewm_jax.train import checkpoint_files, loop, runs
from pewm_jax.train.checkpoint import Checkpoints
from pewm_jax.train.log import MetricsLog
from tests.train import fakes


def fill(folder):
    """Leave no byte free."""
    with (folder / "ballast").open("ab", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(b"0" * 4096)


def before(patch, kind, name, when, act):
    """Act before a method is called, if it is called so."""
    real = getattr(kind, name)

    def method(*args, **options):
        if when(*args):
            act()
        return real(*args, **options)

    patch.setattr(kind, name, method)


def train(config):
    """Train as the command line does; returns the exit code and what it prints to stderr."""
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        code = cli.run(lambda _: loop.train(config, log=lambda _: None) and 0, [])
    return code, told.getvalue()


def meet(folder, when):
    """Train until the disk is full, look at what is left, and train on with space again."""
    config = fakes.config(folder / when, stage2=0, save_every=2, keep=1)
    config = fakes.with_train(config, log_every=1 if when == "log" else 100)
    traps = {
        "save": (Checkpoints, "save", lambda _, state: int(state.step) == 4),
        "log": (MetricsLog, "write", lambda _, step, __: step == 3),
        "publish": (runs, "publish", lambda *_: True),
    }
    with pytest.MonkeyPatch.context() as patch:
        before(patch, *traps[when], lambda: fill(folder))
        code, told = train(config)
    stage = checkpoint_files.of(folder / when, "stage1")
    whole = [
        step
        for step in checkpoint_files.steps(stage)
        if not checkpoint_files.flaws(stage / str(step))
    ]
    found = {"code": code, "told": told, "whole": whole}
    found["partial"] = [path.name for path in (folder / when).rglob("*.partial")]
    (folder / "ballast").unlink()
    found["again"] = train(config)
    found["weights"] = (folder / when / runs.WEIGHTS).read_bytes().hex()
    return found


def main(folder):
    with pytest.MonkeyPatch.context() as patch:
        fakes.install(patch)
        print(json.dumps({when: meet(folder, when) for when in ("save", "log", "publish")}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
