"""Classes of voxel frames as an error: a latent decoded alone, drawn by what it counts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import ConfigError
from pewm_jax.models.persist import voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.presets import persist_tiny
from pewm_jax.worlds.persist import stages as persist_classes
from tests.models.persist.networks import normal, weights

VAE = VoxelVAEConfig(
    side=8, classes=5, patch=2, embed=3, widths=(6,), blocks=1, middle=1, kernel=1,
    middle_kernel=1, latent_channels=4,
)  # fmt: skip


@pytest.fixture(scope="module")
def params():
    return weights(voxel_vae, VAE)


def test_a_latent_decoded_alone_says_what_it_says_in_its_grid(params):
    latents = normal(0, 2, 4, 4, 4, 4)
    classes = np.random.default_rng(1).integers(-1, 5, (2, 8, 8, 8))
    scores = jax.nn.log_softmax(voxel_vae.logits(VAE, params, latents))
    missed = -np.take_along_axis(np.asarray(scores), np.maximum(classes, 0)[..., None], -1)[..., 0]
    known = classes >= 0
    missed, known = (
        np.asarray(persist_classes.cells_of_latents(VAE, x)).reshape(-1, 8)
        for x in (missed * known, known)
    )
    ids = persist_classes.cells_of_latents(VAE, classes).reshape(-1, 8)
    error, right = jax.jit(persist_classes.latent_class_error, static_argnums=0)(
        VAE, params, latents.reshape(-1, 4), ids
    )
    np.testing.assert_allclose(error, missed.sum(1) / np.maximum(known.sum(1), 1), rtol=1e-4)
    assert ((right >= 0) & (right <= 1)).all()
    decoded = voxel_vae.decode(VAE, params, latents)
    ids = persist_classes.cells_of_latents(VAE, decoded).reshape(-1, 8)
    np.testing.assert_array_equal(
        persist_classes.latent_class_error(VAE, params, latents.reshape(-1, 4), ids)[1], 1
    )


def test_latents_count_by_their_weight_and_frames_without_any_not_at_all(params):
    latents = jnp.asarray(normal(2, 1, 2, 4, 4, 4, 4))
    classes = voxel_vae.decode(VAE, params, latents[0])[None]
    wrong = (classes + 1) % 5
    here = np.zeros((1, 2, 4, 4, 4), np.float32)
    here[:, 0, 0] = 1
    some = jnp.asarray(classes).at[:, :, 2:].set(wrong[:, :, 2:])

    @jax.jit
    def compared(latents, weight):
        return persist_classes.class_error(
            VAE, params, latents, some, weight, 50, jax.random.key(0)
        )

    assert compared(latents, here)[1] > 0.999  # the second frame counts nothing
    assert compared(latents, 1 - here)[1] < 0.5
    error, slope = jax.value_and_grad(lambda x: compared(x, here)[0])(latents)
    assert np.isfinite(error)
    assert np.isfinite(slope).all()
    moved = np.abs(slope).sum(-1) > 0
    assert moved[here > 0].any()
    assert not moved[here == 0].any()
    nothing = compared(latents, 0 * here)
    assert nothing[0] == 0


def test_a_decoder_that_looks_around_is_refused_with_classes():
    config = persist_tiny.config()
    assert config.train.classes > 0
    nets = config.model.backbone
    levels = {"widths": (256, 256), "patch": 1, "embed": 256}
    for change in ({"kernel": 3}, {"middle_kernel": 3}, levels):
        changed = dataclasses.replace(nets, voxel_vae=dataclasses.replace(nets.voxel_vae, **change))
        with pytest.raises(ConfigError, match=r"train\.classes is 4\.0, voxel_vae\.kernel \d"):
            config.with_model(backbone=changed)
    with pytest.raises(ConfigError, match=r"train\.compared is 0: use 1 or more"):
        dataclasses.replace(config.train, compared=0)
    with pytest.raises(ConfigError, match=r"train\.classes is -1\.0: use 0 or more"):
        dataclasses.replace(config.train, classes=-1.0)
