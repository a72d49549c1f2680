"""Attention in pieces is attention, whatever the number of pieces."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.nn import attention as blocked_attention


def inputs(batch=2, heads=3, queries=13, keys=11, channels=8):
    rng = np.random.default_rng(0)
    shapes = [(batch, heads, n, channels) for n in (queries, keys, keys)]
    return [jnp.asarray(rng.normal(0, 2, shape), jnp.float32) for shape in shapes]


@pytest.mark.parametrize("blocks", [1, 2, 5, 13])
def test_pieces_make_the_whole(blocks):
    q, k, v = inputs()
    want = blocked_attention.plain_attention(q, k, v)
    got = blocked_attention.in_pieces(q, k, v, blocks)
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_large_logits_do_not_overflow():
    q, k, v = inputs()
    got = blocked_attention.in_pieces(q * 1e3, k * 1e3, v, 2)
    np.testing.assert_allclose(
        got, blocked_attention.plain_attention(q * 1e3, k * 1e3, v), rtol=1e-3, atol=1e-3
    )
    assert np.isfinite(got).all()


def test_what_does_not_fit_is_cut_on_a_cpu_and_only_there(monkeypatch):
    q, k, v = inputs()
    monkeypatch.setattr(blocked_attention, "LOGITS", 100)

    def loops(platform):
        traced = jax.jit(functools.partial(blocked_attention.attention)).trace(q, k, v)
        return traced.lower(lowering_platforms=(platform,)).as_text().count("stablehlo.while")

    assert loops("cpu") == 2
    assert loops("cuda") == 0
    want = blocked_attention.plain_attention(q, k, v)
    np.testing.assert_allclose(
        jax.jit(functools.partial(blocked_attention.attention))(q, k, v), want, rtol=1e-5, atol=1e-6
    )
    worlds = jax.vmap(blocked_attention.attention)(*(jnp.stack([x, x[::-1]]) for x in (q, k, v)))
    np.testing.assert_allclose(worlds, jnp.stack([want, want[::-1]]), rtol=1e-5, atol=1e-6)


def test_few_tokens_are_not_cut():
    text = jax.jit(functools.partial(blocked_attention.attention)).lower(*inputs()).as_text()
    assert "stablehlo.while" not in text


@pytest.mark.parametrize("logits", [300, 100])
def test_gradients_are_those_of_the_whole(monkeypatch, logits):
    q, k, v = inputs()
    monkeypatch.setattr(blocked_attention, "LOGITS", logits)
    weight = jnp.asarray(np.random.default_rng(1).normal(size=v.shape[:2] + q.shape[2:]))

    def slopes(attend):
        return jax.jit(jax.grad(lambda *x: (attend(*x) * weight).sum(), (0, 1, 2)))(q, k, v)

    for got, want in zip(
        slopes(blocked_attention.attention), slopes(blocked_attention.plain_attention), strict=True
    ):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_elsewhere_the_same_formula_runs_without_loops():
    q, k, v = inputs()
    cut = {"blocks": 2}
    whole = blocked_attention._piece_forward(q, k, v)
    for got, want in zip(blocked_attention._pieces_forward(q, k, v, **cut), whole, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)
    grad = v[:, :, :1] + q
    shared = (grad * whole[0]).sum(-1, keepdims=True)
    given = (q, k, v, whole[1], shared, grad)
    for got, want in zip(
        blocked_attention._pieces_backward(*given, **cut),
        blocked_attention._piece_backward(*given),
        strict=True,
    ):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_flash_attention_is_refused_where_there_is_none_and_taken_where_there_is(monkeypatch):
    q, k, v = inputs()
    with pytest.raises(UserError, match="cpu, float32 and 8: choose auto or xla"):
        blocked_attention.attention(q, k, v, "cudnn")
    asked = []

    def flash(q, k, v, implementation, **lengths):
        asked.append((q.shape, implementation, {name: int(x[0]) for name, x in lengths.items()}))
        return q + v[:, :1] * k[:, :1]

    monkeypatch.setattr(blocked_attention, "has_flash", lambda: True)
    monkeypatch.setattr(jax.nn, "dot_product_attention", flash)
    half = [x.astype(jnp.bfloat16) for x in (q, k, v)]
    assert blocked_attention.attention(*half).shape == q.shape
    blocked_attention.attention(*half, "xla")
    blocked_attention.attention(q, k, v)
    lengths = {"query_seq_lengths": 13, "key_value_seq_lengths": 11}
    assert asked == [((2, 14, 3, 8), "cudnn", lengths)], "16 bits alone, tokens in front of heads"


ODD = [(9, 9), (9, 10), (10, 9), (1, 1), (17, 2), (8, 8)]


@pytest.mark.parametrize(("queries", "keys"), ODD)
def test_cudnn_traces_gradients_of_any_length(monkeypatch, queries, keys):
    """Stable Video Diffusion attends over 9 frames; cuDNN's gradient wants even lengths."""
    from jax._src.cudnn import fused_attention_stablehlo as cudnn

    version = types.SimpleNamespace(cudnn_get_version=lambda: 91000)
    monkeypatch.setattr(cudnn, "cuda_versions", version)  # JAX asks for it while tracing
    monkeypatch.setattr(blocked_attention, "has_flash", lambda: True)
    half = [x.astype(jnp.bfloat16) for x in inputs(queries=queries, keys=keys)]

    def total(*x):
        return blocked_attention.attention(*x).astype(jnp.float32).sum()

    traced = str(jax.make_jaxpr(jax.grad(total, (0, 1, 2)))(*half))
    assert "dot_product_attention_bwd_wrapper" in traced


@pytest.mark.slow(but=("9-9", "10-9"))
@pytest.mark.parametrize(("queries", "keys"), ODD)
def test_padding_for_odd_lengths_changes_neither_results_nor_gradients(queries, keys):
    q, k, v = inputs(queries=queries, keys=keys)
    weight = jnp.asarray(np.random.default_rng(1).normal(size=q.shape))

    def padded(q, k, v):
        swapped = (x.swapaxes(1, 2) for x in (q, k, v))
        return blocked_attention.flash(*swapped, "xla").swapaxes(1, 2)

    def slopes(attend):
        return jax.grad(lambda *x: (attend(*x) * weight).sum(), (0, 1, 2))(q, k, v)

    np.testing.assert_allclose(
        padded(q, k, v), blocked_attention.plain_attention(q, k, v), rtol=1e-5, atol=1e-5
    )
    for got, want in zip(slopes(padded), slopes(blocked_attention.plain_attention), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
