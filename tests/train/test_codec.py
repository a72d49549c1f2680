"""The learned codec is trained by the trainer of world models, scored, and started from."""

import dataclasses
import functools
import json

import jax
import numpy as np
import optax
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets, worlds
from pewm_jax.cli import main as program
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import (
    ClipConfig,
    Config,
    ConfigError,
    DataConfig,
    Launch,
    StageConfig,
    UserError,
)
from pewm_jax.data import abstract, loader
from pewm_jax.data.dataset import Manifest, describe_shard, write_manifest, write_shard
from pewm_jax.data.episodes import EpisodeArrays, write_episode
from pewm_jax.eval import codec_score
from pewm_jax.eval import evaluate as report
from pewm_jax.io import tree, weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.plan import plan
from pewm_jax.train import loading, loop, runs, step
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig
from pewm_jax.worlds.stages import FREEZE, TRAIN
from tests.helpers import random_camera

TINY = LearnedCodecConfig(latent_channels=4, fine=8, coarse=12, fine_blocks=1, coarse_blocks=1)
init = jax.jit(worlds.init, static_argnums=0)


def experiment(run="runs/it", steps=2, **train):
    stage = StageConfig(steps=steps, batch=4, warmup=0, learning_rate=3e-3, decay="constant")
    settings = {"save_every": 1, "log_every": 1, "ema": 0.0, "codec": stage} | train
    settings.setdefault("statistics", dataclasses.replace(stage, learning_rate=0.03))
    return Config(
        model=CodecTask(clip=ClipConfig(frames=2, height=16, width=24), codec=TINY),
        data=DataConfig(context=1),
        train=CodecTrainConfig(run=str(run), **settings),
    )


def smooth(rng, *shape):
    """Pictures of broad random waves, in [−1, 1]."""
    v, u = np.mgrid[:16, :24] / 16
    rate, phase = rng.uniform(-4, 4, (2, *shape, 1, 1)), rng.uniform(0, 6, (*shape, 1, 1))
    return np.sin(rate[0] * v + rate[1] * u + phase)


def batch(config, rows=4, seed=0):
    rng = np.random.default_rng(seed)
    like = abstract.clip(config, rows)
    clip = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), like)
    rgb = 127.5 * (np.moveaxis(smooth(rng, rows, 2, 3), 2, -1) + 1)
    depth = (2 + smooth(rng, rows, 2)).astype(np.float32)
    frames = dataclasses.replace(clip.frames, rgb_THWC=rgb.astype(np.uint8), depth_THW=depth)
    return dataclasses.replace(clip, frames=frames)


@pytest.fixture
def clips(monkeypatch):
    def endless(config, split="train", *, seed, batch: int, start_step=0, **_options):
        for number in range(start_step, 1000):
            yield make(config, batch, 1000 * seed + number)

    make = batch
    monkeypatch.setattr(loader, "clips", endless)


def descend(config, params, stage, count, rate, clips_of):
    rule = optax.masked(
        optax.adam(rate),
        lambda p: tree.assign(
            [(pattern, label == TRAIN) for pattern, label in stage.rules], p, "mask"
        ),
    )

    @jax.jit
    def step(params, state, clip, key):
        loss = jax.value_and_grad(
            lambda p: stage.loss(config.model, config.train, p, clip, key), has_aux=True
        )
        measured, slope = loss(params)
        kept = tree.assign([(p, float(k == TRAIN)) for p, k in stage.rules], slope, "mask")
        slope = jax.tree.map(lambda x, k: x * k, slope, kept)
        move, state = rule.update(slope, state, params)
        return optax.apply_updates(params, move), state, measured

    state, found = jax.jit(rule.init)(params), []
    for number in range(count):
        params, state, measured = step(params, state, clips_of(number), jax.random.key(number))
        value, parts = measured
        found.append((float(value), {name: float(x) for name, x in parts.items()}))
    return params, found


