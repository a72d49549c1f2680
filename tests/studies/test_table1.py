"""Table 1: the whole of it on a tiny setting, its rows, equal time, and what its numbers mean."""

import contextlib
import csv
import dataclasses
import io
import json
import shutil
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.cli import main as program
from pewm_jax.config import UserError
from pewm_jax.convert import dinov2 as convert
from pewm_jax.eval import metrics
from pewm_jax.eval.metrics.images import MASKS, SUMS
from pewm_jax.geometry.actions import integrate, there_and_back
from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.io import tree, weights
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.lpips import model as lpips
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.studies import (
    table1,
    table1_page,
    table1_rows,
    table1_scoring,
    table1_training,
)
from pewm_jax.train import feed
from pewm_jax.worlds.pewm.world import STAGES

SIZE = ["--size", "16", "--frames", "30"]


ROWS = tuple(row.name for row in table1_rows.main_rows(presets.load("table1")))


def small(data):
    """The preset of the tests, made smaller still."""
    base = presets.load("tiny")
    backbone = dataclasses.replace(base.model.backbone, layers=1, heads=1)
    memory = dataclasses.replace(base.model.memory, reader=AttentionConfig(heads=4, head_dim=8))
    return dataclasses.replace(
        base.with_model(backbone=backbone, memory=memory),
        data=dataclasses.replace(base.data, path=str(data), prepared=4),
        evaluate=dataclasses.replace(base.evaluate, clips=4),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A whole table by the command, one seed, two steps of each training, and what was said."""
    folder = tmp_path_factory.mktemp("table1")
    few = ["--train", "2", "--validation", "0", "--test", "2"]
    assert program.main(["data", "collect", str(folder / "data"), *few, *SIZE]) == 0
    said = io.StringIO()
    with (
        mock.patch.object(presets, "load", return_value=small(folder / "data")),
        mock.patch("pewm_jax.io.runtime.cache_compilation"),  # it sets an option of all of JAX
        contextlib.redirect_stdout(said),
    ):
        argv = ["--data", str(folder / "data"), "--out", str(folder / "out")]
        assert program.execute(["table1", *argv, "--steps", "2", "2", "--seeds", "0"]) == 0
    return folder, folder / "out" / "table1.md", said.getvalue().splitlines()


@pytest.mark.slow
def test_the_whole_table_is_made(made):
    _, page, said = made
    text = page.read_text()
    results = json.loads((page.parent / "table1-results.json").read_text())
    assert set(results["rows"]) == {*ROWS, "backbone", "reproject", "copy"}
    for name in results["rows"]:
        assert f"\n| {table1_page.label(results, name)} | " in text
        assert np.isfinite(results["rows"][name]["measures"]["psnr/all"]["mean"])
    assert "512 × 512 images of scanned houses" in text  # what is not comparable
    assert "lpips_alex is left out: " in text
    assert any(line.startswith("fvd is left out: ") for line in said)
    blind = next(line for line in text.splitlines() if "without depth |" in line)
    assert blind.endswith("| – |")
    with page.with_suffix(".csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {line["row"] for line in lines} <= {*results["rows"], table1_page.TRUTH}
    assert {line["row"] for line in lines} >= set(results["rows"])
    tex = page.with_suffix(".tex").read_text()
    src = any("src" in one["measures"] for one in results["rows"].values())  # adds two places
    assert tex.count(r"\\") == len(results["rows"]) + 2 + src  # with a heading and the truth itself
    assert page.with_suffix(".png").stat().st_size > 0
    assert results["about"]["hours"]["clock"] > 0


def whole(folder, log, out=None):
    """Make the table, as the command does."""
    base, out = small(folder / "data"), out or folder / "out"
    return table1.run(base, out, minutes=(1, 1), steps=(2, 2), seeds=[0], log=log)


@pytest.mark.slow
def test_what_is_done_is_not_done_again(made):
    folder = made[0]
    files = sorted((folder / "out").glob("seed0/*/*.safetensors"))
    files += sorted((folder / "out").rglob("*.npz"))
    before = [file.stat().st_mtime_ns for file in files]
    said = []
    whole(folder, said.append)
    assert [file.stat().st_mtime_ns for file in files] == before
    assert len(files) >= 2 * len(ROWS)
    assert not any("compil" in line for line in said)


@pytest.mark.slow
def test_scores_outlive_the_weights(made):
    folder, page, _ = made
    out, before = folder / "elsewhere", page.read_text()
    for name in ("protocol.json", "hours.json"):
        (out / name).parent.mkdir(exist_ok=True)
        shutil.copy(folder / "out" / name, out / name)
    shutil.copytree(folder / "out" / "recorded", out / "recorded")
    said = []
    again = whole(folder, said.append, out)
    assert sum("its scores are recorded" in line for line in said) == len(ROWS)
    assert not (out / "seed0").exists()
    numbers = [line for line in before.splitlines() if line.startswith("| ")]
    assert [line for line in again.read_text().splitlines() if line.startswith("| ")] == numbers
    file = min((out / "recorded").iterdir())
    file.write_bytes(file.read_bytes()[:100])
    assert table1_scoring.read_recorded(file) is None
    base, row = small(folder / "data"), table1_rows.main_rows(small(folder / "data"))[0]
    study = table1_training.Study(base, out, (1, 1), (2, 2))
    steps = {"none": 2, "backbone": 2}
    path = table1_scoring.recorded_path(study, row, 0, steps, "x")
    assert path != table1_scoring.recorded_path(study, row, 0, steps | {"backbone": 3}, "x")
    assert path != table1_scoring.recorded_path(study, row, 0, steps, "y")
    assert path != table1_scoring.recorded_path(study, row, 1, steps, "x")
    from_codec = dataclasses.replace(
        study, base=dataclasses.replace(base, train=dataclasses.replace(base.train, start="codec"))
    )
    assert path != table1_scoring.recorded_path(from_codec, row, 0, steps, "x")


@pytest.mark.slow
def test_all_rows_start_from_one_backbone_and_keep_it(made):
    out = made[0] / "out" / "seed0"
    before = tree.flatten(weights.load(out / "backbone" / "weights.safetensors"))
    for name in ("voxel-attend-sinusoid", "surfels-render"):
        after = tree.flatten(weights.load(out / name / "weights.safetensors"))
        assert all(np.array_equal(after[leaf], value) for leaf, value in before.items())
        assert any(leaf.startswith("memory/") for leaf in after)


@pytest.mark.slow
def test_the_features_of_a_network_can_be_tried(made):
    """The paper's own: a DINOv2 behind the map, from the backbone that all rows start from."""
    folder, said = made[0], []
    network = DINOv2Config(layers=1, heads=1, width=32, patch=4, pretrained_size=16)
    source = folder / "encoders" / "small"
    params = jax.jit(lambda key: dinov2.init(network, key))(jax.random.key(1))
    convert.write(network, params, source)
    base = small(folder / "data")
    values, steps = (f"dinov2={source}",), (2, 2)
    page = table1.run(
        base,
        folder / "out",
        minutes=(1, 1),
        steps=steps,
        seeds=[0],
        ablation="features",
        values=values,
        log=said.append,
    )
    results = json.loads((page.parent / "table1-features-results.json").read_text())
    name = "voxel-attend-features_dinov2_small"
    assert np.isfinite(results["rows"][name]["measures"]["psnr/all"]["mean"])
    encoder = results["about"]["rows"][name]["settings"]["encoder"]
    assert encoder["size"] // network.patch == base.model.memory.encoder.grid(base.model.clip)[0]
    kept = tree.flatten(weights.load(folder / "out" / "seed0" / name / "weights.safetensors"))
    for leaf, value in tree.flatten({"encoder": params}).items():
        np.testing.assert_array_equal(kept[leaf], value)
    assert not any(line.startswith("stage 1") for line in said)  # the backbone was there
    with pytest.raises(UserError, match="holds no DINOv2"):
        table1_rows.ablated(base, "features", ("dinov2=nowhere",))
    with pytest.raises(UserError, match="there are no features 'hog'; choose colours, "):
        table1_rows.ablated(base, "features", ("hog",))


@pytest.mark.slow
def test_a_step_is_timed(made):
    folder = made[0]
    study = table1_training.Study(small(folder / "data"), folder / "timed", (1, 1))
    said = []
    kinds = [row for row in table1_rows.main_rows(study.base) if row.name == "none"]
    plan = table1_training.planned(study, kinds, said.append)
    assert plan["backbone"]["seconds"] == plan["none"]["seconds"] > 0
    assert plan["none"]["steps"] == round(60 / plan["none"]["seconds"])
    assert any(": compiled in " in line for line in said)


@pytest.mark.slow
def test_what_was_made_from_other_weights_is_refused(made):
    folder = made[0]
    mark = folder / "out" / "seed0" / "surfels-render" / table1_training.MADE_FROM
    before = mark.read_text()
    mark.write_text(before.replace('"start": "', '"start": "0'))
    with pytest.raises(UserError, match="was made from other weights or data"):
        whole(folder, [].append)
    mark.write_text(before)


@pytest.mark.slow
def test_the_memory_is_what_differs_from_an_empty_one(made):
    from tests.helpers import randomise

    folder = made[0]
    out, run = folder / "random", folder / "out" / "seed0" / "surfels-render"
    base = small(folder / "data")
    judge = table1_scoring.open_scorer(base, out, print)
    row = next(row for row in table1_rows.main_rows(base) if row.name == "surfels-render")
    study = table1_training.Study(base, folder / "out", (1, 1))
    config = table1_training.settings(study, row, 0, 2, start="x")
    params = randomise(weights.load(run / "weights.safetensors"), scale=0.3)
    weights.save(out / "run" / "weights.safetensors", params)
    configuration.save(config, out / "run" / "config.json")
    config = dataclasses.replace(
        config, train=dataclasses.replace(config.train, run=str(out / "run"))
    )
    memory, empty = (judge.row(config, memory=memory)["sums"] for memory in (True, False))
    assert not np.allclose(memory, empty)


def test_rows_have_about_the_same_parameters_and_the_same_extent():
    base = presets.load("table1")
    every = table1_rows.main_rows(base)
    counts = {row.name: table1_rows.parameters(base, row.memory) for row in every if row.reads}
    assert max(counts.values()) <= 1.07 * min(counts.values()), counts
    for row in every:
        size = np.multiply(row.memory.cell_m, row.memory.cells)
        np.testing.assert_allclose(size, (32, 32, 16), atol=0.1)
    assert {row.paper for row in every if row.paper} == set(table1_page.PAPER)
    assert set(table1.CHAIN) <= {row.name for row in every}


@pytest.mark.slow
@pytest.mark.parametrize("name", table1_rows.ABLATIONS)
def test_an_ablation_varies_what_it_says_and_nothing_else(name):
    base = presets.load("table1")
    found = table1_rows.ablated(base, name)
    plain = {row.name: row for row in table1_rows.main_rows(base)}
    if name == "time":
        once, nothing, longer, nothing_longer = found
        assert once == dataclasses.replace(plain[table1_rows.PAPER_FORM], paper="")
        assert nothing == plain[table1_rows.CONTROL]
        for row, first in ((longer, once), (nothing_longer, nothing)):
            assert dataclasses.replace(row, name=first.name, times=1) == first
            assert row.times == 4
        return
    assert len(found) == len(table1_rows.ABLATIONS[name].values) == len({row.name for row in found})
    voxel = plain["voxel-attend"].memory
    varied = {"cell": {"cell_m", "cells"}, "extent": {"cells"}, "tokens": {"tokens"}}
    for row in found:
        if name in varied:
            fields = {field.name for field in dataclasses.fields(voxel)}
            differing = {f for f in fields if getattr(row.memory, f) != getattr(voxel, f)}
            assert differing <= varied[name] | {"capacity"}
            assert row.memory.cell_m[2] == voxel.cell_m[2]
    assert any(row.memory == voxel for row in found)  # the table's own value is among them


@pytest.mark.slow
def test_a_row_gets_as_many_steps_as_its_time_allows(monkeypatch, tmp_path):
    base = presets.load("table1")
    chosen = [row for row in table1_rows.main_rows(base) if row.name in ("none", "voxel-attend")]
    chosen += table1_rows.ablated(base, "time", ("4",))
    seconds = {"backbone": 0.5, "none": 0.5, "voxel-attend": 1.0, "map2d-attend": 2.0}
    seconds |= {"voxel-attend-sinusoid-time_4": 1.0, "none-attend-time_4": 0.8}
    asked, pace = [], 1.0

    def measured(study, which, log):
        asked.extend(row.name for row in which.values())
        return {model: pace * seconds[row.name] for model, row in which.items()}

    monkeypatch.setattr(table1_training, "_measure", measured)
    study = table1_training.Study(base, tmp_path, (2, 1))
    plan = table1_training.planned(study, chosen, print)
    steps = {name: entry["steps"] for name, entry in plan.items()}
    assert steps["backbone"] == 2 * 60 / 0.5
    assert (steps["none"], steps["voxel-attend"]) == (120, 60)
    assert steps["voxel-attend-sinusoid-time_4"] == 240
    assert steps["none-attend-time_4"] == 300  # the control gets the same minutes
    assert table1_training.planned(study, chosen, print) == plan
    assert len(asked) == 4  # each once; the row without a memory trains what the backbone does
    longer = dataclasses.replace(study, minutes=(2, 2))
    assert table1_training.planned(longer, chosen[:1], print)["none"]["steps"] == 240
    assert (
        table1_training.planned(study, chosen, print) == plan
    )  # other minutes have changed nothing
    pace = 3.0  # what is timed on a busier machine is scaled by what was timed before
    late = [row for row in table1_rows.main_rows(base) if row.name == "map2d-attend"]
    assert table1_training.planned(study, late, print)["map2d-attend"]["steps"] == 30
    before = len(asked)  # readers are scaled by one, and not by a backbone
    more = [
        row for row in table1_rows.main_rows(base) if row.name in ("voxel-attend", "images-attend")
    ]
    seconds["images-attend"] = 1.5
    assert table1_training.planned(study, more, print)["images-attend"]["steps"] == 40
    assert asked[before:] == ["voxel-attend", "images-attend"]
    equal = dataclasses.replace(study, steps=(7, 5))
    steps = {
        name: entry["steps"]
        for name, entry in table1_training.planned(equal, chosen, print).items()
    }
    assert steps == {
        "backbone": 7,
        "none": 5,
        "voxel-attend": 5,
        "voxel-attend-sinusoid-time_4": 20,
        "none-attend-time_4": 20,
    }
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(UserError, match=r"plan\.json is damaged"):
        table1_training.planned(study, chosen, print)


def test_differences_are_paired_by_clip_and_seeds_are_averaged_first():
    rng, houses = np.random.default_rng(0), np.array([0, 0, 1, 1, 2, 2])

    def arrays(shift):
        sums = np.ones((6, 2, len(MASKS), len(SUMS)))
        sums[..., SUMS.index("squared")] = 10 ** -(shift + noise[:, None, None] / 10)
        return {"sums": sums, "src": 50 + shift + 0 * noise}

    noise = rng.normal(size=6)
    pieces = {"none": [arrays(1.0), arrays(1.1)], "images-attend": [arrays(1.2), arrays(1.3)]}
    found = table1.summary(pieces, {}, houses, {})
    gain = found["differences"]["none"]["images-attend"]["psnr/all"]
    assert gain["mean"] == pytest.approx(2)
    assert gain["low"] == pytest.approx(2)  # the same noise in both: paired away
    assert found["rows"]["none"]["measures"]["psnr/all"]["per_seed"][1] == pytest.approx(
        found["rows"]["none"]["measures"]["psnr/all"]["per_seed"][0] + 1
    )
    assert table1_page.mark_of(gain) == "*"  # both seeds gain as much
    apart = table1.summary(
        {"none": pieces["none"], "voxel-attend": [arrays(0.9), arrays(2.2)]}, {}, houses, {}
    )
    unsure = apart["differences"]["none"]["voxel-attend"]["psnr/all"]
    assert unsure["low"] > 0 > unsure["over_seeds"]["low"]  # one seed loses, the other gains more
    assert table1_page.mark_of(unsure) == "°"
    (step,) = found["order"]
    assert (step["worse"], step["better"]) == ("none", "images-attend")
    assert step["differences"]["psnr/all"]["over_seeds"]["mean"] == pytest.approx(2)
    spread = found["rows"]["none"]["measures"]["psnr/all"]
    assert spread["low"] < spread["mean"] < spread["high"]


@dataclasses.dataclass(frozen=True)
class Patches(metrics.VideoDistance):
    """FVD and KVD of mean colours in the place of I3D, which is large."""

    def features(self, video_BTHWC):
        """Return 4 × 4 mean colours of the first and of the last frame."""
        x = np.asarray(video_BTHWC)[:, [0, -1]]
        side = x.shape[2] // 4
        return x.reshape(len(x), 2, 4, side, 4, side, 3).mean((3, 5)).reshape(len(x), -1)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A judge with every measure that Table 1 has, by random weights, and small clips."""
    folder = tmp_path_factory.mktemp("measured")
    few = ["--train", "1", "--validation", "0", "--test", "3", "--size", "32", "--frames", "48"]
    assert program.main(["data", "collect", str(folder / "data"), *few]) == 0
    alex = folder / "alex.safetensors"
    weights.save(alex, lpips.init("alex", jax.random.key(0)))
    nets = {
        "lpips_alex": metrics.load("lpips_alex", alex),
        table1_scoring.SRC: metrics.load("src[alex]", alex),
    }
    nets |= {kind: Patches(kind, {}) for kind in ("fvd", "kvd")}
    base = small(folder / "data")
    clip = dataclasses.replace(base.model.clip, height=32, width=32, frames=9)
    evaluate = dataclasses.replace(base.evaluate, clips=9, batch=4)
    base = dataclasses.replace(base.with_model(clip=clip), evaluate=evaluate)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(table1_scoring, "_measures", lambda *_: (nets, {}))
        return base, table1_scoring.open_scorer(base, folder / "out", print), folder / "out"


@pytest.mark.slow
def test_every_measure_of_the_table_stands_beside_what_it_can_be(measured):
    base, judge, out = measured
    truth, copied = judge.truth(out), judge.baseline("copy", out)
    count = len(judge.protocol.clips)
    assert count % 4  # a last batch that is padded
    for name in ("src_ceiling", "src_floor"):
        assert truth[name].shape == copied["src"].shape == (count,)
    np.testing.assert_allclose(truth["src_ceiling"], 100, rtol=1e-5)
    np.testing.assert_allclose(copied["src"], 100, rtol=1e-5)  # a picture that never changes
    assert (truth["src_floor"] < 99.9).all()  # each beside another clip, the last one too
    assert truth["logits"].shape == copied["logits"].shape == (count, 96)

    pieces = {name: [copied, copied] for name in ("none", "none-attend", "voxel-attend")}
    pieces |= {"copy": [copied]}
    results = table1.summary(pieces, truth, judge.house_of_clip, judge.nets, judge.frames)
    row = results["rows"]["none"]["measures"]
    net = judge.nets["fvd"]
    assert row["fvd"]["mean"] == pytest.approx(net.distance(copied["logits"], truth["logits"]))
    score = net.score(copied["logits"], truth["logits"])
    assert row["fvd_half"]["per_seed"] == pytest.approx([score.half.mean] * 2)
    assert results["floors"]["fvd"]["floor"]["mean"] == pytest.approx(score.floor.mean)
    assert results["floors"]["fvd"]["name"] == f"FVD-9f@{count // 2}"
    apart = results["differences"]["none"]["copy"]["psnr/seen"]
    assert apart["over_seeds"] == {"mean": 0, "low": 0, "high": 0}  # paired, and not of two groups
    apart = results["differences"]["none"]["copy"]["fvd_half"]
    assert apart["over_seeds"] == {"mean": 0, "low": 0, "high": 0}
    assert apart["p_seeds"] == apart["p_seeds_holm"] == 1
    assert table1_page.mark_of(apart) == ""

    study = table1_training.Study(base, out, (1, 1))
    chosen = [row for row in table1_rows.main_rows(base) if row.name in pieces]
    facts = table1._facts(study, judge, chosen, {}, [0, 1], "")
    table1_page.write({"about": facts, **results}, out / "page.md")
    text = (out / "page.md").read_text()
    assert f"| FVD-9f@{count // 2} | KVD-9f@{count // 2} |" in text
    assert f"the truth against itself | – | – | – | – | – | {score.floor.mean:.0f} |" in text
    assert (
        f"SRC[alex]: ground truth 100.0, two different places {truth['src_floor'].mean():.1f}"
        in text
    )
    assert "## Each row minus none · attend" in text
    assert "none · attend − none | +0.00 [+0.00, +0.00] | +0.00 [+0.00, +0.00] |" in text
    with (out / "page.csv").open() as file:
        lines = list(csv.DictReader(file))
    over = {line["measure"]: line["interval_over"] for line in lines if line["row"] == "none"}
    assert (over["psnr/all"], over["fvd"], over["src"]) == ("houses", "seeds", "houses")


def test_every_entry_of_the_results_is_documented():
    docs = Path(__file__).parents[2] / "docs"
    text = (docs / "table1.md").read_text()
    for path in (docs / "table1").glob("*-results.json"):
        results = json.loads(path.read_text())
        about = results["about"]
        keys = {*results, *about, *next(iter(about["rows"].values()))} - {"rows", "differences"}
        assert [key for key in sorted(keys) if f"`{key}`" not in text] == []


def test_what_needs_no_network_and_is_better_is_named():
    measures = {"psnr/all": 10.0, "lpips/all": 0.5, "src": 50.0}

    def row(**changes):
        values = measures | changes
        return {
            "measures": {
                name: {"mean": value, "low": value, "high": value} for name, value in values.items()
            }
        }

    described = {"label": "none", "depth": True}
    results = {
        "about": {"rows": {"none": described}},
        "floors": {},
        "rows": {"none": row(), "copy": row(**{"lpips/all": 0.2, "src": 100.0})},
    }
    assert table1_page._unbeaten(results) == (
        "Without a network, and better than every trained row: copying the last frame is better in "
        "LPIPS[alex]."
    )
    results["rows"]["copy"] = row(**{"psnr/all": 9.0})
    assert table1_page._unbeaten(results) == ""


def test_a_row_without_a_memory_learns_from_the_clips_that_readers_learn_from():
    base = presets.load("table1")
    every = {row.name: row for row in table1_rows.main_rows(base)}
    study = table1_training.Study(base, Path("x"), (1, 1))

    def drawn(row):
        stage = STAGES[1 if row.reads else 0]
        config = table1_training.settings(study, row, 3, 10, start="x")
        return feed.prepared_seed(config, stage), stage.data_seed(config)

    alike = {drawn(row) for row in every.values()}
    assert len(alike) == 1
    assert drawn(table1_training.backbone_of(base, every["none"])) not in alike


def test_the_walk_back_passes_the_same_cameras():
    actions = np.array([[0.2, 0.1, 0.3]] * 4)
    start = pose_from_yaw(np.zeros(3), 0.4)
    out = np.asarray(integrate(start, actions))[None]
    walk = np.asarray(integrate(start, there_and_back(actions)))
    np.testing.assert_allclose(walk, table1_scoring._there_and_back(out, 4)[0], atol=1e-5)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--rows", "nothing"], "there are no rows nothing; choose from none, "),
        (["--values", "3"], "values apply to an ablation"),
        (["--ablate", "cell", "--values", "wide"], "the ablation cell cannot take 'wide'"),
        (["--ablate", "cell", "--values", "0"], "the ablation cell cannot take '0'"),
        (["--ablate", "cell", "--values", "1e-4"], "cells of 1e-4 m on the ground need a map of"),
        (["--ablate", "tokens", "--values", "999999999"], "999999999 tokens need a map of as many"),
        (["--ablate", "extent", "--values", "-4"], "ablation extent cannot take '-4'"),
        (["--ablate", "time", "--values", "-4"], "the ablation time cannot take '-4'"),
        (["--minutes", "nan", "1"], "minutes are"),
        (["--steps", "0", "1"], "steps are"),
        (["--seeds", "1", "1"], "give distinct training seeds"),
        (["--seeds", "0", "-1"], "give distinct training seeds of 0 or more"),
        (["--ablate", "cell", "--rows", "none"], "rows apply to the table, not to an ablation"),
        (["--preset", "nomad"], "of a NomadTask, but Table 1 compares memories"),
        (["--preset", "codec"], "of a CodecTask, but Table 1 compares memories"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(tmp_path, argv, words):
    with pytest.raises(UserError, match=words):
        program.execute(
            ["table1", *argv, "--out", str(tmp_path / "out"), "--data", str(tmp_path / "none")]
        )
    assert not (tmp_path / "out" / "protocol.json").exists()


def test_marks_are_corrected_for_the_comparisons_of_a_column():
    def family():
        return [
            {"psnr/seen": {"p": p, "p_seeds": 0.001}, "src": {"p": 0.5}}
            for p in (0.01, 0.02, 0.03, 0.2)
        ]

    alone = family()[1:2]
    table1.adjust(alone)
    assert table1_page.mark_of(alone[0]["psnr/seen"]) == "*"
    together = family()
    table1.adjust(together)
    found = [each["psnr/seen"]["p_holm"] for each in together]
    assert found == pytest.approx([0.04, 0.06, 0.06, 0.2])
    assert [table1_page.mark_of(each["psnr/seen"]) for each in together] == ["*", "", "", ""]
    assert {each["src"]["p_holm"] for each in together} == {1.0}
    assert "Holm's correction for the comparisons of a column" in table1_page.PAIRED


def test_the_names_of_recorded_scores_do_not_change_with_settings_that_came_later():
    """``docs/table1/recorded`` holds scores of 36 trainings; their files must be found again."""
    base = presets.load("table1")
    assert table1_scoring._settings(base)["version"] == 3
    assert not table1_scoring._settings(base).keys() & table1_scoring.ADDED.keys()
    if hasattr(base.train, "beta2"):
        other = dataclasses.replace(base, train=dataclasses.replace(base.train, beta2=0.95))
        assert table1_scoring._settings(other)["train.beta2"] == 0.95
