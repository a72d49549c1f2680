"""The autoencoder of Stable Video Diffusion equals diffusers'."""

import json

import jax
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLTemporalDecoder
from safetensors.numpy import load_file

from pewm_jax.config import UserError
from pewm_jax.convert import pipeline, svd
from pewm_jax.models.svd import vae as model
from pewm_jax.models.svd.convert import BLOCK, VAE
from pewm_jax.models.svd.vae import SVDVAECodec
from tests.models.svd.references import distance, draw, first, randomise

WIDTHS = (32, 64)
TOLERANCE = 1e-4


def reference(widths):
    blocks = [BLOCK] * len(widths)
    return AutoencoderKLTemporalDecoder(
        block_out_channels=widths, down_block_types=blocks, layers_per_block=2
    )


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    network = randomise(reference(WIDTHS))
    folder = tmp_path_factory.mktemp("svd") / "vae"
    network.save_pretrained(folder)
    return network, folder, svd.read_vae(folder)


def test_frames_are_encoded_to_the_reference_s_mode(pair):
    network, _, (config, params) = pair
    video = draw(2, 2, 6, 10, 3)
    want = network.encode(first(video).flatten(0, 1)).latent_dist.mode()
    got = model.encode(config, params, video)
    want = np.moveaxis(want.unflatten(0, (2, 2)).numpy(), 2, -1)
    assert distance(got, want) < TOLERANCE


def decoded(network, latents):
    batch, frames = latents.shape[:2]
    out = network.decode(first(latents).flatten(0, 1), num_frames=frames).sample
    return np.moveaxis(out.unflatten(0, (batch, frames)).numpy(), 2, -1)


def test_frames_are_decoded_as_by_the_reference_together_and_some_at_a_time(pair):
    network, _, (config, params) = pair
    latents = draw(2, 6, 3, 5, 4)
    want = [decoded(network, latents[:, k : k + 3]) for k in (0, 3)]
    got = model.decode(config, params, latents, at_once=3)
    assert got.shape == (2, 6, 6, 10, 3)
    assert distance(got, np.concatenate(want, 1)) < TOLERANCE
    with pytest.raises(UserError, match="at least one frame"):
        model.decode(config, params, latents, at_once=0)
    whole = model.decode(config, params, latents[:, :3])
    np.testing.assert_array_equal(whole, got[:, :3])


def test_what_is_written_back_is_what_was_read(pair, tmp_path):
    _, folder, (config, params) = pair
    svd.write_vae(config, params, tmp_path / "back")
    name = "diffusion_pytorch_model.safetensors"
    before, after = load_file(folder / name), load_file(tmp_path / "back" / name)
    assert before.keys() == after.keys()
    for key, tensor in before.items():
        np.testing.assert_array_equal(after[key], tensor)
    again = AutoencoderKLTemporalDecoder.from_pretrained(tmp_path / "back")
    assert VAE.read_config(dict(again.config)) == config


@pytest.mark.slow
def test_the_published_size_has_the_reference_s_tensors():
    config = SVDVAECodec()
    with torch.device("meta"):
        network = reference(config.widths)
    assert VAE.read_config(dict(network.config)) == config
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    want = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert pipeline.expected(VAE.entries(config), like) == want


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("norm_num_groups", 8, "not known: norm_num_groups"),
        (
            "down_block_types",
            ["AttnDownEncoderBlock2D"] * 2,
            "only .*DownEncoderBlock2D.* is",
        ),
        ("latent_channels", 1.5, "a value like 4"),
        ("scaling_factor", None, "a value like 0.18215"),
        ("layers_per_block", 1, "at least 2"),
    ],
)
def test_settings_that_are_not_supported_are_refused(pair, setting, value, words):
    _, folder, _ = pair
    values = json.loads((folder / "config.json").read_text()) | {setting: value}
    with pytest.raises(UserError, match=words):
        VAE.read_config(values)


def test_videos_that_do_not_fit_are_refused(pair):
    config, params = pair[2]
    with pytest.raises(UserError, match="multiples of 2"):
        model.encode(config, params, draw(1, 1, 5, 4, 3))
    with pytest.raises(UserError, match="4 channels last"):
        model.decode(config, params, draw(1, 1, 4, 4, 3))
