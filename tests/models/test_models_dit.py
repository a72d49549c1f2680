import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pewm_jax.models import dit, layers
from tests.helpers import randomise, tiny_config

CONFIG = tiny_config().dit


def inputs(channels=5, shape=(3, 4, 6), seed=0):
    rng = np.random.default_rng(seed)
    latents = jnp.asarray(rng.normal(size=(2, *shape, channels)), jnp.float32)
    text = jnp.asarray(rng.normal(size=(2, CONFIG.text_length, CONFIG.text_dim)), jnp.float32)
    return latents, text, jnp.array([10, 900])


def random_params(config=CONFIG):
    return randomise(dit.init(config, jax.random.key(0), 5, 7))


@settings(max_examples=15, deadline=None)
@given(
    t=st.integers(1, 3),
    h=st.integers(1, 3),
    w=st.integers(1, 3),
    p=st.integers(1, 3),
    c=st.integers(1, 3),
)
def test_unpatchify_inverts_patchify(t, h, w, p, c):
    latents = np.random.default_rng(0).normal(size=(2, t, h * p, w * p, c))
    tokens = dit.patchify(latents, p)
    assert tokens.shape == (2, t * h * w, c * p * p)
    np.testing.assert_array_equal(dit.unpatchify(tokens, t, h * p, w * p, p), latents)


def test_a_fresh_network_predicts_zero():
    params = dit.init(CONFIG, jax.random.key(0), 5, 7)
    out = dit.apply(CONFIG, params, *inputs())
    assert out.shape == (2, 3, 4, 6, 7)
    np.testing.assert_array_equal(out, 0)


def test_samples_of_a_batch_do_not_see_each_other():
    latents, text, times = inputs()
    params = random_params()
    both = dit.apply(CONFIG, params, latents, text, times)
    alone = dit.apply(CONFIG, params, latents[1:], text[1:], times[1:])
    np.testing.assert_allclose(both[1:], alone, atol=1e-5)


def test_everything_given_matters():
    params = random_params()
    latents, text, times = inputs()
    base = dit.apply(CONFIG, params, latents, text, times)
    for changed in (
        (latents.at[:, 0, 0, 0, 0].add(1), text, times),
        (latents, text.at[:, 0, 0].add(1), times),
        (latents, text, times + 50),
    ):
        out = dit.apply(CONFIG, params, *changed)
        assert np.abs(out - base)[:, -1, -1, -1].max() > 1e-6, "the far corner must hear of it"


def test_scan_and_remat_equal_a_plain_loop():
    params = random_params()
    latents, text, times = inputs()
    scanned = dit.apply(CONFIG, params, latents, text, times)
    remat = dataclasses.replace(CONFIG, remat=True)
    np.testing.assert_allclose(dit.apply(remat, params, latents, text, times), scanned, atol=1e-5)

    ends = dit.Ends(CONFIG, 7, jnp.dtype("float32"))
    rest = {"params": {k: v for k, v in params.items() if k != "blocks"}}
    video, words, time = ends.apply(rest, dit.patchify(latents, 2), text, times, method="embed")
    angles = layers.rope_angles(3, 2, 3, CONFIG.head_dim)
    for i in range(CONFIG.layers):
        layer = jax.tree.map(lambda x, i=i: x[i], params["blocks"])
        video, words = dit.Block(CONFIG).apply({"params": layer}, video, words, time, angles)
    out = dit.unpatchify(ends.apply(rest, video, time, method="project"), 3, 4, 6, 2)
    np.testing.assert_allclose(out, scanned, atol=1e-5)


def test_rotary_embedding_makes_attention_relative():
    rng = np.random.default_rng(0)
    q, k = rng.normal(size=(2, 32)).astype(np.float32)
    angles = layers.rope_angles(4, 5, 6, 32).reshape(4, 5, 6, 16)

    def product(a, b):
        return float(layers.rotate(q, angles[a]) @ layers.rotate(k, angles[b]))

    here = product((0, 1, 2), (2, 2, 3))
    np.testing.assert_allclose(product((1, 3, 4), (3, 4, 5)), here, rtol=1e-4)
    assert abs(here - product((0, 1, 2), (1, 2, 3))) > 1e-4
