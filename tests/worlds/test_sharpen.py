"""The loss that sharpens: its gradients are those of its terms, weighted at the last layer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.codecs import discriminator
from pewm_jax.worlds import sharpen

KEY = jax.random.key(0)


def toy():
    """A decoder of two linear layers, random latents, pictures and a discriminator."""
    keys = jax.random.split(KEY, 5)
    decoder = {
        "first": {"kernel": jax.random.normal(keys[0], (4, 8)) / 2},
        "out": {"kernel": jax.random.normal(keys[1], (8, 3)) / 4, "bias": jnp.zeros(3)},
    }
    latents = jax.random.normal(keys[2], (2, 32, 32, 4))
    truth = jnp.tanh(jax.random.normal(keys[3], (2, 32, 32, 3)))

    def decode(decoder):
        hidden = jnp.tanh(latents @ decoder["first"]["kernel"])
        return hidden @ decoder["out"]["kernel"] + decoder["out"]["bias"]

    return decode, decoder, truth, sharpen.init(keys[4])["discriminator"]


def squares(truth):
    """In place of LPIPS."""
    return lambda made: jnp.square(made - truth).mean()


@pytest.mark.slow(but=["0.0"])
@pytest.mark.parametrize("gan_weight", [0.5, 0.0])
def test_gradients_are_those_of_the_terms_with_the_adaptive_weight(gan_weight):
    decode, decoder, truth, adversary = toy()
    distance = squares(truth)

    @jax.jit
    def ours(decoder, adversary):
        return sharpen.loss(
            decode(decoder),
            truth,
            adversary,
            pull=sharpen.pull_of_last(decode, decoder),
            lpips=distance,
            lpips_weight=2.0,
            gan_weight=gan_weight,
        )

    def reconstruction(decoder):
        made = decode(decoder)
        return jnp.abs(made - truth).mean() + 2.0 * distance(made)

    def adversarial(decoder):
        return -discriminator.apply(adversary, decode(decoder)).mean()

    def judged(adversary):
        logits = (discriminator.apply(adversary, x) for x in (truth, decode(decoder)))
        return discriminator.hinge(*logits)

    (value, measured), (mine, against) = jax.value_and_grad(ours, (0, 1), has_aux=True)(
        decoder, adversary
    )
    one, other = jax.jit(jax.grad(reconstruction))(decoder), jax.jit(jax.grad(adversarial))(decoder)
    norms = [np.linalg.norm(tree["out"]["kernel"]) for tree in (one, other)]
    scale = gan_weight * norms[0] / (norms[1] + 1e-4)
    wanted = jax.tree.map(lambda a, b: a + scale * b, one, other)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), mine, wanted)
    assert measured["loss_rgb"] > 0
    total = reconstruction(decoder)
    if gan_weight:
        assert measured["gan_scale"] == pytest.approx(scale, rel=1e-4)
        total = total + scale * adversarial(decoder) + judged(adversary)
        expected = jax.jit(jax.grad(judged))(adversary)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), against, expected
        )
    else:
        assert not any(np.any(x) for x in jax.tree.leaves(against))
        assert "gan_scale" not in measured
    assert float(value) == pytest.approx(float(total), rel=1e-4)