@pytest.mark.slow
def test_descent_lowers_the_loss_and_then_the_latents_are_distributed_normally():
    config = experiment()
    first, second, _ = worlds.stages(config)
    params = init(config, jax.random.key(0))
    params, found = descend(config, params, first, 20, 5e-3, lambda n: batch(config, seed=n % 2))
    assert found[-1][0] < 0.8 * found[0][0]
    assert found[-1][1]["psnr_rgb"] > found[0][1]["psnr_rgb"]
    before = tree.flatten(params)
    params, found = descend(config, params, second, 150, 0.02, lambda _: batch(config, seed=0))
    assert found[-1][1]["latent_variance"] == pytest.approx(1, abs=0.05)
    assert found[-1][1]["latent_mean"] < 0.1
    after = tree.flatten(params)
    moved = {path for path in before if not np.array_equal(before[path], after[path])}
    assert moved == {"codec/latent_mean_C", "codec/latent_scale_C"}


@pytest.mark.slow
def test_depth_that_was_not_measured_does_not_count():
    config = experiment()
    params = init(config, jax.random.key(0))
    clip = batch(config)
    holes = clip.frames.depth_THW.copy()
    holes[..., :8, :] = 0
    loss = worlds.stages(config)[0].loss
    train = dataclasses.replace(config.train, latent_noise=0.0)
    made = []
    for out in ("encoder", "decoder"):  # what is made does not depend on what is seen then
        for last in ("out", "direct"):
            params["codec"][out][last]["kernel"] *= 0
    for depth in (clip.frames.depth_THW, holes):
        seen = dataclasses.replace(clip.frames, depth_THW=depth)
        made.append(
            loss(
                config.model,
                train,
                params,
                dataclasses.replace(clip, frames=seen),
                jax.random.key(0),
            )[1]
        )
    truth, counts = config.model.pictures(clip)
    lower = np.abs(truth[1])[:, 8:].mean()
    pixels = float(lower) + train.squared_weight * float((np.asarray(truth[1])[:, 8:] ** 2).mean())
    slopes = sum(float(np.abs(np.diff(np.asarray(truth[1])[:, 8:], axis=a)).mean()) for a in (1, 2))
    assert made[1]["loss_depth"] == pytest.approx(pixels + slopes, rel=1e-4)
    assert made[0]["loss_rgb"] == made[1]["loss_rgb"]
    assert counts.min() == 1


def perceptual(tmp_path, **train):
    """An experiment whose loss has LPIPS, with random weights, and frames that AlexNet takes."""
    file = tmp_path / "alex.safetensors"
    weights.save(file, jax.jit(lpips.init, static_argnums=0)("alex", jax.random.key(0)))
    settings = {"lpips_weight": 0.5, "lpips_file": str(file)} | train
    config = experiment(tmp_path / "run", **settings)
    return config.with_model(clip=ClipConfig(frames=2, height=32, width=32))


def of_32(batch):
    """The same clips at 32 × 32 pixels."""

    def grown(x):
        return x if x.ndim < 4 else np.resize(x, (*x.shape[:2], 32, 32, *x.shape[4:]))

    return lambda config, rows=4, seed=0: dataclasses.replace(
        made := batch(config, rows, seed),
        frames=dataclasses.replace(
            made.frames,
            rgb_THWC=grown(made.frames.rgb_THWC),
            depth_THW=grown(made.frames.depth_THW),
        ),
    )


@pytest.mark.slow
def test_lpips_counts_as_much_as_it_weighs(tmp_path):
    config = perceptual(tmp_path)
    stage, make = worlds.stages(config)[0], of_32(batch)
    params, given = init(config, jax.random.key(0)), stage.extra_weights(config.model, config.train)
    clip, key = make(config), jax.random.key(1)
    loss = jax.jit(stage.loss, static_argnums=(0, 1))
    whole, measured = loss(config.model, config.train, params | given, clip, key)
    plain = dataclasses.replace(config.train, lpips_weight=0.0)
    without, few = loss(config.model, plain, params, clip, key)
    assert stage.extra_weights(config.model, plain) is None
    assert "lpips" not in few
    assert measured["lpips"] > 0
    assert whole == pytest.approx(float(without + 0.5 * measured["lpips"]), rel=1e-5)


