import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import ConfigError, UserError
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox import model as dit_block
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.config import PUBLISHED
from pewm_jax.nn import layers
from pewm_jax.nn.tokens import TokenLayout, patchify, unpatchify
from pewm_jax.types import MemoryReadout
from pewm_jax.worlds import world_model
from tests.helpers import TINY, random_world, randomise
from tests.properties import examples
from tests.worlds.test_world_model import setup as world

CONFIG = dataclasses.replace(TINY.backbone, in_channels=5, out_channels=7)


def inputs(config=CONFIG, shape=(3, 4, 6), seed=0):
    rng = np.random.default_rng(seed)
    latents = jnp.asarray(rng.normal(size=(2, *shape, config.in_channels)), jnp.float32)
    text = jnp.asarray(rng.normal(size=(2, config.text_length, config.text_dim)), jnp.float32)
    return latents, text, jnp.array([10, 900])


def random_params(config=CONFIG):
    shapes = jax.eval_shape(lambda: dit.init(config, jax.random.key(0)))
    return randomise(jax.tree.map(lambda x: jnp.zeros(x.shape), shapes))


run = jax.jit(dit.apply, static_argnums=0, static_argnames="memory_block")


@examples(15)
@given(
    t=st.integers(1, 3),
    h=st.integers(1, 3),
    w=st.integers(1, 3),
    p=st.integers(1, 3),
    p_t=st.integers(1, 3),
    c=st.integers(1, 3),
)
def test_unpatchify_inverts_patchify(t, h, w, p, p_t, c):
    latents = np.random.default_rng(0).normal(size=(2, t * p_t, h * p, w * p, c))
    tokens = patchify(latents, p, p_t)
    assert tokens.shape == (2, t * h * w, c * p_t * p * p)
    np.testing.assert_array_equal(unpatchify(tokens, t * p_t, h * p, w * p, p, p_t), latents)
    np.testing.assert_array_equal(patchify(latents, (p, p), p_t), tokens)
    whole = (h * p, 1)
    tokens = patchify(latents, whole, p_t)
    assert tokens.shape == (2, t * w * p, c * p_t * h * p)
    np.testing.assert_array_equal(unpatchify(tokens, t * p_t, h * p, w * p, whole, p_t), latents)


def test_a_fresh_network_predicts_zero():
    params = jax.jit(dit.init, static_argnums=0)(CONFIG, jax.random.key(0))
    out = run(CONFIG, params, *inputs())
    assert out.shape == (2, 3, 4, 6, 7)
    np.testing.assert_array_equal(out, 0)


def test_samples_of_a_batch_do_not_see_each_other():
    latents, text, times = inputs()
    params = random_params()
    both = run(CONFIG, params, latents, text, times)
    other = run(CONFIG, params, latents.at[0].add(1), text.at[0].add(1), times.at[0].add(9))
    np.testing.assert_array_equal(both[1], other[1])
    assert np.abs(both[0] - other[0]).max() > 1e-3


def test_everything_given_matters():
    params = random_params()
    latents, text, times = inputs()
    base = run(CONFIG, params, latents, text, times)
    for changed in (
        (latents.at[:, 0, 0, 0, 0].add(1), text, times),
        (latents, text.at[:, 0, 0].add(1), times),
        (latents, text, times + 50),
    ):
        out = run(CONFIG, params, *changed)
        assert np.abs(out - base)[:, -1, -1, -1].max() > 1e-6, "the far corner must hear of it"


def plain_loop(params, latents, text, times):
    """The same network without scan."""
    ends = dit.Ends(CONFIG, 7, jnp.dtype("float32"))
    rest = {"params": {k: v for k, v in params.items() if k != "blocks"}}
    tokens = patchify(latents, 2)
    tokens, time = ends.apply(rest, tokens, text, times, times, method="embed")
    length = CONFIG.text_length
    angles = positions.joint_angles(CONFIG, (3, 2, 3), length)
    layout = TokenLayout(parts=1, text=length, frames=3, patches=6)
    for i in range(CONFIG.layers):
        layer = jax.tree.map(lambda x, i=i: x[i], params["blocks"])
        tokens = dit_block.Block(CONFIG).apply({"params": layer}, tokens, time, angles, layout)
    out = ends.apply(rest, tokens[:, length:], time, method="project")
    return unpatchify(out, 3, 4, 6, 2)


