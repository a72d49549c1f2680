"""``pewm-jax demo``: the same parts as ``make demo`` in order, and what to open then."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pewm_jax.cli import demo, parser
from pewm_jax.cli import main as program
from pewm_jax.config import UserError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def called(monkeypatch, tmp_path):
    """What the parts are called with, in place of doing it."""
    monkeypatch.chdir(tmp_path)
    seen = []
    monkeypatch.setattr(program, "execute", lambda argv: seen.append(list(argv)) or 0)
    return seen


def run(*words):
    """Run the demo with its own arguments."""
    return demo.run(parser.parse(demo.Settings, words, prog="pewm-jax demo"))


def test_it_does_what_make_demo_does(called, capsys):
    assert run() == 0
    makefile = (ROOT / "Makefile").read_text()
    settings = dict(re.findall(r"^(\w+) \?= (.+)$", makefile, re.MULTILINE))
    (recipe,) = re.findall(r"^demo: .*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    asked = [
        re.sub(r"\$\((\w+)\)", lambda m: settings.get(m[1], m[0]), x) for x in recipe.split("\n")
    ]
    plain = [
        re.sub(r"^\t@\$\(PY\) (-m pewm_jax[. ])?", "", x).replace(".py", "") for x in asked if x
    ]
    assert [shlex.split(line) for line in plain] == called
    lines = capsys.readouterr().out.splitlines()
    assert [line[:5] for line in lines[:3]] == ["[1/3]", "[2/3]", "[3/3]"]
    assert "runs/demo/report/index.html" in lines[-1]


def test_walks_are_collected_as_large_as_the_preset_wants_them():
    parts = {preset: demo.steps(demo.Settings(preset)) for preset in ("demo", "tiny")}
    assert "--size" not in parts["demo"][0][1]
    assert parts["tiny"][0][1][-2:] == ["--size", "16"]


def test_a_part_that_fails_ends_it(called, monkeypatch, capsys):
    monkeypatch.setattr(program, "execute", lambda argv: 2)
    assert run("--run", "elsewhere") == 2
    assert called == []
    assert "Done" not in capsys.readouterr().out


def test_a_folder_that_training_refuses_is_refused_before_the_walks(called):
    Path("taken").write_text("a file")
    with pytest.raises(UserError, match="taken cannot be created"):
        run("--run", "taken")
    assert called == []


def test_its_end_names_the_command_that_installs_the_viewer():
    folder = Path("my runs/a")
    assert demo.ending(folder, viewer=True).endswith("Drive in it: pewm-jax play 'my runs/a'")
    assert "pip install 'pewm-jax[play]' && pewm-jax play" in demo.ending(folder, viewer=False)


def test_what_cannot_be_is_refused_before_anything_is_made(called):
    wrong = (
        (["--preset", "dmo"], "There is no preset 'dmo'"),
        (["--houses", "0"], "at least 1"),
        *((["--preset", name], "square images") for name in ("codec", "persist_tiny", "egowm_svd")),
        (["--house", "3"], "did you mean --houses"),
    )
    for argv, says in wrong:
        with pytest.raises(UserError, match=says):
            run(*argv)
    assert called == []


def test_without_the_renderer_it_names_the_command_that_installs_it(tmp_path):
    code = (
        "import sys; sys.modules['embreex'] = None\n"
        "from pewm_jax.cli.main import main; sys.exit(main(['demo']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "pip install embreex" in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
