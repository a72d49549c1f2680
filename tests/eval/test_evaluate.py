"""The report of a tiny real run: schema, self-containedness, resuming, errors, previews."""

from __future__ import annotations

import base64
import dataclasses
import functools
import io
import json
import re
import shutil
import types
from html.parser import HTMLParser
from pathlib import Path

import av
import jax
import numpy as np
import pytest
from PIL import Image

from pewm_jax import config as configs
from pewm_jax.cli import main, parser
from pewm_jax.cli import main as program
from pewm_jax.config import StageConfig, TrainConfig, UserError
from pewm_jax.eval import compare, preview, reproject, runner
from pewm_jax.eval import evaluate as report
from pewm_jax.eval import loaded_run as runs
from pewm_jax.eval.runner import Methods, ModelRunner
from pewm_jax.io import runtime, tree, weights
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.models.lpips import model as lpips
from pewm_jax.report.evaluation_page import introduction
from pewm_jax.report.labels import format_comparison, format_drift, format_verdict, number
from pewm_jax.types import Frames
from pewm_jax.worlds import world_model
from pewm_jax.worlds.pewm.world import STAGES
from tests.eval.scene import tiny, write_split

ROOT = Path(__file__).parents[2]
FLAT = Frames(np.zeros((1, 1, 2, 2, 3)), np.zeros((1, 1, 2, 2)), None)


@pytest.fixture(scope="module")
def command():
    def evaluate(argv):
        return main.execute(["evaluate", *argv], "python evaluate.py")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runtime, "cache_compilation", lambda _: None)
        yield functools.partial(parser.run, evaluate)


@pytest.fixture(scope="module", autouse=True)
def compile_once():
    """Let equal programs of this file be compiled once; compiling is most of its time."""
    compiled = {}

    def cached(name, function, arguments, log):
        shapes = jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), arguments)
        key = name, str(shapes)
        if key not in compiled:
            compiled[key] = original(name, function, arguments, log)
        return compiled[key]

    with pytest.MonkeyPatch.context() as patch:
        original = runner._compile
        patch.setattr(runner, "_compile", cached)
        patch.setattr(reproject, "CANDIDATES", reproject.CANDIDATES[:2])
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory, compile_once):
    """A run folder with untrained weights, and its report."""
    base = tmp_path_factory.mktemp("experiment")
    config = tiny(base)
    write_split(base / "data" / "revisit", episodes=2)
    write_split(base / "data" / "validation", episodes=2)
    write_split(base / "data" / "train", episodes=1, scene="elsewhere")
    folder = base / "run"
    folder.mkdir()
    configs.save(config, folder / "config.json")
    params = jax.jit(lambda key: world_model.init(config.model, key, memory=True))(
        jax.random.key(0)
    )
    weights.save(folder / "weights.safetensors", params)
    report.evaluate(folder, log=lambda _: None)
    return folder


@pytest.fixture
def copied(run, tmp_path):
    """The same run in a folder that a test may damage; its data stays where it is."""
    return Path(shutil.copytree(run, tmp_path / "run"))


def test_metrics_hold_every_method_mask_and_metric(run):
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    for method in ("memory", "empty", "reproject", "copy"):
        for mask in ("seen", "unseen", "all"):
            for metric in ("psnr", "ssim", "depth_mae", "depth_rel"):
                entry = metrics["results"][method][mask][metric]
                assert set(entry) == {"mean", "stderr", "n"}
                frames = metrics["per_frame"][method][mask][metric]["mean"]
                assert len(frames) == 4
        assert np.isfinite(metrics["results"][method]["seen"]["psnr"]["mean"])
    protocol = metrics["protocol"]
    assert protocol["seeds"] == [0, 1]
    assert (protocol["clips"], protocol["episodes"], protocol["scenes"]) == (4, 2, 2)
    assert protocol["weights_sha256"] == report.file_hash(run / "weights.safetensors")
    assert protocol["context"] == 6
    assert (protocol["held_out"], protocol["trained_scenes"]) == (True, [])
    assert protocol["clustered_by"] == "scene"
    assert protocol["sampling_steps"] == 2
    assert (protocol["sampler"], protocol["memory"]) == ("ddim", "voxel")
    assert protocol["encoder"] == "patch_colours"
    assert configs.from_dict(configs.Config, protocol["config"]) == configs.load(
        run / "config.json"
    )
    assert len(metrics["margin"]["seen"]["psnr"]["per_seed"]) == 2
    assert metrics["margin"] == metrics["margins"]["empty"]
    assert set(metrics["margins"]) == {"empty", "reproject", "copy"}
    assert protocol["reproject"]["split"] == "validation"
    assert protocol["none"] is None
    shares = metrics["coverage"]
    assert set(shares) == {"held", "chosen", "attended", "rendered", "looked_at"}
    assert 1 >= shares["held"] >= shares["chosen"] >= shares["attended"] > 0
    assert shares["looked_at"] == shares["attended"]  # the reader attends
    assert len(metrics["long"]["drift"]["memory"]["quarters"]) == 4
    assert len(metrics["long"]["per_frame"]["memory"]["all"]["psnr"]["mean"]) == 8


