"""Every command and every public function refuses what it cannot use, in one sentence.

The commands, their positional arguments and their flags are found from the program itself: a new
command, or a new flag that takes a path, is covered without a line here.
"""

import contextlib
import dataclasses
import errno
import inspect
import io
import itertools
import signal
import types
import typing
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.cli import main as program
from pewm_jax.config import UserError
from pewm_jax.io import atomic
from tests import properties

SECONDS = 120
"""No refusal takes so long; what does has begun to work."""


@contextlib.contextmanager
def in_time(what):
    """Fail if something does not end soon."""

    def late(*_):
        pytest.fail(f"{what}: still running after {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def call(*argv):
    """Run the program; returns the exit code and what it wrote: ``(code, out, err)``."""
    out, err = io.StringIO(), io.StringIO()
    argv = [str(word) for word in argv]
    with in_time(" ".join(argv)), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = program.main(argv)
        except SystemExit as end:
            code = end.code
    return code, out.getvalue(), err.getvalue()


COMMANDS = sorted(tuple(name.split()) for name in program.COMMANDS)
FIRST = {
    **dict.fromkeys(("train", "plan", "protocol"), "tiny"),
    **dict.fromkeys(("evaluate", "horizon", "play"), "small"),
}
"""What a command's first argument names where it is no path: a preset, or weights that ship."""


def settings_of(words):
    """Return the dataclasses that a command reads, each as a type or with its defaults."""
    name = " ".join(words)
    found = program.arguments_of(name, [FIRST.get(words[0], "nowhere")], f"pewm-jax {name}")
    return [default or kind for kind, default in found.groups.values()]


def fields_of(kind, prefix=""):
    """Yield ``(name, type, positional)`` of all fields of nested settings."""
    hints = typing.get_type_hints(
        kind if isinstance(kind, type) else type(kind), include_extras=True
    )
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        value = getattr(kind, field.name, None)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            flat = any(getattr(mark, "name", None) == "" for mark in typing.get_args(hint))
            yield from fields_of(value, prefix if flat else f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", hint, "Positional" in str(hint)


def takes_path(name, hint):
    """Return whether a setting is a path: by its type, or by its name where it is text."""
    text = str(hint)
    if "Path" in text:
        return True
    ends = name.rsplit(".", 1)[-1]
    known = ("path", "run", "start", "features", "prepared_path", "protocol", "lpips", "fvd")
    known = (*known, "none", "model", "policy", "scene")
    return hint in (str, str | None) and ends in known


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """Paths that no command can use, by what is wrong with them."""
    base = tmp_path_factory.mktemp("a folder with spaces")
    (base / "empty").mkdir()
    (base / "file.txt").write_text("no settings, no weights, no picture\n")
    (base / "binary.safetensors").write_bytes(bytes(range(256)) * 4)
    (base / "cut.json").write_text('{"version": 3, "model": {"kind": ')
    (base / "cut.glb").write_bytes(b"glTF\x02\x00\x00\x00")
    (base / "list.json").write_text("[1, 2]")
    for name, text in (("cut", '{"version": '), ("wrong", '{"model": 5}'), ("odd", "\xff\xfe")):
        (base / name).mkdir()
        (base / name / "config.json").write_text(text, "utf-8")
        (base / name / "dataset.json").write_text(text, "utf-8")
    run = base / "run"
    run.mkdir()
    configuration.save(presets.load("tiny"), run / "config.json")
    (run / "weights.safetensors").write_bytes(b"\x40\x00\x00\x00\x00\x00\x00\x00{")
    (base / "data").mkdir()
    for split in ("train", "validation", "revisit"):
        (base / "data" / split).mkdir()
        (base / "data" / split / "dataset.json").write_text('{"shards": [')
    deep = {
        "missing": base / "missing",
        "empty folder": base / "empty",
        "file": base / "file.txt",
        "binary file": base / "binary.safetensors",
        "truncated file": base / "cut.json",
        "truncated mesh": base / "cut.glb",
        "another file": base / "list.json",
        "truncated settings": base / "cut",
        "wrong settings": base / "wrong",
        "no text": base / "odd",
        "truncated weights": run,
        "truncated data": base / "data",
        "below a file": base / "file.txt" / "below",
        "a device": Path("/dev/null"),
        "nothing": Path(),
    }
    return types.SimpleNamespace(base=base, paths=deep)


def refused(code, out, err, what):
    """Insist on one sentence and the exit code of bad input."""
    assert "Traceback" not in err + out, (what, err)
    assert code == 2, (what, code, out[-300:], err)
    lines = [line for line in err.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    assert len(errors) == 1, (what, err)
    assert lines[-1] == errors[0], (what, err)
    assert errors[0].rstrip().endswith((".", "!", "?", ")")), (what, err)


WRITTEN = ("out", "dst", "run", "worlds", "train.run", "data.prepared_path")
"""Names of settings that name what is written: only what cannot be written is wrong there."""
UNWRITABLE = ("below a file", "a device")
LATER = {"train": "evaluate."}
"""Settings that a command keeps for another one, which refuses them."""


def cases(words, bad):
    """Yield ``(arguments, what is wrong)``: every bad path in the place of every path."""
    fields = [field for kind in settings_of(words) for field in fields_of(kind)]
    named = [name for name, _, positional in fields if positional]
    slots = named
    new = (bad.base / f"new{number}" for number in itertools.count())

    def other(name):
        return next(new) if name in WRITTEN else "nowhere"

    for place, slot in enumerate(slots):
        for wrong, path in bad.paths.items():
            if slot not in WRITTEN or wrong in UNWRITABLE:
                rest = [path if place == k else other(name) for k, name in enumerate(slots)]
                yield [*words, *rest], f"{slot}: {wrong}"
    first = [FIRST[words[0]]] if words[0] in FIRST else [next(new) for _ in named]
    for name, hint, positional in fields:
        if positional or not takes_path(name, hint) or name.startswith(LATER.get(words[0], "?")):
            continue
        writes = name in WRITTEN or words == ("demo",)
        for wrong, path in bad.paths.items():
            if wrong != "nothing" and (not writes or wrong in UNWRITABLE):
                yield [*words, *first, f"--{name}", path], f"--{name}: {wrong}"


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_refuses_every_bad_path_in_one_sentence(words, bad, monkeypatch):
    monkeypatch.chdir(bad.base)
    tried = 0
    for argv, what in properties.cases(cases(words, bad), 7):  # 7: no divisor of the bad paths
        refused(*call(*argv), f"{' '.join(words)}, {what}")
        tried += 1
    assert tried


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_refuses_an_unknown_flag_and_explains_itself(words):
    fields = [field for kind in settings_of(words) for field in fields_of(kind)]
    first = [FIRST.get(words[0], "nowhere") for _, _, positional in fields if positional]
    refused(*call(*words, *first, "--no-such-setting", "1"), words)
    code, out, err = call(*words, *first, "--help")
    assert (code, err) == (0, "")
    assert len(out.splitlines()) > 5


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EIO])
@pytest.mark.parametrize("name", program.COMMANDS)
def test_a_disk_that_fails_is_one_sentence_and_names_the_file(name, number):
    def fails(*_):
        raise OSError(number, "the system's reason", "runs/x/file")

    found = {"read": lambda *_: [None], "function_of": lambda _: fails}
    with mock.patch.multiple(program, **found):
        code, out, err = call(*name.split())
    refused(code, out, err, name)
    assert "runs/x/file: the system's reason" in err


def test_a_full_disk_leaves_nothing_that_could_be_taken_for_whole(tmp_path, monkeypatch):
    """The data set is not listed, and the same command goes on when there is space."""
    argv = ["data", "collect", tmp_path / "data", "--train", "1", "--validation", "0"]
    argv += ["--test", "0", "--frames", "32", "--size", "16", "--workers", "1"]
    real = atomic.replacing

    @contextlib.contextmanager
    def full(path):
        with real(path) as partial:
            yield partial
            raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(atomic, "replacing", full)
        refused(*call(*argv), "a full disk")
    assert not list((tmp_path / "data").rglob("dataset.json"))
    code, _, err = call(*argv)
    assert code == 0, err
    assert list((tmp_path / "data").rglob("dataset.json"))


class Anything:
    """A type that nothing knows."""


STRANGE = {
    "none": None,
    "text": "text",
    "an object": Anything(),
    "a list": [[1, 2], [3]],
    "not a number": float("nan"),
    "a wrong shape": np.zeros((3, 7, 2)),
    "an empty array": np.zeros((0,)),
    "bytes": b"bytes",
}
GOOD = {
    "intrinsics_from_fov": {"height": 16, "width": 16, "horizontal_fov_deg": 90.0},
    "pose_from_yaw": {"position_3": np.zeros(3), "yaw": 0.0, "pitch": 0.0},
    "integrate": {"world_from_camera": np.eye(4), "actions_T3": np.zeros((2, 3))},
    "rgb_from_signal": {"signal": np.zeros((2, 2, 3))},
}
"""Functions of arrays → arguments that they take."""
FUNCTIONS = sorted(
    name for name in pewm_jax.__all__ if isinstance(getattr(pewm_jax, name), types.FunctionType)
)
WORLD = ("start", "observe", "imagine", "imagine_many", "rollout")
"""Functions of worlds; ``test_calls`` has what their frames and controls refuse."""


def test_every_public_function_is_covered():
    assert set(FUNCTIONS) == {*GOOD, *WORLD, "load", "cache_compilation"}


def refusal(function, *args, **kwargs):
    """Return the sentence with which a function refuses its arguments."""
    with pytest.raises(UserError) as caught:
        function(*args, **kwargs)
    text = str(caught.value)
    assert text.strip()
    assert "\n" not in text
    return text


@pytest.mark.parametrize("what", STRANGE)
@pytest.mark.parametrize("name", GOOD)
def test_a_function_of_arrays_refuses_strange_ones(name, what):
    function = getattr(pewm_jax, name)
    function(**GOOD[name])
    if name == "rgb_from_signal" and what in ("a wrong shape", "an empty array"):
        return  # it takes any shape
    for argument in GOOD[name]:
        said = refusal(function, **GOOD[name] | {argument: STRANGE[what]})
        assert name in said
        assert argument in said


def test_loading_refuses_every_bad_path(bad):
    for path in bad.paths.values():
        refusal(pewm_jax.load, path)
    for what, value in STRANGE.items():
        if what != "text":
            assert "load()" in refusal(pewm_jax.load, value)


def test_a_cache_refuses_what_is_no_folder():
    for what, value in STRANGE.items():
        if what != "text":
            assert "cache_compilation()" in refusal(pewm_jax.cache_compilation, value)


@pytest.mark.parametrize("what", STRANGE)
@pytest.mark.parametrize("name", WORLD)
def test_a_function_of_worlds_refuses_strange_arguments(name, what):
    function = getattr(pewm_jax, name)
    parameters = inspect.signature(function).parameters.values()
    needed = [p for p in parameters if p.default is p.empty]
    refusal(function, presets.load("tiny"), {}, *[STRANGE[what]] * (len(needed) - 2))


def test_metrics_and_episodes_refuse_bad_files(bad):
    from pewm_jax.data.dataset import EpisodeSource
    from pewm_jax.eval import metrics

    for path in bad.paths.values():
        with pytest.raises(UserError):
            EpisodeSource(path)
    with pytest.raises(UserError):
        metrics.load("no_such_measure")
    for path in bad.paths.values():
        if path != Path():
            with pytest.raises(UserError):
                metrics.load("lpips_alex", path)
