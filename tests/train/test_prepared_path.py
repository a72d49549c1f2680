"""Prepared clips on disk: found again, gone on with, and refused where they are not ours."""

import dataclasses
import itertools
import shutil
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.config import UserError
from pewm_jax.train import feed
from pewm_jax.worlds.pewm import world as pewm
from tests.train import fakes
from tests.train.test_loop import file_bytes, losses, train

CLIPS = 20
"""Three batches of 8."""
PARAMS = {"codec": {"kernel": jnp.ones(2)}, "backbone": {"kernel": jnp.ones(3)}}


def prepare(model, params, clip):
    """Stand for the codec: a few numbers of every frame; the context is not kept."""
    latents = clip.frames.rgb_THWC[:, :, :2, :2].astype(jnp.float32) / 255
    if "codec" in params:
        latents = latents * params["codec"]["kernel"].sum()
    emptied = dataclasses.replace(
        clip,
        context=jax.tree.map(lambda x: x[:, :0], clip.context),
        context_valid_S=clip.context_valid_S[:, :0],
    )
    return emptied.with_extras(latents_thwC=latents)


STAGE = dataclasses.replace(fakes.STAGES[0], prepare=prepare)


@pytest.fixture(autouse=True)
def split(monkeypatch):
    """A split of one shard, whose checksum a test may change."""
    shard = types.SimpleNamespace(sha256="0" * 64)
    monkeypatch.setattr(feed, "read_manifest", lambda _: types.SimpleNamespace(shards=(shard,)))
    return shard


def experiment(folder, **data):
    config = fakes.config()
    data = {"prepared": CLIPS, "prepared_path": str(folder)} | data
    return dataclasses.replace(config, data=dataclasses.replace(config.data, **data))


class Reader:
    """Reads batches, and notes from which on and how many."""

    def __init__(self, config):
        self.config, self.taken = config, []

    def __call__(self, first):
        seed = feed.prepared_seed(self.config, STAGE)
        for number, clip in enumerate(
            fakes.clips(self.config, seed=seed, batch=8, start_step=first), first
        ):
            self.taken.append(number)
            yield clip


def gather(config, params=PARAMS, most=None, stage=STAGE):
    """Return the prepared batches, and which were read; training stops after ``most`` of them."""
    reader, done = Reader(config), itertools.count(1)

    def unless_stopped(call):
        return None if most is not None and next(done) > most else call()

    clips = feed.Prepared(config, stage, params, reader)
    return clips.batches if clips.fill(unless_stopped) else None, reader.taken


