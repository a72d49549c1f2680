"""The gate: the decoder where nothing is rendered, and at first mostly the memory elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import gates
from tests.helpers import randomise


def pictures(seed, shape=(2, 6, 8, 4)):
    return jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, shape), jnp.float32)


SEEN = jnp.asarray(np.random.default_rng(5).random((2, 6, 8)) < 0.5)


def test_it_is_exactly_the_decoder_where_nothing_is_rendered():
    params = randomise(gates.init(8, jax.random.key(0)))
    decoded, rendered = pictures(0), pictures(1)
    made = jax.jit(gates.apply)(params, decoded, rendered, SEEN)
    np.testing.assert_array_equal(made[~SEEN], decoded[~SEEN])
    assert (made[SEEN] != decoded[SEEN]).mean() > 0.99
    other = jnp.where(SEEN[..., None], rendered, 7.0)
    np.testing.assert_array_equal(jax.jit(gates.apply)(params, decoded, other, SEEN), made)


def test_a_fresh_gate_takes_one_share_of_what_was_seen():
    decoded, rendered = pictures(0), pictures(1)
    made = gates.apply(gates.init(8, jax.random.key(0)), decoded, rendered, SEEN)
    share = jax.nn.sigmoid(gates.INITIAL_LOGIT)
    mixed = decoded + share * (rendered - decoded)
    np.testing.assert_allclose(made[SEEN], mixed[SEEN], atol=1e-5)