def test_metrics_hold_means_over_houses_with_intervals(run):
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    assert metrics["schema"] == 1
    houses = metrics["houses"]
    assert (houses["house"], houses["how"]["level"]) == ("scene", 0.95)
    for part, horizon in ((houses, 4), (houses["long"], 8)):
        assert set(part["margins"]) == {"empty", "reproject", "copy"}
        for method in ("memory", "empty", "reproject", "copy"):
            entry = part["results"][method]["all"]["psnr"]
            assert set(entry) == {"mean", "low", "high", "houses"}
            assert entry["low"] <= entry["mean"] <= entry["high"]
            assert entry["houses"] == 2
            assert len(part["per_frame"][method]["seen"]["psnr"]["high"]) == horizon
        assert len(part["per_frame_margins"]["copy"]["all"]["ssim"]["low"]) == horizon
    # As many clips in each house: the mean over houses is that over clips.
    clips = metrics["results"]["memory"]["all"]["psnr"]["mean"]
    assert houses["results"]["memory"]["all"]["psnr"]["mean"] == pytest.approx(clips)
    assert "House by house" in (run / "report" / "index.html").read_text()


@pytest.mark.slow
def test_things_are_followed_where_the_episodes_have_instance_ids(run, copied, tmp_path, command):
    protocol = json.loads((run / "report" / "metrics.json").read_text())["protocol"]
    assert protocol["scs"].startswith(
        "SCS is not measured, because the episodes have no instance ids"
    )
    assert protocol["scs_segmenter"] is None
    with pytest.raises(UserError, match=r"evaluate\.scs is flow, but .* collect them with --ids"):
        report.evaluate(copied, log=lambda _: None, scs="flow")
    write_split(tmp_path / "data" / "revisit", episodes=2, ids=True)
    said = []
    page = report.evaluate(copied, log=said.append, data=tmp_path / "data", lpips="off")
    metrics = json.loads((page.parent / "metrics.json").read_text())
    found = metrics["scs"]
    assert (found["name"], found["clips"], found["seed"]) == ("SCS[flow]", 4, 0)
    assert set(found["results"]) == {"memory", "empty", "reproject", "copy"}
    assert set(found["margins"]) == {"empty", "reproject", "copy"}
    for entry in (*found["results"].values(), found["ceiling"]):
        assert 0 <= entry["low"] <= entry["mean"] <= entry["high"] <= 100
        assert entry["houses"] == 2
    assert len(found["per_frame"]["memory"]["mean"]) == 4
    assert page.read_text().count("SCS[flow]") >= 3  # the table, the sentence, the protocol
    assert any(line.startswith("SCS[flow], higher is better: ") for line in said)
    fingerprint = metrics["protocol"]["fingerprint"]
    page = report.evaluate(copied, log=said.append, data=tmp_path / "data", lpips="off", scs="off")
    metrics = json.loads((page.parent / "metrics.json").read_text())
    assert metrics["scs"] is None
    assert metrics["protocol"]["scs"] == "SCS is not measured (evaluate.scs)."
    assert metrics["protocol"]["fingerprint"] == fingerprint  # other scores are kept
    assert command([str(copied), "--data", str(tmp_path / "data"), "--scs", "nowhere"]) == 2


def test_the_page_on_evaluation_names_every_entry(run):
    page = (ROOT / "docs" / "evaluation.md").read_text()
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    protocol = json.loads((run / "report" / "protocol.json").read_text())
    found = [*metrics, *metrics["houses"], *metrics["houses"]["results"]["memory"]["all"]["psnr"]]
    found += [*protocol, *protocol["protocol"], *protocol["protocol"]["clips"][0]]
    for name in found:
        assert re.search(rf"[`.]{name}[`.]", page), name


