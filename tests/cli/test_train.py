"""`python train.py`, as people run it: helped, refused in one sentence, stopped and resumed."""

import dataclasses
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax import registry as kinds
from pewm_jax.cli import main as command
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config, Launch
from pewm_jax.data.collect import collect
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.eval import preview
from pewm_jax.io import runtime
from pewm_jax.train import loop

ROOT = Path(__file__).parents[2]


def settings(kind, prefix=""):
    for field in dataclasses.fields(kind):
        default = kinds.default_of(field)
        if dataclasses.is_dataclass(default):
            yield from settings(default, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}"


@pytest.fixture
def taken(monkeypatch, tmp_path):
    """What train.py hands to the loop, without training."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "cache_compilation", lambda folder: None)
    calls = []
    monkeypatch.setattr(preview, "make_preview", lambda config, run: ("preview", run))
    monkeypatch.setattr(
        loop, "train", lambda config, *, preview=None, profile=0: calls.append((config, preview))
    )
    return calls


def refused(capsys, *argv):
    """Return the sentence with which train.py refuses the arguments."""
    assert command.main(["train", *argv]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err.removeprefix("error: ").strip()


def test_help_lists_every_preset_with_its_description(capsys):
    with pytest.raises(SystemExit) as left:
        command.main(["train", "--help"])
    assert left.value.code == 0
    out = capsys.readouterr().out
    assert {"demo", "tiny"} <= set(presets.names())
    for name in presets.names():
        assert re.search(rf"^  {name} +{re.escape(presets.describe(name))}$", out, re.MULTILINE)


def test_help_of_a_preset_documents_every_setting(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as left:
        command.main(["train", "tiny", "--help"])
    assert left.value.code == 0
    out = capsys.readouterr().out
    for name in settings(Config()):
        entry = re.search(rf"--{re.escape(name)}[ ,][^\n]*\n?(?:(?!│ --)[^\n]*\n)*", out)
        assert entry, name
        text = re.sub(r"[│╭╮╰╯─]|\(default: .*?\)|--\S+|[A-Z]{3,}|\{.*?\}", "", entry.group())
        assert len(text.split()) >= 2, f"{name} has no help text"


def test_flags_override_the_preset_and_the_rest_is_kept(taken):
    argv = ["tiny", "--train.stage1.steps", "10", "--data.path=elsewhere"]
    argv += ["--memory.cell_m", "1", "1", "2", "--train.preview-every", "5"]
    assert command.main(["train", *argv]) == 0
    ((config, preview),) = taken
    tiny = presets.load("tiny")
    assert config.train.stage1.steps == 10
    assert config.data.path == "elsewhere"
    assert config.model.memory.cell_m == (1.0, 1.0, 2.0)
    assert config.model.backbone == tiny.model.backbone
    assert config.train.stage2 == tiny.train.stage2
    assert preview == ("preview", Path("runs/tiny"))


def test_a_folder_of_weights_stands_for_its_settings_and_trains_from_them(taken, tmp_path, capsys):
    """A run's own folder goes on with it, starting from what it started from."""
    tiny = presets.load("tiny")
    for folder in ("world", "runs/tiny"):
        Path(folder).mkdir(parents=True)
        configuration.save(tiny, tmp_path / folder / "config.json")
    assert command.main(["train", "world", "--train.stage1.steps", "4"]) == 0
    config = taken.pop()[0]
    assert config.train.start == "world"
    assert config.train.stage1.steps == 4
    assert config.model == tiny.model
    assert command.main(["train", "world", "--train.start", "other"]) == 0
    assert taken.pop()[0].train.start == "other"
    assert command.main(["train", "runs/tiny"]) == 0
    assert taken.pop()[0] == tiny
    Path("demo").mkdir()
    configuration.save(tiny, tmp_path / "demo" / "config.json")
    assert command.main(["train", "demo"]) == 0
    assert taken.pop()[0] == presets.load("demo")
    (tmp_path / "world" / "config.json").write_text("{")
    assert "config.json is not valid JSON" in refused(capsys, "world")
    (tmp_path / "world" / "config.json").unlink()
    assert "no preset 'world'" in refused(capsys, "world")


def test_no_pictures_are_prepared_where_none_are_wanted(taken):
    assert command.main(["train", "tiny", "--train.preview_every", "0"]) == 0
    assert taken[0][1] is None


def test_a_file_of_settings_lies_over_the_preset_and_under_the_flags(taken, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"train": {"seed": 7, "stage1": {"steps": 3}}}))
    argv = ["tiny", "--config", str(file), "--train.stage1.steps", "4"]
    assert command.main(["train", *argv]) == 0
    config = taken[0][0]
    assert (config.train.seed, config.train.stage1.steps) == (7, 4)
    assert config.train.stage1.batch == presets.load("tiny").train.stage1.batch


