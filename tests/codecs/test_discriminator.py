"""The discriminator scores patches, and its weight follows from two gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.codecs import discriminator
from pewm_jax.config import UserError

init = jax.jit(discriminator.init)


def test_its_size_is_that_of_the_recipe_and_its_logits_are_of_patches():
    params = init(jax.random.key(0))
    count = sum(x.size for x in jax.tree.leaves(params))
    assert 0.65e6 < count < 0.75e6
    logits = jax.eval_shape(discriminator.apply, params, jnp.zeros((2, 64, 48, 3)))
    assert logits.shape == (2, 6, 4)
    least = jnp.zeros((1, discriminator.LEAST, discriminator.LEAST, 3))
    assert jax.eval_shape(discriminator.apply, params, least).shape == (1, 1, 1)
    discriminator.require_size(discriminator.LEAST, 40)
    with pytest.raises(UserError, match=r"23×40 pixels are too small for the discriminator"):
        discriminator.require_size(23, 40)


def test_the_hinge_is_0_for_a_clear_judgement_and_1_without_one():
    high, low = jnp.full((2, 3), 1.5), jnp.full((2, 3), -1.0)
    assert discriminator.hinge(high, low) == 0
    assert discriminator.hinge(jnp.zeros(3), jnp.zeros(3)) == 1
    assert discriminator.hinge(low, high) == pytest.approx((2.0 + 2.5) / 2)


@pytest.mark.parametrize(
    ("reconstruction", "adversarial", "expected"),
    [
        ([3.0, 4.0], [0.0, 2.0], 0.5 * 5 / (2 + 1e-4)),
        ([0.0, 0.0], [1.0, 0.0], 0.0),
        ([3.0, 4.0], [0.0, 0.0], 0.5 * 1e4),  # 5 · 10⁴ without the limit
    ],
)
def test_the_adaptive_weight_is_the_quotient_of_the_gradients(
    reconstruction, adversarial, expected
):
    pair = jnp.asarray(reconstruction), jnp.asarray(adversarial)
    np.testing.assert_allclose(discriminator.adaptive_weight(*pair, 0.5), expected, rtol=1e-6)
