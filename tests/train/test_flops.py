"""FLOPs counted in jaxprs: by hand for small programs, and as XLA counts them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.sharding import PartitionSpec as P

from pewm_jax.data import abstract
from pewm_jax.nn import attention
from pewm_jax.train import flops, jaxprs, step
from pewm_jax.worlds.pewm.world import STAGES
from tests.plan import programs

N, D, M = 6, 8, 4
X, W, V = jnp.ones((N, D)), jnp.ones((D, M)), jnp.ones((M, D))
ONE = 2 * N * D * M
"""FLOPs of one product of these sizes."""


def executed(f, *args, **more):
    return flops.executed(jax.make_jaxpr(f)(*args), **more).total


def needed(f, trained, *args):
    return flops.needed(jax.make_jaxpr(f)(*args), trained).total


def xla(f, *args):
    cost = jax.jit(f).lower(*args).compile().cost_analysis()
    return (cost[0] if isinstance(cost, list) else cost)["flops"]


@pytest.mark.parametrize(
    ("lhs", "rhs", "dims"),
    [
        ((5, 7), (7, 3), (((1,), (0,)), ((), ()))),
        ((2, 5, 7), (2, 7, 3), (((2,), (1,)), ((0,), (0,)))),
        ((4, 5, 7), (7, 5, 3), (((1, 2), (1, 0)), ((), ()))),
    ],
)
def test_products_count_as_xla_counts_them(lhs, rhs, dims):
    f = functools.partial(lax.dot_general, dimension_numbers=dims)
    args = jnp.ones(lhs), jnp.ones(rhs)
    assert executed(f, *args) == pytest.approx(xla(f, *args), rel=1e-6)


@pytest.mark.parametrize(("stride", "groups", "dilation"), [(1, 1, 1), (2, 1, 1), (1, 4, 2)])
def test_convolutions_count_as_xla_counts_them(stride, groups, dilation):
    def f(x, w):
        return lax.conv_general_dilated(
            x,
            w,
            (stride, stride),
            "VALID",
            rhs_dilation=(dilation, dilation),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            feature_group_count=groups,
        )

    args = jnp.ones((2, 12, 10, 8)), jnp.ones((3, 3, 8 // groups, 12))
    assert executed(f, *args) == pytest.approx(xla(f, *args), rel=1e-6)


def test_the_gradient_of_a_convolution_counts_as_its_products():
    def f(x, w):
        return lax.conv(x, w, (1, 1), "VALID").sum()

    x, w = jnp.ones((2, 3, 9, 9)), jnp.ones((5, 3, 4, 4))
    one = 2 * 2 * 5 * 6 * 6 * 3 * 4 * 4
    assert executed(f, x, w) == one
    assert needed(f, [False, True], x, w) == 2 * one
    assert needed(f, [True, True], x, w) == 3 * one
    by_weights = executed(jax.grad(f, 1), x, w)  # the value itself is not needed for it
    assert by_weights == one


def test_loops_count_as_often_as_they_run():
    def steps(x, w, v):
        return lax.scan(lambda c, _: ((c @ w) @ v, None), x, None, length=5)[0]

    def nested(x, w, v):
        return lax.scan(lambda c, _: (steps(c, w, v), None), x, None, length=3)[0]

    def counted(x, w, v):
        return lax.fori_loop(2, 9, lambda _, c: (c @ w) @ v, x)

    def strided(x, w, v):
        start = (1, x)
        return lax.while_loop(lambda s: s[0] < 10, lambda s: (s[0] + 2, (s[1] @ w) @ v), start)

    assert executed(steps, X, W, V) == 5 * 2 * ONE
    assert executed(nested, X, W, V) == 15 * 2 * ONE
    assert executed(counted, X, W, V) == 7 * 2 * ONE
    assert executed(strided, X, W, V) == 5 * 2 * ONE
    assert executed(lambda x, w: lax.map(lambda row: row @ w, x), X, W) == ONE


def test_a_loop_of_unknown_length_is_named():
    def f(x, w, v):
        return lax.while_loop(lambda c: c.sum() < 10, lambda c: (c @ w) @ v, x)

    work = flops.executed(jax.make_jaxpr(f)(X, W, V))
    assert work.total == 2 * ONE
    assert len(work.unknown) == 1
    assert flops.executed(jax.make_jaxpr(lambda x, w: x @ w)(X, W)).unknown == ()


def test_of_branches_the_most_expensive_counts():
    def f(x, w):
        return lax.cond(x.sum() > 0, lambda: x @ w, lambda: (x[:2] @ w).sum() + x @ w)

    assert executed(f, X, W) == ONE + 2 * 2 * D * M


def test_of_platforms_the_given_one_counts_and_for_the_need_the_cheapest():
    def f(x, w):
        padded = lambda x, w: (jnp.pad(x, ((0, N), (0, 0))) @ w)[:N]  # noqa: E731
        return lax.platform_dependent(x, w, cpu=padded, default=lambda x, w: x @ w)

    assert executed(f, X, W, platform="cpu") == 2 * ONE
    assert executed(f, X, W, platform="tpu") == ONE
    assert needed(f, [False, False], X, W) == ONE


def test_calls_are_followed():
    @jax.custom_vjp
    def product(x, w):
        return x @ w

    product.defvjp(lambda x, w: (x @ w, (x, w)), lambda saved, g: (g @ saved[1].T, saved[0].T @ g))

    @jax.custom_jvp
    def other(x, w):
        return x @ w

    other.defjvp(lambda p, t: (p[0] @ p[1], t[0] @ p[1] + p[0] @ t[1]))
    for f in (product, other, jax.jit(lambda x, w: x @ w), jax.checkpoint(lambda x, w: x @ w)):
        assert executed(f, X, W) == ONE
        assert needed(f, [True, True], X, W) == 3 * ONE
    total = executed(jax.value_and_grad(lambda x, w: product(x, w).sum(), (0, 1)), X, W)
    assert total == 3 * ONE


def test_a_sharded_program_counts_all_devices():
    mesh = jax.make_mesh((1,), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    f = jax.shard_map(lambda x, w: x @ w, mesh=mesh, in_specs=(P("data"), P()), out_specs=P("data"))
    assert executed(f, X, W) == ONE

    four = jax.sharding.AbstractMesh((4,), ("data",))
    eqn = next(e for e in jax.make_jaxpr(f)(X, W).eqns if e.primitive.name == "shard_map")
    params = {**eqn.params, "mesh": four}
    again = type("Eqn", (), {"primitive": eqn.primitive, "params": params})
    assert jaxprs.copies(again) == 4


def test_recomputation_is_executed_and_not_needed():
    def loss(w, v, x, *, remat):
        block = lambda c: jnp.sin(jnp.sin(c @ w) @ v)  # noqa: E731
        block = jax.checkpoint(block) if remat else block
        return lax.scan(lambda c, _: (block(c), None), x, None, length=3)[0].sum()

    for remat, times in ((False, 3), (True, 4)):
        f = functools.partial(loss, remat=remat)
        # Of the last product of a block, the recomputation needs the value too: sin' asks for it.
        assert executed(jax.grad(f, (0, 1)), W, V, X) == 3 * times * 2 * ONE
        assert needed(f, [True, True, False], W, V, X) == 3 * 3 * 2 * ONE


def test_only_operands_that_depend_on_something_trained_need_gradients():
    def loss(w, v, x):
        return ((x @ w) @ v).sum()

    assert needed(loss, [False, False, False], W, V, X) == 2 * ONE
    assert needed(loss, [True, False, False], W, V, X) == (2 + 2) * ONE
    assert needed(loss, [False, True, False], W, V, X) == (1 + 2) * ONE
    assert needed(loss, [True, True, False], W, V, X) == (2 + 3) * ONE
    stopped = lambda w, v, x: (lax.stop_gradient(x @ w) @ v).sum()  # noqa: E731
    assert needed(stopped, [True, True, False], W, V, X) == (1 + 2) * ONE
    measured = lambda w, v, x: ((x @ v.T).sum(), (x @ w).sum())  # noqa: E731
    assert needed(measured, [True, True, False], W, V, X) == (2 + 1) * ONE
    rounded = lambda w, v, x: ((x @ w).astype(int).astype(float) @ v).sum()  # noqa: E731
    assert needed(rounded, [True, False, False], W, V, X) == 2 * ONE


def test_what_a_loop_carries_needs_a_gradient_from_its_first_round_on():
    def loss(w, v, x):
        return lax.scan(lambda c, _: ((c @ w) @ v, None), x, None, length=4)[0].sum()

    assert needed(loss, [False, True, False], W, V, X) == 4 * (2 + 3) * ONE


def test_what_a_loop_only_measures_needs_no_gradient():
    def loss(w, v, x):
        def layer(c, _):
            after = (c @ w) @ v
            return after, lax.stop_gradient(c @ w) + 0 * after[:, :M]

        c, seen = lax.scan(layer, x, None, length=4)
        return c.sum(), seen

    assert needed(loss, [True, True, False], W, V, X) == 4 * (3 + 3 + 1) * ONE


@pytest.mark.parametrize("remat", [False, True])
def test_a_small_network_needs_what_its_gradient_executes(remat):
    """Without recomputation both counts agree."""

    def loss(params, x):
        def block(c, w):
            q = c @ w["qkv"]
            a = jax.nn.softmax(jnp.einsum("nd,md->nm", q, q)) @ q
            return c + jnp.tanh(a @ w["out"]), None

        block = jax.checkpoint(block) if remat else block
        return jnp.square(lax.scan(block, x @ params["in"], params["blocks"])[0]).sum()

    blocks = {"qkv": jnp.ones((3, D, D)), "out": jnp.ones((3, D, D))}
    params = {"in": jnp.ones((D, D)), "blocks": blocks}
    trained = [True] * 3 + [False]
    need = needed(loss, trained, params, X)
    done = executed(jax.grad(loss), params, X)
    products = 2 * N * D * D
    per_block = 2 * products + 2 * (2 * N * N * D)
    assert need == 3 * 3 * per_block + 2 * products
    assert done == need + (3 * per_block if remat else 0)


def test_kinds_of_products_are_told_apart():
    def f(x, w, k):
        return (
            (x @ w).sum()
            + jnp.einsum("bnd,bmd->bnm", k, k).sum()
            + lax.conv(jnp.ones((1, 1, 4, 4)), jnp.ones((1, 1, 2, 2)), (1, 1), "VALID").sum()
        )

    work = flops.executed(jax.make_jaxpr(f)(X, W, jnp.ones((2, 3, 5))))
    assert work.flops == {"linear": ONE, "attention": 2 * 2 * 3 * 3 * 5, "convolution": 2 * 9 * 4}
    assert work.traffic == 4 * (N * D + D * M + N * M) + 4 * (16 + 4 + 9)


def test_results_that_tensor_sums_are_found_through_reshapes_and_loops():
    heads, width = 2, 3

    def loss(w, x):
        def layer(c, w_KdD):
            out = w_KdD.astype(jnp.float32).reshape(heads * width, D)
            return c + jnp.ones((N, heads * width)) @ out, None

        return lax.scan(layer, x, w)[0].sum()

    w = jnp.ones((4, heads, width, D))
    jaxpr = jax.make_jaxpr(loss)(w, X)
    found = flops.needed(jaxpr, [True, False], [(None, "tensor", None, None), None])
    assert found.summed == 4 * N * D * 4
    found = flops.needed(jaxpr, [True, False], [(None, None, None, "tensor"), None])
    assert found.summed == 0


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_axes_follow_a_weight(order):
    w = jnp.ones((2, 3, 5))
    axes = ("a", "b", "c")
    eqn = jax.make_jaxpr(lambda w: jnp.transpose(w, order))(w).eqns
    moved = jaxprs.moved(eqn[0], axes) if eqn else axes
    assert moved == tuple(axes[k] for k in order)
    assert jaxprs._reshaped((2, 3, 5), (6, 5), axes) == ("a", "c")
    assert jaxprs._reshaped((6, 5), (2, 3, 5), ("a", "c")) == ("a", None, "c")
    assert np.prod(order) == 0


@pytest.mark.slow
def test_a_step_of_two_layers_counts_as_its_unrolled_program(monkeypatch):
    # Not stage 2: a loop computes the gradient of its first layer's input, which is not needed.
    config = programs.experiment(layers=2, heads=32, batch=32, remat=False)
    stage, clip = STAGES[0], abstract.clip(config, 32)
    state = jax.eval_shape(functools.partial(step.create, config, stage), jax.random.key(0))
    args = state, clip, jax.random.key(0)
    train_step = functools.partial(step.train_step, config, stage)
    scan = lax.scan
    monkeypatch.setattr(attention, "LOGITS", 2**40)  # no loop over heads on a CPU
    counted = executed(train_step, *args)
    monkeypatch.setattr(lax, "scan", lambda *a, **more: scan(*a, **{**more, "unroll": True}))
    jax.clear_caches()
    assert counted == pytest.approx(xla(train_step, *args), rel=0.01)