@pytest.mark.slow
def test_the_protocol_of_a_report_scores_another_run_which_is_compared(run, copied, command):
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    protocol = run / "report" / "protocol.json"
    name = metrics["protocol"]["protocol_sha256"]
    assert metrics["protocol"]["protocol_file"] is None
    assert name == json.loads(protocol.read_text())["sha256"]
    assert name in (run / "report" / "index.html").read_text()
    params = weights.load(copied / "weights.safetensors")
    changed = jax.tree.map(lambda leaf: leaf + np.float32(0.02), params)
    weights.save(copied / "weights.safetensors", changed)
    assert command([str(copied), "--protocol", str(protocol)]) == 0
    other = json.loads((copied / "report" / "metrics.json").read_text())
    assert other["protocol"]["protocol_sha256"] == name
    assert other["protocol"]["protocol_file"] == str(protocol)
    assert other["protocol"]["clip_list"] == metrics["protocol"]["clip_list"]
    assert other["results"]["copy"] == metrics["results"]["copy"]
    assert other["results"]["memory"] != metrics["results"]["memory"]

    said = []
    page = compare.compare(copied, run, log=said.append)
    found = json.loads(page.with_name("comparison.json").read_text())
    both = [m["houses"]["results"]["memory"]["seen"]["psnr"] for m in (other, metrics)]
    assert [found[side]["clips"]["seen"]["psnr"] for side in "ab"] == both
    difference = found["differences"]["clips"]["seen"]["psnr"]["mean"]
    assert difference == pytest.approx(both[0]["mean"] - both[1]["mean"])
    assert len(re.findall("<figure><img", page.read_text())) == 1
    report.evaluate(copied, log=lambda _: None, clips=3)
    with pytest.raises(UserError, match="3 and 4 clips"):
        compare.compare(copied, run)


@pytest.mark.slow
def test_a_protocol_is_written_before_training_and_followed(run, copied, tmp_path, capsys):
    path = tmp_path / "protocol.json"
    assert program.main(["protocol", str(run), "--out", str(path)]) == 0
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    assert metrics["protocol"]["protocol_sha256"] in capsys.readouterr().out
    other = tmp_path / "other.json"
    flags = ["--clips", "3", "--seeds", "5", "--out", str(other)]
    assert program.main(["protocol", str(run), *flags]) == 0
    settings = json.loads((copied / "config.json").read_text())
    settings["evaluate"]["protocol"] = str(other)
    (copied / "config.json").write_text(json.dumps(settings))
    report.evaluate(copied, log=lambda _: None)
    followed = json.loads((copied / "report" / "metrics.json").read_text())["protocol"]
    assert (followed["clips"], followed["seeds"]) == (3, [5])
    with pytest.raises(UserError, match="--clips cannot be combined with"):
        report.evaluate(copied, log=lambda _: None, clips=2)
    report.evaluate(copied, log=lambda _: None, protocol="off")
    own = json.loads((copied / "report" / "metrics.json").read_text())["protocol"]
    assert own["protocol_sha256"] == metrics["protocol"]["protocol_sha256"]
    assert program.main(["protocol", "nothing"]) == 2
    assert program.main(["protocol", "codec"]) == 2


def test_untrained_memory_changes_nothing(run):
    # At the start of stage 2 the memory blocks are exactly the identity.
    gain = json.loads((run / "report" / "metrics.json").read_text())["margin"]["all"]["psnr"]
    assert gain["mean"] == pytest.approx(0, abs=1e-4)


