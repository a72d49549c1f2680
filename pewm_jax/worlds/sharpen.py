"""The loss that sharpens a decoder which has converged: absolute error, LPIPS and a discriminator.

A decoder that is trained by the error of its pixels returns their mean where the latents leave
several pictures open, which is a blur. Here it is trained further, by

    L1 + lpips_weight · LPIPS + w · adversarial,

with the hinge loss and the adaptive weight w of ``codecs.discriminator``. The discriminator learns
at the same time from the same pictures. Its parameters are under ``discriminator``, a part of the
stage that no weights contain (``stages.ADVERSARY``). Adversarial training is the end, not the
start: from random weights it gives lurid colours.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs import discriminator
from pewm_jax.types import Array, Params

NAME = "discriminator"
DISCRIMINATOR = rf"{NAME}/.*"
SHARDING = ((DISCRIMINATOR, P()),)
"""The discriminator is small: every device has all of it."""
LAST = "out"
"""The decoder's last layer, in which the gradients are compared."""
FOLD = 65534
"""Number that is folded into the key of the discriminator's parameters."""

Pull = Callable[[Array], Array]
"""From a gradient with respect to the decoded pictures to that of the decoder's last kernel."""

require_size = discriminator.require_size


def init(key: Array) -> Params:
    """Return the random parameters of the discriminator, under its name."""
    return {NAME: discriminator.init(jax.random.fold_in(key, FOLD))}


def pull_of_last(decode: Callable[[Params], Array], decoder: Params) -> Pull:
    """Return the function that pulls a gradient of pictures back to the decoder's last kernel.

    ``decode`` returns the pictures of a decoder's parameters.
    """
    fixed = jax.lax.stop_gradient(decoder)

    def of_kernel(kernel: Array) -> Array:
        return decode({**fixed, LAST: {**fixed[LAST], "kernel": kernel}})

    pull = jax.vjp(of_kernel, fixed[LAST]["kernel"])[1]
    return lambda gradient: pull(gradient)[0]


def loss(
    made_NHWC: Array,
    truth_NHWC: Array,
    adversary: Params,
    *,
    pull: Pull,
    lpips: Callable[[Array], Array] | None,
    lpips_weight: float,
    gan_weight: float,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of decoded colours and of the discriminator, in one number.

    The two do not see each other's gradient: the discriminator's loss is of the pictures as they
    are, and the decoder's is of the discriminator as it is.

    Args:
        made_NHWC: decoded colours in [−1, 1]; the gradient flows into them.
        truth_NHWC: the recorded colours.
        adversary: parameters of the discriminator.
        pull: from ``pull_of_last``.
        lpips: returns the distance of pictures from the truth; None for none.
        lpips_weight: its weight.
        gan_weight: the factor of the adaptive weight; 0 for no discriminator.

    Returns:
        ``(loss, measured)``: ``loss_rgb``, the absolute error, and what counts of ``lpips``,
        ``loss_gan``, ``gan_scale``, the adaptive weight, and ``loss_discriminator``.
    """
    given = jax.lax.stop_gradient(made_NHWC)

    def reconstruction(made: Array) -> tuple[Array, dict[str, Array]]:
        absolute = jnp.abs(made - truth_NHWC).mean()
        if lpips is None:
            return absolute, {"loss_rgb": absolute}
        apart = lpips(made)
        return absolute + lpips_weight * apart, {"loss_rgb": absolute, "lpips": apart}

    def adversarial(made: Array) -> Array:
        return -discriminator.apply(jax.lax.stop_gradient(adversary), made).mean()

    (value, measured), gradient = jax.value_and_grad(reconstruction, has_aux=True)(given)
    wrong = jnp.zeros(())
    if gan_weight:
        against, away = jax.value_and_grad(adversarial)(given)
        scale = discriminator.adaptive_weight(pull(gradient), pull(away), gan_weight)
        wrong = discriminator.hinge(
            discriminator.apply(adversary, truth_NHWC), discriminator.apply(adversary, given)
        )
        value, gradient = value + scale * against, gradient + scale * away
        measured |= {"loss_gan": against, "gan_scale": scale, "loss_discriminator": wrong}
    value, gradient = jax.lax.stop_gradient((value, gradient))
    # The gradient of the decoder's terms is known, so they are not differentiated a second time.
    known = (made_NHWC * gradient).sum()
    return value + (known - jax.lax.stop_gradient(known)) + wrong, measured
