"""The transformer of Cosmos equals diffusers', a time and a modulation per frame included."""

import dataclasses
import functools
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import CosmosTransformer3DModel
from diffusers.models.transformers.transformer_cosmos import (
    CosmosAdaLayerNorm,
    CosmosAdaLayerNormZero,
)
from safetensors.numpy import load_file, save_file

from pewm_jax.config import UserError
from pewm_jax.convert import cosmos, pipeline
from pewm_jax.io import tree
from pewm_jax.models.cosmos import model
from pewm_jax.models.cosmos.backbone import COSMOS_2B, COSMOS_14B, CosmosBackbone
from pewm_jax.models.cosmos.convert import TRANSFORMER
from tests import properties
from tests.models.cosmos.references import channels_first, channels_last, transformer
from tests.models.svd.references import distance, draw

TOLERANCE = 1e-4
FILE = "diffusion_pytorch_model.safetensors"


def ours(network):
    """Return a reference's settings and weights as ours."""
    config = TRANSFORMER.read_config(dict(network.config))
    tensors = network.state_dict()
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    leaves = {path: np.empty(x.shape, np.float32) for path, x in tree.flatten(like).items()}
    for entry in TRANSFORMER.entries(config):
        place = leaves[entry.path] if entry.layer is None else leaves[entry.path][entry.layer]
        place[...] = entry.transform.read(tensors[entry.name].numpy())
    return config, tree.unflatten(leaves)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    network = transformer()
    folder = tmp_path_factory.mktemp("cosmos") / "transformer"
    network.save_pretrained(folder)
    return network, folder, cosmos.read_transformer(folder)


@functools.cache
def compiled():
    return jax.jit(model.apply, static_argnums=0)


def inputs(frames=3, height=6, width=10, *, batch=2, per_frame=True, text=24):
    """Latents, times, text, the mask of given frames, and one of padding of another size."""
    rng = np.random.default_rng(3)
    times = rng.uniform(0.001, 0.99, (batch, frames) if per_frame else (batch,))
    given = np.zeros((batch, frames, height, width, 1), np.float32)
    given[:, 0] = 1
    padding = (draw(1, 3 * height + 1, 2 * width, 1, seed=4) > 0.5).astype(np.float32)
    latents = draw(batch, frames, height, width, 4)
    return latents, times.astype(np.float32), draw(batch, 5, text, seed=1), given, padding


def reference(network, latents, times, text, given, padding, fps=None):
    times = torch.tensor(times)
    out = network(
        channels_first(latents),
        times[:, None, :, None, None] if times.ndim == 2 else times,
        torch.tensor(text),
        condition_mask=channels_first(given),
        padding_mask=None if padding is None else channels_first(padding),
        fps=fps,
    ).sample
    return channels_last(out)


@pytest.mark.parametrize(("per_frame", "fps"), [(True, 16), (False, None)])
def test_it_predicts_as_the_reference_with_a_time_per_clip_and_per_frame(pair, per_frame, fps):
    network, _, (config, params) = pair
    arguments = inputs(per_frame=per_frame)
    want = reference(network, *arguments, fps)
    assert distance(compiled()(config, params, *arguments, fps), want) < TOLERANCE


def test_rate_times_and_masks_matter(pair):
    network, _, (config, params) = pair
    arguments = inputs()
    base = compiled()(config, params, *arguments, 16)
    others = [compiled()(config, params, *arguments, 8)]
    for k in range(5):
        changed = list(arguments)
        changed[k] = 1 - changed[k]
        others.append(compiled()(config, params, *changed, 16))
    assert min(distance(other, base) for other in others) > 20 * TOLERANCE
    zero = compiled()(config, params, *arguments[:4], None, 16)
    want = reference(network, *arguments[:4], 0 * arguments[4], 16)
    assert distance(zero, want) < TOLERANCE


VARIANTS = {
    "Predict1": {"extra_pos_embed_type": "learnable", "rope_scale": (2.0, 1.0, 1.0)},
    "Predict2.5": {
        "use_crossattn_projection": True,
        "crossattn_proj_in_channels": 40,
        "encoder_hidden_states_channels": 24,
    },
    "no mask": {"concat_padding_mask": False, "attention_head_dim": 22},
    "two frames to a token": {"patch_size": (2, 1, 1), "extra_pos_embed_type": "learnable"},
}


