"""The codec's latents: as features that a memory keeps, and as the picture that a reader gets."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import registry as kinds
from pewm_jax import worlds
from pewm_jax.codecs import rgbd
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import Config, ConfigError, DataConfig, UserError
from pewm_jax.convert import stablehlo as stablehlo_programs
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.encoders.simple import LatentsConfig, PatchColoursConfig
from pewm_jax.io import tree
from pewm_jax.memory import feature_cache
from pewm_jax.memory import interface as memories
from pewm_jax.memory.points import PointsConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import BothConfig, RenderConfig
from pewm_jax.train import feed
from pewm_jax.types import Clip, Control, EncodedView, Frames, MemoryReadout, View
from pewm_jax.worlds import objective, world_model
from pewm_jax.worlds.codec import CodecTask
from pewm_jax.worlds.pewm import world as pewm
from tests import properties
from tests.helpers import TINY, init_world, random_camera, random_frames, random_world, tiny_model

CODEC = LearnedCodecConfig(
    latent_channels=4, fine=8, coarse=8, fine_blocks=1, coarse_blocks=1, gate=8
)
ENCODER = LatentsConfig(channels=4)
ATTEND = AttentionConfig(heads=4, head_dim=8)
RENDER = RenderConfig(picture_width=16)
LATENTS = dataclasses.replace(RENDER, picture="latents")
VOXELS = VoxelConfig(
    cell_m=(0.5, 0.5, 0.5), cells=(24, 24, 8), capacity=512, tokens=32, encoder=ENCODER
)
SURFELS = SurfelConfig(cell_m=(0.1, 0.1, 0.1), cells=(128, 128, 64), capacity=4096, tokens=32)
MEMORIES = {
    "features, attended to": dataclasses.replace(VOXELS, reader=ATTEND),
    "features, rendered": dataclasses.replace(VOXELS, reader=RENDER),
    "features of surfels": dataclasses.replace(
        SURFELS, features=True, encoder=ENCODER, reader=RENDER
    ),
    "picture": dataclasses.replace(SURFELS, reader=LATENTS),
    "picture at the input": dataclasses.replace(
        SURFELS, reader=dataclasses.replace(LATENTS, blocks=False)
    ),
    "picture and attention": dataclasses.replace(
        SURFELS,
        reader=BothConfig(heads=4, head_dim=8, picture_width=16, picture="latents"),
    ),
}
ALL = pytest.mark.parametrize(
    "kind", properties.first([kind for kind in MEMORIES if "input" not in kind], 1)
)
PICTURES = pytest.mark.parametrize(
    "kind", properties.first([kind for kind in MEMORIES if "picture" in kind], 1)
)
TIMES = jnp.array([5, 700])
GRID = (5, 2, 3)
"""Latents of a clip: 5 frames of 16 × 24 pixels."""
apply = jax.jit(world_model.apply, static_argnums=0)
condition = jax.jit(world_model.condition, static_argnums=0)
look = jax.jit(objective.clip_readout, static_argnums=0)
start = jax.jit(pewm.PEWM.start, static_argnums=0)
encode_rgbd = jax.jit(rgbd.encode_rgbd, static_argnums=0)
features = jax.jit(
    lambda model, *given: model.memory.encoder.features(model, *given), static_argnums=0
)


@functools.cache
def model_of(kind):
    """The tiny model with the learned codec; every cell of its latents is a token."""
    return tiny_model(
        clip=dataclasses.replace(TINY.clip, frames=5),
        codec=CODEC,
        backbone=dataclasses.replace(TINY.backbone, patch=1),
        memory=MEMORIES[kind],
        noise=DDPMConfig(sample_steps=1),
    )


@functools.cache
def weights(kind):
    params = random_world(model_of(kind))
    params["codec"]["latent_scale_C"] = jnp.linspace(0.5, 2, 4)
    return params


@functools.cache
def batch(count=2):
    """Clips of random frames that stand where their context stood."""
    rng = np.random.default_rng(0)
    made = [random_frames(rng, 5) for _ in range(count)]
    frames = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *made)
    return Clip(frames, frames, jnp.ones((count, 5), bool))


@functools.cache
def inputs():
    """Conditioning, what is seen of a memory, and noisy latents, of two clips."""
    rng = np.random.default_rng(0)
    camera = jax.tree.map(lambda x: jnp.asarray(np.stack([x, x[::-1]])), random_camera(rng, 5))

    def draw(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    first = jax.tree.map(lambda x: x[:, :1], camera)
    observed = Frames(jnp.tanh(draw(2, 1, 16, 24, 3)), jnp.ones((2, 1, 16, 24)), first)
    model = model_of("picture")
    given = condition(model, weights("picture"), observed, Control(camera))
    seen = jnp.asarray(rng.uniform(size=(2, 5, 16, 24)) < 0.3).at[:, 2, :8, 8:16].set(False)
    encoded = EncodedView(draw(2, *GRID, 8), seen)
    return given, encoded, draw(2, *GRID, 8)


def sight_of(kind, encoded):
    """What a reader of pictures is shown, without a token."""
    if not model_of(kind).memory.reader.READS_TOKENS:
        return MemoryReadout(encoded=encoded)
    readout = look(model_of(kind), weights(kind), batch())
    tokens = dataclasses.replace(readout.tokens, valid_M=jnp.zeros_like(readout.tokens.valid_M))
    return MemoryReadout(tokens, encoded=encoded)


def predict(kind, params, readout):
    conditioning, _, noisy = inputs()
    return apply(model_of(kind), params, noisy, conditioning, TIMES, readout)


@pytest.mark.slow
def test_features_are_the_latents_of_each_frame_s_colours():
    kind, frames = "features, rendered", batch().frames
    model, params, rgb = model_of(kind), weights(kind), frames.rgb_THWC[0] / 127.5 - 1
    found = features(model, params, rgb)
    assert found.shape == (*GRID, 4) == (5, *ENCODER.grid(model.clip), ENCODER.channels)
    whole = encode_rgbd(model, params, rgb[None], frames.depth_THW[:1])
    np.testing.assert_allclose(found, whole[0, ..., :4], atol=1e-4)
    other = features(model, params, rgb.at[3].set(0))
    same = np.abs(other - found).max((1, 2, 3)) == 0
    assert same.tolist() == [True, True, True, False, True]
    assert ENCODER.colours(found.reshape(-1, 4)).shape == (30, 3)


@pytest.mark.slow
@ALL
def test_a_rollout_looks_as_training_does(kind):
    model, params, clips = model_of(kind), weights(kind), batch()
    readout = look(model, params, clips)
    reader = model.memory.reader
    given = {
        field.name for field in dataclasses.fields(MemoryReadout) if getattr(readout, field.name)
    }
    asked = {"tokens": reader.READS_TOKENS, "encoded": reader.READS_LATENTS}
    asked["view"] = reader.READS_VIEW and not reader.READS_LATENTS
    assert given == {name for name, wanted in asked.items() if wanted}
    if reader.READS_LATENTS:
        assert readout.encoded.latents_thwC.shape == (2, *GRID, 8)
        assert readout.encoded.seen_THW.mean() > 0.1
    again = jax.jit(
        lambda params, memory, camera: memories.readout(model, memory, camera, params=params)
    )
    for i in range(2):
        frames = jax.tree.map(lambda x, i=i: x[i], clips.frames)
        alone = again(params, start(model, params, frames).map, frames.camera)
        one = jax.tree.map(lambda x, i=i: x[i], readout)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), alone, one)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["features of surfels", "picture and attention"])
def test_worlds_imagine_with_them(kind):
    model, params = model_of(kind), weights(kind)
    state = start(model, params, jax.tree.map(lambda x: x[0], batch().frames))
    imagine = jax.jit(worlds.imagine, static_argnums=0)
    moves = jnp.zeros((4, 3)).at[:, 0].set(0.1)
    unread = {**params, "memory": jax.tree.map(jnp.zeros_like, params["memory"])}
    (after, made), (_, without) = (
        imagine(model, some, state, moves, jax.random.key(0)) for some in (params, unread)
    )
    assert np.isfinite(made.rgb_THWC).all()
    assert np.abs(made.rgb_THWC - without.rgb_THWC).max() > 1e-4
    assert int(after.map.occupied) >= int(state.map.occupied) > 0


@pytest.mark.slow
@PICTURES
def test_a_fresh_reader_and_an_empty_memory_change_nothing_bit_for_bit(kind):
    _, encoded, _ = inputs()
    learned = weights(kind)
    fresh = {**learned, "memory": init_world(model_of(kind))["memory"]}
    base = predict(kind, {"backbone": learned["backbone"]}, None)
    assert np.abs(base).max() > 0.1
    readout = sight_of(kind, encoded)
    np.testing.assert_array_equal(predict(kind, fresh, readout), base)
    nothing = objective.hide_readout(readout, jnp.zeros((2,), bool))
    np.testing.assert_array_equal(predict(kind, learned, nothing), base)
    first = objective.hide_readout(readout, jnp.array([True, False]))
    np.testing.assert_array_equal(predict(kind, learned, first)[1], base[1])
    assert np.abs(predict(kind, learned, first)[0] - base[0]).max() > 1e-3


@pytest.mark.slow
def test_latents_of_cells_of_which_nothing_is_seen_are_not_read():
    _, encoded, _ = inputs()
    blind = ~encoded.seen_THW.reshape(2, 5, 2, 8, 3, 8).any((3, 5))
    assert blind[:, 2, 0, 1].all()
    junk = jnp.where(blind[..., None], jnp.nan, encoded.latents_thwC)
    base = predict("picture", weights("picture"), MemoryReadout(encoded=encoded))
    junk = MemoryReadout(encoded=EncodedView(junk, encoded.seen_THW))
    np.testing.assert_array_equal(predict("picture", weights("picture"), junk), base)


def test_each_token_gets_the_latents_and_the_mask_of_its_cell():
    model, (conditioning, encoded, _) = model_of("picture"), inputs()
    params = weights("picture")["memory"]
    added = jax.jit(
        lambda encoded: (
            model.memory.reader.prepare(
                model,
                params,
                MemoryReadout(encoded=encoded),
                conditioning.camera,
                conditioning.rays_BthwC,
            ).added_BND
        )
    )
    latents, seen = encoded.latents_thwC, encoded.seen_THW
    base = added(encoded).reshape(2, *GRID, -1)
    for t, h, w in ((0, 0, 0), (3, 1, 2), (4, 0, 1)):
        other = latents.at[1, t, h, w].add(1.0)
        mask = seen.at[1, t, 8 * h + 3, 8 * w + 5].set(~seen[1, t, 8 * h + 3, 8 * w + 5])
        for changed in (EncodedView(other, seen), EncodedView(latents, mask)):
            moved = added(changed).reshape(base.shape)
            assert np.argwhere(np.abs(moved - base).max(-1) > 0).tolist() == [[1, t, h, w]]


def test_a_view_is_encoded_as_frames_are_and_its_holes_do_not_count():
    model, params = model_of("picture"), weights("picture")
    frames = jax.tree.map(lambda x: x[0], batch().frames)
    rgb, depth = frames.rgb_THWC / 127.5 - 1, frames.depth_THW
    whole = View(rgb, depth, jnp.ones_like(depth, bool))
    expected = encode_rgbd(model, params, rgb[None], depth[None])[0]
    encode = jax.jit(functools.partial(memories.encode, model))
    np.testing.assert_allclose(encode(params, whole).latents_thwC, expected, atol=1e-4)

    seen = inputs()[1].seen_THW[0].at[1].set(False)
    holes = View(jnp.where(seen[..., None], rgb, jnp.nan), jnp.where(seen, depth, jnp.inf), seen)
    found = encode(params, holes)
    np.testing.assert_array_equal(found.seen_THW, seen)
    blank = View(jnp.where(seen[..., None], rgb, 0), jnp.where(seen, depth, 0), seen)
    np.testing.assert_array_equal(found.latents_thwC, encode(params, blank).latents_thwC)
    far = jnp.full((1, 1, 16, 24), model.clip.far_m)
    empty = encode_rgbd(model, params, jnp.zeros((1, 1, 16, 24, 3)), far)[0, 0]
    np.testing.assert_allclose(found.latents_thwC[1], empty, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["features, attended to", "picture"])
def test_a_prepared_batch_has_the_same_loss(kind):
    model, params, clips = model_of(kind), weights(kind), batch()
    stage, config = pewm.STAGES[1], Config(model=model)
    ready = jax.jit(lambda p, c: stage.prepare(model, p, c))(params, clips)
    assert ready.context.depth_THW.size == 0
    assert ready.extras["readout"].view is None
    loss = jax.jit(lambda p, c: stage.loss(model, config.train, p, c, jax.random.key(1))[0])
    np.testing.assert_allclose(loss(params, ready), loss(params, clips), rtol=1e-4)


def test_any_codec_encodes_the_picture_and_pixels_are_as_before():
    memory = PointsConfig(capacity=512, tokens=32, reader=LATENTS)
    model = tiny_model(memory=memory)  # the pixel codec, which folds four frames
    made = jax.eval_shape(functools.partial(objective.clip_readout, model, {}), nine())
    assert made.encoded.latents_thwC.shape == (2, *model.latent_shape, model.codec.channels)
    params = jax.eval_shape(functools.partial(world_model.init, model), jax.random.key(0))
    per_cell = model.codec.channels + 4 * 4 * 4
    assert params["memory"]["render"]["embed_1"]["kernel"].shape == (4 * per_cell, 16)
    plain = tiny_model(memory=dataclasses.replace(memory, reader=RENDER))
    params = jax.eval_shape(functools.partial(world_model.init, plain), jax.random.key(0))
    assert params["memory"]["render"]["embed_1"]["kernel"].shape == (4 * 5 * 64, 16)


def nine():
    """Shapes of two clips of nine frames."""
    frames = jax.tree.map(lambda x: jnp.concatenate([x, x[:, :4]], 1), batch().frames)
    return Clip(frames, frames, jnp.ones((2, 9), bool))


@pytest.mark.slow
def test_an_exported_denoiser_takes_the_encoded_picture():
    model = model_of("picture")
    params = jax.eval_shape(functools.partial(world_model.init, model), jax.random.key(0))
    program = stablehlo_programs.denoise_program(Config(model=model), params)
    shown = {name for name in program.inputs if name.split("/")[0] in ("tokens", "view", "encoded")}
    assert shown == {"encoded/latents_thwC", "encoded/seen_THW"}
    made = jax.eval_shape(program.function, tree.flatten(params), program.inputs)
    assert made["prediction_BthwC"].shape == (1, *GRID, 8)


def test_clips_prepared_before_there_was_a_choice_are_found(monkeypatch):
    """The name of their folder depends on the picture only where it is not the pixels."""
    told = []
    dumps = json.dumps
    monkeypatch.setattr(feed.json, "dumps", lambda x, **k: told.append(x) or dumps(x, **k))
    monkeypatch.setattr(feed, "read_manifest", lambda _: type("Manifest", (), {"shards": ()}))
    names = set()
    for reader in (RENDER, LATENTS):
        model = tiny_model(memory=dataclasses.replace(SURFELS, reader=reader))
        config = Config(model=model, data=DataConfig(prepared=2, prepared_path="there"))
        names.add(feed._folder(config, pewm.STAGES[1], {}))
    assert len(names) == 2
    pictures = [facts["model"]["memory"]["reader"].get("picture") for facts in told]
    assert pictures == [None, "latents"]


@pytest.mark.parametrize(
    ("sections", "says"),
    [
        ({"codec": PixelConfig(), "memory": VOXELS}, "the codec folds 4 frames into one"),
        (
            {"memory": dataclasses.replace(VOXELS, encoder=LatentsConfig())},
            "latents have 4 channels for 8 pix",
        ),
        ({"memory": dataclasses.replace(VOXELS, reader=LATENTS)}, "this memory shows features"),
        (
            {
                "memory": dataclasses.replace(
                    SURFELS, features=True, encoder=ENCODER, reader=LATENTS
                )
            },
            "this memory shows features",
        ),
    ],
)
def test_models_that_do_not_fit_are_refused_in_a_sentence(sections, says):
    with pytest.raises(ConfigError, match=says) as refusal:
        dataclasses.replace(model_of("picture"), **sections)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).endswith(".")


def test_what_has_no_meaning_is_refused_in_a_sentence():
    with pytest.raises(ConfigError, match=r"picture is 'words'; choose pixels or latents\."):
        RenderConfig(picture="words")
    with pytest.raises(ConfigError, match=r"memory\.encoder\.spatial"):
        LatentsConfig(spatial=0)
    model = model_of("features, rendered")
    with pytest.raises(ConfigError, match=r"no cache is kept: leave data\.features empty"):
        Config(model=model, data=DataConfig(features="kept"))
    with pytest.raises(ConfigError, match="keeps colours alone"):
        CodecTask(memory=dataclasses.replace(SURFELS, encoder=ENCODER))
    with pytest.raises(UserError, match="are not kept in a cache"):
        feature_cache.fingerprint(ENCODER, {}, None)
    with pytest.raises(UserError, match="takes the weights of the codec"):
        ENCODER.encode({}, np.zeros((1, 16, 24, 3)))
    assert Config(model=TINY, data=DataConfig(features="kept")).model.memory.encoder == (
        PatchColoursConfig()
    )
    assert kinds.of(ENCODER).name == "latents"
