"""Widening, on the two layers alone and for any patch: new inputs weigh nothing, and it inverts."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.convert import widen
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.nn import tokens
from tests.properties import examples


def build(patch, patch_t, latents, *, image):
    inputs = 2 * latents if image else latents
    return DiTBackbone(patch=patch, patch_t=patch_t, in_channels=inputs, out_channels=latents)


@examples(30)
@given(
    patch=st.integers(1, 3),
    patch_t=st.integers(1, 2),
    latents=st.integers(1, 5),
    camera=st.integers(0, 6),
    image=st.booleans(),
    seed=st.integers(0, 99),
)
def test_old_channels_keep_their_weights_wherever_they_go(
    patch, patch_t, latents, camera, image, seed
):
    rng = np.random.default_rng(seed)
    old = build(patch, patch_t, latents, image=image)
    plan = widen.plan(old, latents, camera)
    cells = patch_t * patch**2
    params = {
        "patch_embed": {"kernel": rng.normal(size=(old.in_channels * cells, 3)), "bias": 1.0},
        "proj_out": {
            "kernel": rng.normal(size=(3, latents * cells)),
            "bias": rng.normal(size=latents * cells),
        },
    }
    wide = widen.widen(plan, params)
    size = (1, 2 * patch_t, 2 * patch, patch)
    seen = rng.normal(size=(*size, 4 * latents + camera))
    known = seen[..., :latents]
    if image:
        known = np.concatenate([known, seen[..., 2 * latents : 3 * latents]], -1)

    def embed(latents_BthwC, kernel):
        return tokens.patchify(latents_BthwC, patch, patch_t) @ kernel

    token = embed(known, params["patch_embed"]["kernel"])
    np.testing.assert_allclose(embed(seen, wide["patch_embed"]["kernel"]), token, atol=1e-12)

    def project(layer):
        rows = token @ layer["kernel"] + layer["bias"]
        return tokens.unpatchify(rows, *size[1:], patch, patch_t)

    made = project(wide["proj_out"])
    np.testing.assert_allclose(made[..., :latents], project(params["proj_out"]), atol=1e-12)
    assert not made[..., latents:].any()

    back = widen.narrow(plan, wide)
    for name in ("kernel", "bias"):
        np.testing.assert_array_equal(back["proj_out"][name], params["proj_out"][name])
    np.testing.assert_array_equal(back["patch_embed"]["kernel"], params["patch_embed"]["kernel"])


def test_a_transformer_of_other_channels_is_refused():
    old = dataclasses.replace(build(2, 1, 4, image=False), in_channels=12)
    with pytest.raises(UserError, match="has 12 input and 4 output channels"):
        widen.plan(old, 4, 24)
