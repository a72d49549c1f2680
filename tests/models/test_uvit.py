"""The U-ViT: what it is at the start, what reaches which pixels, and that a world runs with it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets, worlds
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ConfigError, StageConfig, TrainConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.memory import interface as memories
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.models.interface import Conditioning, Readers
from pewm_jax.models.uvit import UViTBackbone
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.train import runs
from pewm_jax.types import Clip
from pewm_jax.worlds import objective
from tests.helpers import TINY, init_world, random_frames, random_world, randomise, tiny_config

UVIT = UViTBackbone(
    layers=2, heads=2, head_dim=16, text_length=3, text_dim=8, time_dim=16, channels=12, blocks=1
)
MODEL = dataclasses.replace(
    TINY,
    codec=PixelConfig(spatial=2, temporal=1, gate=8),
    backbone=UVIT,
    memory=SurfelConfig(
        cell_m=(0.2, 0.2, 0.2), capacity=2048, reader=RenderConfig(picture_width=8, blocks=False)
    ),
    noise=EDMConfig(sample_steps=2),
    observed="warped",
)
IN, OUT = 6, 4


def draw(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


APPLY = jax.jit(
    lambda params, x, times, given, added: UVIT.apply(
        params, x, times, given, Readers(added_BthwC=added)
    )
)


def predict(params, x, times, readers=None):
    given = Conditioning(joined_BthwC=draw(9, *x.shape[:-1], IN - OUT))
    added = None if readers is None else readers.added_BthwC
    return APPLY(params, x, times, given, added)


@pytest.fixture(scope="module")
def params():
    return randomise(UVIT.init(jax.random.key(0), IN, OUT))


def test_a_fresh_network_predicts_zero_and_a_trained_one_does_not(params):
    x, times = draw(0, 2, 3, 8, 12, OUT), jnp.array([0.1, 2.0])
    fresh = UVIT.init(jax.random.key(0), IN, OUT)
    np.testing.assert_array_equal(predict(fresh, x, times), jnp.zeros_like(x))
    made = predict(params, x, times)
    assert made.shape == x.shape
    assert float(jnp.abs(made).min(-1).max()) > 0
    assert not np.allclose(made, predict(params, x, times[::-1]))


def test_times_of_single_frames_are_those_of_the_clip_if_they_are_equal(params):
    x, times = draw(0, 2, 3, 8, 12, OUT), jnp.array([0.1, 2.0])
    per_frame = jnp.broadcast_to(times[:, None], (2, 3))
    wanted = predict(params, x, times)
    np.testing.assert_allclose(predict(params, x, per_frame), wanted, atol=1e-5)
    other = predict(params, x, per_frame.at[:, 1].set(0.7))
    assert not np.allclose(other[:, 1], wanted[:, 1], atol=1e-3)


def test_one_pixel_reaches_all_frames_through_the_transformer_alone(params):
    x, times = draw(0, 1, 3, 16, 16, OUT), jnp.array([0.5])
    moved = x.at[0, 0, 0, 0].add(1.0)
    changed = jnp.abs(predict(params, moved, times) - predict(params, x, times)).max(-1)[0]
    assert (changed > 0).all()
    inner = params["transformer"]
    cut = jax.tree.map(jnp.zeros_like, inner["proj_out"])
    without = params | {"transformer": inner | {"proj_out": cut}}
    changed = jnp.abs(predict(without, moved, times) - predict(without, x, times)).max(-1)[0]
    assert (changed[0, :6, :6] > 0).any()
    assert not changed[1:].any()
    assert not changed[0, 6:].any()  # five convolutions of 3 × 3


def test_what_is_added_at_a_cell_is_seen_at_once(params):
    x, times = draw(0, 1, 2, 8, 8, OUT), jnp.array([0.5])
    added = jnp.zeros((1, 2, 8, 8, UVIT.channels)).at[0, 1, 3, 4].set(1.0)
    base = predict(params, x, times, Readers(added_BthwC=jnp.zeros_like(added)))
    np.testing.assert_array_equal(base, predict(params, x, times))
    changed = jnp.abs(predict(params, x, times, Readers(added_BthwC=added)) - base).max(-1)
    assert jnp.unravel_index(changed.argmax(), changed.shape) == (0, 1, 3, 4)


LOSSES = {
    name: jax.jit(getattr(objective, name), static_argnums=(0, 1))
    for name in ("with_memory", "without_memory", "joint")
}


def loss_of(stage, *given):
    return LOSSES[stage](*given)[0]


def clips(batch=2, frames=9):
    rng = np.random.default_rng(0)
    made = [
        Clip(random_frames(rng, frames), random_frames(rng, 3), np.ones(3, bool))
        for _ in range(batch)
    ]
    return jax.tree.map(lambda *x: np.stack(x), *made)


def test_a_world_imagines_and_learns_with_it_and_reads_its_memory_at_every_cell():
    params = random_world(MODEL)
    assert params["memory"]["render"]["cell_2"]["kernel"].shape == (12, 12)
    rng = np.random.default_rng(1)
    state = worlds.start(MODEL, params, random_frames(rng, 3))
    camera = random_frames(rng, 4).camera
    _, frames = worlds.imagine(MODEL, params, state, camera, jax.random.key(0))
    assert frames.rgb_THWC.shape == (4, 16, 24, 3)
    assert np.isfinite(frames.depth_THW).all()
    clip, key = clips(), jax.random.key(1)

    def loss(params):
        return objective.with_memory(MODEL, TrainConfig(), params, clip, key)[0]

    gradients = jax.jit(jax.grad(loss))(params)
    assert float(jnp.abs(gradients["memory"]["render"]["cell_1"]["kernel"]).max()) > 0
    assert float(jnp.abs(gradients["backbone"]["into"]["kernel"]).max()) > 0


@pytest.mark.slow
def test_a_fresh_reader_changes_nothing_and_hidden_memories_are_not_read():
    clip, key = clips(), jax.random.key(1)
    readout = objective.clip_readout(MODEL, random_world(MODEL), clip)

    def loss(params, kept):
        shown = objective.hide_readout(readout, kept)
        given = clip.with_extras(readout=shown)
        return loss_of("with_memory", MODEL, TrainConfig(), params, given, key)

    kept, trained = jnp.ones(2, bool), random_world(MODEL)
    fresh = trained | {"memory": init_world(MODEL)["memory"]}
    blind = loss_of("without_memory", MODEL, TrainConfig(), fresh, clip, key)
    np.testing.assert_allclose(loss(fresh, kept), blind, rtol=1e-5)
    assert abs(float(loss(trained, kept) - loss(trained, ~kept))) > 1e-4
    np.testing.assert_allclose(loss(trained, ~kept), loss(fresh, ~kept), rtol=1e-5)


@pytest.mark.slow
def test_blocks_read_too():
    reader = RenderConfig(picture_width=8)
    model = dataclasses.replace(MODEL, memory=dataclasses.replace(MODEL.memory, reader=reader))
    clip, key = clips(), jax.random.key(1)
    params = random_world(model)
    fewer = params | {
        "memory": {"render": {k: v for k, v in params["memory"]["render"].items() if k != "blocks"}}
    }
    with_blocks = loss_of("with_memory", model, TrainConfig(), params, clip, key)
    without = loss_of("with_memory", MODEL, TrainConfig(), fewer, clip, key)
    assert abs(float(with_blocks - without)) > 1e-4


@pytest.mark.slow
def test_attention_reads_tokens_and_no_cells():
    reader = AttentionConfig(heads=2, head_dim=8)
    model = dataclasses.replace(MODEL, memory=dataclasses.replace(TINY.memory, reader=reader))
    value = loss_of(
        "with_memory", model, TrainConfig(), random_world(model), clips(), jax.random.key(0)
    )
    assert np.isfinite(value)
    assert not memories.gated(model)


def test_frames_of_several_latent_frames_are_refused():
    with pytest.raises(ConfigError, match="patch_t is 2"):
        dataclasses.replace(MODEL, backbone=dataclasses.replace(UVIT, patch_t=2))
    with pytest.raises(ConfigError, match=r"backbone\.channels"):
        dataclasses.replace(UVIT, channels=0)


TRAINS = TrainConfig(joint=StageConfig(frames=2))


def test_drawn_frames_are_the_observed_one_and_others_in_order():
    clip = objective.prepare(MODEL, random_world(MODEL), clips(), memory=True)
    numbered = jnp.broadcast_to(jnp.arange(9.0)[None, :, None, None], clip.frames.depth_THW.shape)
    clip = dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, depth_THW=numbered))
    found = set()
    for seed in range(12):
        model, drawn = objective.draw_frames(MODEL, clip, 3, jax.random.key(seed))
        assert model.latent_shape[0] == 4
        rows = np.asarray(drawn.frames.depth_THW[0, :, 0, 0]).astype(int)
        assert rows[0] == 0
        assert (np.diff(rows) > 0).all()
        found |= set(rows.tolist())
        for name in ("latents_thwC", "everywhere_thwC"):
            np.testing.assert_array_equal(drawn.extras[name], clip.extras[name][:, rows])
        shown, wanted = drawn.extras["readout"].view, clip.extras["readout"].view
        np.testing.assert_array_equal(shown.seen_THW, wanted.seen_THW[:, rows])
        pose = clip.frames.camera.world_from_camera[:, rows]
        np.testing.assert_array_equal(drawn.frames.camera.world_from_camera, pose)
    assert found == set(range(9))


@pytest.mark.slow
def test_a_step_of_drawn_frames_has_the_loss_of_these_frames_prepared_or_not():
    params, clip, key = random_world(MODEL), clips(), jax.random.key(4)
    prepared = objective.prepare(MODEL, params, clip, memory=True)
    chained = dataclasses.replace(TRAINS, chained=0.5)
    wanted = loss_of("joint", MODEL, TRAINS, params, clip, key)
    for train, given in ((TRAINS, prepared), (chained, clip)):
        value = loss_of("joint", MODEL, train, params, given, key)
        np.testing.assert_allclose(value, wanted, rtol=1e-5)
    model, drawn = objective.draw_frames(MODEL, clip, 2, jax.random.fold_in(key, 9))
    by_hand = loss_of("joint", model, TrainConfig(), params, drawn, key)
    np.testing.assert_allclose(by_hand, wanted, rtol=1e-5)


@pytest.mark.slow
def test_a_share_of_the_steps_takes_whole_clips():
    params, clip = random_world(MODEL), clips()
    mixed = dataclasses.replace(TRAINS, joint=StageConfig(frames=2, whole=0.5))

    def losses(train):
        keys = map(jax.random.key, range(6))
        return [float(loss_of("joint", MODEL, train, params, clip, key)) for key in keys]

    whole, few, both = losses(TrainConfig()), losses(TRAINS), losses(mixed)
    taken = [abs(b - w) < abs(b - f) for b, w, f in zip(both, whole, few, strict=True)]
    assert 0 < sum(taken) < 6
    wanted = [w if take else f for w, f, take in zip(whole, few, taken, strict=True)]
    np.testing.assert_allclose(both, wanted, rtol=1e-5)


def test_frames_are_not_drawn_where_a_stage_or_a_codec_cannot():
    few = StageConfig(frames=2)
    with pytest.raises(ConfigError, match=r"train\.gate\.frames is 2.*whole clips"):
        tiny_config(codec=MODEL.codec, train=TrainConfig(gate=few))
    with pytest.raises(ConfigError, match="codec of single frames"):
        tiny_config(train=TrainConfig(joint=few))
    with pytest.raises(ConfigError, match=r"frames is 9, and a clip of 9 frames imagines 8"):
        tiny_config(codec=MODEL.codec, train=TrainConfig(joint=StageConfig(frames=9)))
    with pytest.raises(ConfigError, match="share from 0 to 1"):
        StageConfig(frames=2, whole=1.5)
    with pytest.raises(ConfigError, match=r"whole is 0\.25, and frames is 0"):
        StageConfig(whole=0.25)
    persist = presets.load("persist_tiny")
    train = dataclasses.replace(persist.train, renderer=StageConfig(frames=2))
    with pytest.raises(ConfigError, match=r"train\.renderer\.frames is 2.*whole clips"):
        dataclasses.replace(persist, train=train)


@pytest.mark.slow
@pytest.mark.parametrize("count", [11, 8, 3])
def test_the_last_frame_of_candidates_can_be_imagined_alone(count):
    """As by a model of two frames; clips between are skipped, and views that are given are used."""
    params, rng = random_world(MODEL), np.random.default_rng(1)
    state = worlds.start(MODEL, params, random_frames(rng, 3))
    one = random_frames(rng, count).camera
    cameras = jax.tree.map(lambda x: np.stack([x, x]), one)
    keys = jax.random.split(jax.random.key(0), 2)
    alone = dataclasses.replace(MODEL, asked_alone=True)
    views = alone.views(params, state)(cameras)

    def last(model, cameras, views=None):
        made = worlds.imagine_many(model, params, state, cameras, keys, last=True, views=views)
        return made[1]

    made, rendered = last(alone, cameras), last(alone, cameras, views)
    assert made.rgb_THWC.shape == (2, 1, 16, 24, 3)
    np.testing.assert_allclose(made.rgb_THWC, rendered.rgb_THWC, atol=1e-4)
    short = dataclasses.replace(MODEL, clip=dataclasses.replace(MODEL.clip, frames=2))
    ends = sorted({min(k * 8, count) for k in range(1, -(-count // 8) + 1)})
    skipped = jax.tree.map(lambda x: x[:, np.array(ends) - 1], cameras)
    wanted = last(short, skipped)
    np.testing.assert_allclose(made.rgb_THWC, wanted.rgb_THWC, atol=1e-4)
    whole = last(MODEL, cameras)
    assert not np.allclose(made.rgb_THWC, whole.rgb_THWC, atol=1e-3)


def test_frames_are_imagined_alone_only_with_cameras_and_codecs_of_single_frames():
    with pytest.raises(ConfigError, match="codec of single frames"):
        dataclasses.replace(TINY, asked_alone=True)


def test_asked_alone_may_change_when_a_run_is_resumed():
    config = tiny_config(codec=MODEL.codec)
    alone = config.with_model(asked_alone=True)
    assert configuration.to_dict(alone) != configuration.to_dict(config)
    assert runs.identity(alone) == runs.identity(config)