@pytest.mark.slow
def test_lpips_can_be_descended(tmp_path):
    config = perceptual(tmp_path)
    stage, make = worlds.stages(config)[0], of_32(batch)
    params, given = init(config, jax.random.key(0)), stage.extra_weights(config.model, config.train)
    clip = make(config)
    only = dataclasses.replace(
        config.train, lpips_weight=1.0, gradient_weight=0.0, squared_weight=0.0
    )
    fitting = dataclasses.replace(config, train=only)
    _, found = descend(fitting, params | given, with_given(stage), 15, 5e-3, lambda _: clip)
    assert found[-1][1]["lpips"] < 0.9 * found[0][1]["lpips"]


def with_given(stage):
    """The stage with rules that freeze what is given, which the trainer keeps apart."""
    return dataclasses.replace(stage, rules=((r"lpips/.*", FREEZE), *stage.rules))


@pytest.mark.slow
def test_the_trainer_reads_lpips_and_saves_none_of_it(clips, monkeypatch, tmp_path):
    make = of_32(batch)

    def endless(config, split="train", *, seed, batch: int, start_step=0, **_options):
        for number in range(start_step, 1000):
            yield make(config, batch, 1000 * seed + number)

    monkeypatch.setattr(loader, "clips", endless)
    config = perceptual(tmp_path)
    run = loop.train(config, log=lambda _line: None)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [("lpips" in line) for line in lines] == [True, True, False, False]
    assert set(pewm_jax.load(run)[1]) == {"codec"}
    assert set(pewm_jax.load(run / "checkpoints" / "codec" / "1")[1]) == {"codec"}


def test_lpips_without_weights_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    with pytest.raises(UserError, match="LPIPS with AlexNet needs weights, and none are installed"):
        loop.train(experiment(tmp_path / "run", lpips_weight=1.0))
    gone = {"lpips_weight": 1.0, "lpips_file": "gone"}
    with pytest.raises(UserError, match="gone does not exist"):
        loop.train(experiment(tmp_path / "run", **gone))
    with pytest.raises(UserError, match="weights of AlexNet, not of VGG16"):
        loop.train(perceptual(tmp_path, lpips_net="vgg"))
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match=r"train\.lpips_weight is -1: use 0 or more"):
        CodecTrainConfig(lpips_weight=-1)


@pytest.mark.slow
def test_it_is_trained_stopped_in_the_middle_loaded_and_no_world_model(clips, tmp_path):
    config = experiment(tmp_path / "run")
    run = loop.train(config, log=lambda _line: None)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [(x["stage"], x["step"]) for x in lines] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert {"psnr_rgb", "depth_m"} <= lines[0].keys()
    assert {"latent_mean", "latent_variance"} <= lines[-1].keys()
    loaded, params = pewm_jax.load(run)
    assert loaded == config
    assert not np.array_equal(params["codec"]["latent_mean_C"], np.zeros(4))
    _, first = pewm_jax.load(run / "checkpoints" / "codec" / "1")
    assert np.array_equal(first["codec"]["latent_mean_C"], np.zeros(4))
    acts = (
        lambda: worlds.start(loaded, params, None),
        lambda: worlds.observe(loaded, params, None, None),
        lambda: worlds.imagine(loaded, params, None, [0], jax.random.key(0)),
    )
    for act, who in zip(acts, ("start", "observe", "imagine"), strict=True):
        with pytest.raises(UserError, match=rf"{who}\(\) got a run that trained a codec alone"):
            act()
    with pytest.raises(UserError, match=r"evaluating .* got a run that trained a codec alone"):
        report.evaluate(run)


