"""Weights that are computed where they are used: values, slices under scan, error bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.nn import deferred, layers, modules
from pewm_jax.nn.deferred import LowRank

RNG = np.random.default_rng(0)


def normal(*shape):
    return RNG.normal(size=shape).astype(np.float32)


@pytest.mark.parametrize(
    ("base", "a", "b"),
    [
        ((4, 6), (4, 2), (2, 6)),
        ((3, 3, 4, 6), (3, 3, 4, 2), (2, 6)),
        ((5, 4, 6), (5, 4, 2), (5, 2, 6)),
        ((5, 3, 3, 4, 6), (5, 3, 3, 4, 2), (5, 2, 6)),
    ],
)
def test_an_adapted_weight_is_the_sum(base, a, b):
    w, a, b = normal(*base), normal(*a), normal(*b)
    found = LowRank(w, a, b, 0.5)
    wanted = w + 0.5 * np.einsum(
        "...ir,...ro->...io", a, b.reshape(*b.shape[:-2], *(1,) * (a.ndim - b.ndim), *b.shape[-2:])
    )
    assert (found.shape, found.ndim, found.size) == (w.shape, w.ndim, w.size)
    np.testing.assert_allclose(found.unbox(), wanted, atol=1e-5)
    assert LowRank(w.astype(jnp.bfloat16), a, b, 0.5).unbox().dtype == jnp.bfloat16


def test_scan_slices_it_and_layers_take_it():
    w, a, b, x = normal(5, 4, 4), normal(5, 4, 2), normal(5, 2, 4), normal(3, 4)
    weight = LowRank(w, a, b, 1.0)

    def run(kernel):
        def body(x, layer):
            return jnp.tanh(layers.linear({"kernel": layer}, x)), layer.astype(jnp.float32).shape

        return jax.lax.scan(lambda x, k: (body(x, k)[0], None), x, kernel)[0]

    np.testing.assert_allclose(jax.jit(run)(weight), jax.jit(run)(weight.unbox()), atol=1e-6)
    dense = modules.dense(4, jnp.float32, "x")
    one = LowRank(w[0], a[0], b[0], 1.0)
    bias = np.zeros(4, np.float32)
    mine = dense.apply({"params": {"kernel": one, "bias": bias}}, x)
    np.testing.assert_allclose(mine, x @ np.asarray(one.unbox()), atol=1e-5)
    np.testing.assert_allclose(jnp.asarray(x) @ one, x @ np.asarray(one.unbox()), atol=1e-5)


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("shape", [(3, 40, 30), (3, 2, 2, 16, 8)])
def test_quantization_errors_are_bounded(shape, stacked):
    w = normal(*shape) * np.float32(10.0) ** RNG.integers(-6, 6, shape[-1]).astype(np.float32)
    w[..., 0] = 0
    axes = tuple(range(int(stacked), w.ndim - 1))
    largest = np.abs(w).max(axes, keepdims=True)
    eight, floats = (deferred.quantize(w, name, stacked=stacked) for name in ("int8", "fp8"))
    assert (eight.values.dtype, floats.values.dtype) == (jnp.int8, jnp.float8_e4m3fn)
    assert eight.scale.size == largest.size
    error = np.abs(np.asarray(eight.wide()) - w)
    assert (error <= largest / 254 * 1.001).all()
    error = np.abs(np.asarray(floats.wide()) - w)
    assert (error <= np.maximum(np.abs(w) / 16, largest / 448 / 1024) * 1.001).all()
    assert not np.asarray(eight.wide())[..., 0].any()


def test_quantized_weights_need_a_quarter_of_the_memory():
    w = normal(64, 64)
    found = deferred.quantize(w, "int8", stacked=False)
    assert sum(x.nbytes for x in jax.tree.leaves(found)) == w.nbytes // 4 + 64 * 4
    half = deferred.quantize(w.astype(jnp.bfloat16), "fp8", stacked=False)
    assert half.dtype == jnp.bfloat16
    assert half.astype(jnp.bfloat16).dtype == jnp.bfloat16


def test_paths_say_what_is_stacked_and_what_is_a_matrix():
    assert deferred.is_stacked("backbone/blocks/to_q/kernel")
    assert not deferred.is_stacked("backbone/proj_out/kernel")
    assert not deferred.is_matrix("backbone/blocks/to_q/bias", (2, 32))
    assert deferred.is_matrix("backbone/blocks/to_q/kernel", (2, 32, 32))
    assert deferred.is_matrix("backbone/conv_in/kernel", (3, 3, 8, 32))
