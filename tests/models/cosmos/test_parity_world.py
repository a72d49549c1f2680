"""A pipeline's folder of Cosmos-Predict2 becomes a world that samples what the pipeline samples."""

import dataclasses
import functools
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import Cosmos2VideoToWorldPipeline
from transformers import AutoTokenizer, T5EncoderModel

import pewm_jax
from pewm_jax import worlds
from pewm_jax.codecs import rgbd
from pewm_jax.config import ConfigError, UserError
from pewm_jax.convert import commands, cosmos
from pewm_jax.convert.options import ImportCosmos2
from pewm_jax.io import tree
from pewm_jax.train import loading
from pewm_jax.types import Camera, Control, Frames
from pewm_jax.worlds import world_model
from pewm_jax.worlds import world_model as sampling
from pewm_jax.worlds.egowm.world import EgoWM
from tests.convert.pipelines import save_text
from tests.helpers import random_frames
from tests.models.cosmos.references import channels_first, channels_last, small_pipeline
from tests.models.svd.references import distance, draw

STEPS, GUIDANCE = 4, 3.0
FRAMES, SIZE = 9, 16
KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def pipeline():
    return small_pipeline()


@pytest.fixture(scope="module")
def folder(pipeline, tmp_path_factory):
    found = tmp_path_factory.mktemp("cosmos")
    for part in ("transformer", "vae", "scheduler"):
        getattr(pipeline, part).save_pretrained(found / part)
    return found


def run(src, dst, **options):
    sizes = {"frames": FRAMES, "height": SIZE, "width": SIZE}
    commands.import_cosmos2(ImportCosmos2(src, dst, **(sizes | options)))
    return pewm_jax.load(dst)


@pytest.fixture(scope="module")
def where(tmp_path_factory):
    return tmp_path_factory.mktemp("worlds") / "world"


@pytest.fixture(scope="module")
def world(folder, where):
    return run(folder, where)


@pytest.fixture(scope="module")
def model(world):
    """The imported model, with prompts of five tokens and guidance on them, in few steps."""
    found = world[0].model
    return dataclasses.replace(
        found,
        backbone=dataclasses.replace(found.backbone, prompt="stored", text_length=5),
        noise=dataclasses.replace(found.noise, sample_steps=STEPS, guidance=1 + GUIDANCE),
    )


@pytest.fixture(scope="module")
def params(world):
    texts = draw(2, 5, 24)
    return {**world[1], "text": {"prompt_LC": texts[0], "negative_LC": texts[1]}}


@functools.partial(jax.jit, static_argnums=0)
def conditioned(model, params, first, actions_TA):
    """The conditioning of a clip that begins with a frame, and the same without the prompt."""
    camera = Camera(jnp.ones((1, FRAMES, 4)), jnp.broadcast_to(jnp.eye(4), (1, FRAMES, 4, 4)))
    seen = Frames(first, jnp.zeros((1, 1, SIZE, SIZE)), jax.tree.map(lambda x: x[:, :1], camera))
    given = world_model.condition(model, params, seen, Control(camera, actions_TA[None]))
    return given, world_model.blind(model, params, given, np.ones((1,), bool))


@functools.partial(jax.jit, static_argnums=0)
def sampled(model, params, first, actions_TA, start):
    given, blind = conditioned(model, params, first, actions_TA)
    return sampling.sample(model, params, given, None, start, blind=blind)


MOVES = np.random.default_rng(4).uniform((-0.1, -0.1, -0.3), (0.4, 0.1, 0.3), (FRAMES - 1, 3))
MOVES = MOVES.astype(np.float32)
START = draw(1, 3, 4, 4, 4, seed=1)
FIRST = np.tanh(draw(1, 1, SIZE, SIZE, 3, seed=2))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # the reference's
def test_what_the_pipeline_samples_the_world_samples(pipeline, model, params, monkeypatch):
    monkeypatch.setattr(  # the mode instead of a draw
        "diffusers.pipelines.cosmos.pipeline_cosmos2_video2world.retrieve_latents",
        lambda output, _: output.latent_dist.mode(),
    )
    prompt, negative = (torch.tensor(x)[None] for x in params["text"].values())
    seen = []

    def watch(_pipe, _index, _t, tensors):
        seen.append(channels_last(tensors["latents"]))
        return {}

    frames = pipeline(
        video=torch.tensor((FIRST + 1) / 2).movedim(-1, 2),
        prompt_embeds=prompt,
        negative_prompt_embeds=negative,
        height=SIZE,
        width=SIZE,
        num_frames=FRAMES,
        num_inference_steps=STEPS,
        guidance_scale=GUIDANCE,
        fps=16,
        latents=channels_first(START),
        output_type="pt",
        callback_on_step_end=watch,
    ).frames
    got = sampled(model, params, FIRST, MOVES, START)
    assert distance(got, seen[-1]) < 1e-4
    rgb, depth = jax.jit(rgbd.decode_rgbd, static_argnums=0)(model, params, got)
    theirs = 2 * np.moveaxis(frames[0].numpy(), 1, -1) - 1
    assert np.abs(np.asarray(rgb[0]) - theirs).max() < 2 / 255 + 1e-3  # theirs went through 8 bits
    assert not np.any(depth)


