"""Attention in pieces and by kernels is attention, whatever the sizes and the hardware."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.models.svd import layers as svd
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import target
from pewm_jax.nn.target import Target

H100, A100, T4, V5P = (
    *(Target("cuda", capability) for capability in ((9, 0), (8, 0), (7, 5))),
    Target("tpu"),
)


def inputs(batch=2, heads=3, queries=13, keys=11, channels=8):
    rng = np.random.default_rng(0)
    shapes = [(batch, heads, n, channels) for n in (queries, keys, keys)]
    return [jnp.asarray(rng.normal(0, 2, shape), jnp.float32) for shape in shapes]


@pytest.mark.parametrize("blocks", [1, 2, 5, 13])
def test_pieces_make_the_whole(blocks):
    q, k, v = inputs()
    want = blocked_attention.plain_attention(q, k, v)
    got = blocked_attention._pieces_forward(q, k, v, blocks=blocks)[0]
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_large_logits_do_not_overflow():
    q, k, v = inputs()
    got = blocked_attention._pieces_forward(q * 1e3, k * 1e3, v, blocks=2)[0]
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


def reference(q, k, v):
    """Attention in NumPy's order of operations, in float32."""
    q, k, v = (x.astype(jnp.float32) for x in (q, k, v))
    logits = jnp.einsum("bknd,bkmd->bknm", q, k, precision="highest") / q.shape[-1] ** 0.5
    return jnp.einsum("bknm,bkmd->bknd", jax.nn.softmax(logits, -1), v, precision="highest")


def check_against_the_reference(attend, arrays, exact=reference):
    """Compare results and gradients: to 1e-5 of the largest value, to 2e-3 in bfloat16."""
    weight = jnp.asarray(np.random.default_rng(1).normal(size=arrays[0].shape), arrays[0].dtype)

    def total(attend):
        def function(*x):
            out = attend(*x)
            return (out.astype(jnp.float32) * weight).sum(), out

        return jax.jit(jax.value_and_grad(function, (0, 1, 2), has_aux=True))(*arrays)

    (_, got), slopes = total(attend)
    (_, want), right = total(exact)
    assert got.dtype == arrays[0].dtype
    most = 1e-5 if got.dtype == jnp.float32 else 2e-3
    for one, other in ((got, want), *zip(slopes, right, strict=True)):
        error = np.asarray(one, np.float32) - np.asarray(other, np.float32)
        largest = np.abs(np.asarray(other, np.float32)).max()
        # The rounding of a single result to bfloat16 is up to 4e-3 of it.
        assert np.sqrt(np.square(error).mean()) <= most * largest
        assert np.abs(error).max() <= 5 * most * largest


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("logits", [2**20, 300, 100])
def test_attention_on_a_cpu_equals_the_reference_with_padding(monkeypatch, logits, dtype):
    monkeypatch.setattr(blocked_attention, "LOGITS", logits)
    real = np.array([0, 1, 3, 4, 6, 7, 10])

    def exact(q, k, v):
        return reference(q, k[:, :, real], v[:, :, real])

    def padded(q, k, v):
        return blocked_attention.attention(q, k, v, real_M=real)

    arrays = [x.astype(dtype) / 2 for x in inputs()]
    check_against_the_reference(padded, arrays, exact)
    check_against_the_reference(blocked_attention.attention, arrays)


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

    monkeypatch.setattr(jax.nn, "dot_product_attention", flash)
    half = [x.astype(jnp.bfloat16) for x in (q, k, v)]
    with target.use(H100):
        assert blocked_attention.attention(*half).shape == q.shape
        blocked_attention.attention(*half, "xla")
        blocked_attention.attention(q, k, v)
    lengths = {"query_seq_lengths": 13, "key_value_seq_lengths": 11}
    assert asked == [((2, 14, 3, 8), "cudnn", lengths)], "16 bits alone, tokens in front of heads"


