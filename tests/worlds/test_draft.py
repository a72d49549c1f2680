"""A model that refines the frames of a finished network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.codecs import rgbd
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import Config, ConfigError, TrainConfig, UserError
from pewm_jax.config.parts import Draft
from pewm_jax.convert import stablehlo
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.io import tree, weights
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.train import loading, runs
from pewm_jax.worlds import draft as drafts
from pewm_jax.worlds import quantized, world_model
from pewm_jax.worlds.draft import NetworkDraft
from pewm_jax.worlds.stages import TRAIN
from tests.helpers import TINY, random_camera, random_frames, random_world, tiny_model
from tests.train.test_prepared import a_batch

KEY = jax.random.key(3)
READER = RenderConfig(picture_width=8)
DRAFT = NetworkDraft(
    codec=PixelConfig(spatial=2, temporal=1, gate=8),
    backbone=dataclasses.replace(TINY.backbone, layers=1),
    reader=READER,
    noise=DDPMConfig(sample_steps=1),
    alone=0.5,
)
MODEL = tiny_model(
    codec=PixelConfig(spatial=4, temporal=1, gate=8),
    memory=SurfelConfig(
        cell_m=(0.3, 0.3, 0.3), cells=(24, 24, 8), capacity=512, tokens=32, reader=READER
    ),
    noise=EDMConfig(sample_steps=2, sigma_min=0.1, sigma_max=1.0),
    observed="drafted",
    draft=DRAFT,
)
CAMERA = random_camera(np.random.default_rng(2), 8, upright=True)


def started(params):
    return worlds.start(MODEL, params, random_frames(np.random.default_rng(0), 3))


def only_the_draft(params):
    """Weights whose denoiser keeps its input, and whose gate takes all that is rendered."""
    out = jax.tree.map(jnp.zeros_like, params["codec"]["gate"]["out"])
    bias = jnp.tile(jnp.array([40.0, 40.0, 0.0, 0.0, 0.0, 0.0]), 4)
    return {**params, "codec": {"gate": {**params["codec"]["gate"], "out": {**out, "bias": bias}}}}


def test_the_settings_survive_json():
    config = Config(model=MODEL)
    assert configuration.from_dict(Config, configuration.to_dict(config)) == config


def test_the_first_network_has_the_memory_and_the_control_of_the_model():
    own = DRAFT.of(MODEL)
    assert (own.clip, own.control) == (MODEL.clip, MODEL.control)
    assert own.memory == MODEL.memory
    assert own.observed == "first"
    assert not own.draft.PREDICTS
    shapes = jax.eval_shape(MODEL.init, KEY)
    alone = jax.eval_shape(own.init, KEY)
    assert jax.tree.map(jnp.shape, shapes["draft"]) == jax.tree.map(jnp.shape, alone)


def test_a_draft_is_what_the_first_network_imagines():
    params = random_world(MODEL)
    state = started(params)
    made = jax.jit(drafts.predict, static_argnums=0)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b])[None], state.frame.camera, CAMERA)
    shown = world_model.memories.readout(
        MODEL, state.map, jax.tree.map(lambda x: x[0], whole), pictures=True
    )
    readout = jax.tree.map(lambda x: x[None], shown)
    present = jax.tree.map(lambda x: x[None], state.frame)
    control = drafts.Control(whole)
    found = made(MODEL, params, present, control, readout)
    rgb, depth = rgbd.decode_rgbd(MODEL, params, found[..., :-1])

    own = DRAFT.of(MODEL)
    seen, masks = shown.view.seen_THW, np.asarray(found[0, ..., -1])
    np.testing.assert_allclose(masks, seen.reshape(9, 4, 4, 6, 4).mean((2, 4)), atol=1e-6)

    fixed = (1, *own.latent_shape, own.codec.channels)
    noise = jax.random.normal(jax.random.key(drafts.NOISE_KEY), fixed[1:])[None]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.random, "normal", lambda _, shape: noise if shape == fixed else None)
        _, frames = own.imagine_clip(
            params["draft"], state, drafts.Control(CAMERA), KEY, remember=False
        )
    np.testing.assert_allclose(rgb[0, 1:], frames.rgb_THWC, atol=1e-4)
    np.testing.assert_allclose(depth[0, 1:], frames.depth_THW, atol=1e-3)


def test_the_gate_blends_the_draft_in_where_the_memory_shows_something():
    params = only_the_draft(random_world(MODEL))
    state = started(params)
    _, first = worlds.imagine(MODEL, params, state, CAMERA, KEY, remember=False)
    _, other = worlds.imagine(MODEL, params, state, CAMERA, jax.random.key(9), remember=False)
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), state.frame.camera, CAMERA)
    seen = world_model.memories.readout(MODEL, state.map, whole, pictures=True).view.seen_THW[1:]
    apart = np.abs(first.rgb_THWC - other.rgb_THWC).max(-1)
    assert seen.any()
    np.testing.assert_allclose(apart[np.asarray(seen)], 0, atol=1e-5)
    assert apart[~np.asarray(seen)].max() > 0.05


def test_sampling_starts_from_the_draft():
    noise = EDMConfig(sample_steps=1, sigma_max=0.5, sigma_min=0.1)
    start = jnp.full((1, 2, 2, 2, 3), 0.7)

    def twice(x, times, weight):
        del times, weight
        return 2 * x

    unit = jnp.ones_like(start)
    np.testing.assert_allclose(noise.sample(twice, unit, start=start), 2 * (0.7 + 0.5))
    np.testing.assert_allclose(noise.sample(twice, unit), 2 * 0.5)


def test_without_a_memory_the_draft_is_made_of_the_present_frame_alone():
    params = random_world(MODEL)
    state = started(params)
    alone = worlds.start(MODEL, params, as_signal(state.frame))
    control = CAMERA
    _, one = worlds.imagine(MODEL, params, state, control, KEY, memory=False, remember=False)
    _, two = worlds.imagine(MODEL, params, alone, control, KEY, remember=False)
    np.testing.assert_allclose(one.rgb_THWC, two.rgb_THWC, atol=1e-4)
    _, full = worlds.imagine(MODEL, params, state, control, KEY, remember=False)
    assert np.abs(full.rgb_THWC - one.rgb_THWC).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 11])
def test_frames_that_are_asked_for_are_imagined_alone_from_the_draft_of_the_whole_clip(count):
    alone = dataclasses.replace(MODEL, asked_alone=True)
    params = only_the_draft(random_world(MODEL))
    state = started(params)
    moves = jnp.tile(jnp.asarray([[0.1, 0.0, 0.1]]), (count, 1))
    now, few = worlds.imagine(alone, params, state, moves, KEY)
    _, whole = worlds.imagine(MODEL, params, state, moves, KEY)
    assert few.rgb_THWC.shape == whole.rgb_THWC.shape
    np.testing.assert_allclose(now.frame.rgb_THWC, few.rgb_THWC[-1:], atol=1e-6)
    rest = count % 8
    start = worlds.imagine(MODEL, params, state, moves[:-rest], KEY)[0] if count > 8 else state
    whole_camera = jax.tree.map(
        lambda a, b: jnp.concatenate([a, b[-rest:]]), start.frame.camera, few.camera
    )
    view = world_model.memories.readout(MODEL, start.map, whole_camera, pictures=True).view
    seen = np.asarray(view.seen_THW[1:])
    assert seen.any()
    # Where the memory shows something the gate takes the draft, which is that of the whole clip.
    np.testing.assert_allclose(few.rgb_THWC[-rest:][seen], whole.rgb_THWC[-rest:][seen], atol=1e-4)
    assert np.abs(few.rgb_THWC[-rest:] - whole.rgb_THWC[-rest:])[~seen].max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("memory", [True, False])
def test_the_last_frame_of_candidates_alone(memory):
    alone = dataclasses.replace(MODEL, asked_alone=True)
    params = random_world(MODEL)
    state = started(params)
    moves = jnp.asarray([[[0.1, 0.0, 0.3]], [[0.2, 0.0, -0.2]]])
    keys = jax.random.split(KEY, 2)
    given = {"memory": memory, "last": True}
    _, many = worlds.imagine_many(alone, params, state, moves, keys, **given)
    for row in range(2):
        _, frames = worlds.imagine(
            alone, params, state, moves[row], keys[row], remember=False, memory=memory
        )
        # A candidate's key is split for its clips, one here, in both.
        np.testing.assert_allclose(many.rgb_THWC[row], frames.rgb_THWC, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("memory", [True, False])
def test_candidates_equal_imagination(memory):
    params = random_world(MODEL)
    state = started(params)
    moves = jnp.asarray([[0, 1, 0], [2, 0, 0]])
    keys = jax.random.split(KEY, 2)
    _, many = worlds.imagine_many(MODEL, params, state, moves, keys, memory=memory)
    for row in range(2):
        _, frames = worlds.imagine(
            MODEL, params, state, moves[row], keys[row], remember=False, memory=memory
        )
        np.testing.assert_allclose(many.rgb_THWC[row], frames.rgb_THWC, atol=2e-4)


def test_the_draft_is_frozen_in_every_stage():
    params = jax.eval_shape(MODEL.init, KEY)
    for stage in worlds.stages(MODEL)[1:4]:
        labels = tree.flatten(stage.labels(params))
        trained = {path for path, label in labels.items() if label == TRAIN}
        assert not any(path.startswith("draft/") for path in trained)
        assert "draft" in stage.prepares_by


@pytest.mark.slow
@pytest.mark.parametrize("chained", [0.0, 0.5])
def test_a_prepared_batch_has_the_same_loss(chained):
    config = Config(model=MODEL, train=TrainConfig(chained=chained))
    params, clip = random_world(MODEL), a_batch(config, 2)
    for stage in worlds.stages(config)[1:4]:
        ready = jax.jit(lambda p, c, s=stage: s.prepare(MODEL, p, c))(params, clip)
        if stage.name == "gate":
            assert ready.extras["readout"].view.features_THWF.shape[-1] == 3
            continue
        loss = jax.jit(lambda p, c, s=stage: s.loss(MODEL, config.train, p, c, KEY)[0])
        np.testing.assert_allclose(loss(params, ready), loss(params, clip), rtol=1e-5)


def test_a_share_of_the_clips_remembers_the_present_frame_alone():
    clip = a_batch(Config(model=MODEL), 40)
    valid = np.ones((40, 3), bool)
    valid[:, 2] = False
    clip = dataclasses.replace(clip, context_valid_S=valid)
    kept = np.asarray(drafts.drop_context(MODEL, clip).context_valid_S)
    assert set(map(tuple, kept)) == {(True, True, False), (False, True, False)}
    assert 8 < (~kept[:, 0]).sum() < 32
    again = np.asarray(
        drafts.drop_context(MODEL, jax.tree.map(lambda x: x[5:9], clip)).context_valid_S
    )
    np.testing.assert_array_equal(again, kept[5:9])


def test_the_weights_of_the_draft_are_those_of_a_run(tmp_path):
    own = DRAFT.of(MODEL)
    params = random_world(MODEL)
    for name, model, given in (("first", own, params["draft"]), ("second", MODEL, params)):
        folder = tmp_path / name
        folder.mkdir()
        configuration.save(Config(model=model), folder / "config.json")
        weights.save(folder / "weights.safetensors", given, {})
    other = random_world(own, seed=5)
    weights.save(tmp_path / "first" / "weights.safetensors", other, {})
    train = TrainConfig(start=str(tmp_path / "first"), start_draft=str(tmp_path / "first"))
    found = loading.read_weights(Config(model=MODEL, train=train), worlds.stages(MODEL)[2], print)
    assert jax.tree.all(jax.tree.map(np.array_equal, found["draft"], dict(other)))
    train = dataclasses.replace(train, start=str(tmp_path / "second"))
    found = loading.read_weights(Config(model=MODEL, train=train), worlds.stages(MODEL)[2], print)
    assert jax.tree.all(jax.tree.map(np.array_equal, found["draft"], params["draft"]))


def test_the_draft_can_be_kept_in_8_bits():
    params = random_world(MODEL)
    small = quantized.quantize(MODEL, params, "int8")
    assert quantized.bytes_of(small["draft"]["backbone"]) < quantized.bytes_of(
        params["draft"]["backbone"]
    )
    assert jax.tree.all(
        jax.tree.map(np.array_equal, small["draft"]["codec"], params["draft"]["codec"])
    )
    state = started(params)
    _, one = worlds.imagine(MODEL, params, state, CAMERA, KEY, remember=False)
    _, two = worlds.imagine(MODEL, small, state, CAMERA, KEY, remember=False)
    assert np.abs(one.rgb_THWC - two.rgb_THWC).mean() < 0.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observed": "warped"}, "go together"),
        ({"draft": Draft()}, "go together"),
        ({"noise": DDPMConfig()}, "cannot start"),
        ({"draft": dataclasses.replace(DRAFT, reader=AttentionConfig())}, "takes points"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(MODEL, **changes)


def test_a_share_outside_of_0_to_1_is_refused():
    with pytest.raises(ConfigError, match="alone"):
        dataclasses.replace(DRAFT, alone=1.5)


def test_stage_1_is_refused():
    with pytest.raises(UserError, match=r"train\.stage1\.steps is above 0"):
        runs.planned(Config(model=MODEL))


def test_training_needs_the_weights_of_a_draft(tmp_path):
    own, stage = DRAFT.of(MODEL), worlds.stages(MODEL)[2]
    configuration.save(Config(model=own), tmp_path / "config.json")
    weights.save(tmp_path / "weights.safetensors", random_world(own), {})
    with pytest.raises(UserError, match=r"set train\.start .* and train\.start_draft"):
        loading.require_weights(Config(model=MODEL))
    train = TrainConfig(start=str(tmp_path))
    with pytest.raises(UserError, match=r"has no draft: set train\.start_draft"):
        loading.read_weights(Config(model=MODEL, train=train), stage, print)
    other = dataclasses.replace(DRAFT, backbone=dataclasses.replace(DRAFT.backbone, layers=2))
    model = dataclasses.replace(MODEL, draft=other)
    missing = dataclasses.replace(train, start_draft=str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match=r"train\.start_draft is .*nowhere, which has no weights"):
        loading.require_weights(Config(model=MODEL, train=missing))
    train = dataclasses.replace(train, start_draft=str(tmp_path))
    with pytest.raises(UserError, match=r"\(train\.start_draft\) do not fit model\.draft \(back"):
        loading.read_weights(Config(model=model, train=train), stage, print)


def test_one_step_of_a_model_with_a_draft_is_not_exported():
    with pytest.raises(UserError, match="export its rollout"):
        stablehlo.denoise_program(Config(model=MODEL), {})
