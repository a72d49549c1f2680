"""Two reports side by side: paired, over houses, over training seeds; refused where they differ."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re

import numpy as np
import pytest
from PIL import Image

from pewm_jax import config as configs
from pewm_jax.cli import main as program
from pewm_jax.config import UserError
from pewm_jax.eval import compare, results
from pewm_jax.eval import protocol as protocols
from pewm_jax.eval.clips import ClipChoice
from pewm_jax.eval.long_rollouts import LongRollouts
from pewm_jax.eval.metrics.images import MASKS
from pewm_jax.eval.protocol import ClipKey, EpisodeKey, Protocol
from pewm_jax.eval.scoring import Scored
from tests import properties
from tests.eval.scene import tiny
from tests.eval.test_statistics import sums_of

CLIPS, FRAMES, LONG = 12, 4, 8


def protocol(**changes):
    """Twelve clips of six houses."""
    keys = [ClipKey(i // 2, i % 2, (i % 2,), tuple(range(2, 2 + FRAMES)), "m") for i in range(12)]
    made = Protocol(
        split="revisit",
        height=16,
        width=16,
        context=6,
        stride=1,
        horizon=FRAMES,
        long_horizon=LONG,
        seeds=(0, 1),
        control="actions",
        episodes=tuple(EpisodeKey(f"walk-{i}", f"house-{i}", str(i)) for i in range(6)),
        clips=tuple(keys),
        rollouts=tuple(keys[::2]),
    )
    return dataclasses.replace(made, **changes)


def report(folder, errors_SCT, *, chosen=None, seed=0, weights="w", pictures=2, steps=4, **changes):
    """Write the report of a run whose colour errors are the given ones."""
    chosen = chosen or protocol()
    config = tiny(folder)
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, seed=seed))
    config = config.with_model(**changes)
    choices = []
    for key in chosen.clips:
        at = chosen.episodes[key.episode]
        choice = ClipChoice(key.episode, at.name, at.scene, key.start, key.context, key.targets)
        choices.append(choice)
    sums = {"memory": sums_of(errors_SCT), "empty": sums_of(10 * errors_SCT)}
    long_sums = {"memory": sums_of(np.tile(errors_SCT[:1, ::2], (1, 1, 2)))}
    long = LongRollouts(Scored(choices[::2], long_sums), 2, pictures, {})
    facts = {
        "protocol_sha256": chosen.sha256,
        "weights_sha256": weights,
        "lpips_weights_sha256": None,
        "seeds": list(chosen.seeds),
    }
    said = {**facts, "training_seed": seed, "config": configs.to_dict(config)}
    said |= {"sampler": "ddim", "sampling_steps": steps}
    where = folder / "report"
    (where / "rows").mkdir(parents=True)
    results.save_samples(where, results.gather_samples(Scored(choices, sums), long, **facts))
    protocols.save_protocol(where / "protocol.json", chosen, {})
    (where / "metrics.json").write_text(json.dumps({"schema": 1, "protocol": said}))
    for index in range(pictures):
        for name in ("truth", "memory"):
            shade = np.full((16, 8 * 16, 3), 40 * index, np.uint8)
            Image.fromarray(shade).save(where / "rows" / f"{index:02d}-{name}.png")
    return folder


@pytest.fixture
def errors():
    """Errors of clips that differ wildly, (seeds, clips, frames)."""
    return 10.0 ** np.random.default_rng(0).uniform(-3, -1, (2, CLIPS, FRAMES))


def content(page):
    return json.loads(page.with_name("comparison.json").read_text())


def test_the_difference_is_paired_and_the_page_needs_no_other_file(tmp_path, errors):
    a = report(tmp_path / "a", errors / 10**0.1)
    b = report(tmp_path / "b", errors, weights="v", pictures=1)
    said = []
    page = compare.compare(a, b, log=said.append)
    assert page == a / "compare-b" / "index.html"
    found = content(page)
    gain = found["differences"]["clips"]["seen"]["psnr"]
    assert [gain[name] for name in ("mean", "low", "high")] == pytest.approx([1, 1, 1])
    assert gain["houses"] == 6
    score = found["a"]["clips"]["seen"]["psnr"]
    assert score["high"] - score["low"] > 0.5
    assert found["differences"]["frames"]["unseen"]["psnr"]["mean"] == pytest.approx([1] * FRAMES)
    assert found["differences"]["rollouts"]["all"]["psnr"]["low"] == pytest.approx([1] * LONG)
    assert [entry["seen"] for entry in found["by_house"]] == pytest.approx([1] * 6)
    assert found["protocol_sha256"] == protocol().sha256
    assert "closer to the truth" in said[0]
    assert "+1.00 [+1.00, +1.00] dB over 6 houses" in said[0]
    text = page.read_text()
    assert found["protocol_sha256"] in text
    assert len(re.findall("<figure><img", text)) == 1  # the rollout that both show
    assert text.count("data:image/png") == 1 + 2 * 8  # and charts, in light and dark
    assert not re.search(r"https?://|url\(|@import|<script|<link", text)
    back = content(compare.compare(b, a, out=tmp_path / "out", log=said.append))
    assert back["differences"]["clips"]["all"]["psnr"]["mean"] == pytest.approx(-1)
    same = content(compare.compare(a, a, out=tmp_path / "same", log=said.append))
    assert same["differences"]["clips"]["all"]["ssim"]["high"] == 0
    assert "no clear difference" in said[-2]
    assert said[-1] == "a and b are the same weights."


def test_training_seeds_are_apart_from_houses(tmp_path, errors):
    # Better by 1 dB in every clip, and each training is off by something of its own.
    off = {"a": (0.0, 0.3, -0.3), "b": (0.1, -0.1, 0.0)}
    for side, gain in (("a", 1.0), ("b", 0.0)):
        for seed, shift in enumerate(off[side]):
            report(
                tmp_path / f"{side}{seed}",
                errors / 10 ** ((gain + shift) / 10),
                seed=seed,
                weights=f"{side}{seed}",
            )
    names = {side: [tmp_path / f"{side}{seed}" for seed in range(3)] for side in "ab"}
    found = content(
        compare.compare(
            names["a"][0],
            names["b"][0],
            also_one=names["a"][1:],
            also_two=names["b"][1:],
            log=lambda _: None,
        )
    )
    houses = found["differences"]["clips"]["seen"]["psnr"]
    assert [houses[name] for name in ("mean", "low", "high")] == pytest.approx([1, 1, 1])
    seeds = found["training_seeds"]["differences"]["seen"]["psnr"]
    assert seeds["mean"] == pytest.approx(1)
    spread = np.sqrt((0.3**2 + 0.1**2) / 3)
    assert seeds["high"] - 1 == pytest.approx(4.303 * spread, rel=1e-3)  # 2 degrees of freedom
    each = found["training_seeds"]["a"]["seen"]["psnr"]["per_seed"]
    assert np.subtract(each, each[0]) == pytest.approx([0, 0.3, -0.3])
    assert [run["training_seed"] for run in found["a"]["runs"]] == [0, 1, 2]


def test_different_protocols_are_refused(tmp_path, errors):
    a = report(tmp_path / "a", errors)
    b = report(tmp_path / "b", errors, chosen=protocol(context=5))
    with pytest.raises(UserError, match=r"different protocols .*context 6 and 5.*--protocol"):
        compare.compare(a, b)
    with pytest.raises(UserError, match=rf"evaluate {b.name} --data \S+ --protocol \S+a/report/"):
        compare.compare(a, b / "report")  # the folder of a report is no run
    assert not (a / "compare-b").exists()
    assert program.main(["compare", str(a), str(b)]) == 2


def test_what_is_no_pair_of_reports_is_refused(tmp_path, errors, capsys):
    a = report(tmp_path / "a", errors)
    with pytest.raises(UserError, match=r"has no report in .*pewm-jax evaluate"):
        compare.compare(a, tmp_path / "gone")
    other = report(tmp_path / "other", errors, seed=1, clip=configs.ClipConfig(frames=9))
    with pytest.raises(UserError, match=r"not two seeds of one training: .*clip\.frames"):
        compare.compare(a, a, also_one=[other])
    with pytest.raises(UserError, match="trained with the same seed"):
        compare.compare(a, a, also_one=[report(tmp_path / "twin", errors)])
    b = report(tmp_path / "b", errors)
    where = b / "report"
    metrics = json.loads((where / "metrics.json").read_text())
    (where / "metrics.json").write_text(json.dumps({**metrics, "schema": None}))
    with pytest.raises(UserError, match="of another version of the library"):
        compare.compare(a, b)
    metrics["protocol"]["weights_sha256"] = "another"
    (where / "metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(UserError, match="not of one evaluation"):
        compare.compare(a, b)
    whole = (where / "samples.npz").read_bytes()
    for place in properties.cases(
        range(0, len(whole), 7), 8
    ):  # some flips damage the zip, some its streams, some none
        flipped = bytearray(whole)
        flipped[place] ^= 0xFF
        (where / "samples.npz").write_bytes(flipped)
        with contextlib.suppress(UserError):
            results.load_samples(where)
    (where / "samples.npz").write_bytes(whole[:200])
    with pytest.raises(UserError, match=r"samples\.npz is damaged"):
        compare.compare(a, b)
    (where / "samples.npz").unlink()
    with pytest.raises(UserError, match="the scores clip by clip"):
        compare.compare(a, b)
    assert program.main(["compare", str(a)]) == 2
    assert "RUN_B is missing" in capsys.readouterr().err


@pytest.mark.slow
def test_lpips_of_different_networks_is_left_out(tmp_path, errors):
    for name, net in (("a", "alex"), ("b", "vgg")):
        folder = report(tmp_path / name, errors)
        read = results.load_samples(folder / "report")
        lpips = {
            f"{part}/memory/all/lpips": read.arrays[f"{part}/memory/all/psnr"] / 100
            for part in results.PARTS
        }
        results.save_samples(
            folder / "report", results.Samples(read.about, {**read.arrays, **lpips})
        )
        path = folder / "report" / "metrics.json"
        metrics = json.loads(path.read_text())
        metrics["protocol"]["lpips_weights_sha256"] = net
        path.write_text(json.dumps(metrics))
    apart = compare.compare(tmp_path / "a", tmp_path / "b", log=lambda _: None)
    assert content(apart)["left_out"] == ["lpips"]
    assert "lpips" not in content(apart)["differences"]["clips"]["all"]
    assert "different networks" in apart.read_text()
    same = compare.compare(tmp_path / "a", tmp_path / "a", log=lambda _: None)
    assert content(same)["differences"]["clips"]["all"]["lpips"]["mean"] == 0
    report(tmp_path / "c", errors)
    one = compare.compare(tmp_path / "a", tmp_path / "c", log=lambda _: None)
    assert content(one)["measured_by_one"] == ["lpips"]
    assert "only one of the two was measured with it" in one.read_text()


def video_scores(value, masks=("seen", "unseen")):
    """FVD and KVD of a report; an earlier version has no masks."""
    table = {"memory": {kind: {"value": value} for kind in ("fvd", "kvd")}}
    found = {"names": {"fvd": "FVD-9f@12", "kvd": "KVD-9f@12"}, "results": table}
    return found | ({"masks": dict.fromkeys(masks, table)} if masks else {})


@pytest.mark.slow
def test_masked_lpips_is_paired_and_reports_without_it_can_be_compared(tmp_path, errors):
    for name, masks, gain in (("a", MASKS, 0.1), ("b", MASKS, 0), ("c", (), 0)):
        folder = report(tmp_path / name, errors)
        read = results.load_samples(folder / "report")
        lpips = {
            f"{part}/memory/{mask}/lpips": read.arrays[f"{part}/memory/{mask}/psnr"] / 100 + gain
            for part in results.PARTS
            for mask in {*masks, "all"}
        }
        samples = results.Samples(read.about, {**read.arrays, **lpips})
        results.save_samples(folder / "report", samples)
        path = folder / "report" / "metrics.json"
        metrics = json.loads(path.read_text())
        metrics["videos"] = video_scores(10 + gain, masks[:2])
        path.write_text(json.dumps(metrics))
    page = compare.compare(tmp_path / "a", tmp_path / "b", log=lambda _: None)
    found = content(page)
    for mask in ("seen", "unseen", "all"):
        assert found["differences"]["clips"][mask]["lpips"]["mean"] == pytest.approx(0.1)
        assert found["videos"]["a"][mask] == {"fvd": 10.1, "kvd": 10.1}
    assert found["masked_by_one"] == []
    assert "KVD-9f@12" in page.read_text()
    page = compare.compare(tmp_path / "a", tmp_path / "c", log=lambda _: None)
    found = content(page)
    assert found["masked_by_one"] == ["lpips"]
    assert found["measured_by_one"] == []
    assert "lpips" not in found["differences"]["clips"]["seen"]
    assert found["differences"]["clips"]["all"]["lpips"]["mean"] == pytest.approx(0.1)
    assert set(found["videos"]["a"]) == {"all"}
    assert "only one of the two reports has it" in page.read_text()


@pytest.mark.slow
def test_sides_that_sample_differently_are_told_apart(tmp_path, errors):
    said = []
    for name, steps in (("a", 4), ("b", 2), ("c", 4)):
        report(tmp_path / name, errors, steps=steps)
    page = compare.compare(tmp_path / "a", tmp_path / "b", log=said.append)
    words = "a imagines in 4 sampling steps (ddim), b imagines in 2 sampling steps (ddim)."
    assert said[-1] == words
    assert words in page.read_text()
    said.clear()
    compare.compare(tmp_path / "a", tmp_path / "c", log=said.append)
    assert not any("sampling steps" in line for line in said)


def test_samples_give_back_what_was_kept(tmp_path, errors):
    errors[0, 3] = 0.5
    folder = report(tmp_path / "a", errors) / "report"
    found = results.load_samples(folder)
    assert found.table("clips", "memory")["seen"]["psnr"].shape == (2, CLIPS)
    assert found.table("frames", "empty")["all"]["depth_mae"].shape == (2, CLIPS, FRAMES)
    np.testing.assert_allclose(found.table("frames", "memory")["seen"]["psnr"][0, 3], 3.0103, 1e-4)
    assert found.table("clips", "none") == {}
    assert found.houses("clips")[:3] == ["house-0", "house-0", "house-1"]
    assert len(found.houses("rollouts")) == 6