def test_scan_and_remat_equal_a_plain_loop():
    params, given = random_params(), inputs()
    looped = jax.jit(plain_loop)(params, *given)
    np.testing.assert_allclose(run(CONFIG, params, *given), looped, atol=1e-5)
    remat = dataclasses.replace(CONFIG, remat=True)
    np.testing.assert_allclose(run(remat, params, *given), looped, atol=1e-5)


def add_gate(gate, video, time):
    """A memory block whose parameter is a number."""
    assert video.shape == (2, 18, CONFIG.width)
    return video + gate * time.mean()


def test_a_memory_block_reads_and_writes_the_video_tokens_alone():
    params, given = random_params(), inputs()
    plain = run(CONFIG, params, *given)

    @jax.jit
    def value_and_slope(gates):
        def out(gates):
            return dit.apply(CONFIG, params, *given, memory_block=add_gate, memory_params=gates)

        return out(gates), jax.grad(lambda g: out(g).std())(gates)

    closed, slope = value_and_slope(jnp.zeros(CONFIG.layers))
    np.testing.assert_allclose(closed, plain, atol=1e-6)
    assert np.all(np.abs(slope) > 0), "every layer's memory block is called"


def test_with_closed_memory_gates_stage_2_is_stage_1_and_feels_no_map():
    model, conditioning, tokens, noisy, times = world("sinusoid")
    params = random_world(model)
    stage1 = {"backbone": params["backbone"]}
    linear = params["memory"]["blocks"]["linear"]
    closed = jax.tree.map(jnp.zeros_like, linear)

    def out(linear, features):
        blocks = {**params["memory"]["blocks"], "linear": linear}
        memory = {**params["memory"], "blocks": blocks}
        seen = dataclasses.replace(tokens, features_MF=features)
        both = {**stage1, "memory": memory}
        return world_model.apply(model, both, noisy, conditioning, times, MemoryReadout(seen))

    @jax.jit
    def compare(linear):
        plain = world_model.apply(model, stage1, noisy, conditioning, times)
        slope = jax.grad(lambda *a: out(*a).std(), (0, 1))(linear, tokens.features_MF)
        return plain, out(linear, tokens.features_MF), slope

    plain, same, (gates, features) = compare(closed)
    np.testing.assert_allclose(same, plain, rtol=1e-5, atol=1e-6)
    assert not np.asarray(features).any(), "nothing of the map comes through"
    assert np.asarray(gates["bias"]).any(), "and the gates can open"
    _, other, (_, features) = compare(linear)
    assert np.abs(other - plain).max() > 1e-3
    assert np.asarray(features).any()


def test_rotary_embedding_makes_attention_relative():
    rng = np.random.default_rng(0)
    q, k = rng.normal(size=(2, 32)).astype(np.float32)
    angles = positions.rope_angles(np.arange(4), np.arange(5), np.arange(6), 32)
    angles = angles.reshape(4, 5, 6, 16)

    def product(a, b):
        return float(layers.rotate(q, angles[a]) @ layers.rotate(k, angles[b]))

    here = product((0, 1, 2), (2, 2, 3))
    np.testing.assert_allclose(product((1, 3, 4), (3, 4, 5)), here, rtol=1e-4)
    assert abs(here - product((0, 1, 2), (1, 2, 3))) > 1e-4


def refused(config, shape, **changes):
    """The sentence with which abstract inputs of this shape are refused."""
    text = jnp.zeros(changes.pop("text", (1, config.text_length, config.text_dim)))
    params = jax.eval_shape(lambda: dit.init(config, jax.random.key(0)))
    with pytest.raises(UserError) as caught:
        jax.eval_shape(
            lambda p: dit.apply(config, p, jnp.zeros((1, *shape)), text, jnp.zeros(1), **changes),
            params,
        )
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.endswith(".")
    return sentence


def small(name):
    """A published network with its sizes divided, everything else as published."""
    config = DiTBackbone.published(name)
    sample = {"sample_height": 4, "sample_width": 6, "sample_frames": 9}
    return dataclasses.replace(
        config, layers=1, heads=1, head_dim=16, text_dim=8, text_length=3, **sample
    )