@pytest.mark.parametrize("variant", properties.first(VARIANTS, 1))
def test_every_variant_predicts_as_the_reference(variant):
    network = transformer(**VARIANTS[variant], num_layers=1)
    config, params = ours(network)
    settings = {"frames": 4, "height": 2, "width": 6, "per_frame": config.patch_t == 1}
    arguments = inputs(**settings, text=config.raw_text_dim or 24)
    arguments = arguments if config.padding_mask else (*arguments[:4], None)
    got = compiled()(config, params, *arguments, 10)
    assert distance(got, reference(network, *arguments, 10)) < TOLERANCE
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    want = {name: tuple(x.shape) for name, x in network.state_dict().items()}
    assert pipeline.expected(TRANSFORMER.entries(config), like) == want
    written = TRANSFORMER.write_config(config)
    assert TRANSFORMER.read_config(written) == config


@pytest.mark.parametrize("per_frame", [True, False])
def test_modulation_is_added_per_frame_wherever_the_time_modulates(pair, per_frame):
    network, _, (config, params) = pair
    arguments = inputs(3, 4, 2, per_frame=per_frame)
    modulation = draw(2, 3, config.time_dim, seed=2)
    more = torch.tensor(modulation).repeat_interleave(2 * 1, 1)

    def add(_norm, given):
        sample, embedded, shared = given
        spread = (x if x.ndim == 3 else x[:, None] for x in (embedded + 0, shared))
        embedded, shared = spread
        return sample, embedded + more, shared

    kinds = (CosmosAdaLayerNorm, CosmosAdaLayerNormZero)
    hooks = [m.register_forward_pre_hook(add) for m in network.modules() if isinstance(m, kinds)]
    want = reference(network, *arguments, 16)
    for hook in hooks:
        hook.remove()
    assert len(hooks) == 3 * config.layers + 1

    @jax.jit
    def steered(modulation):
        return model.apply(config, params, *arguments, 16, modulation_BtE=modulation)

    assert distance(steered(modulation), want) < TOLERANCE
    plain = reference(network, *arguments, 16)
    assert distance(plain, want) > 0.01
    assert distance(steered(0 * modulation), plain) < TOLERANCE
    # Attention over time is not causal: the last frame's modulation reaches the first.
    late = np.concatenate([modulation[:, :2], -modulation[:, 2:]], 1)
    assert distance(steered(late)[:, :1], want[:, :1]) > 0.001


def test_memory_blocks_run_after_every_block_and_tokens_can_be_added(pair):
    config, params = pair[2]
    arguments = inputs()
    plain = compiled()(config, params, *arguments, 16)
    seen = []

    def memory_block(gain, video, time):
        seen.append((video.shape, time.shape))
        return video * gain

    @jax.jit
    def run(gains, added):
        return model.apply(
            config,
            params,
            *arguments,
            16,
            memory_block=memory_block,
            memory_params=gains,
            added_BND=added,
        )

    tokens = (2, 3 * 3 * 5, config.width)
    added = draw(*tokens)
    got = run(jnp.ones(config.layers), 0 * added)
    np.testing.assert_allclose(got, plain, rtol=1e-4, atol=1e-4)
    assert seen == [(tokens, (2, 3, config.width))]
    assert distance(run(jnp.array([1.0, -1.0]), 0 * added), plain) > 0.01
    assert distance(run(jnp.ones(config.layers), added), plain) > 0.01


@pytest.mark.parametrize("remat", [True, False])
def test_activations_are_recomputed_if_asked_for(pair, remat):
    config = dataclasses.replace(pair[2][0], remat=remat)
    traced = jax.make_jaxpr(functools.partial(model.apply, config))(pair[2][1], *inputs())
    assert ("remat" in str(traced)) == remat


def test_what_is_written_back_is_what_was_read(pair, tmp_path):
    _, folder, (config, params) = pair
    cosmos.write_transformer(config, params, tmp_path / "back")
    before, after = load_file(folder / FILE), load_file(tmp_path / "back" / FILE)
    assert before.keys() == after.keys()
    for key, tensor in before.items():
        np.testing.assert_array_equal(after[key], tensor)
    again = CosmosTransformer3DModel.from_pretrained(tmp_path / "back")
    assert TRANSFORMER.read_config(dict(again.config)) == config