class Sources(HTMLParser):
    """Collects everything a page would load."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [
            (tag, v) for k, v in attrs if k in {"src", "srcset", "href", "poster", "data"}
        ]


def test_page_needs_no_other_file(run):
    page = (run / "report" / "index.html").read_text()
    sources = Sources()
    sources.feed(page)
    assert len(sources.found) == 14  # a video, stills, masks, map; 5 charts in light and dark
    assert all(source.startswith("data:") for _, source in sources.found)
    assert not re.search(r"https?://|url\(|@import|<script|<link", page)


def test_video_in_the_page_plays(run):
    page = (run / "report" / "index.html").read_text()
    film = base64.b64decode(re.search(r"data:video/mp4;base64,([^\"]+)", page).group(1))
    with av.open(io.BytesIO(film)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        frames = sum(1 for _ in container.decode(video=0))
    assert frames == 2 * 4 + 1 + 3  # two clips, the present, and it stands still for a while


def test_strip_is_a_picture(run):
    with Image.open(run / "report" / "strip.png") as picture:
        assert picture.width > 600
    with Image.open(run / "report" / "strip.gif") as film:
        assert film.n_frames > 2 * 4  # still frames at the beginning are joined
        assert film.width > 4 * 100


def test_a_complete_report_is_left_alone(run, command, capsys, monkeypatch):
    monkeypatch.setattr(ModelRunner, "prepare", None)
    before = (run / "report" / "metrics.json").stat().st_mtime_ns
    assert command([str(run), "--seeds", "0", "1", "--clips", "4"]) == 0
    said = capsys.readouterr().out
    assert "nothing to do" in said
    assert said.strip().endswith(f"report: {run / 'report' / 'index.html'}")
    assert (run / "report" / "metrics.json").stat().st_mtime_ns == before


@pytest.mark.slow
def test_a_damaged_page_is_drawn_again_without_imagining(copied, monkeypatch):
    monkeypatch.setattr(ModelRunner, "run", None)
    page = copied / "report" / "index.html"
    whole = page.read_bytes()
    page.write_bytes(whole[:1000])
    report.evaluate(copied, log=lambda _: None)
    assert page.read_bytes() == whole


@pytest.mark.slow
def test_a_report_with_another_validation_split_is_not_complete(run, tmp_path):
    """The settings of ``reproject`` are chosen on that split, also without a protocol's file."""
    base = tmp_path / "copy"
    shutil.copytree(run.parent, base)
    data, folder = base / "data", base / "run"
    report.evaluate(folder, data=data, out=tmp_path / "report", log=lambda _: None)
    before = json.loads((tmp_path / "report" / "metrics.json").read_text())
    shutil.rmtree(data / "validation")
    write_split(data / "validation", episodes=1)
    said = []
    report.evaluate(folder, data=data, out=tmp_path / "report", log=said.append)
    assert not any("nothing to do" in line for line in said)
    after = json.loads((tmp_path / "report" / "metrics.json").read_text())
    hashes = [each["protocol"]["reproject"]["dataset_sha256"] for each in (before, after)]
    assert hashes[0] != hashes[1]
    assert hashes[1] == report.file_hash(data / "validation" / report.MANIFEST)
    report.evaluate(folder, data=data, out=tmp_path / "report", log=said.append)
    assert "nothing to do" in said[-1]


@pytest.mark.slow
def test_lpips_is_scored_where_weights_are_given_and_else_said_to_be_left_out(copied, tmp_path):
    metrics = json.loads((copied / "report" / "metrics.json").read_text())
    assert "lpips" not in metrics["results"]["memory"]["all"]
    assert metrics["protocol"]["lpips"].startswith("LPIPS is not measured")
    assert metrics["protocol"]["lpips_weights_sha256"] is None
    page = (copied / "report" / "index.html").read_text()
    assert "LPIPS is not measured" in page
    assert "LPIPS[" not in page

    path = tmp_path / "vgg.safetensors"  # AlexNet takes no pictures this small
    weights.save(path, jax.jit(lambda key: lpips.init("vgg", key))(jax.random.key(0)))
    said = []
    report.evaluate(copied, log=said.append, clips=3, seeds=(0,), lpips=path)
    metrics = json.loads((copied / "report" / "metrics.json").read_text())
    found = {name: masks["all"]["lpips"] for name, masks in metrics["results"].items()}
    assert set(found) == {"memory", "empty", "reproject", "copy"}
    assert all(entry["n"] == 3 and entry["mean"] > 0 for entry in found.values())
    assert found["copy"] != found["memory"]
    assert metrics["margins"]["empty"]["all"]["lpips"]["mean"] == pytest.approx(0, abs=1e-3)
    assert len(metrics["long"]["per_frame"]["copy"]["all"]["lpips"]["mean"]) == 8
    for mask in ("seen", "unseen"):
        for part in (metrics, metrics["long"], metrics["houses"]):
            assert part["results"]["copy"][mask]["lpips"]["mean"] > 0
            assert "lpips" in part["margins"]["reproject"][mask]
    assert metrics["protocol"]["lpips_weights_sha256"] == report.file_hash(path)
    page = (copied / "report" / "index.html").read_text()
    name = f"LPIPS[vgg-{tree.digest(weights.load(path))[:8]}]"  # weights of one's own
    assert f"{name} ↓" in page
    assert "not resized" in page
    assert any(line.startswith(f"{name} of whole images, lower is better") for line in said)
    said.clear()
    report.evaluate(copied, log=said.append, clips=3, seeds=(0,), lpips=path)
    assert "nothing to do" in said[-1]