@pytest.mark.slow
def test_before_training_any_action_leaves_the_output_bit_for_bit(model, params):
    one = sampled(model, params, FIRST, MOVES, START)
    other = sampled(model, params, FIRST, -3 * MOVES, START)
    np.testing.assert_array_equal(one, other)

    @functools.partial(jax.jit, static_argnums=0)
    def predicted(model, params, x, given):
        part = params["backbone"]
        return model.backbone.apply(part, x, jnp.float32([0.7]), given)

    given, _ = conditioned(model, params, FIRST, MOVES)
    assert given.backbone.modulation_BtE.shape == (1, 3, 32)
    without = dataclasses.replace(given.backbone, modulation_BtE=None)
    np.testing.assert_array_equal(
        predicted(model, params, START, given.backbone), predicted(model, params, START, without)
    )


@pytest.mark.slow
def test_attention_over_time_is_not_causal_and_the_given_frame_and_earlier_chunks_stand(
    model, params
):
    """What a later action changes once the actions' layers are trained."""
    control = dict(params["control"])
    drawn = 0.3 * draw(*control["conv_2"]["kernel"].shape)
    control["conv_2"] = {**control["conv_2"], "kernel": drawn}
    trained = {**params, "control": control}
    later = MOVES.copy()
    later[-1] += 1  # it leads to the last frame, in the last of three latent frames
    given, _ = conditioned(model, trained, FIRST, MOVES)
    moved, _ = conditioned(model, trained, FIRST, later)
    change = np.asarray(given.backbone.modulation_BtE - moved.backbone.modulation_BtE)
    assert not np.any(change[:, :2])
    assert np.any(change[:, 2])
    one = sampled(model, trained, FIRST, MOVES, START)
    other = sampled(model, trained, FIRST, later, START)
    change = np.abs(one - other).max((0, 2, 3, 4))
    assert change[0] == 0  # it is given
    assert min(change[1:]) > 1e-5  # the frames before the action, too

    quick = dataclasses.replace(
        model, noise=dataclasses.replace(model.noise, sample_steps=2, guidance=1.0)
    )
    state = worlds.start(quick, trained, random_frames(np.random.default_rng(0), 2, SIZE, SIZE))
    imagine = jax.jit(worlds.imagine, static_argnums=0)
    plan = np.concatenate([MOVES, MOVES[:2]])
    turned = plan.copy()
    turned[-1] += 1
    _, frames = imagine(quick, trained, state, plan, KEY)
    _, changed = imagine(quick, trained, state, turned, KEY)
    assert frames.rgb_THWC.shape == (10, SIZE, SIZE, 3)
    np.testing.assert_array_equal(frames.rgb_THWC[:8], changed.rgb_THWC[:8])
    assert np.abs(frames.rgb_THWC[8:] - changed.rgb_THWC[8:]).max() > 1e-5


def test_it_loads_with_every_tensor_and_can_be_trained(world, folder, where):
    config, params = world
    assert isinstance(config.model, EgoWM)
    clip = config.model.clip
    assert (clip.frames, clip.height, clip.width, config.model.codec.temporal) == (9, 16, 16, 4)
    like = jax.eval_shape(lambda: worlds.init(config.model, jax.random.key(0)))
    assert tree.mismatches(params, like) == []
    for part, read in (("backbone", cosmos.read_transformer), ("codec", cosmos.read_vae)):
        stored = tree.flatten(read(folder)[1])
        for path, leaf in tree.flatten(params[part]).items():
            np.testing.assert_array_equal(leaf, stored[path], err_msg=path)
    with pytest.raises(UserError, match=r"set train\.start to its folder"):
        loading.require_weights(config)
    loading.require_weights(
        dataclasses.replace(config, train=dataclasses.replace(config.train, start=str(where)))
    )


def test_prompts_are_encoded_as_the_pipeline_does(folder, tmp_path):
    src = shutil.copytree(folder, tmp_path / "src")
    save_text(src, width=24)
    config, params = run(src, tmp_path / "told", prompt="a room", negative="a chair with a room")
    backbone = config.model.backbone
    assert (backbone.prompt, backbone.text_shape) == ("stored", (512, 24))
    assert config.model.noise.guidance == 1
    reference = SimpleNamespace(
        tokenizer=AutoTokenizer.from_pretrained(src / "tokenizer"),
        text_encoder=T5EncoderModel.from_pretrained(src / "text_encoder"),
        _execution_device="cpu",
    )
    with torch.inference_mode():
        expected = Cosmos2VideoToWorldPipeline._get_t5_prompt_embeds(
            reference, ["a room", "a chair with a room"], dtype=torch.float32
        ).numpy()
    for name, tokens in zip(("prompt_LC", "negative_LC"), expected, strict=True):
        np.testing.assert_allclose(params["text"][name], tokens, atol=1e-5)
    assert np.any(params["text"]["negative_LC"][5])
    assert not np.any(params["text"]["negative_LC"][6:])
    like = jax.eval_shape(lambda: worlds.init(config.model, jax.random.key(0)))
    assert tree.mismatches(params, like) == []


def test_what_does_not_fit_is_refused_before_anything_is_written(folder, tmp_path):
    with pytest.raises(ConfigError, match=r"codec\.spatial × backbone\.patch"):
        run(folder, tmp_path / "odd", height=20)
    with pytest.raises(ConfigError, match="use 4k"):
        run(folder, tmp_path / "odd", frames=7)
    with pytest.raises(UserError):
        run(folder / "vae", tmp_path / "nothing")
    assert not list(tmp_path.iterdir())


def test_guidance_without_text_and_noise_in_other_units_are_refused(world):
    model = world[0].model
    with pytest.raises(ConfigError, match="no text is stored"):
        dataclasses.replace(model, noise=dataclasses.replace(model.noise, guidance=2.0))
    with pytest.raises(ConfigError, match=r"noise\.target flow"):
        dataclasses.replace(model, noise=dataclasses.replace(model.noise, target="edm"))
