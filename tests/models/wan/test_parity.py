"""The autoencoder of Wan 2.1 and Cosmos-Predict2 equals diffusers'."""

import json

import jax
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLWan
from safetensors.numpy import load_file

from pewm_jax.config import UserError
from pewm_jax.convert import cosmos, pipeline
from pewm_jax.models.wan import vae as model
from pewm_jax.models.wan.convert import VAE
from pewm_jax.models.wan.vae import WanVAECodec
from tests.models.cosmos.references import channels_first, channels_last
from tests.models.svd.references import distance, draw, randomise

SHRUNKEN = {
    "base_dim": 6,
    "decoder_base_dim": 8,
    "z_dim": 4,
    "dim_mult": [1, 2, 2, 1],
    "num_res_blocks": 1,
    "temperal_downsample": [False, True, True],
    "latents_mean": [0.5, -1.0, 0.1, 2.0],
    "latents_std": [1.5, 0.7, 2.0, 1.0],
}
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    network = randomise(AutoencoderKLWan(**SHRUNKEN))
    with torch.no_grad():  # so that few values are cut at ±1
        network.decoder.conv_out.weight *= 0.2
        network.decoder.norm_out.gamma *= 0.5
    folder = tmp_path_factory.mktemp("cosmos") / "vae"
    network.save_pretrained(folder)
    return network, folder, cosmos.read_vae(folder)


def videos(frames, height, width, batch=1):
    return np.tanh(draw(batch, frames, height, width, 3))


def require_equal(network, config, params, video):
    """Compare encoding, and decoding of what was encoded."""
    posterior = network.encode(channels_first(video)).latent_dist
    mean, logvar = model.encode(config, params, video)
    assert distance(mean, channels_last(posterior.mean)) < TOLERANCE
    assert distance(logvar, channels_last(posterior.logvar)) < TOLERANCE
    want = channels_last(network.decode(posterior.mean).sample)
    got = model.decode(config, params, mean)
    assert distance(got, want) < TOLERANCE
    assert 0.1 < np.mean(np.abs(want) < 1) <= 1
    assert got.shape[1] == video.shape[1]


@pytest.mark.slow(but="1")
@pytest.mark.parametrize("frames", [1, 5, 13])
def test_clips_are_encoded_and_decoded_as_by_the_reference(pair, frames):
    """Rows and columns beyond the latents are read, too: 19 × 9 pixels, 2 × 1 latents."""
    network, _, (config, params) = pair
    require_equal(network, config, params, videos(frames, 19, 9))


def test_inside_jit_chunks_are_scanned_with_the_same_result():
    """With a running sum in the place of a network, which is quicker to compile."""

    def step(chunk, past):
        out = chunk.cumsum(1) + (past["sum"] if past else 0)
        return out, {"sum": out[:, -1:]}

    def run(x):
        return model.in_chunks(step, x, 1, 4)

    x = draw(2, 13, 2, 1, 3)
    np.testing.assert_allclose(run(x), x.cumsum(1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(jax.jit(run)(x), x.cumsum(1), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(jax.jit(run)(x[:, :1]), x[:, :1])


def test_no_latent_sees_a_later_frame(pair):
    config, params = pair[2]
    video = videos(9, 19, 9)
    changed = np.concatenate([video[:, :5], -video[:, 5:]], 1)
    one, other = (model.encode(config, params, v)[0] for v in (video, changed))
    np.testing.assert_array_equal(one[:, :2], other[:, :2])
    assert distance(one[:, 2:], other[:, 2:]) > 0.01


def test_latents_are_normalised_by_the_published_numbers(pair):
    config = pair[2][0]
    latents = draw(1, 2, 3, 4, 4)
    normal = model.normalise(config, latents)
    want = (latents - np.array(SHRUNKEN["latents_mean"])) / np.array(SHRUNKEN["latents_std"])
    np.testing.assert_allclose(normal, want, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(model.restore(config, normal), latents, rtol=1e-5, atol=1e-6)


def test_what_is_written_back_is_what_was_read(pair, tmp_path):
    _, folder, (config, params) = pair
    cosmos.write_vae(config, params, tmp_path / "back")
    name = "diffusion_pytorch_model.safetensors"
    before, after = load_file(folder / name), load_file(tmp_path / "back" / name)
    assert before.keys() == after.keys()
    for key, tensor in before.items():
        np.testing.assert_array_equal(after[key], tensor)
    again = AutoencoderKLWan.from_pretrained(tmp_path / "back")
    assert VAE.read_config(dict(again.config)) == config


def test_the_published_size_has_the_reference_s_tensors():
    with torch.device("meta"):
        network = AutoencoderKLWan()
    config = VAE.read_config(dict(network.config))
    assert config == WanVAECodec()
    assert (config.spatial, config.temporal) == (8, 4)
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    want = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert pipeline.expected(VAE.entries(config), like) == want


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("_class_name", "AutoencoderKLCogVideoX", "only AutoencoderKLWan can be read"),
        ("norm_num_groups", 8, "not known: norm_num_groups"),
        ("is_residual", True, "is_residual is True; only False"),
        ("patch_size", 2, "patch_size is 2; only None"),
        ("attn_scales", [0.5], "only \\[\\] is supported"),
        ("z_dim", 4.0, "a value like 16"),
        ("decoder_base_dim", 8.5, "must be a whole number"),
        ("dim_mult", [1, 2, 2.5], "a value like \\[1, 2, 4, 4\\]"),
        ("latents_std", [1, 1, 1, 0], "numbers above 0"),
        ("latents_mean", [0], "names 1 channels"),
        ("temperal_downsample", [True], "names 1 levels"),
        ("temperal_downsample", [True] * 3, "halves time 3 times"),
    ],
)
def test_settings_that_are_not_supported_are_refused(pair, setting, value, words):
    values = json.loads((pair[1] / "config.json").read_text()) | {setting: value}
    with pytest.raises(UserError, match=words):
        VAE.read_config(values)


def test_videos_that_do_not_fit_are_refused(pair):
    config, params = pair[2]
    with pytest.raises(UserError, match="use 4n"):
        model.encode(config, params, videos(4, 8, 8))
    with pytest.raises(UserError, match="smaller than one latent, 8×8"):
        model.encode(config, params, videos(1, 7, 8))
    with pytest.raises(UserError, match="4 channels last"):
        model.decode(config, params, videos(1, 4, 4))
    with pytest.raises(UserError, match="holds int32"):
        model.decode(config, params, np.zeros((1, 1, 2, 2, 4), np.int32))