ODD = [(9, 9), (9, 10), (10, 9), (1, 1), (17, 2), (8, 8)]


@pytest.mark.parametrize(("queries", "keys"), ODD)
def test_cudnn_traces_gradients_of_any_length(has_cudnn, queries, keys):
    """Stable Video Diffusion attends over 9 frames; cuDNN's gradient wants even lengths."""
    half = [x.astype(jnp.bfloat16) for x in inputs(queries=queries, keys=keys)]

    def total(*x):
        return blocked_attention.attention(*x).astype(jnp.float32).sum()

    with target.use(H100):
        traced = str(jax.make_jaxpr(jax.grad(total, (0, 1, 2)))(*half))
    assert "dot_product_attention_bwd_wrapper" in traced


@pytest.mark.parametrize("axes", [(0, None, None), (None, 0, 0), (0, 0, 0), (1, None, 0)])
@pytest.mark.parametrize(("queries", "keys"), [(9, 9), (8, 8)])
def test_cudnn_traces_what_vmap_maps_over_some_or_all_arrays(has_cudnn, queries, keys, axes):
    half = [x.astype(jnp.bfloat16) for x in inputs(queries=queries, keys=keys)]
    stacked = [
        x if axis is None else jnp.stack([x] * 4, axis) for x, axis in zip(half, axes, strict=True)
    ]

    def total(*x):
        return blocked_attention.attention(*x).astype(jnp.float32).sum()

    with target.use(H100):
        slopes = jax.vmap(jax.grad(total, (0, 1, 2)), axes)
        one = jax.make_jaxpr(slopes)(*stacked)
        other = jax.make_jaxpr(jax.grad(lambda *x: jax.vmap(total, axes)(*x).sum()))(*stacked)
    for traced in (one, other):
        assert "dot_product_attention_bwd_wrapper" in str(traced)
    assert one.out_avals[0].shape == (4, *half[0].shape)