@pytest.mark.slow
def test_a_model_starts_from_it_and_is_refused_without_it(clips, tmp_path):
    run = loop.train(experiment(tmp_path / "run"), log=lambda _line: None)
    tiny = presets.load("tiny")
    backbone = dataclasses.replace(tiny.model.backbone, patch=1)
    clip = ClipConfig(frames=3, height=16, width=24)
    tiny = tiny.with_model(codec=TINY, backbone=backbone, clip=clip)
    with pytest.raises(
        UserError, match=r"codec of kind learned .*train it \(pewm-jax train codec\)"
    ):
        loading.require_weights(tiny)
    fresh = (r"memory/.*", r"backbone/.*", r"control/.*")
    train = dataclasses.replace(tiny.train, start=str(run), fresh=fresh)
    tiny = dataclasses.replace(tiny, train=train)
    loading.require_weights(tiny)
    stage = runs.planned(tiny)[0]
    start = loading.read_weights(tiny, stage, print)
    mesh = loop.sharding.make_mesh()
    state = step.initial_state(tiny, stage, mesh, start)
    mine = tree.flatten(state.params["codec"])
    for path, leaf in tree.flatten(pewm_jax.load(run)[1]["codec"]).items():
        np.testing.assert_array_equal(mine[path], leaf)


def test_what_cannot_work_is_refused_in_a_sentence():
    with pytest.raises(ConfigError, match=r"codec is a PixelConfig, .* use codec\.kind learned"):
        CodecTask(codec=PixelConfig())
    with pytest.raises(ConfigError, match=r"train\.preview_every is 5: a codec imagines nothing"):
        CodecTrainConfig(preview_every=5)
    with pytest.raises(ConfigError, match=r"train\.latent_noise is -1: use 0 or more"):
        CodecTrainConfig(latent_noise=-1)


def test_its_training_can_be_planned(tmp_path):
    said = []
    launch = Launch(plan=True, devices=1, chip="h100", compiled="off")
    made = plan.show(experiment(tmp_path / "run"), launch, said.append)
    assert [one.stage.name for one in made] == ["codec", "statistics"]


def test_the_preset_goes_to_json_and_back_and_keeps_to_an_hour(tmp_path):
    config = presets.load("codec")
    configuration.save(config, tmp_path / "config.json")
    assert configuration.load(tmp_path / "config.json") == config
    assert (config.model.clip.height, config.model.clip.width) == (64, 64)
    assert config.train.codec.decay == "cosine"


def recorded(folder, scenes, holes=False):
    """Write a split of two episodes in each of some scenes, of 16 × 24 pixels."""
    rng, records = np.random.default_rng(0), []
    for scene in range(scenes):
        for walk in range(2):
            rgb = (127.5 * (np.moveaxis(smooth(rng, 3, 3), 1, -1) + 1)).astype(np.uint8)
            depth = (0.0 if holes else 2.0) + np.zeros((3, 16, 24), np.float32)
            camera = random_camera(rng, 3)
            arrays = EpisodeArrays(rgb, depth, camera.intrinsics_4[0], camera.world_from_camera)
            records.append(write_episode(arrays, f"{scene}-{walk}", f"house-{scene}"))
    shard = folder / "shard-00000-of-00001.array_record"
    folder.mkdir(parents=True)
    write_shard(shard, records)
    write_manifest(folder, Manifest(folder.name, (describe_shard(shard),), {}, 3 * len(records)))