def test_a_whole_saved_configuration_is_such_a_file_too(taken, tmp_path):
    saved = dataclasses.replace(presets.load("tiny"), evaluate=Config().evaluate)
    configuration.save(saved, tmp_path / "config.json")
    assert command.main(["train", "demo", f"--config={tmp_path / 'config.json'}"]) == 0
    assert taken[0][0] == saved


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('{"train": {"sede": 1}}', "train has no setting sede"),
        ('{"dit": {"layers": "four"}}', "model.backbone.layers must be int, got 'four'"),
        ('{"model": {"backbone": {"layers": "4"}}}', "backbone.layers must be int, got '4'"),
        ('{"version": 99}', "install a newer pewm_jax"),
        ('{"train": {"seed": 1}', "is not valid JSON"),
        ("[1]", "must hold a table"),
        ('{"clip": {"frames": 8}}', "use 4k + 1 frames"),
    ],
)
def test_a_file_with_wrong_settings_is_refused(taken, tmp_path, capsys, text, part):
    file = tmp_path / "mine.json"
    file.write_text(text)
    assert part in refused(capsys, "tiny", "--config", str(file))
    assert taken == []


@pytest.mark.parametrize(
    ("argv", "part"),
    [
        ([], "Give a preset first: pewm-jax train demo"),
        (["--train.seed", "1"], "Give a preset first"),
        (["dmo"], "no preset 'dmo' (did you mean demo?"),
        (["tiny", "--train.stage1.stepz", "1"], "did you mean --train.stage1.steps?"),
        (["tiny", "--steps", "1"], "did you mean --train.stage1.steps?"),
        (["tiny", "--train.seed", "abc"], "--train.seed needs an integer, got 'abc'."),
        (["tiny", "--train.ema", "abc"], "--train.ema needs a number, got 'abc'."),
        (["tiny", "--train.seed"], "--train.seed needs a value."),
        (["tiny", "--noise.target", "x1"], "--model.noise.target is 'x1': use x0, v, eps."),
        (["tiny", "--memory.cell_m", "1", "2"], "--model.memory.cell_m needs 3 values."),
        (
            ["tiny", "--memory.kind", "image"],
            "There is no memory of kind 'image'; the kinds are grid, images",
        ),
        (["tiny", "--clip.frames", "8"], "clip.frames is 8: the codec folds every 4 frames"),
        (
            ["tiny", "--clip.height", "20"],
            "backbone.patch = 8; change the clip's size or the patch",
        ),
        (
            ["tiny", "stray"],
            "stray is an unexpected argument; `pewm-jax train tiny --help` lists the settings.",
        ),
        (["tiny", "--config"], "--config needs the name of a JSON file"),
        (["tiny", "--config", "none.json"], "none.json cannot be read"),
    ],
)
def test_wrong_arguments_are_refused_in_one_sentence_that_names_the_fix(taken, capsys, argv, part):
    assert part in refused(capsys, *argv)
    assert taken == []
    assert not Path("runs").exists()


def test_an_interruption_is_told_and_exits_as_shells_expect(capsys):
    def interrupted(_argv):
        raise KeyboardInterrupt

    assert cli.run(interrupted, []) == 130
    assert capsys.readouterr().err == "Interrupted.\n"


@pytest.mark.parametrize(
    ("number", "part"),
    [(errno.ENOSPC, "free some space"), (errno.EACCES, "allow access"), (errno.EIO, "fix that")],
)
def test_a_file_that_cannot_be_used_is_a_sentence(capsys, number, part):
    def broken(_argv):
        raise OSError(number, os.strerror(number), "runs/it/config.json")

    assert cli.run(broken, []) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: runs/it/config.json: {os.strerror(number)}; {part}")
    assert err.count("\n") == 1