@pytest.mark.parametrize("axes", [(0, None, None), (None, 0, 0)])
def test_mapping_over_some_arrays_changes_neither_results_nor_gradients(axes):
    q, k, v = inputs(queries=9, keys=9)
    weight = jnp.asarray(np.random.default_rng(1).normal(size=q.shape))
    stacked = [
        x if axis is None else jnp.stack([x, 2 * x])
        for x, axis in zip((q, k, v), axes, strict=True)
    ]

    def slopes(attend):
        def total(*x):
            return (jax.vmap(attend, axes)(*x) * weight).sum()

        return jax.grad(total, (0, 1, 2))(*stacked)

    def padded(q, k, v):
        swapped = (x.swapaxes(1, 2) for x in (q, k, v))
        return blocked_attention.flash(*swapped, "xla").swapaxes(1, 2)

    for got, want in zip(slopes(padded), slopes(blocked_attention.plain_attention), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


@pytest.mark.slow(but=("9-9-float32", "10-9-bfloat16"))
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize(("queries", "keys"), ODD)
def test_padding_for_odd_lengths_changes_neither_results_nor_gradients(queries, keys, dtype):
    def padded(q, k, v):
        swapped = (x.swapaxes(1, 2) for x in (q, k, v))
        return blocked_attention.flash(*swapped, "xla").swapaxes(1, 2)

    arrays = [x.astype(dtype) / 2 for x in inputs(queries=queries, keys=keys)]
    check_against_the_reference(padded, arrays)


def test_the_nine_frames_of_svd_are_traced_for_a_gpu_with_gradients(has_cudnn):
    params = {
        "to_q": {"kernel": jnp.ones((64, 64))},
        "to_k": {"kernel": jnp.ones((64, 64))},
        "to_v": {"kernel": jnp.ones((64, 64))},
        "to_out": {"kernel": jnp.ones((64, 64)), "bias": jnp.zeros(64)},
    }
    frames = jax.ShapeDtypeStruct((2, 9, 4, 64), jnp.bfloat16)

    def total(params, x):
        return svd._over_frames(params, x, heads=2).astype(jnp.float32).sum()

    with target.use(H100):
        traced = str(jax.make_jaxpr(jax.grad(total))(params, frames))
    assert "dot_product_attention_bwd_wrapper" in traced


def shape(tokens, channels=64, dtype=jnp.bfloat16):
    return jax.ShapeDtypeStruct((1, 2, tokens, channels), dtype)


@pytest.mark.parametrize(
    ("where", "tokens", "channels", "dtype", "kernel"),
    [
        (H100, 9, 64, jnp.bfloat16, "cudnn"),
        (A100, 4096, 128, jnp.float16, "cudnn"),
        (A100, 4096, 64, jnp.float32, "formula"),
        (A100, 4096, 512, jnp.bfloat16, "formula"),
        (T4, 4096, 64, jnp.bfloat16, "formula"),
        (V5P, 3298, 64, jnp.bfloat16, "splash"),
        (V5P, 3298, 128, jnp.float32, "splash"),
        (V5P, 9, 64, jnp.bfloat16, "formula"),
        (V5P, 4096, 512, jnp.bfloat16, "formula"),
        (Target("cpu"), 4096, 64, jnp.bfloat16, "formula"),
    ],
)
def test_the_target_chooses_the_kernel(where, tokens, channels, dtype, kernel):
    q = shape(tokens, channels, dtype)
    assert blocked_attention.choose_kernel(where, q, q) == kernel
    assert blocked_attention.choose_kernel(where, q, q, "xla") == "formula"


def test_few_keys_or_few_queries_need_no_kernel_on_a_tpu():
    for queries, keys in ((4096, 16), (16, 4096)):
        assert blocked_attention.choose_kernel(V5P, shape(queries), shape(keys)) == "formula"
    assert blocked_attention.choose_kernel(V5P, shape(3072), shape(512)) == "splash"


def test_splash_attention_is_refused_where_there_is_no_tpu():
    with pytest.raises(UserError, match="splash needs a TPU; this is cpu"):
        blocked_attention.attention(*inputs(), "splash")


def test_one_function_is_traced_once_for_every_target():
    seen = []

    @jax.jit
    def function(x):
        seen.append(target.current())
        return x

    for where in (V5P, H100, V5P, None):
        with target.use(where):
            function(1.0)
    assert seen == [V5P, H100, target.of_devices()]


def test_a_program_for_tpus_is_traced_and_lowered_on_any_host():
    half = [x.astype(jnp.bfloat16) for x in inputs(1, 2, 300, 260, 64)]

    def total(*x):
        return blocked_attention.attention(*x).astype(jnp.float32).sum()

    with target.use(V5P):
        traced = jax.jit(jax.grad(total, (0, 1, 2))).trace(*half)
        text = traced.lower(lowering_platforms=("tpu",)).as_text()
    assert text.count("custom_call @tpu_custom_call") == 3, "forward, queries, keys with values"


IN_SPLASH = [(128, 128, 128), (13, 11, 8), (130, 257, 64), (300, 384, 80), (257, 16, 64)]


@pytest.mark.slow(but=("13-11-8-float32", "130-257-64-bfloat16", "300-384-80-float32"))
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize(("queries", "keys", "channels"), IN_SPLASH)
def test_splash_attention_equals_the_reference_forward_and_backward(queries, keys, channels, dtype):
    # Queries and keys of variance 1, as after their normalisation in the networks.
    arrays = [x.astype(dtype) / 2 for x in inputs(2, 2, queries, keys, channels)]
    check_against_the_reference(functools.partial(blocked_attention.splash, interpret=True), arrays)


def test_tiles_waste_little():
    for tokens in (*range(1, 700), 3298, 17776):
        padded = -(-tokens // blocked_attention.tile(tokens)) * blocked_attention.tile(tokens)
        assert padded - tokens < 256 or padded <= 1.2 * tokens
