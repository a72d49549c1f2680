"""The transformer equals diffusers', in all five published variants at shrunken widths."""

import dataclasses
import inspect
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import CogVideoXTransformer3DModel
from diffusers.models.embeddings import get_3d_rotary_pos_embed, get_3d_sincos_pos_embed
from diffusers.pipelines.cogvideo.pipeline_cogvideox import get_resize_crop_region_for_grid
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.io import tree
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.config import PUBLISHED
from pewm_jax.models.cogvideox.convert import TRANSFORMER
from tests import properties
from tests.properties import examples

LENGTH = 7
OLDER = {"sample_height": 8, "sample_width": 12, "sample_frames": 9}
"""A sample size whose latents, 3×8×12, a test can take."""
SHAPES = {
    "2b": [(3, 6, 10)],
    "5b": [(3, 6, 10), (1, 10, 6)],
    "5b-I2V": [(3, 8, 12), (2, 8, 12)],
    "1.5-5B": [(4, 10, 6)],
    "1.5-5B-I2V": [(2, 6, 10)],
}
"""Latents: an odd number of tokens each way, wider and taller than the sample. Learned positions
are for one size; with other numbers of frames the reference puts the sinusoid in their place, which
is said by ``learned="reference"``."""

run = jax.jit(dit.apply, static_argnums=0)


def shrunken(name):
    config = DiTBackbone.published(name)
    small = {"layers": 2, "heads": 2, "head_dim": 32, "text_dim": 24, "text_length": LENGTH}
    small |= {"time_dim": 48, "ofs_dim": 48 if config.ofs_dim else 0}
    small |= {"learned": "reference"} if config.positions == "rope_learned" else {}
    return dataclasses.replace(config, **small, **(OLDER if config.patch_t == 1 else {}))


def build(config):
    values = TRANSFORMER.write_config(config)
    return CogVideoXTransformer3DModel(**{k: v for k, v in values.items() if k[0] != "_"}).eval()


@cache
def reference(name):
    """The shrunken network with every tensor drawn, norms and biases included."""
    network = build(shrunken(name))
    generator = torch.Generator().manual_seed(PUBLISHED.index(name))
    with torch.no_grad():
        for path, tensor in network.state_dict().items():
            noise = torch.randn(tensor.shape, generator=generator)
            one = "norm" in path and path.endswith("norm.weight")
            matrix = tensor.ndim > 1 and "pos_embedding" not in path
            scale = tensor[0].numel() ** -0.5 if matrix else 0.3
            tensor.copy_(one + noise * scale)
    return network


@cache
def converted(name):
    """The reference's tensors as our parameters."""
    config, state = shrunken(name), reference(name).state_dict()
    leaves = {}
    for entry in TRANSFORMER.entries(config):
        tensor = entry.transform.read(state[entry.name].numpy())
        leaves.setdefault(entry.path, {})[entry.layer] = tensor
    stacked = {
        path: parts[None] if None in parts else np.stack([parts[i] for i in range(config.layers)])
        for path, parts in leaves.items()
    }
    return jax.tree.map(jnp.asarray, tree.unflatten(stacked))


def rotary(config, shape):
    """What CogVideoX's pipelines hand to their transformer for latents of (t, h, w)."""
    frames, rows, columns = shape[0], shape[1] // config.patch, shape[2] // config.patch
    base = config.sample_height // config.patch, config.sample_width // config.patch
    if config.positions == "sincos":
        return None
    if config.positions == "rope_integer":
        return get_3d_rotary_pos_embed(
            config.head_dim,
            None,
            (rows, columns),
            frames // config.patch_t,
            grid_type="slice",
            max_size=base,
        )
    crop = get_resize_crop_region_for_grid((rows, columns), base[1], base[0])
    return get_3d_rotary_pos_embed(config.head_dim, crop, (rows, columns), frames)