PUBLISHED = {
    "2B": (COSMOS_2B, {"num_layers": 28, "num_attention_heads": 16, "rope_scale": (1, 3, 3)}),
    "14B": (
        COSMOS_14B,
        {"num_layers": 36, "num_attention_heads": 40, "rope_scale": (20 / 24, 2.0, 2.0)},
    ),
}


def abstract(config):
    return jax.eval_shape(lambda: model.init(config, jax.random.key(0)))


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_sizes_have_the_reference_s_tensors(name):
    config, settings = PUBLISHED[name]
    with torch.device("meta"):
        network = CosmosTransformer3DModel(in_channels=17, extra_pos_embed_type=None, **settings)
    assert TRANSFORMER.read_config(dict(network.config)) == config
    want = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert pipeline.expected(TRANSFORMER.entries(config), abstract(config)) == want


@pytest.mark.parametrize("settings", [{}, {"learned_positions": True, "raw_text_dim": 8}], ids=str)
def test_every_parameter_has_one_place_on_a_mesh(settings):
    config = dataclasses.replace(COSMOS_2B, **settings)
    paths = {f"backbone/{path}": x for path, x in tree.flatten(abstract(config)).items()}
    rules = dict(model.SHARDING)
    found = {path: [r for r in rules if re.fullmatch(r, path)] for path in paths}
    assert [path for path, matched in found.items() if len(matched) != 1] == []
    for path, leaf in paths.items():
        spec, axes = rules[found[path][0]], leaf.ndim - path.startswith("backbone/blocks/")
        assert len(spec) == (axes if axes > 1 else 0), path


def test_every_tensor_must_be_used_and_there(pair, tmp_path):
    _, folder, _ = pair
    tensors = load_file(folder / FILE)
    tensors["proj_out.more"] = tensors.pop("proj_out.weight")
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    save_file(tensors, tmp_path / FILE)
    with pytest.raises(UserError, match=r"lacks 1 tensors \(proj_out.weight\) and has 1 .*more"):
        cosmos.read_transformer(tmp_path)


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("_class_name", "WanTransformer3DModel", "only CosmosTransformer3DModel can be read"),
        ("dropout", 0.1, "not known: dropout"),
        ("img_context_dim_in", 64, "only None is supported"),
        ("patch_size", [1, 2, 1], "only square patches"),
        ("rope_scale", [1, 3], r"a value like \(2.0, 1.0, 1.0\)"),
        ("num_layers", 2.5, "a value like 28"),
        ("extra_pos_embed_type", "sincos", "supported are None, learnable"),
        ("attention_head_dim", 10, "head_dim is 10"),
    ],
)
def test_settings_that_are_not_supported_are_refused(pair, setting, value, words):
    values = json.loads((pair[1] / "config.json").read_text()) | {setting: value}
    with pytest.raises(UserError, match=words):
        TRANSFORMER.read_config(values)


def test_a_projection_of_the_text_that_does_not_fit_is_refused():
    values = VARIANTS["Predict2.5"] | {"text_embed_dim": 32}
    with pytest.raises(UserError, match="is not its text_embed_dim 32"):
        TRANSFORMER.read_config(values)


@pytest.mark.parametrize("which", range(5))
def test_arguments_of_another_shape_are_refused(pair, which):
    config, params = pair[2]
    arguments = list(inputs())
    arguments[which] = arguments[which][..., :-1]
    with pytest.raises(UserError, match=r"must be|the network takes 5"):
        model.apply(config, params, *arguments)


@pytest.mark.parametrize(
    ("sizes", "settings", "words"),
    [
        ((1, 5, 4), {}, "multiples of 2"),
        ((9, 2, 2), {}, r"positions reach \(8, 8, 8\)"),
        ((1, 14, 2), {"learned_positions": True}, r"positions reach \(8, 6, 6\)"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(pair, sizes, settings, words):
    config = dataclasses.replace(pair[2][0], **settings)
    with pytest.raises(UserError, match=words):
        model.apply(config, pair[2][1], *inputs(*sizes))


def test_the_defaults_are_those_of_the_published_model():
    assert CosmosBackbone() == COSMOS_2B
    assert (COSMOS_2B.width, COSMOS_14B.width) == (2048, 5120)
