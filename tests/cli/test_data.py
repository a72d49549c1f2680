"""The command line: help, exit codes, and one sentence for whatever is wrong."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from pewm_jax.cli import main as program
from pewm_jax.data.validate import ValidationResult
from pewm_jax.presets.demo import config as demo
from tests.data.two_rooms import split

ROOT = Path(__file__).parents[2]

COMMANDS = ("collect", "import", "validate", "show")


def refused(capsys, *argv):
    """The one sentence that a refused command prints on stderr."""
    assert program.main(["data", *map(str, argv)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    assert lines[0].endswith(".")
    assert "Traceback" not in lines[0]
    return lines[0]


def test_the_help_lists_the_commands(capsys):
    assert program.main(["data", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {command} " in text for command in COMMANDS)
    assert program.main(["data"]) == 2


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as leave:
        program.main(["data", command, "--help"])
    assert leave.value.code == 0
    text = capsys.readouterr().out
    shown = {
        "collect": ["--train", "--step", "--scene", "--overwrite", "metres"],
        "import": ["--intrinsics", "--depth", "--trajectory", "millimetres"],
        "validate": ["PATH", "split"],
        "show": ["--episode", "--out"],
    }[command]
    assert all(word in text for word in shown)


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["colect", "x"], "did you mean collect?"),
        (["collect"], "Folder to write"),
        (["collect", "x", "--trian", "3"], "did you mean --train?"),
        (["collect", "x", "--train", "many"], "--train needs an integer"),
        (["collect", "x", "--frames", "1"], "--frames is 1"),
        (["collect", "x", "--policy", "random"], "'random'"),
        (["collect", "x", "--scene", "nowhere.glb"], "nowhere.glb does not exist"),
        (["import", "x", "y"], "--intrinsics"),
        (["import", "x", "y", "--intrinsics", "1", "2", "3"], "--intrinsics"),
        (["import", "nowhere", "y", "--intrinsics", "1", "1", "1", "1"], "nowhere is not a folder"),
        (["validate", "nowhere"], "nowhere does not exist"),
        (["show", "nowhere"], "nowhere does not exist"),
        (["show", "x", "--out", "x.jpg"], "ends in .png"),
    ],
)
def test_wrong_arguments_end_in_one_sentence(argv, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert says in refused(capsys, *argv)
    assert list(tmp_path.iterdir()) == []


def test_the_commands_of_the_format_description_fit_together(monkeypatch):
    ran = {command: [] for command in COMMANDS}
    monkeypatch.setattr("pewm_jax.data.collect.collect", ran["collect"].append)
    monkeypatch.setattr("pewm_jax.data.importer.import_recording", ran["import"].append)
    monkeypatch.setattr("pewm_jax.data.show.show", ran["show"].append)
    monkeypatch.setattr(
        "pewm_jax.data.validate.validate",
        lambda asked: ran["validate"].append(asked) or ValidationResult(0, 0, []),
    )
    text = (ROOT / "docs" / "data_format.md").read_text("utf-8")
    called = r"^(?:python -m pewm_jax\.|pewm-jax )(data .*)$"
    lines = [shlex.split(line) for line in re.findall(called, text, re.MULTILINE)]
    assert lines
    assert [program.main(words) for words in lines] == [0] * len(lines)
    assert all(ran.values())
    folders = [made.out for made in ran["collect"] + ran["import"]]
    assert len(set(folders)) == len(folders)  # an import is refused where a collection lies
    assert {made.size for made in ran["collect"]} == {demo().model.clip.width}


def test_what_the_system_refuses_ends_in_one_sentence(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    flags = ["--train", 1, "--validation", 0, "--test", 0]
    assert "is a file" in refused(capsys, "collect", tmp_path / "file", *flags)
    assert "file" in refused(capsys, "collect", tmp_path / "file" / "below", *flags)


def test_validate_and_show_from_the_command_line(capsys, tmp_path):
    folder = split(tmp_path / "train", frames=20)
    assert program.main(["data", "validate", str(tmp_path)]) == 0
    assert "4 episodes, 80 frames, no problems" in capsys.readouterr().out
    picture = tmp_path / "x.png"
    assert program.main(["data", "show", str(folder), "--episode", "2", "--out", str(picture)]) == 0
    assert cv2.imread(str(picture)) is not None
    assert "0 to 3" in refused(capsys, "show", folder, "--episode", 9, "--out", picture)
    shard = folder / "shard-00000-of-00002.array_record"
    content = bytearray(shard.read_bytes())
    content[content.index(b"PEWMEPIS") + 9000] ^= 1
    shard.write_bytes(content)
    assert program.main(["data", "validate", str(tmp_path)]) == 1
    assert "sha256" in capsys.readouterr().out
    shard.write_bytes(content[:-1])
    assert "truncated" in refused(capsys, "validate", tmp_path)


def test_the_module_runs_and_its_exit_code_is_seen_outside(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "pewm_jax", "data", "validate", str(tmp_path / "nowhere")],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1


def test_an_interruption_says_so(capsys, monkeypatch, tmp_path):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pewm_jax.data.collect.collect", interrupted)
    assert program.main(["data", "collect", str(tmp_path / "x")]) == 130
    assert "run the same command again to resume" in capsys.readouterr().err


def test_the_format_is_the_first_argument_or_a_flag(monkeypatch, capsys):
    ran = []
    monkeypatch.setattr("pewm_jax.data.importer.import_recording", ran.append)
    for words in (["tum", "src", "out"], ["--format", "tum", "src", "out"]):
        assert program.main(["data", "import", *words]) == 0
    assert [(one.format, str(one.src), str(one.out)) for one in ran] == [("tum", "src", "out")] * 2
    assert capsys.readouterr().err == ""
    focal = ["--intrinsics", "1", "1", "1", "1"]
    assert program.main(["data", "import", "src", "out", *focal]) == 0
    assert "`pewm-jax data import SRC OUT` is deprecated" in capsys.readouterr().err
    assert (ran[-1].format, str(ran[-1].src)) == ("open3d", "src")
    assert "did you mean lerobot?" in refused(capsys, "import", "lerobt", "src", "out")
    assert "OUT is missing" in refused(capsys, "import", "lerobot", "src")
