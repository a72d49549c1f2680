"""Files without this user's seal are removed before they are executed."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from pewm_jax.io import seals
from pewm_jax.io.seals import Seals

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(seals, "NEW_S", 0.0)
    made = tmp_path / "cache"
    one = Seals(made, "-cache", seals.read_key())
    (made / "a-cache").write_bytes(b"program a")
    (made / "b-cache").write_bytes(b"program b")
    one.add_new()
    return made


def opened(folder):
    return Seals(folder, "-cache", seals.read_key())


def names(folder):
    return sorted(path.name for path in folder.glob("*-cache"))


def test_own_files_stay_and_are_sealed_once(folder):
    again = opened(folder)
    assert again.remove_foreign() == 0
    assert names(folder) == ["a-cache", "b-cache"]
    seal = folder / "a-cache.seal"
    before = seal.stat().st_mtime_ns
    again.add_new()
    assert seal.stat().st_mtime_ns == before


@pytest.mark.parametrize("how", ["truncated", "changed", "unsealed", "renamed", "link", "folder"])
def test_other_files_are_removed(folder, how, tmp_path):
    path = folder / "a-cache"
    if how == "truncated":
        path.write_bytes(b"program")
    elif how == "changed":
        path.write_bytes(b"Program a")
    elif how == "unsealed":
        (folder / "a-cache.seal").unlink()
    elif how == "renamed":
        path.rename(folder / "c-cache")
        (folder / "a-cache.seal").rename(folder / "c-cache.seal")
    elif how == "link":
        path.rename(tmp_path / "elsewhere")
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.unlink()
        path.mkdir()
        (path / "inside").touch()
    assert opened(folder).remove_foreign() == 1
    assert names(folder) == ["b-cache"]
    assert sorted(path.name for path in folder.glob("*.seal")) == ["b-cache.seal"]
    if how == "link":
        assert (tmp_path / "elsewhere").exists()


def test_a_file_that_another_process_is_about_to_seal_stays(folder, monkeypatch):
    other = opened(folder)
    (folder / "c-cache").write_bytes(b"program c")
    monkeypatch.setattr(seals, "NEW_S", 0.5)
    monkeypatch.setattr(seals.time, "sleep", lambda _: other.add_new())
    assert opened(folder).remove_foreign() == 0
    assert names(folder) == ["a-cache", "b-cache", "c-cache"]


def test_files_of_another_user_s_key_are_removed(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    assert opened(folder).remove_foreign() == 2
    assert names(folder) == []


def test_folder_and_key_are_private(folder, tmp_path):
    folder.chmod(0o777)
    opened(folder)
    key = tmp_path / "state" / "pewm_jax" / "key"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(key.parent.stat().st_mode) == 0o700
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert len(key.read_bytes()) == seals.KEY_BYTES
    assert list(key.parent.iterdir()) == [key]
    key.write_bytes(b"short")
    with pytest.raises(OSError, match="damaged"):
        seals.read_key()


def test_a_folder_of_another_user_is_refused(folder, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(OSError, match="another user"):
        Seals(folder, "-cache", b"")


COMPILE = """
import sys, warnings
import jax, jax.numpy as jnp
from pewm_jax.io import runtime
warnings.simplefilter("error")
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event.split("/")[-1]))
runtime.cache_compilation(sys.argv[1])
print(jax.jit(lambda x: jnp.sin(x) + 1)(jnp.zeros(3)), jnp.sort(jnp.arange(5) % 3))
print("hits", events.count("cache_hits"), "misses", events.count("cache_misses"))
"""


def compiled(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", COMPILE, str(tmp_path)],
        env={
            **{name: text for name, text in os.environ.items() if not name.startswith("JAX_")},
            "JAX_PLATFORMS": "cpu",
            "XDG_STATE_HOME": str(tmp_path / "state"),
            "PYTHONPATH": str(ROOT),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    *_, last = done.stdout.splitlines()
    _, hits, _, misses = last.split()
    return int(hits), int(misses), done.stderr


def test_the_second_start_compiles_nothing_and_damaged_programs_are_compiled_anew(tmp_path):
    hits, misses, said = compiled(tmp_path)
    assert hits == 0
    assert misses > 1
    assert said == ""
    assert compiled(tmp_path) == (misses, 0, "")
    programs = sorted((tmp_path / ".cache").rglob("*-cache"))
    assert len(programs) == misses, "small ones, too"
    programs[0].write_bytes(programs[0].read_bytes()[:-9])
    (programs[0].parent / "planted-cache").write_bytes(b"anything")
    hits, missed, said = compiled(tmp_path)
    assert (hits, missed) == (misses - 1, 1)
    assert said.startswith("2 compiled programs are damaged or not from this user, and compiled")
    assert len(said.splitlines()) == 1
    assert compiled(tmp_path) == (misses, 0, "")
