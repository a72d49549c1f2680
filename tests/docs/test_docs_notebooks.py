"""The notebooks run as they are written, only shorter, and hold their outputs.

All run in this process and not in kernels, so that JAX and torch are loaded once. The first runs
with the model that comes along, the others with a tiny one, which compiles in less time.
"""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import pewm_jax
from tests.play import tiny_drive

HERE = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(HERE.glob("*.ipynb"))
MOST_BYTES = 300_000
WHOLE = "SMALL = False"


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
def tiny(monkeypatch):
    model = tiny_drive.an_engine()
    monkeypatch.setattr(pewm_jax, "load", lambda _: (model.config, model.params), raising=False)


def test_the_first_rollout_remembers():
    names = run("1_first_rollout")
    assert names["psnr"](names["imagined"]) > names["psnr"](names["forgetful"]) + 3
    assert int(names["after"].map.occupied) >= int(names["state"].map.occupied) > 10_000


def test_a_recording_is_imported_and_a_wrong_unit_refused(tiny, capsys):
    names = run("2_your_recording")
    said = capsys.readouterr().out
    assert "six degrees of freedom, no actions" in said
    assert "the unit is wrong" in said
    assert len(names["imagined"].rgb_THWC) == 2
    assert np.isfinite(names["imagined"].rgb_THWC).all()


def test_a_plan_is_found_and_carried_out(tiny, capsys):
    names = run("3_planning")
    assert len(names["found"].actions) == len(names["poses"]) - 1
    assert "from the goal and ends" in capsys.readouterr().out


def test_a_sofa_is_erased_and_moved(tiny):
    names = run("4_edit_a_world")
    model, box = names["model"], names["box"]

    def inside(drive):
        points = model.points(drive.world)[0]
        return int(((points > box[0]) & (points < box[1])).all(1).sum())

    assert "sofa" in names["scene"].objects[names["number"]]
    assert inside(names["first"]) > 20
    assert inside(names["erased"]) < inside(names["first"]) / 2


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
