"""3D convolutions as products are XLA's, forward and backward."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.nn import convolution

FORMS = {"whole": convolution.convolve_grid, "halved": convolution.halve_grid}


def draw(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("name", FORMS)
def test_both_forms_and_both_gradients_agree(name):
    x, kernel = draw(0, 2, 4, 6, 2, 3), draw(1, 3, 3, 3, 3, 5)
    out = draw(2, *FORMS[name](x, kernel, "xla").shape)
    assert out.shape[1:4] == ((4, 6, 2) if name == "whole" else (2, 3, 1))

    def gradients(form):
        return jax.value_and_grad(
            lambda x, kernel: (FORMS[name](x, kernel, form) * out).sum(), (0, 1)
        )

    wanted = jax.jit(gradients("xla"))(x, kernel)
    for form in ("products", "auto"):
        made = jax.jit(gradients(form))(x, kernel)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), made, wanted)


def test_a_kernel_of_one_place_is_a_linear_layer():
    x, kernel = draw(0, 2, 3, 3, 3, 4), draw(1, 1, 1, 1, 4, 5)
    made = convolution.convolve_grid(x, kernel)
    np.testing.assert_allclose(made, convolution.by_xla(x, kernel), atol=1e-5)


def test_the_gradient_of_a_kernel_does_not_depend_on_the_groups(monkeypatch):
    x, kernel, out = draw(0, 6, 5, 4, 3), draw(1, 3, 3, 3, 2), draw(2, 6, 5, 4, 2)

    wanted = convolution._kernel_by_convolution(x, kernel, out)
    for size in (1, 2000, 10**9):  # one picture at a time, three, all
        monkeypatch.setattr(convolution, "GROUP", size)
        made = convolution._kernel_by_product(x, kernel, out)  # under jit its trace would be kept
        np.testing.assert_allclose(made, wanted, atol=2e-5)
    made = jax.grad(lambda k: (convolution.convolve(x, k) * out).sum())(kernel)
    np.testing.assert_allclose(made, wanted, atol=2e-5)