def inputs(config, shape, seed=0):
    rng = np.random.default_rng(seed)
    latents = rng.normal(size=(2, *shape, config.in_channels)).astype(np.float32)
    text = rng.normal(size=(2, LENGTH, config.text_dim)).astype(np.float32)
    return latents, text


def theirs(network, config, latents, text, times, ofs=None):
    """The reference's output, channels last."""
    dtype = network.proj_out.weight.dtype
    extra = {} if ofs is None else {"ofs": torch.tensor(ofs)}
    out = network(
        torch.as_tensor(latents).to(dtype).permute(0, 1, 4, 2, 3),
        torch.as_tensor(text).to(dtype),
        torch.tensor(times),
        image_rotary_emb=rotary(config, latents.shape[1:4]),
        return_dict=False,
        **extra,
    )[0]
    return out.permute(0, 1, 3, 4, 2)


def distance(got, want):
    want = np.asarray(want, np.float32)
    return np.abs(np.asarray(got, np.float32) - want).max() / np.abs(want).max()


@pytest.mark.parametrize("name", properties.first(PUBLISHED, 2))
def test_equal_end_to_end(name):
    config, network, params = shrunken(name), reference(name), converted(name)
    tree.require_like(params, jax.eval_shape(lambda: dit.init(config, jax.random.key(0))), name)
    for shape in SHAPES[name]:
        latents, text = inputs(config, shape)
        for times, ofs in (([0, 999], [2.0, 2.0]), ([500, 21], [1.0, 3.5])):
            second = ofs if config.ofs_dim else None
            with torch.no_grad():
                want = theirs(network, config, latents, text, times, second)
            given = (latents, text, np.array(times), second and np.array(second))
            got = run(config, params, *given)
            assert got.shape == want.shape
            assert distance(got, want) < 2e-5, (shape, times)


@pytest.mark.slow
def test_in_bfloat16_no_further_from_float32_than_the_reference():
    name = "5b"
    config, network = shrunken(name), reference(name)
    latents, text = inputs(config, (3, 6, 10))
    half = build(config).to(torch.bfloat16)
    half.load_state_dict(network.state_dict())
    with torch.no_grad():
        exact = theirs(network, config, latents, text, [0, 999])
        peer = theirs(half, config, latents, text, [0, 999]).float()
    params = jax.tree.map(lambda x: x.astype(jnp.bfloat16), converted(name))
    cast = (jnp.asarray(x, jnp.bfloat16) for x in (latents, text))
    got = run(config, params, *cast, np.array([0, 999]))
    assert got.dtype == jnp.bfloat16
    assert 0 < distance(got, exact) < 1.5 * distance(peer, exact)


def test_gradients_are_equal():
    name, times = "5b", [100, 900]
    config, network = shrunken(name), reference(name)
    latents, text = inputs(config, (3, 6, 10))
    target = np.random.default_rng(1).normal(size=latents.shape).astype(np.float32)
    network.zero_grad()
    (theirs(network, config, latents, text, times) * torch.tensor(target)).sum().backward()

    @jax.jit
    def gradient(params):
        out = dit.apply(config, params, jnp.asarray(latents), text, np.array(times))
        return (out * target).sum()

    ours = tree.flatten(jax.jit(jax.grad(gradient))(converted(name)))
    wanted = {path: parameter.grad.numpy() for path, parameter in network.named_parameters()}
    for entry in TRANSFORMER.entries(config):
        got = ours[entry.path] if entry.layer is None else ours[entry.path][entry.layer]
        # The keys' common part moves no softmax, so the gradient of its bias is rounding alone.
        scale = max(np.abs(wanted[entry.name]).max(), 1e-3)
        off = np.abs(got - entry.transform.read(wanted[entry.name])).max() / scale
        assert off < 1e-4, (entry.name, off)