@pytest.mark.slow
def test_its_numbers_are_printed_by_evaluate(clips, tmp_path, capsys):
    run = loop.train(experiment(tmp_path / "run"), log=lambda _line: None)
    data = tmp_path / "data"
    recorded(data / "validation", 3)
    recorded(data / "blind", 1, holes=True)
    argv = [str(run), "--data", str(data), "--split", "validation"]
    assert program.execute(["evaluate", *argv]) == 0
    out = capsys.readouterr().out
    assert "3 scenes, 24×16 pixels" in out
    result = json.loads((run / "report" / "codec-validation.json").read_text())
    assert result["episodes"] == 6
    numbers = result["numbers"]
    assert f"depth error, cm                {numbers['depth_cm']['mean']:.3f} ± " in out
    assert 0 < numbers["ssim"]["mean"] < 1
    assert result["in_loss"] == []
    assert result["videos"] is None
    assert "FVD and KVD are not measured: I3D needs 9 frames, and an episode has 3." in out

    file = tmp_path / "vgg.safetensors"
    weights.save(file, jax.jit(lpips.init, static_argnums=0)("vgg", jax.random.key(0)))
    assert program.execute(["evaluate", *argv, "--lpips", str(file)]) == 0
    result = json.loads((run / "report" / "codec-validation.json").read_text())
    (name,) = (name for name in result["numbers"] if name.startswith("lpips"))
    assert name.startswith("lpips_vgg-")  # weights of one's own have their hash in the name
    assert f"LPIPS[{name.removeprefix('lpips_')}]" in capsys.readouterr().out
    with pytest.raises(UserError, match="--fvd is on, and episodes are too short for it"):
        program.execute(["evaluate", *argv, "--fvd", "on"])

    config, params = pewm_jax.load(run)
    one = codec_score.EpisodeSource(data / "validation")[0].frames()
    found = codec_score.measures(config.model, params["codec"], one)
    assert found["psnr"].shape == (3,)
    worse = dataclasses.replace(one, rgb_THWC=255 - one.rgb_THWC)
    made = codec_score.measures(config.model, params["codec"], worse)
    assert not np.allclose(found["psnr"], made["psnr"])

    blind = codec_score.score(run, data=data, split="blind", log=lambda _line: None)
    assert json.loads(blind.read_text())["numbers"]["depth_cm"] == {"mean": None, "error": None}
    longer = dataclasses.replace(config.train.statistics, steps=3)
    half = dataclasses.replace(config.train, statistics=longer)
    configuration.save(dataclasses.replace(config, train=half), run / "config.json")
    with pytest.raises(UserError, match="is not fully trained"):
        codec_score.score(run, data=data, split="validation")
    with pytest.raises(ConfigError, match="omit --seeds, --steps"):
        program.execute(["evaluate", str(run), "--steps", "2", "--seeds", "0"])


def test_the_networks_that_judge_are_those_installed_and_the_one_in_the_loss_is_named(
    tmp_path, monkeypatch
):
    made = jax.jit(lpips.init, static_argnums=0)
    files = {net: tmp_path / f"{net}.safetensors" for net in ("alex", "vgg")}
    for net, file in files.items():
        weights.save(file, made(net, jax.random.key(0)))
    monkeypatch.setattr(lpips_weights, "installed", files.get)
    choose = functools.partial(codec_score.choose_judges, accelerator=False)
    found = choose("", "off", 64, 48, 16)
    assert set(found.lpips) == {"lpips_alex", "lpips_vgg"}
    assert set(choose("", "off", 16, 48, 16).lpips) == {"lpips_vgg"}
    assert choose("off", "off", 64, 48, 16).lpips == {}
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    found = choose("", "", 64, 48, 16)
    assert found.lpips == {}
    assert found.i3d is None
    assert "no weights are installed" in found.about[0]
    assert "FVD and KVD are not measured" in found.about[1]

    steps = StageConfig(steps=1)
    assert codec_score.in_loss(CodecTrainConfig()) == []
    assert codec_score.in_loss(CodecTrainConfig(sharpen=steps, lpips_net="vgg")) == ["lpips_vgg"]
    assert codec_score.in_loss(CodecTrainConfig(sharpen=steps, sharpen_lpips=0)) == []
    assert codec_score.in_loss(CodecTrainConfig(lpips_weight=1)) == ["lpips_alex"]
