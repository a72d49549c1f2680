"""The notebooks run as they are written, only shorter, and hold their outputs.

All run in this process and not in kernels, so that JAX and torch are loaded once. The first runs
with the model that comes along; in the others a toy that knows the truth stands in for it, as
compiling would take most of the time.
"""

import dataclasses
import inspect
import json
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax.planning import candidates
from pewm_jax.play import engine
from pewm_jax.types import Camera
from tests.play import tiny_drive

HERE = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(HERE.glob("*.ipynb"))
MOST_BYTES = 300_000
WHOLE = "SMALL = False"
STEPS = np.array([[0.25, 0, 0], [0, 0, np.pi / 6], [0, 0, -np.pi / 6]])
"""What the discrete actions do."""


def cells(path, kind):
    every = json.loads(path.read_text())["cells"]
    return [cell for cell in every if cell["cell_type"] == kind]


def run(name, **replaced):
    """Run a notebook's code and return its names."""
    code = "\n".join("".join(cell["source"]) for cell in cells(HERE / f"{name}.ipynb", "code"))
    for before, after in {WHOLE: "SMALL = True", **replaced}.items():
        assert code.count(before) == 1, before
        code = code.replace(before, after)
    names = {"__name__": name}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning)  # diffusers' own
        warnings.filterwarnings("ignore", category=FutureWarning)
        exec(compile(code, f"{name}.ipynb", "exec"), names)
    return names


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """Files of the notebooks go to a folder of the test, and the process comes back from it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.mkdtemp", lambda: str(tmp_path))


@pytest.fixture
def toy(monkeypatch):
    """In the place of the model one that knows the truth, and compiles nothing."""
    model = tiny_drive.a_toy()
    bind = inspect.signature(pewm_jax.rollout).bind

    def imagined(state, steps):
        frames = []
        for step in steps:
            state = model.imagine_blind(state, np.asarray(step), None)
            frames.append(state.frame)
        return state, jax.tree.map(lambda *x: np.concatenate(x), *frames)

    def rollout(*args, **options):
        given = bind(*args, **options).arguments
        actions = given["actions"]
        camera = actions if isinstance(actions, Camera) else None
        steps = STEPS[[0] * len(camera.intrinsics_4) if camera else np.asarray(actions)]
        state, frames = imagined(given["state"], steps)
        return state, dataclasses.replace(frames, camera=camera or frames.camera)

    def imagination(_config, _params, state, _key):
        def last(actions_KN):
            ends = [imagined(state, STEPS[row])[0].frame for row in np.asarray(actions_KN)]
            return jax.tree.map(lambda *x: np.stack(x), *ends)

        return last

    monkeypatch.setattr(jax, "jit", lambda function, **_: function)
    monkeypatch.setattr(pewm_jax, "load", lambda _: (model.config, {}), raising=False)
    monkeypatch.setattr(pewm_jax, "start", lambda _c, _p, f: model.start(f), raising=False)
    monkeypatch.setattr(pewm_jax, "rollout", rollout, raising=False)
    monkeypatch.setattr(candidates, "ImaginedRollout", imagination)
    monkeypatch.setattr(engine, "open_engine", lambda *_: model)


@pytest.mark.slow
def test_the_first_rollout_remembers():
    names = run("1_first_rollout")
    assert names["psnr"](names["imagined"]) > names["psnr"](names["forgetful"]) + 3
    assert int(names["after"].map.occupied) >= int(names["state"].map.occupied) > 10_000


@pytest.mark.slow
def test_a_recording_is_imported_and_a_wrong_unit_refused(toy, capsys):
    names = run("2_your_recording")
    said = capsys.readouterr().out
    assert "six degrees of freedom, no actions" in said
    assert "the unit is wrong" in said
    assert len(names["imagined"].rgb_THWC) == 2
    assert np.isfinite(names["imagined"].rgb_THWC).all()


@pytest.mark.slow
def test_a_plan_is_found_and_carried_out(toy, capsys):
    names = run("3_planning")
    assert len(names["found"].actions) == len(names["poses"]) - 1
    assert "from the goal and ends" in capsys.readouterr().out


@pytest.mark.slow
def test_a_sofa_is_erased_and_moved(toy):
    names = run("4_edit_a_world")
    model, box = names["model"], names["box"]

    def inside(drive):
        points = model.points(drive.world)[0]
        return int(((points > box[0]) & (points < box[1])).all(1).sum())

    assert "sofa" in names["scene"].objects[names["number"]]
    assert inside(names["first"]) > 20
    assert inside(names["erased"]) < inside(names["back"])  # the toy sees it again
    assert "Erased" in names["erased"].said
    assert "Moved the box" in names["moved"].said


@pytest.mark.slow
def test_a_pipeline_is_converted_and_comes_back_bit_for_bit(capsys):
    names = run("5_convert_cogvideox")
    assert names["apart"] < 1e-4
    assert names["same"]
    wide, old = names["wide"], names["old"]
    assert wide.shape[1] == old.shape[1]
    assert np.count_nonzero(wide) == np.count_nonzero(old)


def test_there_are_five_and_the_tests_above_run_them_all():
    text = Path(__file__).read_text()
    assert len(NOTEBOOKS) == 5
    assert all(f'run("{path.stem}"' in text for path in NOTEBOOKS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_holds_its_outputs_and_is_small(path):
    assert path.stat().st_size <= MOST_BYTES
    outputs = [output for cell in cells(path, "code") for output in cell["outputs"]]
    assert any(kind.startswith("image/") for o in outputs for kind in o.get("data", {}))
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert "/tmp" not in json.dumps(outputs), "outputs name no folder of a machine"
    printing = [c for c in cells(path, "code") if "print(" in "".join(c["source"])]
    shown = [c for c in printing if c["outputs"]]
    assert len(shown) >= len(printing) - 1, "run it again: python notebooks/run.py"