@pytest.mark.slow
def test_more_seeds_keep_what_was_scored(copied):
    said = []
    report.evaluate(copied, log=said.append, seeds=(0, 1, 2))
    assert any("12 of 16 scores are reused" in line for line in said)
    metrics = json.loads((copied / "report" / "metrics.json").read_text())
    assert metrics["protocol"]["seeds"] == [0, 1, 2]


@pytest.mark.slow
def test_a_quick_look_does_not_cost_the_full_scores(copied, monkeypatch):
    page = copied / "report" / "index.html"
    whole = page.read_bytes()
    report.evaluate(copied, log=lambda _: None, clips=2)
    assert page.read_bytes() != whole
    monkeypatch.setattr(ModelRunner, "run", None)
    report.evaluate(copied, log=lambda _: None)
    assert page.read_bytes() == whole


@pytest.mark.slow
def test_other_weights_start_anew(copied):
    params = weights.load(copied / "weights.safetensors")
    changed = jax.tree.map(lambda leaf: leaf * np.float32(1.01), params)
    weights.save(copied / "weights.safetensors", changed)
    said = []
    report.evaluate(copied, log=said.append)
    assert not any("are reused" in line for line in said)
    assert len(list((copied / "report" / "partial").iterdir())) == 1


def rival(run, folder, *, steps, **changes):
    """A run without a memory: the first stage of the model, trained for some steps."""
    config = dataclasses.replace(
        configs.load(run / "config.json"),
        train=TrainConfig(stage1=StageConfig(steps=steps), stage2=StageConfig(steps=0)),
    ).with_model(**changes)
    folder.mkdir()
    configs.save(config, folder / "config.json")
    params = jax.jit(lambda key: world_model.init(config.model, key, memory=False))(
        jax.random.key(1)
    )
    params = jax.tree.map(lambda leaf: leaf + 0.02, params)
    weights.save(folder / "weights.safetensors", params, {"stage": "1", "step": str(steps)})
    return folder


@pytest.mark.slow
def test_a_model_without_a_memory_gets_a_row(copied, tmp_path):
    none = rival(copied, tmp_path / "none", steps=1000)
    said = []
    report.evaluate(copied, log=said.append, none=none)
    assert any("12 of 16 scores are reused" in line for line in said)
    metrics = json.loads((copied / "report" / "metrics.json").read_text())
    assert set(metrics["results"]) == {"memory", "empty", "none", "reproject", "copy"}
    assert metrics["results"]["none"] != metrics["results"]["empty"]
    assert len(metrics["margins"]["none"]["all"]["psnr"]["per_seed"]) == 2
    assert metrics["protocol"]["none"]["steps"] == 1000
    assert any("trained as long without a memory" in line for line in said)
    said.clear()
    report.evaluate(copied, log=said.append, none=none)
    assert "nothing to do" in said[-1]
    report.evaluate(copied, log=said.append)
    assert any("--none" in line for line in said)  # how to get the row


@pytest.mark.slow
def test_a_rival_that_cannot_be_compared_is_refused(copied, command, capsys, tmp_path):
    short = rival(copied, tmp_path / "short", steps=999)
    said = refused(command, [str(copied), "--none", str(short)], capsys)
    assert "999 steps" in said
    assert "1000 in total" in said
    clip = dataclasses.replace(configs.load(copied / "config.json").model.clip, far_m=9.0)
    other = rival(copied, tmp_path / "other", steps=1000, clip=clip)
    assert "far_m 9.0 there" in refused(command, [str(copied), "--none", str(other)], capsys)
    assert "does not exist" in refused(command, [str(copied), "--none", "gone"], capsys)


