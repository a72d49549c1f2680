"""A learned table of positions at other sizes than its own: resized, left out, or refused."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax import presets
from pewm_jax.config import ConfigError, UserError
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.worlds import world_model
from tests.helpers import randomised
from tests.properties import examples

TABLE = dataclasses.replace(
    DiTBackbone.published("5b-I2V"),
    layers=1,
    heads=1,
    head_dim=16,
    text_dim=8,
    text_length=3,
    time_dim=16,
    in_channels=4,
    out_channels=2,
    sample_height=4,
    sample_width=6,
    sample_frames=9,
)
"""A table for latents of 3 × 4 × 6, which are 3 × 2 × 3 tokens."""
OWN, OTHER_FRAMES, OTHER_SIZE = (3, 4, 6), (2, 4, 6), (3, 6, 8)


def choose(learned):
    return dataclasses.replace(TABLE, learned=learned)


@pytest.fixture(scope="module")
def params():
    return randomised(dit.init, TABLE, jax.random.key(0))


def run(config, params, shape):
    rng = np.random.default_rng(1)
    latents = jnp.asarray(rng.normal(size=(1, *shape, config.in_channels)), jnp.float32)
    text = jnp.asarray(rng.normal(size=(1, config.text_length, config.text_dim)), jnp.float32)
    return jax.jit(dit.apply, static_argnums=0)(config, params, latents, text, jnp.array([9]))


def axes(grid):
    """Centres of cells along each axis, from 0 to 1."""
    return np.meshgrid(*((np.arange(n) + 0.5) / n for n in grid), indexing="ij")


@examples(20)
@given(grid=st.tuples(st.integers(1, 3), st.integers(1, 2), st.integers(1, 3)), seed=st.integers(0))
def test_a_table_that_is_linear_in_space_and_time_stays_so(grid, seed):
    rng = np.random.default_rng(seed % 2**32)
    slopes, text = rng.normal(size=(3, 5)), rng.normal(size=(3, 5))

    def video(of):
        return np.stack(axes(of), -1).reshape(-1, 3) @ slopes

    own = positions.sample_grid(TABLE)
    table = np.concatenate([text, video(own)]).astype(np.float32)
    got = positions.resized(TABLE, jnp.asarray(table), grid)
    np.testing.assert_allclose(got, np.concatenate([text, video(grid)]), atol=1e-5)


def test_between_two_entries_lies_their_mean():
    table = jnp.arange(3 + math.prod(positions.sample_grid(TABLE)), dtype=jnp.float32)[:, None]
    rows = positions.resized(TABLE, table, (3, 3, 3))[3:, 0].reshape(3, 3, 3)
    own = table[3:, 0].reshape(3, 2, 3)
    np.testing.assert_allclose(rows[:, 1], own.mean(1))
    np.testing.assert_allclose(rows[:, [0, 2]], own)


def test_every_choice_but_drop_gives_the_table_at_its_own_size(params):
    exact = run(choose("exact"), params, OWN)
    for learned in ("interpolate", "reference"):
        np.testing.assert_array_equal(run(choose(learned), params, OWN), exact)
    assert not np.allclose(run(choose("drop"), params, OWN), exact)


@pytest.mark.parametrize("shape", [OWN, OTHER_FRAMES, OTHER_SIZE])
def test_drop_is_the_network_with_rotary_positions_alone(params, shape):
    rotary = dataclasses.replace(TABLE, positions="rope_crop")
    without = {name: part for name, part in params.items() if name != "positions"}
    want = run(rotary, without, shape)
    np.testing.assert_array_equal(run(choose("drop"), params, shape), want)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [OTHER_FRAMES, OTHER_SIZE, (1, 2, 2)])
def test_a_resized_table_is_used_and_learns(params, shape):
    def loss(params):
        return (run(choose("interpolate"), params, shape) ** 2).mean()

    gradient = jax.grad(loss)(params)["positions"]
    assert np.isfinite(gradient).all()
    assert np.abs(gradient[TABLE.text_length :]).max() > 0
    assert not np.allclose(
        run(choose("interpolate"), params, shape), run(choose("drop"), params, shape)
    )


@pytest.mark.parametrize(
    ("learned", "shape"),
    [("exact", OTHER_FRAMES), ("exact", OTHER_SIZE), ("reference", OTHER_SIZE)],
)
def test_other_sizes_are_refused_with_the_choices(params, learned, shape):
    with pytest.raises(UserError) as refusal:
        run(choose(learned), params, shape)
    for part in ("3×4×6", "×".join(map(str, shape)), "backbone.learned", "--positions"):
        assert part in str(refusal.value)


def test_the_reference_s_sinusoid_takes_the_table_s_place_where_it_is_asked_for(params):
    grid = (2, 2, 3)
    length, tokens = TABLE.text_length, TABLE.text_length + math.prod(grid)
    zeros = jnp.zeros((1, tokens, TABLE.width))
    added = positions.add(choose("reference"), zeros, params["positions"], grid)[0]
    np.testing.assert_array_equal(added[:length], 0)
    np.testing.assert_allclose(added[length:], positions.sincos_table(TABLE, grid), atol=1e-6)


def test_the_preset_takes_its_clip():
    """As shapes alone: nothing of the network is allocated."""
    model = presets.load("pewm_5b_i2v").model
    assert model.backbone.learned == "interpolate"
    like = jax.eval_shape(lambda: world_model.init(model, jax.random.key(0), memory=False))
    video = (1, *model.latent_shape, model.in_channels)
    text = (1, *model.backbone.text_shape)
    given = [jax.ShapeDtypeStruct(shape, jnp.bfloat16) for shape in (video, text, (1,))]
    sized = dataclasses.replace(model.backbone, in_channels=video[-1], out_channels=32)
    out = jax.eval_shape(functools.partial(dit.apply, sized), like["backbone"], *given)
    assert out.shape == (1, 3, 64, 64, 32)


def test_only_a_table_can_be_chosen_for():
    with pytest.raises(ConfigError, match="leave it at exact"):
        DiTBackbone(learned="interpolate")
