"""Programs are counted as they run: loops as often, devices by what they send."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.plan import hlo
from pewm_jax.plan import program as programs


def program(function, *shapes):
    arguments = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    return programs.read(jax.jit(function).lower(*arguments).compile().as_text())


def test_a_product_counts_two_flops_per_multiply_add():
    assert program(jnp.matmul, (3, 5), (5, 7)).flops == 2 * 3 * 5 * 7
    batched = program(lambda a, b: jnp.einsum("bij,bkj->bik", a, b), (2, 3, 5), (2, 7, 5))
    assert batched.flops == 2 * 2 * 3 * 5 * 7


def test_a_loop_counts_as_often_as_it_runs_and_loops_within_it_too():
    def inner(x, w):
        return jax.lax.fori_loop(0, 3, lambda _, y: jnp.tanh(y @ w), x)

    def outer(x, ws):
        return jax.lax.scan(lambda y, w: (inner(y, w), None), x, ws)[0]

    counted = program(outer, (4, 8), (5, 8, 8))
    assert counted.flops == 5 * 3 * 2 * 4 * 8 * 8
    assert counted.unknown == []


def test_a_loop_that_does_not_say_how_often_is_named():
    def until(x, w):
        return jax.lax.while_loop(lambda y: y.sum() < 9, lambda y: y @ w, x)

    counted = program(until, (4, 8), (8, 8))
    assert counted.flops == 2 * 4 * 8 * 8
    assert len(counted.unknown) == 1


def test_of_the_branches_the_longest_counts():
    def either(flag, x, w):
        return jax.lax.cond(flag[0] > 0, lambda: x @ w, lambda: x)

    assert program(either, (1,), (4, 8), (8, 8)).flops == 2 * 4 * 8 * 8


@pytest.mark.parametrize(("stride", "out"), [(1, 6), (2, 3)])
def test_a_convolution_counts_its_taps_with_the_padding(stride, out):
    def convolve(x, w):
        dimensions = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(
            x, w, (stride, stride), "SAME", dimension_numbers=dimensions
        )

    counted = program(convolve, (2, 6, 6, 8), (3, 3, 8, 16))
    assert counted.flops == 2 * (2 * out * out * 16) * 9 * 8


ROW = "  %{name} = {type} {text}\n"


def written(*rows, head="%region (a: f32[]) -> f32[] {\n}\n\n"):
    text = "".join(ROW.format(name=n, type=t, text=x) for n, t, x in rows)
    return programs.read(f"HloModule m\n\n{head}ENTRY %main (p: f32[64]) -> f32[64] {{\n{text}}}\n")


GROUPS = [
    ("{{0,2,4,6},{1,3,5,7}}", (0, 2, 4, 6)),
    ("[2,4]<=[8]", (0, 1, 2, 3)),
    ("[2,4]<=[4,2]T(1,0)", (0, 2, 4, 6)),
    ("mesh['a'=4,'b'=2] {'a'}", (0, 2, 4, 6)),
    ("mesh['a'=4,'b'=2] {'a':(2)2,'b'}", (0, 1, 2, 3)),
    ("mesh['a'=2,'b'=4], device_ids=([4,2]T(1,0)) {'b'}", (0, 2, 4, 6)),
    ("mesh['a'=2,'b'=4], device_ids=(7,6,5,4,3,2,1,0) {'b'}", (7, 6, 5, 4)),
]


@pytest.mark.parametrize(("groups", "first"), GROUPS)
def test_groups_of_devices_are_read_in_all_spellings(groups, first):
    found = written(
        ("p", "f32[64]{0}", "parameter(0)"),
        ("g", "f32[256]{0}", f"all-gather(%p), channel_id=1, replica_groups={groups}"),
    )
    assert found.collectives[0].group == first
    assert found.sent("all-gather") == 3 * 64 * 4


def test_bytes_sent_are_those_of_a_ring():
    rest = "replica_groups=[1,8]<=[8], to_apply=%region"
    found = written(
        ("p", "bf16[64]{0}", "parameter(0)"),
        ("a", "bf16[64]{0}", f"all-reduce(%p), {rest}"),
        ("r", "bf16[8]{0}", f"reduce-scatter(%p), {rest}"),
        ("t", "bf16[64]{0}", f"all-to-all(%p), {rest}"),
        ("c", "bf16[64]{0}", "collective-permute(%p), source_target_pairs={{0,1},{1,2}}"),
    )
    assert {kind: found.sent(kind) for kind in programs.COLLECTIVES} == {
        "all-gather": 0,
        "all-reduce": 2 * 128 * 7 / 8,
        "reduce-scatter": 128 * 7 / 8,
        "all-to-all": 128 * 7 / 8,
        "collective-permute": 128,
    }


def test_a_sum_of_which_only_slices_are_used_is_a_reduce_scatter():
    fused = (
        "%fused (q: f32[64], i: s32[]) -> f32[8] {\n"
        "  %q = f32[64]{0} parameter(0)\n"
        "  %i = s32[] parameter(1)\n"
        "  ROOT %s = f32[8]{0} dynamic-slice(%q, %i), dynamic_slice_sizes={8}\n"
        "}\n\n"
    )
    rest = "replica_groups=[1,8]<=[8], to_apply=%region"
    rows = [
        ("p", "f32[64]{0}", "parameter(0)"),
        ("i", "s32[]", "partition-id()"),
        ("both", "(f32[64]{0}, f32[64]{0})", f"all-reduce(%p, %p), {rest}"),
        ("first", "f32[64]{0}", "get-tuple-element(%both), index=0"),
        ("second", "f32[64]{0}", "get-tuple-element(%both), index=1"),
        ("cut", "f32[8]{0}", "fusion(%first, %i), kind=kLoop, calls=%fused"),
        ("whole", "f32[64]{0}", "negate(%second)"),
    ]
    found = written(*rows, head=fused)
    assert found.sent("reduce-scatter") == 256 * 7 / 8
    assert found.sent("all-reduce") == 2 * 256 * 7 / 8


@pytest.mark.parametrize(("last", "kind"), [("cut", "reduce-scatter"), ("whole", "all-reduce")])
def test_a_sum_may_be_converted_before_it_is_cut(last, kind):
    fused = (
        "%converted (q: f32[64]) -> bf16[64] {\n"
        "  %q = f32[64]{0} parameter(0)\n"
        "  ROOT %c = bf16[64]{0} convert(%q)\n"
        "}\n\n"
    )
    rest = "replica_groups=[1,8]<=[8], to_apply=%region"
    ends = {
        "cut": ("cut", "bf16[8]{0}", "dynamic-slice(%narrow, %i), dynamic_slice_sizes={8}"),
        "whole": ("whole", "bf16[64]{0}", "negate(%narrow)"),
    }
    rows = [
        ("p", "f32[64]{0}", "parameter(0)"),
        ("i", "s32[]", "partition-id()"),
        ("sum", "f32[64]{0}", f"all-reduce(%p), {rest}"),
        ("narrow", "bf16[64]{0}", "fusion(%sum), kind=kLoop, calls=%converted"),
        ends[last],
    ]
    found = written(*rows, head=fused)
    assert [one.kind for one in found.collectives] == [kind]


def test_sizes_of_types_are_in_bytes():
    assert hlo.size("(f32[2,3]{1,0}, s32[], bf16[4]{0}, pred[5]{0})") == 24 + 4 + 8 + 5
    assert hlo.size("f8e4m3fn[16]{0}") == 16


def test_the_figures_do_not_depend_on_how_the_compiler_fuses():
    def step(w, x):
        return jax.grad(functools.partial(loss, x=x))(w)

    def loss(w, x):
        return jnp.mean(jnp.tanh(x @ w["a"]) @ w["b"])

    weights = {"a": np.zeros((8, 16), np.float32), "b": np.zeros((16, 4), np.float32)}
    text = jax.jit(step).lower(weights, np.zeros((32, 8), np.float32)).compile().as_text()
    forward, backward = 8 * 16, 8 * 16 + 2 * 16 * 4  # the last product's value is not needed
    assert programs.read(text).flops == 2 * 32 * (forward + backward)