@pytest.mark.slow
def test_a_run_without_a_memory_is_scored_and_compared_under_its_own_name(run, tmp_path, command):
    own, said = rival(run, tmp_path / "own", steps=3), []
    report.evaluate(own, log=said.append, protocol=run / "report" / "protocol.json")
    metrics = json.loads((own / "report" / "metrics.json").read_text())
    assert set(metrics["results"]) == {"model", "reproject", "copy"}
    assert set(metrics["margins"]) == {"reproject", "copy"}
    assert (metrics["margin"], metrics["coverage"]) == (None, None)
    assert (metrics["protocol"]["method"], metrics["protocol"]["memory"]) == ("model", "none")
    assert any("trained without a memory" in line for line in said)
    page = (own / "report" / "index.html").read_text()
    assert "trained without a memory" in page
    assert not re.search("with its map|empty map<|for each seed|from above", page)
    assert (own / "report" / "rows" / "00-model.png").is_file()

    found = compare.compare(run, own, log=said.append)
    content = json.loads(found.with_name("comparison.json").read_text())
    assert [content[side]["runs"][0]["method"] for side in "ab"] == ["memory", "model"]
    theirs = json.loads((run / "report" / "metrics.json").read_text())
    both = [m["houses"]["results"] for m in (theirs, metrics)]
    assert content["a"]["clips"]["seen"]["psnr"] == both[0]["memory"]["seen"]["psnr"]
    assert content["b"]["clips"]["seen"]["psnr"] == both[1]["model"]["seen"]["psnr"]
    assert found.read_text().count("data:image/png") == 1 + 2 * 8  # and charts, light and dark
    shutil.rmtree(found.parent)


def test_a_memory_of_kind_none_is_no_memory_and_its_blocks_are_used(run, tmp_path):
    none = configs.load(run / "config.json").model.memory
    memory = NoMemoryConfig(capacity=none.capacity, tokens=none.tokens, reader=none.reader)
    config = configs.load(run / "config.json").with_model(memory=memory)
    (tmp_path / "none").mkdir()
    configs.save(config, tmp_path / "none" / "config.json")
    params = weights.load(run / "weights.safetensors")
    weights.save(tmp_path / "none" / "weights.safetensors", params, {"stage": "2", "step": "1000"})
    opened = runs.open_run(tmp_path / "none")
    assert not runs.has_memory(opened)
    backbone = {name: part for name, part in params.items() if name != "memory"}
    with pytest.raises(UserError, match="no memory blocks yet"):
        runs.has_memory(
            dataclasses.replace(opened, params=backbone)
        )  # of stage 2, which was asked for
    ran = []
    model = types.SimpleNamespace(run=lambda *_, memory: (ran.append(memory), None, FLAT))
    Methods(model, None, remembers=False).imagine("model", None, None, None, None)
    assert ran == [True]


def test_a_training_without_a_memory_that_is_not_finished_is_refused(run, tmp_path):
    short = rival(run, tmp_path / "short", steps=3)
    params = weights.load(short / "weights.safetensors")
    weights.save(short / "weights.safetensors", params, {"stage": "1", "step": "2"})
    with pytest.raises(UserError, match="from step 2 of 3 of stage1"):
        report.evaluate(short, log=lambda _: None)


@pytest.mark.slow
def test_other_data_get_a_report_of_their_own(copied, tmp_path):
    own = (copied / "report" / "metrics.json").read_bytes()
    write_split(tmp_path / "walks" / "revisit", episodes=1, scene="theirs")
    page = report.evaluate(copied, log=lambda _: None, data=tmp_path / "walks", clips=2)
    assert page == copied / "report-walks" / "index.html"
    metrics = json.loads(page.with_name("metrics.json").read_text())
    assert set(metrics["results"]) == {"memory", "empty", "reproject", "copy"}
    assert metrics["protocol"]["reproject"]["split"] is None  # nothing there to choose settings on
    assert "nothing was tried" in page.read_text()
    named = report.evaluate(
        copied, log=lambda _: None, split="validation", clips=2, out=tmp_path / "out"
    )
    assert named == tmp_path / "out" / "index.html"
    assert (copied / "report" / "metrics.json").read_bytes() == own
    config = configs.load(copied / "config.json")
    opened = runs.open_run(copied)
    other = report.override(config, split="validation")
    assert runs.report_folder(opened, other).name == "report-validation"
    assert runs.report_folder(opened, config).name == "report"


def test_a_folder_that_cannot_be_written_is_refused(copied, command, capsys, tmp_path):
    (tmp_path / "file").write_text("")
    said = refused(command, [str(copied), "--out", str(tmp_path / "file" / "report")], capsys)
    assert "--out" in said


