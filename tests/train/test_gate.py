"""The gate is trained after the codec, alone, and learns to show what was seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pewm_jax
from pewm_jax import shipped, worlds
from pewm_jax.codecs import gates
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ClipConfig, Config, ConfigError, DataConfig, StageConfig, UserError
from pewm_jax.data import abstract
from pewm_jax.io import tree, weights
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.train import loop, runs
from pewm_jax.types import Frames
from pewm_jax.worlds import codec as codec_gate
from pewm_jax.worlds import codec_losses, sharpen
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig
from pewm_jax.worlds.rollouts import load_finished
from tests.helpers import TINY, random_camera, random_world, tiny_config

CODEC = LearnedCodecConfig(
    latent_channels=4, fine=8, coarse=8, fine_blocks=1, coarse_blocks=1, gate=8
)


def experiment(run="runs/it", **steps):
    each = {name: StageConfig(steps=0) for name in ("codec", "statistics", "gate")}
    each |= {
        name: StageConfig(steps=count, batch=2, warmup=0, learning_rate=5e-3, decay="constant")
        for name, count in steps.items()
    }
    memory = SurfelConfig(capacity=2048, cell_m=(0.02, 0.02, 0.02))
    return Config(
        model=CodecTask(clip=ClipConfig(frames=3, height=16, width=24), codec=CODEC, memory=memory),
        data=DataConfig(context=2),
        train=CodecTrainConfig(run=str(run), save_every=1, log_every=1, ema=0.0, **each),
    )


def batch(config, rows, seed=0):
    """Still cameras before a wall in waves of colour: all of it was seen before."""
    rng = np.random.default_rng(seed)
    like = abstract.clip(config, rows)
    clip = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), like)
    cameras = [random_camera(rng, 1) for _ in range(rows)]
    one = jax.tree.map(lambda *x: np.stack(x), *cameras)
    walls = rng.integers(0, 256, (rows, 1, 16, 24, 3), np.uint8)

    def still(frames):
        count = frames.depth_THW.shape[1]
        return dataclasses.replace(
            frames,
            rgb_THWC=np.repeat(walls, count, 1),
            depth_THW=np.full_like(frames.depth_THW, 2.0),
            camera=jax.tree.map(lambda x: np.repeat(x, count, 1), one),
        )

    return dataclasses.replace(
        clip,
        frames=still(clip.frames),
        context=still(clip.context),
        context_valid_S=np.ones_like(clip.context_valid_S),
    )


@pytest.fixture
def clips(monkeypatch):
    def given(config, split, *, batch: int, start_step: int = 0, **_):
        del split
        while True:
            yield globals()["batch"](config, batch, start_step)
            start_step += 1

    monkeypatch.setattr(loop.loader, "clips", given)


@pytest.mark.slow
def test_only_the_gate_learns_in_its_stage_and_the_run_can_be_loaded(clips, tmp_path):
    first = loop.train(experiment(tmp_path / "codec", codec=1, statistics=1), log=lambda _: None)
    before = tree.flatten(pewm_jax.load(first)[1])
    config = experiment(tmp_path / "gate", gate=2)
    start = dataclasses.replace(config.train, start=str(first), fresh=(r"codec/gate/.*",))
    run = loop.train(dataclasses.replace(config, train=start), log=lambda _: None)
    after = tree.flatten(load_finished(run)[1])
    assert {path for path in after if path.startswith("codec/gate/")} == after.keys() - before
    for path, leaf in before.items():
        np.testing.assert_array_equal(after[path], leaf)
    assert np.abs(after["codec/gate/out/kernel"]).max() > 0


@pytest.mark.slow
def test_with_what_was_seen_the_gate_makes_more_of_noisy_latents_than_the_decoder():
    config = experiment()
    stage = worlds.stages(config)[2]
    params = jax.jit(worlds.init, static_argnums=0)(config, jax.random.key(0))
    clip = batch(config, 2)
    loss = jax.jit(lambda p, key: stage.loss(config.model, config.train, p, clip, key))
    measured = loss(params, jax.random.key(1))[1]
    assert measured["psnr_rgb"] > measured["psnr_decoded"] + 3
    assert measured["psnr_rendered"] > measured["psnr_rgb"]


def test_weights_that_come_with_the_library_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in shipped.names():
        config, params = pewm_jax.load(name)
        assert (shipped.find(name) / "README.md").is_file()
        assert all(np.isfinite(leaf.astype(np.float32)).all() for leaf in jax.tree.leaves(params))
        stored = weights.metadata(shipped.find(name) / "weights.safetensors")["dtype"]
        kept = {2, 4} if stored == "int8" else {2}  # kernels in 8 bits are loaded in float32
        assert {leaf.dtype.itemsize for leaf in jax.tree.leaves(params)} == kept
        if isinstance(config.model, CodecTask):
            video = jnp.zeros((1, 2, 16, 24, 3))
            latents = config.model.codec.encode(params["codec"], video)
            assert latents.shape == (1, 2, 2, 3, config.model.codec.latent_channels)


def imagining(reader=None):
    """A tiny world model whose memory is mixed in by a gate."""
    memory = SurfelConfig(capacity=2048, cell_m=(0.05, 0.05, 0.05), tokens=16)
    memory = dataclasses.replace(memory, reader=reader or RenderConfig(picture_width=8))
    backbone = dataclasses.replace(TINY.backbone, patch=1)
    return tiny_config(
        codec=CODEC, backbone=backbone, memory=memory, data=DataConfig(context=2, prepared=2)
    )


LAST = worlds.stages(tiny_config())[3]


@pytest.mark.slow
@pytest.mark.parametrize(
    "reader",
    [
        None,
        pytest.param(AttentionConfig(heads=4, head_dim=8), marks=pytest.mark.slow),
        pytest.param(RenderConfig(picture_width=8, picture="latents"), marks=pytest.mark.slow),
    ],
)
def test_the_gate_learns_alone_on_what_the_model_imagines(reader):
    config = imagining(reader)
    params = random_world(config.model)
    clip = batch(config, 2)
    ready = jax.device_get(jax.jit(lambda p, c: LAST.prepare(config.model, p, c))(params, clip))
    assert ready.extras["latents_thwC"].shape[:2] == (2, 9)
    assert ready.extras["readout"].view.seen_THW.any()
    trained = {
        path for path, label in tree.flatten(LAST.labels(params)).items() if label == "train"
    }
    assert trained == {path for path in tree.flatten(params) if path.startswith("codec/gate/")}

    def loss(gate, clip):
        whole = {**params, "codec": {**params["codec"], "gate": gate}}
        return LAST.loss(config.model, config.train, whole, clip, jax.random.key(0))[0]

    compiled = jax.jit(jax.value_and_grad(loss))
    once, gradient = compiled(params["codec"]["gate"], ready)
    np.testing.assert_allclose(compiled(params["codec"]["gate"], clip)[0], once, rtol=1e-5)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_lpips_of_the_mixed_frames_counts_as_much_as_it_weighs(monkeypatch):
    rng = np.random.default_rng(0)
    model, shape = imagining().model, (1, 2, 32, 32)
    network = lpips.init("alex", jax.random.key(0))
    truth = Frames(
        jnp.asarray(rng.uniform(-1, 1, (*shape, 3))), jnp.asarray(rng.uniform(1, 3, shape)), None
    )
    given = jnp.asarray(rng.uniform(-1, 1, (*shape, 3))), jnp.asarray(rng.uniform(1, 3, shape))
    shown, seen = jnp.asarray(rng.uniform(-1, 1, (*shape, 4))), jnp.ones(shape, bool)
    gate = gates.init(8, jax.random.key(1))

    def score(perceptual):
        return codec_gate.score(model, gate, *given, shown, seen, truth, perceptual)

    without, few = score(None)
    whole, measured = score((0.5, network))
    assert measured["lpips"] > 0
    assert "lpips" not in few
    assert float(whole) == pytest.approx(float(without + 0.5 * measured["lpips"]), rel=1e-5)

    train = dataclasses.replace(imagining().train, gate_lpips=0.5)
    clip = dataclasses.replace(model.clip, height=32, width=32)
    large = dataclasses.replace(model, clip=clip)
    assert LAST.extra_weights(model, imagining().train) is None
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    with pytest.raises(UserError, match="none are installed"):
        LAST.extra_weights(large, train)
    monkeypatch.setattr(lpips_weights, "find", lambda *_: None)
    monkeypatch.setattr(lpips_weights, "read", lambda _, net: (net, network))
    assert LAST.extra_weights(large, train) == {"lpips": network}
    with pytest.raises(UserError, match="too small for LPIPS"):  # before any stage
        LAST.extra_weights(model, train)
    with pytest.raises(ConfigError, match=r"train\.gate_lpips is -1"):
        dataclasses.replace(train, gate_lpips=-1)


def test_the_gate_is_sharpened_alone_and_by_its_discriminator():
    rng = np.random.default_rng(0)
    model, shape = imagining().model, (1, 2, 32, 32)
    truth = Frames(
        jnp.asarray(rng.uniform(-1, 1, (*shape, 3)), jnp.float32),
        jnp.asarray(rng.uniform(1, 3, shape), jnp.float32),
        None,
    )
    given = (
        jnp.asarray(rng.uniform(-1, 1, (*shape, 3)), jnp.float32),
        jnp.asarray(rng.uniform(1, 3, shape), jnp.float32),
        jnp.asarray(rng.uniform(-1, 1, (*shape, 4)), jnp.float32),
        jnp.asarray(rng.random(shape) < 0.7),
    )
    params = {"codec": {"gate": jax.jit(gates.init, static_argnums=0)(8, jax.random.key(1))}}
    params |= jax.jit(sharpen.init)(jax.random.key(2))
    train = dataclasses.replace(imagining().train, sharpen_lpips=0.0)

    @jax.jit
    def loss(params):
        return codec_losses.sharpen_gate(model, train, params, *given, truth)

    (_, measured), gradient = jax.value_and_grad(loss, has_aux=True)(params)
    assert {"loss_rgb", "gan_scale", "loss_discriminator", "loss_depth"} <= measured.keys()
    for part in (gradient["codec"]["gate"]["out"], gradient["discriminator"]["conv_0"]):
        assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(part))

    stage = worlds.stages(model)[-1]
    assert (stage.name, stage.number, stage.optional) == ("sharpen", 5, True)
    shapes = jax.eval_shape(lambda key: stage.init(model, key), jax.random.key(0))
    labels = tree.flatten(stage.labels(shapes))
    assert {path.split("/")[0] for path, label in labels.items() if label == "adversary"} == {
        "discriminator"
    }
    trained = {path for path, label in labels.items() if label == "train"}
    assert trained == {path for path in labels if path.startswith("codec/gate/")}
    assert "discriminator" not in stage.published(shapes)
    with pytest.raises(UserError, match="too small for the discriminator"):
        stage.require(model)
    assert LAST.name == worlds.stages(tiny_config())[-1].name == "gate"
    steps = dataclasses.replace(train, sharpen=StageConfig(steps=1))
    with pytest.raises(
        ConfigError, match=r"train\.sharpen\.steps is 1, but this model has no gate"
    ):
        dataclasses.replace(tiny_config(), train=steps)
    assert dataclasses.replace(imagining(), train=steps).train.sharpen.steps == 1


@pytest.mark.slow
def test_lpips_counts_in_the_codecs_gate_stage(tmp_path):
    file = tmp_path / "alex.safetensors"
    weights.save(file, jax.jit(lpips.init, static_argnums=0)("alex", jax.random.key(0)))
    config = experiment()
    config = config.with_model(clip=dataclasses.replace(config.model.clip, height=32, width=32))
    stage = worlds.stages(config)[2]
    assert stage.extra_weights(config.model, config.train) is None
    train = dataclasses.replace(config.train, gate_lpips=0.5, lpips_file=str(file))
    given = stage.extra_weights(config.model, train)
    params = jax.jit(worlds.init, static_argnums=0)(config, jax.random.key(0))
    like = abstract.clip(config, 1)
    clip = jax.tree.map(lambda x: np.ones(x.shape, x.dtype), like)
    loss = jax.jit(stage.loss, static_argnums=(0, 1))
    whole, measured = loss(config.model, train, params | given, clip, jax.random.key(1))
    without, few = loss(config.model, config.train, params, clip, jax.random.key(1))
    assert "lpips" not in few
    assert float(whole) == pytest.approx(float(without + 0.5 * measured["lpips"]), rel=1e-4)


def test_without_a_gate_there_is_nothing_to_learn():
    config = tiny_config()
    with pytest.raises(UserError, match=r"train\.gate\.steps is above 0, but this model has no"):
        LAST.require(config.model)
    train = dataclasses.replace(config.train, gate=StageConfig(steps=1))
    with pytest.raises(UserError, match=r"this model has no gate"):  # before stage 1
        runs.planned(dataclasses.replace(config, train=train))
    assert runs.planned(dataclasses.replace(imagining(), train=train))[-1].name == "gate"