def same(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(*map(jax.tree.leaves, (one, two)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def files(folder):
    return {file: file.stat().st_mtime_ns for file in sorted(folder.rglob("*.safetensors"))}


def test_a_second_run_reads_the_same_files_and_draws_the_same_batches(tmp_path):
    alone, taken = gather(experiment(""))
    assert taken == [0, 1, 2]
    first, taken = gather(experiment(tmp_path))
    assert taken == [0, 0, 1, 2]  # the shapes of one, then all
    written = files(tmp_path)
    assert len(written) == 3
    again, taken = gather(experiment(tmp_path))
    assert taken == [0]
    assert files(tmp_path) == written
    same(first, alone)
    same(again, alone)
    one, two = (list(itertools.islice(feed.draw_prepared(x, 8, 5), 4)) for x in (alone, again))
    same(one, two)


def test_a_folder_half_made_is_continued(tmp_path):
    config = experiment(tmp_path)
    assert gather(config, most=2)[0] is None
    written = files(tmp_path)
    assert len(written) == 2
    clips, taken = gather(config)
    assert taken == [0, 2]
    assert written.items() <= files(tmp_path).items()
    same(clips, gather(experiment(""))[0])
    more = experiment(tmp_path, prepared=4 * 8)  # other runs may want more of the same
    assert gather(more)[1] == [0, 3]


def test_old_clips_give_way_to_new_ones_also_after_an_interruption(tmp_path):
    def draw(config, done, count):
        reader = Reader(config)
        clips = feed.Prepared(config, STAGE, PARAMS, reader, done)
        assert clips.fill(lambda call: call())
        drawn = list(itertools.islice(clips.draw(8, STAGE.data_seed(config)), count))
        return drawn, reader.taken

    kept = experiment(tmp_path)
    for folder in ("", tmp_path):
        config = fakes.with_train(experiment(folder, refresh=2), save_every=1)
        whole, _ = draw(config, 0, 7)
        again, taken = draw(config, 3, 4)
        same(again, whole[3:])
        # Batches were drawn 4 steps ahead of the checkpoint at step 3, and all are there.
        assert taken == ([0] if folder else [1, 2, 3, 4, 5])
    names = [file.stem for file in files(tmp_path)]
    assert names == ["00001", "00002", "00003", "00004", "00005"]
    next(tmp_path.rglob("00002.safetensors")).unlink()  # one that is gone is made, no other
    again, taken = draw(config, 3, 4)
    same(again, whole[3:])
    assert taken == [0, 2]
    source = fakes.clips(kept, seed=feed.prepared_seed(kept, STAGE), batch=8)
    loaded = list(itertools.islice(source, 6))
    for step, drawn in enumerate(whole):
        rows = feed.prepared_rows(config, STAGE, step)
        assert min(rows) >= step // 2 * 8
        assert max(rows) < (step // 2 + 3) * 8
        depth = [loaded[row // 8].frames.depth_THW[row % 8] for row in rows]
        np.testing.assert_array_equal(drawn.frames.depth_THW, np.stack(depth))


def test_what_is_not_whole_or_not_ours_is_refused_with_its_name(tmp_path):
    config = experiment(tmp_path)
    gather(config)
    file = list(files(tmp_path))[1]
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:20], b"", b"something else entirely"):
        file.write_bytes(damaged)
        with pytest.raises(UserError, match=rf"{file.name} is damaged or truncated"):
            gather(config)
    other = experiment(tmp_path / "other")
    size = dataclasses.replace(other.model.clip, height=32)
    gather(other.with_model(clip=size))
    file.write_bytes(next(iter(files(tmp_path / "other"))).read_bytes())
    with pytest.raises(
        UserError, match=rf"{file.name} does not contain the prepared clips .* delete"
    ):
        gather(config)
    file.write_bytes(whole)
    assert gather(config)[1] == [0]


def test_the_folder_is_named_by_all_that_the_clips_depend_on(tmp_path, split):
    config = fakes.with_stage(experiment(tmp_path), "joint", batch=8)

    def folder(config=config, params=PARAMS, stage=STAGE):
        return feed._folder(config, stage, feed._digest(stage, params))

    def with_data(**changes):
        return dataclasses.replace(config, data=dataclasses.replace(config.data, **changes))

    kernel = {"kernel": jnp.zeros(3)}
    same = [
        folder(),
        folder(with_data(path="elsewhere", prepared=99, workers=3, bad_records=2)),
        folder(fakes.with_train(config, optimizer="muon", run="runs/other")),
        folder(fakes.with_stage(config, "stage1", steps=99, learning_rate=0.5)),
        folder(params={**PARAMS, "backbone": kernel}),
    ]
    assert len(set(same)) == 1
    memory = dataclasses.replace(fakes.STAGES[1], prepare=prepare)
    joint = dataclasses.replace(fakes.STAGES[2], prepare=prepare)
    assert folder(stage=memory) == folder(stage=joint)
    other = [
        folder(with_data(stride_max=2)),
        folder(with_data(context=2)),
        folder(fakes.with_train(config, seed=1)),
        folder(fakes.with_stage(config, "stage1", batch=4)),
        folder(config.with_model(clip=dataclasses.replace(config.model.clip, height=32))),
        folder(params={**PARAMS, "codec": {"kernel": jnp.zeros(2)}}),
        folder(stage=memory),
        folder(stage=dataclasses.replace(STAGE, prepares_by=("backbone", "codec"))),
    ]
    split.sha256 = "1" * 64
    other.append(folder())
    assert len({same[0], *other}) == 1 + len(other)


def test_how_actions_enter_the_network_does_not_change_prepared_clips(tmp_path):
    """So that ways of conditioning share them, and clips of earlier versions are found."""
    base = presets.load("egowm_humanoid")
    base = dataclasses.replace(base, data=dataclasses.replace(base.data, prepared_path="clips"))
    adapt = base.model.stages()[1]

    def folder(config=base, **control):
        return feed._folder(
            config.with_model(control=dataclasses.replace(config.model.control, **control)),
            adapt,
            "weights",
        )

    assert len({folder(), folder(inject="attention"), folder(inject="channels")}) == 1
    undrawn = folder(drawn=False)
    assert folder(drawn=False, body="") == undrawn
    plain = base.with_model(control=presets.load("egowm").model.control)
    others = [
        folder(state=0, drawn=False),
        folder(base.with_model(observed="first")),
        folder(plain),
    ]
    assert len({folder(), undrawn, *others}) == 2 + len(others)


def test_a_training_learns_the_same_with_clips_in_memory_and_on_disk(
    fake_model, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        pewm, "STAGES", tuple(dataclasses.replace(s, prepare=prepare) for s in pewm.STAGES)
    )

    def config(run, **data):
        made = fakes.with_train(fakes.config(stage1=4, stage2=2), run=str(tmp_path / run))
        return dataclasses.replace(made, data=dataclasses.replace(made.data, prepared=16, **data))

    train(config("memory"))
    disk = str(tmp_path / "clips")
    train(config("first", prepared_path=disk))
    written = files(tmp_path / "clips")
    train(config("second", prepared_path=disk))
    assert files(tmp_path / "clips") == written
    assert len(written) == 4
    for run in ("first", "second"):
        assert losses(tmp_path / run) == losses(tmp_path / "memory")
        assert file_bytes(tmp_path / run) == file_bytes(tmp_path / "memory")
    elsewhere = str(tmp_path / "elsewhere")  # where they lie alters nothing of what was learnt
    assert "already trained" in train(config("first", prepared_path=elsewhere))[0]


def test_a_resumed_stage_finds_its_clips_although_it_trains_what_prepares_them(
    fake_model, tmp_path, monkeypatch, capsys
):
    """As stage ``gate`` does: it prepares by the codec and trains a part of it."""
    both = tuple(
        dataclasses.replace(s, prepare=prepare, prepares_by=("backbone", "codec"))
        for s in pewm.STAGES
    )
    monkeypatch.setattr(pewm, "STAGES", both)

    def config(run, **train_settings):
        made = fakes.config(stage1=6, stage2=0)
        made = fakes.with_train(made, run=str(tmp_path / run), save_every=2, **train_settings)
        data = {"prepared": 16, "prepared_path": str(tmp_path / "clips")}
        return dataclasses.replace(made, data=dataclasses.replace(made.data, **data))

    train(config("undisturbed"))
    (folder,) = (tmp_path / "clips").iterdir()
    written = files(folder)
    shutil.copytree(tmp_path / "undisturbed", tmp_path / "resumed")
    (tmp_path / "resumed" / "weights.safetensors").unlink()
    for step in (tmp_path / "resumed" / "checkpoints" / "stage1").glob("[0-9]*"):
        if int(step.name) > 4:
            shutil.rmtree(step)
    train(config("resumed"))
    assert "resuming after step 4" in capsys.readouterr().out
    assert list((tmp_path / "clips").iterdir()) == [folder]
    assert files(folder) == written
    assert losses(tmp_path / "resumed") == losses(tmp_path / "undisturbed")
    train(config("other", seed=5))  # other weights and clips: another folder
    assert len(list((tmp_path / "clips").iterdir())) == 2