def refused(command, arguments, capsys):
    assert command(arguments) == 2
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_bad_input_ends_in_one_sentence(copied, command, capsys, tmp_path):
    assert "does not exist" in refused(command, [str(tmp_path / "nothing")], capsys)
    (tmp_path / "a.json").write_text("{")
    assert "a.json is a file" in refused(command, [str(tmp_path / "a.json")], capsys)
    assert "missing does not exist" in refused(
        command, [str(copied), "--data", str(tmp_path / "missing"), "--split", ""], capsys
    ).replace("/ ", " ")
    assert "RUN is missing" in refused(command, [], capsys)
    assert "did you mean --clips" in refused(command, [str(copied), "--clip", "1"], capsys)
    assert "evaluate.clips" in refused(command, [str(copied), "--clips", "0"], capsys)
    assert "sample_steps" in refused(command, [str(copied), "--steps", "0"], capsys)
    assert "weights of LPIPS" in refused(command, [str(copied), "--lpips", "gone"], capsys)


def test_truncated_data_are_refused(copied, command, capsys, tmp_path):
    config = configs.load(copied / "config.json")
    data = Path(shutil.copytree(config.data.path, tmp_path / "data"))
    shard = next((data / "revisit").glob("*.array_record"))
    shard.write_bytes(shard.read_bytes()[:-100])
    assert "truncated" in refused(command, [str(copied), "--data", str(data)], capsys)


def test_weights_that_do_not_fit_are_refused(copied, command, capsys):
    path = copied / "weights.safetensors"
    whole = weights.load(path)
    weights.save(path, {"backbone": whole["backbone"]})
    assert "stage 1" in refused(command, [str(copied)], capsys)
    path.write_bytes(path.read_bytes()[:50])
    assert "weights.safetensors" in refused(command, [str(copied)], capsys)
    weights.save(path, whole)
    settings = json.loads((copied / "config.json").read_text())
    settings["model"]["backbone"]["layers"] = 3
    (copied / "config.json").write_text(json.dumps(settings))
    assert "weights.safetensors" in refused(command, [str(copied)], capsys)