COMMANDS = {
    "train": ("python train.py", ["train.py"]),
    "evaluate": ("python evaluate.py", ["evaluate.py"]),
    "data": ("python -m pewm_jax.data", ["-m", "pewm_jax.data"]),
    "memory": ("python -m pewm_jax.memory", ["-m", "pewm_jax.memory"]),
    "convert": ("python -m pewm_jax.convert", ["-m", "pewm_jax.convert"]),
    "plan": ("pewm-jax plan", ["-m", "pewm_jax", "plan"]),
    "protocol": ("pewm-jax protocol", ["-m", "pewm_jax", "protocol"]),
    "compare": ("pewm-jax compare", ["-m", "pewm_jax", "compare"]),
    "play": ("pewm-jax play", ["-m", "pewm_jax", "play"]),
    "demo": ("pewm-jax demo", ["-m", "pewm_jax", "demo"]),
    "table2": ("pewm-jax table2", ["-m", "pewm_jax", "table2"]),
    "practice": ("pewm-jax practice", ["-m", "pewm_jax", "practice"]),
    "show": ("pewm-jax show", ["-m", "pewm_jax", "show"]),
    "pull": ("pewm-jax pull", ["-m", "pewm_jax", "pull"]),
    "push": ("pewm-jax push", ["-m", "pewm_jax", "push"]),
    "horizon": ("pewm-jax horizon", ["-m", "pewm_jax", "horizon"]),
    "table1": ("pewm-jax table1", ["-m", "pewm_jax", "table1"]),
    "conditioning": ("pewm-jax conditioning", ["-m", "pewm_jax", "conditioning"]),
}
"""Each subcommand: the words it is called by without ``pewm-jax``, and how to call it so."""
INTERRUPTED_AT_JAX = """
import runpy, sys
from importlib import abc

class CtrlC(abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "jax":
            raise KeyboardInterrupt

sys.meta_path.insert(0, CtrlC())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def python(*argv, cwd=ROOT):
    return subprocess.run(
        [sys.executable, *map(str, argv)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_command_names_every_subcommand_and_what_it_does(capsys):
    assert {name.split()[0] for name in command.COMMANDS} == set(COMMANDS)
    assert command.main(["--help"]) == 0
    out = capsys.readouterr().out
    commands = command.below("")
    width = max(map(len, commands)) + 2
    for name, about in commands.items():
        assert f"\n  {name:<{width}}{about}\n" in out
        assert len(f"  {name:<{width}}{about}") <= 80
    assert command.main([]) == 2
    assert capsys.readouterr().out == out
    assert command.main(["--version"]) == 0
    assert capsys.readouterr().out == f"pewm-jax {pewm_jax.__version__}\n"


def test_an_unknown_subcommand_is_one_sentence_with_the_nearest(capsys):
    assert command.main(["trian", "demo"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: There is no command 'trian' (did you mean train?); choose from ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("name", COMMANDS)
def test_a_subcommand_says_the_words_it_was_called_by(name):
    words, argv = COMMANDS[name]
    ours, other = python("-m", "pewm_jax", name, "--help"), python(*argv, "--help")
    for done, called in ((ours, f"pewm-jax {name}"), (other, words)):
        deprecated = "is deprecated" if called.startswith("python -m") else ""
        assert done.returncode == 0
        assert deprecated in done.stderr
        assert done.stderr.count("\n") == bool(deprecated)
        assert done.stdout.startswith(f"usage: {called} ")
    assert ours.stdout.replace(f"pewm-jax {name}", words).split() == other.stdout.split()


@pytest.mark.parametrize("name", COMMANDS)
def test_help_and_refusals_load_nothing_heavy(name):
    heavy = {"jax", "flax", "orbax", "trimesh", "embreex", "tensorboardX", "cv2", "scipy"}
    code = (
        "import sys\nfrom pewm_jax.cli.main import main\n"
        f"try: main([{name!r}, '--help'])\nexcept SystemExit: pass\n"
        f"assert main([{name!r}, '--nothing']) == 2"
    )
    done = python(
        "-c", f"{code}\nassert not {heavy} & set(sys.modules), {heavy} & set(sys.modules)"
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("error: ")


@pytest.mark.parametrize(
    "argv", [["train.py", "tiny", "--train.run", "it"], ["evaluate.py", "it"]], ids=lambda a: a[0]
)
def test_ctrl_c_during_the_imports_is_told(tmp_path, argv):
    done = python("-c", INTERRUPTED_AT_JAX, ROOT / argv[0], *argv[1:], cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "Interrupted.\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("asked", ["flag", "command"])
def test_a_plan_is_a_flag_and_a_command(asked, monkeypatch):
    from pewm_jax.plan import plan

    shown = []
    monkeypatch.setattr(plan, "show", lambda *given: shown.append(given))
    flags = ["pewm_5b", "--devices", "64", "--chip", "h100"]
    flags = ["train", *flags, "--plan"] if asked == "flag" else ["plan", *flags]
    assert command.main(flags) == 0
    assert shown == [(presets.load("pewm_5b"), Launch(plan=True, devices=64, chip="h100"))]


def start(*argv, **options):
    command = [sys.executable, "-W", "error", "train.py", *map(str, argv)]
    return subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def finish(process):
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def wait_for_lines(path, count, process):
    for _ in range(6000):
        if path.exists() and len(path.read_text().splitlines()) >= count:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    pytest.fail(f"{path} has not reached {count} lines")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data")
    collect(CollectConfig(out=path, train=2, validation=0, test=0, frames=24, size=16, workers=1))
    return path


@pytest.mark.slow
def test_training_real_episodes_stopped_by_ctrl_c_and_started_again(data, tmp_path):
    run = tmp_path / "runs" / "it"
    argv = ["tiny", "--data.path", data, "--train.run", run, "--train.save_every", "1000"]
    argv += ["--train.stage1.steps", "200", "--train.stage2.steps", "2", "--train.log_every", "2"]
    process = start(*argv)
    wait_for_lines(run / "metrics.jsonl", 3, process)
    process.send_signal(signal.SIGINT)
    code, out, err = finish(process)
    assert code == 130, err
    assert "compiling the training step …" in out
    stopped = int(re.search(r"Stopped after step (\d+) of stage 1; everything is saved", err)[1])
    assert "Traceback" not in err
    assert not (run / "weights.safetensors").exists()

    code, out, err = finish(start(*argv))
    assert (code, err) == (0, "")
    assert f"stage 1: resuming after step {stopped}" in out
    assert re.search(r"stage 1 200/200 loss .* clips/s · .* GFLOP/s/device", out)
    assert out.splitlines()[-1] == f"Trained: {run / 'weights.safetensors'}"
    steps = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    seen = [(entry["stage"], entry["step"]) for entry in steps]
    assert seen == sorted(set(seen))
    assert {(1, 200), (2, 2)} <= set(seen)
    assert all(np.isfinite(entry["loss"]) for entry in steps)

    assert any(path.is_file() for path in (run.parent / ".cache").rglob("*"))

    config, params = pewm_jax.load(run)
    assert config.train.stage1.steps == 200
    assert set(params) == {"backbone", "memory"}

    code, out, err = finish(start(*argv))
    assert (code, out, err) == (0, f"{run} is already trained: nothing to do.\n", "")

    code, out, err = finish(start(*argv, "--backbone.layers", "1"))
    assert code == 2
    assert err.count("\n") == 1
    assert "model.backbone.layers 2 there, 1 here" in err


@pytest.mark.slow
def test_told_to_end_while_it_compiles_then_trained_without_a_record_that_is_damaged(
    data, tmp_path
):
    shutil.copytree(data, tmp_path / "data")
    shard = next((tmp_path / "data" / "train").glob("*.array_record"))
    held = shard.read_bytes()
    place = held.index(b"IDAT") + 20
    shard.write_bytes(held[:place] + bytes([held[place] ^ 4]) + held[place + 1 :])
    argv = ["tiny", "--data.path", tmp_path / "data", "--train.run", tmp_path / "runs" / "it"]
    argv += ["--train.stage1.steps", "3", "--train.stage2.steps", "0", "--data.bad_records", "1"]
    process = start(*argv, "--profile", "1")
    assert process.stdout is not None
    while "compiling the training step" not in process.stdout.readline():
        assert process.poll() is None, process.communicate()
    process.send_signal(signal.SIGTERM)
    code, _, err = finish(process)
    assert code == 143
    assert err.strip() == (
        "Stopped with nothing to save (nothing was saved yet); run the same command again to "
        "resume."
    )

    code, out, err = finish(start(*argv, "--profile", "1"))
    assert (code, err) == (0, "")
    named = rf"bad record 1 of 1 allowed, skipped: train/{shard.name} record 0: "
    assert len(re.findall(named, out)) == 1
    assert re.search(r"^stage 1 3/3 loss .* · bad records 1 · ", out, re.MULTILINE)
    assert re.search(r"^stage 1: traced 1 step; open with `tensorboard ", out, re.MULTILINE)
    assert list((tmp_path / "runs" / "it" / "profile").rglob("*.xplane.pb"))


@pytest.mark.slow
def test_absent_data_are_a_sentence_and_the_run_can_be_started_again(tmp_path):
    argv = ["tiny", "--data.path", tmp_path / "none", "--train.run", tmp_path / "runs" / "it"]
    code, _, err = finish(start(*argv))
    assert code == 2
    assert re.fullmatch(r"error: .*none.*train does not exist.*\n", err)


def test_a_compilation_cache_that_the_caller_chose_stays(tmp_path):
    old = jax.config.jax_compilation_cache_dir
    small = {name: getattr(jax.config, name) for name, *_ in runtime.SMALL_TOO}
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
        runtime.cache_compilation(tmp_path / "runs")
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
        jax.config.update("jax_compilation_cache_dir", None)
        jax.config.update("jax_enable_compilation_cache", False)
        runtime.cache_compilation(tmp_path / "runs")
        assert jax.config.jax_compilation_cache_dir is None
        jax.config.update("jax_enable_compilation_cache", True)
        for name, default, _ in runtime.SMALL_TOO:
            jax.config.update(name, default)
        runtime.cache_compilation(tmp_path / "runs")
        assert jax.config.jax_compilation_cache_dir.startswith(str(tmp_path / "runs"))
        for name, _, ours in runtime.SMALL_TOO:
            assert getattr(jax.config, name) == ours
    finally:
        for name, value in small.items():
            jax.config.update(name, value)
        jax.config.update("jax_enable_compilation_cache", True)
        jax.config.update("jax_compilation_cache_dir", old)
