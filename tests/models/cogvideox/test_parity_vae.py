"""The autoencoder equals diffusers' AutoencoderKLCogVideoX, chunk by chunk and tile by tile."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLCogVideoX

from pewm_jax.config import UserError
from pewm_jax.io import tree
from pewm_jax.models.cogvideox import vae
from pewm_jax.models.cogvideox.convert import VAE
from pewm_jax.models.cogvideox.vae import VAECodec
from tests import properties

SHRUNKEN = {
    "block_out_channels": (8, 12, 12, 16),
    "norm_num_groups": 4,
    "latent_channels": 4,
    "layers_per_block": 1,
    "sample_height": 96,
    "sample_width": 160,
}
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def reference():
    """A small reference with every tensor drawn at random, norms and biases included."""
    network = AutoencoderKLCogVideoX(**SHRUNKEN).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    for path, tensor in network.named_parameters():
        if tensor.ndim == 1:
            one = "norm" in path and path.endswith("weight")
            tensor.copy_(one + 0.4 * torch.randn(tensor.shape, generator=generator))
    return network


@pytest.fixture(scope="module")
def ours(reference):
    config = VAE.read_config(dict(reference.config))
    tensors = {name: tensor.numpy() for name, tensor in reference.state_dict().items()}
    leaves = {
        entry.path: jnp.asarray(entry.transform.read(tensors.pop(entry.name)))
        for entry in VAE.entries(config)
    }
    assert not tensors
    # The form that compiles fastest; the others are compared below.
    return dataclasses.replace(config, convolution="volume"), tree.unflatten(leaves)


def draw(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).clamp(-1, 1)


def last(tensor):
    """Channels last, as ours."""
    return tensor.float().permute(0, 2, 3, 4, 1).numpy()


def distance(x, wanted):
    x = np.asarray(x, np.float32)
    assert x.shape == wanted.shape
    return np.abs(x - wanted).max() / np.abs(wanted).max()


def compare(reference, ours, video):
    """Return how far our mean, variance and decoded video are from the reference's."""
    config, params = ours
    posterior = reference.encode(video).latent_dist
    decoded = reference.decode(posterior.mean).sample
    mean, logvar = vae.encode(config, params, jnp.asarray(last(video)))
    video = vae.decode(config, params, jnp.asarray(last(posterior.mean)))
    return (
        distance(mean, last(posterior.mean)),
        distance(logvar, last(posterior.logvar)),
        distance(video, last(decoded)),
    )


@pytest.mark.slow(but="9-24-8")
@pytest.mark.parametrize(
    ("frames", "height", "width"),
    [
        (1, 27, 37),
        (9, 24, 8),
        *(pytest.param(t, 24, 8, marks=pytest.mark.slow) for t in (5, 17, 33, 49)),
    ],
)
def test_it_encodes_and_decodes_as_the_reference(reference, ours, frames, height, width):
    video = draw(2, 3, frames, height, width)
    assert max(compare(reference, ours, video)) < TOLERANCE


@pytest.mark.slow
def test_the_minimal_filtering_is_the_same(reference, ours):
    config, params = ours
    ours = dataclasses.replace(config, convolution="winograd"), params
    assert max(compare(reference, ours, draw(1, 3, 9, 24, 8))) < TOLERANCE


@pytest.mark.slow
def test_inside_jit_the_chunks_are_scanned(reference, ours):
    config, params = ours
    latents = draw(2, 4, 5, 3, 1)
    decode = jax.jit(lambda x: vae.decode(config, params, x))
    video = decode(jnp.asarray(last(latents)))
    assert distance(video, last(reference.decode(latents).sample)) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
def test_an_even_number_of_latents_has_no_first_frame_rule(reference, ours, count, caplog):
    config, params = ours
    latents = draw(2, 4, count, 3, 1)
    video = vae.decode(config, params, jnp.asarray(last(latents)))
    assert video.shape[1] == 4 * count == vae.frames_of(config, count)
    assert distance(video, last(reference.decode(latents).sample)) < TOLERANCE
    assert f"{count} latents decode to {4 * count} frames" in caplog.text
    with pytest.raises(UserError, match="odd number of latents"):
        vae.decode(config, params, jnp.asarray(last(latents)), frames=4 * count - 3)


@pytest.mark.slow
def test_tiles_are_cut_and_blended_as_in_the_reference(reference, ours):
    config, params = ours
    config = dataclasses.replace(config, tiling=True)
    high, wide = draw(1, 3, 1, 88, 64), draw(1, 4, 1, 5, 18)
    reference.enable_tiling()
    try:
        mean = last(reference.encode(high).latent_dist.mean)
        decoded = last(reference.decode(wide).sample)
    finally:
        reference.disable_tiling()
    assert distance(vae.encode(config, params, jnp.asarray(last(high)))[0], mean) < TOLERANCE
    assert distance(vae.decode(config, params, jnp.asarray(last(wide))), decoded) < TOLERANCE


@pytest.mark.slow
def test_bfloat16_is_as_near_to_float32_as_the_references(reference, ours):
    config, params = dataclasses.replace(ours[0], convolution="auto"), ours[1]
    video = draw(2, 3, 9, 24, 8, seed=1)
    posterior = reference.encode(video).latent_dist
    exact = [last(posterior.parameters), last(reference.decode(posterior.mean).sample)]
    half = reference.to(torch.bfloat16)
    try:
        theirs = [
            last(half.encode(video.bfloat16()).latent_dist.parameters),
            last(half.decode(posterior.mean.bfloat16()).sample),
        ]
    finally:
        reference.to(torch.float32)
    moments = vae.encode(config, params, jnp.asarray(last(video), jnp.bfloat16))
    decoded = vae.decode(config, params, jnp.asarray(last(posterior.mean), jnp.bfloat16))
    assert decoded.dtype == jnp.bfloat16
    for x, y, z in zip([np.concatenate(moments, -1), decoded], theirs, exact, strict=True):
        assert distance(x, z) < 1.5 * distance(y, z)
        assert np.square(np.asarray(x, np.float32) - z).sum() < 1.5**2 * np.square(y - z).sum()


@pytest.mark.parametrize(
    "variant", properties.first(["2b", "5b", "5b-I2V", "1.5-5B", "1.5-5B-I2V"], 1)
)
def test_names_and_shapes_of_the_published_size_fit_without_a_weight(variant):
    config = VAECodec.published(variant)
    with torch.device("meta"):
        network = AutoencoderKLCogVideoX.from_config(VAE.write_config(config))
    wanted = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    like = tree.flatten(jax.eval_shape(lambda key: vae.init(config, key), jax.random.key(0)))
    entries = VAE.entries(config)
    nothing = np.zeros((), np.float32)
    have = {
        e.name: e.transform.write(np.broadcast_to(nothing, like[e.path].shape)).shape
        for e in entries
    }
    assert have == wanted
    assert {e.path for e in entries} == like.keys()
    assert len(entries) == len(like)
    assert VAE.read_config(dict(network.config)) == config