def test_help_names_every_setting(command, capsys):
    with pytest.raises(SystemExit) as stop:
        command(["--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    flags = ("--clips", "--seeds", "--steps", "--data", "--video_clips", "--stride")
    for flag in (*flags, "--fvd", "--mirror", "--src", "--distributed", "--coordinator"):
        assert flag in said


def test_an_interruption_is_said_and_has_its_own_exit_code(copied, command, capsys, monkeypatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(ModelRunner, "run", interrupted)
    assert command([str(copied), "--stride", "2"]) == 130
    assert "to resume" in capsys.readouterr().err


@pytest.mark.slow
def test_weights_that_diverged_are_refused(copied):
    params = weights.load(copied / "weights.safetensors")
    broken = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), params)
    weights.save(copied / "weights.safetensors", broken)
    with pytest.raises(UserError, match="not finite"):
        report.evaluate(copied, log=lambda _: None)


@pytest.mark.parametrize(("stage", "rows"), [(STAGES[0], 2), (STAGES[1], 3)])
def test_previews_show_each_method(run, tmp_path, stage, rows, monkeypatch):
    monkeypatch.setattr(preview, "CLIPS", 2)  # the batch that was compiled for the report
    config = configs.load(run / "config.json")
    compiled = []
    prepare = ModelRunner.prepare
    monkeypatch.setattr(
        ModelRunner, "prepare", lambda self, m: (compiled.append(self), prepare(self, m))[1]
    )
    params = weights.load(run / "weights.safetensors")
    if not stage.memory:
        params = {"backbone": params["backbone"]}
    draw = preview.make_preview(config, tmp_path)
    made = draw(params, stage, 250)
    folder = tmp_path / "previews"
    path, video = folder / f"{stage.name}-000250.png", folder / f"{stage.name}-000250.mp4"
    assert made.files == (path, video)
    with Image.open(path) as picture:
        height = picture.height
    other = draw(jax.tree.map(lambda leaf: leaf * 0.5, params), stage, 500)
    assert len(set(map(id, compiled))) == 1
    for one, two in zip(made.files, other.files, strict=True):
        assert one.read_bytes() != two.read_bytes()
    per_row = 96 + 6
    assert (height - 34 - 24) // per_row == 2 * rows
    with av.open(str(video)) as container:
        (stream,) = container.streams.video
        assert stream.codec_context.name == "h264"
        frames = sum(1 for _ in container.decode(stream))
        assert frames == 2 * config.model.clip.frames
        assert stream.width == 8 + rows * (192 + 8)
    names = {"stage1": {"model"}, "stage2": {"memory", "empty"}}
    assert set(made.psnr) == names[stage.name]
    assert all(0 < value < 60 for value in made.psnr.values())


def test_previews_measure_what_is_shown(run, tmp_path, monkeypatch):
    monkeypatch.setattr(preview, "CLIPS", 2)
    config, true = configs.load(run / "config.json"), []
    load = preview.load_clip
    monkeypatch.setattr(
        preview, "load_clip", lambda *a, **k: (true.append(load(*a, **k)), true[-1])[1]
    )
    off = {False: 16, True: 0}  # levels of 255

    def imagined(_model, _context, _actions, _seeds, *, memory, params):
        frames = [clip[1] for clip in true]
        rgb = np.stack([np.where(f.rgb_THWC > 99, f.rgb_THWC - off[memory], 99) for f in frames])
        rgb = np.stack([f.rgb_THWC for f in frames]) if memory else rgb
        return None, None, Frames(rgb, np.stack([f.depth_THW for f in frames]), None)

    monkeypatch.setattr(ModelRunner, "run", imagined)
    made = preview.make_preview(config, tmp_path)({}, STAGES[1], 3)
    truth = np.stack([clip[1].rgb_THWC for clip in true]).astype(float)
    wrong = np.where(truth > 99, truth - 16, 99)
    errors = ((truth - wrong) ** 2).mean((2, 3, 4)) / 255**2
    assert made.psnr["memory"] == 100.0
    assert made.psnr["empty"] == pytest.approx((-10 * np.log10(errors)).mean(), abs=1e-3)


def test_data_that_cannot_be_previewed_cost_one_line_and_not_the_training(tmp_path):
    config, said = tiny(tmp_path), []
    assert preview.make_preview(config, tmp_path, said.append) is None
    assert len(said) == 1
    assert said[0].startswith("no previews")
    assert "validation does not exist" in said[0]

    # Motion that is not upright, as of a recording made by hand, is driven by its cameras.
    write_split(tmp_path / "data" / "validation", episodes=1, nod=0.3)
    assert preview.make_preview(config, tmp_path, said.append) is not None
    assert len(said) == 1


def test_places_are_called_new_only_where_they_are(run, tmp_path):
    page = (run / "report" / "index.html").read_text()
    assert "never trained on" in page
    train = write_split(tmp_path / "train", episodes=2)
    found = report.held_out(["room-1", "room-7"], train)
    assert found == {"held_out": False, "trained_scenes": ["room-1"]}
    names = {"scene_names": ["room-1", "room-7"]}
    assert "trained in 1 of 2" in introduction(found | names)
    assert "never" not in introduction(found | names)
    assert report.held_out(["room-7"], train)["held_out"] is True
    unknown = report.held_out(["room-7"], tmp_path / "gone")
    assert unknown["held_out"] is None
    assert "may have been" in introduction(unknown | names)


def test_verdicts_are_fair():
    assert "3.00 ± 0.50 dB closer" in format_verdict({"mean": 3.0, "stderr": 0.5}, "seen before")
    assert "worse" in format_verdict({"mean": -3.0, "stderr": 0.5}, "seen before")
    assert "no clear difference" in format_verdict({"mean": 0.6, "stderr": 0.5}, "never seen")
    assert "cannot be estimated" in format_verdict({"mean": 0.6, "stderr": None}, "never seen")
    assert "No clip" in format_verdict({"mean": None, "stderr": None}, "never seen")
    assert number({"mean": 1.0, "stderr": 0.25}, 2, sign=True) == "+1.00 ± 0.25"
    assert number({"mean": None, "stderr": None}, 2) == "–"


def test_whether_a_baseline_is_beaten_is_said_plainly():
    def entry(mean, stderr):
        return {"psnr": {"mean": mean, "stderr": stderr}}

    said = format_comparison(
        {"seen": entry(-2.0, 0.5), "unseen": entry(3.0, 0.5), "all": entry(0.6, 0.5)}, "reproject"
    )
    assert "seen before it is WORSE (-2.00 ± 0.50 dB)" in said
    assert "never seen it is better (+3.00 ± 0.50 dB)" in said
    assert "over all no clear difference" in said
    unsure = {"seen": entry(1.0, None), "unseen": entry(None, None), "all": entry(1.0, None)}
    assert "uncertainty unknown" in format_comparison(unsure, "none")
    assert "nothing to compare" in format_comparison(unsure, "none")
    short = {"first16": None, "last16": None, "difference": None}
    assert "fewer than 32" in format_drift(short)
    full = {name: {"mean": -1.5, "stderr": 0.1} for name in short}
    assert format_drift(full).endswith("-1.50 ± 0.10 dB.")