@examples(30)
@given(
    name=st.sampled_from(["5b", "5b-I2V", "1.5-5B"]),
    t=st.integers(1, 13),
    rows=st.integers(1, 60),
    columns=st.integers(1, 60),
)
def test_rotary_angles_are_the_pipelines(name, t, rows, columns):
    config = DiTBackbone.published(name)
    want = rotary(config, (t * config.patch_t, 2 * rows, 2 * columns))
    angles = positions.joint_angles(config, (t, rows, columns), 5)
    assert not angles[:5].any(), "text is not turned"
    for turn, there in zip((np.cos, np.sin), want, strict=True):
        np.testing.assert_allclose(turn(angles[5:]).repeat(2, -1), there, atol=3e-5)


@examples(20)
@given(t=st.integers(1, 13), rows=st.integers(1, 40), columns=st.integers(1, 40))
def test_the_sinusoid_of_positions_is_the_references(t, rows, columns):
    config = dataclasses.replace(DiTBackbone.published("2b"), heads=1, temporal_interpolation=1.25)
    want = get_3d_sincos_pos_embed(
        config.width, (columns, rows), t, config.spatial_interpolation, 1.25
    )
    got = positions.sincos_table(config, (t, rows, columns))
    np.testing.assert_allclose(got, want.flatten(0, 1), atol=1e-5)


@pytest.mark.parametrize("name", PUBLISHED)
def test_at_full_size_names_and_shapes_are_the_references(name):
    config = DiTBackbone.published(name)
    with torch.device("meta"):
        network = build(config)
    there = network.state_dict()
    assert {tensor.device.type for tensor in there.values()} == {"meta"}
    listed = TRANSFORMER.entries(config)
    assert sorted(entry.name for entry in listed) == sorted(there)

    abstract = jax.eval_shape(lambda: dit.init(config, jax.random.key(0)))
    ours = tree.flatten(abstract)
    filled = {path: set() for path in ours}
    for entry in listed:
        shape = tuple(there[entry.name].shape)
        turned = np.shape(entry.transform.read(np.broadcast_to(np.float32(0), shape)))
        back = np.shape(entry.transform.write(np.broadcast_to(np.float32(0), turned)))
        leaf = ours[entry.path].shape
        assert (turned, back) == (leaf if entry.layer is None else leaf[1:], shape), entry
        assert entry.layer not in filled[entry.path], "two tensors for one place"
        filled[entry.path].add(entry.layer)
    every = set(range(config.layers))
    assert all(places == ({None} if None in places else every) for places in filled.values())


@pytest.mark.parametrize("name", PUBLISHED)
def test_settings_survive_the_journey(name):
    for config in (DiTBackbone.published(name), shrunken(name)):
        values = TRANSFORMER.write_config(config)
        stated = dataclasses.replace(config, learned="exact")  # diffusers has no name for it
        assert TRANSFORMER.read_config(values) == stated
        known = set(inspect.signature(CogVideoXTransformer3DModel.__init__).parameters)
        assert {k for k in values if k[0] != "_"} == known - {"self"}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"gravity": 9.81}, "not known: gravity"),
        ({"activation_fn": "silu"}, "activation_fn is 'silu'"),
        ({"norm_eps": 1e-6}, "norm_eps"),
        ({"num_layers": "42"}, "num_layers is '42'; give a value like 30"),
        ({"patch_bias": False}, "patch_bias"),
        ({"patch_size_t": 2}, "patch_size_t with no rotary"),
        ({"use_learned_positional_embeddings": True}, "only both together"),
        ({"_class_name": "WanTransformer3DModel"}, "is a WanTransformer3DModel"),
        ({"attention_head_dim": 20, "use_rotary_positional_embeddings": True}, "multiple of 16"),
    ],
)
def test_settings_that_are_not_known_are_refused_by_name(changes, says):
    with pytest.raises(UserError, match=says):
        TRANSFORMER.read_config(changes)


def test_absent_settings_are_the_references_defaults():
    assert TRANSFORMER.read_config({}) == DiTBackbone.published("2b")
