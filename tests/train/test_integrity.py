"""Damaged checkpoints: found whatever is damaged, named, set aside, and done without."""

import json
import random
import shutil
from pathlib import Path

import pytest

from pewm_jax.config import UserError
from pewm_jax.train import checkpoint_files, loop
from pewm_jax.train.checkpoint import Checkpoints
from tests.train import fakes


class PowerCutError(RuntimeError):
    pass


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    content = bytearray(path.read_bytes())
    content[random.randrange(len(content))] ^= 1 << random.randrange(8)
    path.write_bytes(content)


def grow(path):
    path.write_bytes(path.read_bytes() + b"0")


DAMAGES = {"cut": cut, "flipped": flip, "grown": grow, "deleted": Path.unlink}


def files(folder):
    return [path for path in sorted(folder.rglob("*")) if path.is_file()]


def config(run, **changes):
    return fakes.config(run, save_every=2, keep=2, **changes)


def train(run, **changes):
    said = []
    loop.train(config(run, **changes), log=said.append)
    return said


def results(run):
    entries = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    losses = [(e["stage"], e["step"], e["loss"], e["grad_norm"]) for e in entries]
    return losses, (run / "weights.safetensors").read_bytes()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run without disturbance, and one that broke off after checkpoints 2 and 4 of stage 1."""
    folder = tmp_path_factory.mktemp("trained")
    save = Checkpoints.save

    def save_and_die(self, state):
        save(self, state)
        if int(state.step) == 4:
            raise PowerCutError

    with pytest.MonkeyPatch.context() as patch:
        fakes.install(patch)
        train(folder / "undisturbed")
        patch.setattr(Checkpoints, "save", save_and_die)
        with pytest.raises(PowerCutError):
            train(folder / "broken")
    return folder


@pytest.fixture
def run(fake_model, trained, tmp_path):
    """A copy of the run that broke off."""
    return Path(shutil.copytree(trained / "broken", tmp_path / "run"))


def newest(run):
    return run / "checkpoints" / "stage1" / "4"


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_damage_is_found_and_named_in_whatever_file_it_is(run, damage):
    random.seed(0)
    kinds = {path.relative_to(newest(run)).parts[0] for path in files(newest(run))}
    assert {"weights", "state", "data", "config", "manifest.json"} <= kinds
    for path in files(newest(run)):
        whole = path.read_bytes()
        name = path.relative_to(newest(run)).as_posix()
        for _ in range(5 if damage is flip else 1):
            if not whole and damage in (cut, flip):
                continue
            damage(path)
            (flaw,) = checkpoint_files.flaws(newest(run))
            assert flaw.startswith(f"{name} "), (name, flaw)
            path.write_bytes(whole)
        assert checkpoint_files.flaws(newest(run)) == []


def test_what_was_added_and_what_is_gone_together_are_listed(run):
    shutil.rmtree(newest(run) / "state")
    (newest(run) / "weights" / "more").write_text("")
    found = checkpoint_files.flaws(newest(run))
    assert "state/_METADATA is missing" in found
    assert "weights/more is not listed in the manifest" in found
    assert checkpoint_files.flaws(newest(run), ["config", "data"]) == []


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("manifest.json", "deleted"),
        ("manifest.json", "cut"),
        ("state/_METADATA", "cut"),
        ("state/d/*", "flipped"),
        ("weights/ocdbt.process_0/d/*", "flipped"),
        ("weights/manifest.ocdbt", "deleted"),
        ("config/metadata", "grown"),
        ("data/*", "deleted"),
    ],
)
def test_training_goes_on_from_the_checkpoint_before_and_ends_the_same(run, trained, name, damage):
    path = max(newest(run).glob(name), key=lambda path: path.stat().st_size)
    DAMAGES[damage](path)
    inside = path.relative_to(newest(run)).as_posix()
    said = train(run)
    (line,) = [text for text in said if "damaged" in text]
    assert f"stage1/4 is damaged ({inside} " in line or f"({inside} is" in line
    assert "the previous one is used" in line
    assert (newest(run).parent / "damaged" / "4").is_dir()
    assert results(run) == results(trained / "undisturbed")


def test_half_of_a_checkpoint_gone_is_as_good_as_all_of_it(run, trained):
    for path in files(newest(run))[::2]:
        path.unlink()
    assert sum("damaged" in text for text in train(run)) == 1
    assert results(run) == results(trained / "undisturbed")


def test_with_no_whole_checkpoint_left_a_sentence_asks_what_to_do(run, trained):
    for step in ("2", "4"):
        flip(newest(run).parent / step / "state" / "_METADATA")
    for _ in range(2):
        with pytest.raises(
            UserError, match=r"no intact checkpoint, only damaged ones in .*damaged"
        ):
            train(run)
    damaged = newest(run).parent / "damaged"
    assert {path.name for path in damaged.iterdir()} == {"2", "4"}
    shutil.rmtree(damaged)
    train(run)
    assert results(run) == results(trained / "undisturbed")


def test_checkpoints_damaged_again_and_again_are_all_kept_aside(run):
    for expected in ({"4"}, {"4", "4-1"}):
        cut(newest(run) / "manifest.json")
        with Checkpoints(run, config(run), fakes.STAGES[0], lambda _: None) as checkpoints:
            assert checkpoints.latest() == 2
        assert {path.name for path in (newest(run).parent / "damaged").iterdir()} == expected
        shutil.copytree(newest(run).parent / "damaged" / "4", newest(run))


def test_damage_to_a_stage_that_a_later_one_has_built_on_does_no_harm(run, trained):
    shutil.rmtree(run)
    shutil.copytree(trained / "undisturbed", run)
    (run / "weights.safetensors").unlink()
    for step in (4, 6):
        cut(run / "checkpoints" / "stage1" / str(step) / "manifest.json")
    cut(run / "checkpoints" / "stage2" / "6" / "manifest.json")
    said = train(run)
    assert sum("damaged" in text for text in said) == 1
    assert results(run) == results(trained / "undisturbed")


def test_checking_many_bytes_is_announced_and_its_progress_told(run, monkeypatch):
    monkeypatch.setattr(checkpoint_files, "LARGE", 1000)
    monkeypatch.setattr(checkpoint_files, "_EVERY_S", 0.0)
    said = []
    assert checkpoint_files.flaws(newest(run), log=said.append) == []
    assert said[0].startswith(f"checking {newest(run)}: 0.0 GB")
    assert all("s left" in text for text in said[1:])
    assert len(said) == len(files(newest(run)))