@pytest.mark.parametrize(
    ("name", "shape", "says"),
    [
        ("5b", (2, 4, 5, 16), "multiples of 2"),
        ("5b", (2, 4, 6), "give (batch, t, h, w, channels)"),
        ("5b", (0, 4, 6, 16), "no size may be 0"),
        ("5b", (3, 4, 6, 32), "32 channels and this network takes 16"),
        ("5b-I2V", (3, 4, 6, 16), "16 channels and this network takes 32"),
        ("5b-I2V", (3, 6, 6, 32), "a table for latents of 3×4×6"),
        ("1.5-5B", (3, 4, 6, 16), "repeat the first latent frame 1 times"),
        ("1.5-5B", (2, 4, 8, 16), "larger than the 4×6"),
    ],
)
def test_illegal_latents_are_refused_in_a_sentence(name, shape, says):
    assert says in refused(small(name), shape)


def test_text_and_ofs_that_do_not_fit_are_refused():
    assert "8 channels" in refused(small("5b"), (1, 4, 6, 16), text=(1, 3, 9))
    assert "pad the prompt" in refused(small("5b-I2V"), (3, 4, 6, 32), text=(1, 4, 8))
    assert "1.5-5B-I2V" in refused(small("5b"), (1, 4, 6, 16), ofs_B=jnp.ones(1))


def test_the_second_scalar_is_two_unless_given():
    config = dataclasses.replace(small("1.5-5B-I2V"), time_dim=16, ofs_dim=16)
    params, given = random_params(config), inputs(config, (2, 4, 6))
    two = run(config, params, *given, jnp.full(2, 2.0))
    np.testing.assert_allclose(run(config, params, *given), two, rtol=1e-4, atol=1e-4)
    one = run(config, params, *given, jnp.array([2.0, 1.0]))
    moved = np.abs(one - two).max(axis=(1, 2, 3, 4))
    assert moved[0] == 0 < moved[1]


def test_channels_left_open_need_a_world_model():
    with pytest.raises(UserError, match="set both"):
        dit.init(DiTBackbone(), jax.random.key(0))


def test_published_networks_have_the_sizes_of_their_names():
    billions = {"2b": 1.7, "5b": 5.6, "5b-I2V": 5.6, "1.5-5B": 5.6, "1.5-5B-I2V": 5.6}
    for name in PUBLISHED:
        shapes = jax.eval_shape(
            lambda n=name: dit.init(DiTBackbone.published(n), jax.random.key(0))
        )
        count = sum(x.size for x in jax.tree.leaves(shapes))
        assert abs(count / 1e9 - billions[name]) < 0.1, (name, count)
    with pytest.raises(ConfigError, match="choose one of 2b"):
        DiTBackbone.published("3b")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"positions": "rope_crop"}, "sample_height is 0"),
        ({"patch_t": 2, "positions": "sincos"}, "patch_t is 2"),
        ({"ofs_dim": 7}, "ofs_dim is 7"),
        ({"positions": "sincos", "head_dim": 12, "heads": 1}, "heads × head_dim is 12"),
        ({"spatial_interpolation": 0.0}, "above 0"),
        ({"in_channels": -1}, "0 or more"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes, says):
    with pytest.raises(ConfigError, match=says):
        DiTBackbone(**changes)


def test_layers_without_a_loop_give_the_values_and_gradients_of_the_loop(monkeypatch):
    params, given = random_params(), inputs()

    def loss(params):
        return jnp.square(dit.apply(CONFIG, params, *given)).mean()

    def found(least):
        monkeypatch.setattr(dit, "WORTHWHILE", least)
        lowered = jax.jit(jax.value_and_grad(loss)).lower(params)
        return lowered.as_text().count("stablehlo.while"), lowered.compile()(params)

    (loops, (value, gradients)), (fewer, (other, others)) = found(2**40), found(0)
    assert fewer < loops
    np.testing.assert_allclose(value, other, rtol=1e-5)
    for left, right in zip(*map(jax.tree.leaves, (gradients, others)), strict=True):
        np.testing.assert_allclose(left, right, atol=1e-5 * max(1, float(np.abs(left).max())))
