"""EgoWM's training: Stable Video Diffusion's U-Net with actions, and actions beside a memory."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import (
    ClipConfig,
    Config,
    ConfigError,
    DataConfig,
    MeshConfig,
    StageConfig,
    TrainConfig,
)
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.data import abstract
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.io import tree
from pewm_jax.models.clip.model import CLIPVisionConfig
from pewm_jax.models.interface import Conditioning
from pewm_jax.models.svd.unet import SVDUNetBackbone
from pewm_jax.models.svd.vae import SVDVAECodec
from pewm_jax.plan import program
from pewm_jax.plan.measure import QUICK
from pewm_jax.train import flops, sharding, step
from pewm_jax.train import step as state
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from tests.helpers import TINY, randomise, with_reader
from tests.train import fakes

IMAGE = CLIPVisionConfig(
    layers=1, heads=2, width=16, hidden=32, projection=16, image_size=28, patch=14
)
UNET = SVDUNetBackbone(
    widths=(32,),
    heads=(2,),
    attends=(False,),
    resnets=(1,),
    layers=(1,),
    image_dim=16,
    added_dim=8,
    image=IMAGE,
)
SVD = EgoWM(
    clip=ClipConfig(frames=3, height=16, width=16, depth=False),
    codec=SVDVAECodec(widths=(32,), depth=False),
    backbone=UNET,
    noise=EDMConfig(sigma_data=1.0, target="v", log_mean=0.7, log_std=1.6, sample_steps=2),
    image_noise=0.1,
)
STAGE = StageConfig(steps=4, batch=2, warmup=0, learning_rate=1e-3)


def trained(config, stage, steps=3, start=None):
    """The state after some steps on one batch, the losses, and the program's text."""
    mesh = sharding.make_mesh(jax.devices()[:1], config.train.mesh)
    batch = jax.device_put(fakes.clip(config, 2, 0), sharding.of_batch(mesh))
    moves = np.random.default_rng(0).normal(0, 0.3, batch.actions_TA.shape).astype(np.float32)
    batch = dataclasses.replace(batch, actions_TA=jax.device_put(moves, sharding.of_batch(mesh)))
    compiled = step.trace_step(config, stage, mesh, batch).lower().compile(compiler_options=QUICK)
    now = step.initial_state(config, stage, mesh, start)
    first = jax.tree.map(np.array, now.params)
    key, losses = step.noise_key(config, stage), []
    for _ in range(steps):
        now, metrics = compiled(now, batch, jax.device_put(key, sharding.replicated(mesh)))
        losses.append(float(metrics["loss"]))
    return first, now, losses, compiled.as_text()


def changed(before, after):
    """The parts of a model of which a parameter has changed."""
    after = tree.flatten(after)
    return {p.split("/")[0] for p, x in tree.flatten(before).items() if np.any(x != after[p])}


@pytest.fixture(scope="module")
def svd():
    config = Config(
        model=SVD, data=DataConfig(context=1), train=EgoWMTrainConfig(adapt=STAGE, blind=0.3)
    )
    stage = worlds.stages(SVD)[1]
    return config, stage, *trained(config, stage)


@pytest.mark.slow
def test_the_u_net_learns_with_actions_and_the_rest_stands_still(svd):
    _, _, first, last, losses, _ = svd
    assert losses[-1] < losses[0]
    assert changed(first, last.params) == {"backbone", "control"}
    assert {"codec", "image"} < first.keys()
    assert first["backbone"]["conv_in"]["kernel"].shape == (3, 3, 8, 32)


@pytest.mark.slow
def test_a_video_model_is_made_first_where_there_is_none_and_the_control_waits(svd):
    _, _, first, *_ = svd
    video, adapt, gate = worlds.stages(SVD)
    assert [stage.number for stage in (video, adapt, gate)] == [1, 2, 3]
    assert [stage.optional for stage in (video, adapt, gate)] == [True, False, True]
    assert EgoWMTrainConfig().video.steps == EgoWMTrainConfig().gate.steps == 0
    waits, learns = (tree.flatten(stage.labels(first)) for stage in (video, adapt))
    for path, label in learns.items():
        part = path.split("/")[0]
        assert label == ("train" if part in ("backbone", "control") else "freeze")
        assert waits[path] == ("train" if part == "backbone" else "freeze")
    assert video.rates == ()
    assert adapt.rates == ((r"control/.*", SVD.control.rate),)


@pytest.mark.slow
def test_its_sums_are_those_of_the_compiled_step(svd):
    config, stage, *_, text = svd
    needed = flops.of_stage(config, stage, abstract.clip(config, 2)).total
    assert needed == pytest.approx(program.read(text).flops, rel=0.02)


def test_every_leaf_has_its_place_on_many_devices():
    config = Config(model=SVD, train=EgoWMTrainConfig(adapt=STAGE))
    mesh = jax.sharding.AbstractMesh((1, 8, 1, 1), ("data", "fsdp", "tensor", "context"))
    stage = worlds.stages(SVD)[1]
    shapes = jax.eval_shape(functools.partial(state.create, config, stage), jax.random.key(0))
    placed = tree.flatten(sharding.of_state(SVD, mesh, shapes))
    for path, leaf in tree.flatten(shapes).items():
        split = [axis for axis in placed[path].spec if axis]
        small = leaf.size <= 2048 or path.endswith(("scale", "bias"))
        assert split or small or "codec" in path, f"{path} {leaf.shape} is whole"


@pytest.mark.slow
def test_before_training_any_action_leaves_the_u_net_s_output_bit_for_bit():
    @functools.partial(jax.jit, static_argnums=0)
    def run(config, params, x, time, given):
        return config.apply(params, x, time, given)

    rng = np.random.default_rng(0)
    init = jax.jit(SVDUNetBackbone.init, static_argnums=(0, 2, 3))
    params = randomise(init(UNET, jax.random.key(0), 4, 4), scale=0.1)
    x, image, scalars = (
        rng.normal(size=shape).astype(np.float32) for shape in ((2, 3, 5, 4, 4), (2, 1, 16), (2, 3))
    )
    time = np.array([-1.0, 1.0], np.float32)
    given = Conditioning(image_BMD=image, scalars_BK=scalars)
    zero = np.zeros((2, 3, UNET.time_dim), np.float32)
    led = dataclasses.replace(given, modulation_BtE=zero)
    np.testing.assert_array_equal(
        run(UNET, params, x, time, led), run(UNET, params, x, time, given)
    )


def test_what_does_not_fit_the_u_net_is_refused():
    for changes, says in (
        ({"codec": PixelConfig(temporal=1), "clip": ClipConfig(frames=3)}, None),
        ({"clip": ClipConfig(frames=3)}, "this codec encodes colour alone"),
        ({"backbone": dataclasses.replace(UNET, image_dim=24)}, "is attended to, so use the same"),
        ({"backbone": dataclasses.replace(UNET, added=2)}, "use 3"),
    ):
        if says is None:
            dataclasses.replace(SVD, **changes)
            continue
        with pytest.raises(ConfigError, match=says):
            dataclasses.replace(SVD, **changes)
    with pytest.raises(ConfigError, match="no injection point for a memory"):
        dataclasses.replace(TINY, backbone=UNET)


@pytest.mark.slow
def test_actions_and_a_memory_on_one_backbone():
    """World ``pewm`` with the control ``actions`` and rays, in both stages."""
    model = dataclasses.replace(
        with_reader(TINY, looks=8),
        clip=ClipConfig(frames=5, height=16, width=16),
        backbone=dataclasses.replace(TINY.backbone, layers=1),
        control=ModulationConfig(projection="convolution", rays=True),
        noise=DDPMConfig(sample_steps=1),
    )
    train = TrainConfig(stage1=STAGE, stage2=STAGE, mesh=MeshConfig(), clip_norm=1e6)
    config = Config(model=model, data=DataConfig(context=1), train=train)
    one, two = worlds.stages(model)[:2]
    assert one.rates == two.rates == ((r"control/.*", 10.0),)
    first, last, _, _ = trained(config, one)
    assert changed(first, last.params) == {"backbone", "control"}
    moved = np.abs(last.params["control"]["conv_2"]["bias"]).mean()
    # Its gradient passes layers that begin at zero, so only the third of three steps moves it:
    # half of the peak rate after the cosine, Adam's 0.64 after two gradients of zero, ten times.
    assert moved == pytest.approx(10 * 1e-3 * 0.5 * 0.64, rel=0.1)
    first, last, losses, _ = trained(config, two, start=jax.device_get(last.params))
    assert changed(first, last.params) == {"memory"}
    assert np.isfinite(losses).all()
