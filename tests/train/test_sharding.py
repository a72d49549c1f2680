"""The table of placements: every leaf by a rule, what does not divide left whole and named."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from pewm_jax import presets as configs
from pewm_jax.config import AXES, ConfigError, MeshConfig
from pewm_jax.io import tree, weights
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.train import sharding
from pewm_jax.train import step as state
from pewm_jax.worlds.pewm.world import STAGES
from tests.train import fakes

ONE, TWO = STAGES[:2]
MESH = jax.sharding.AbstractMesh((1, 4, 2, 1), AXES)


def large():
    """All networks there are, in published form but for size."""
    tiny = configs.load("tiny")
    vae = VAECodec(widths=(8, 8, 8, 8), groups=4, resnets=1)
    network = DINOv2Config(layers=2, heads=2, width=32, registers=4)
    backbone = dataclasses.replace(
        DiTBackbone.published("1.5-5B-I2V"),
        layers=2,
        heads=4,
        head_dim=16,
        text_length=8,
        text_dim=8,
        time_dim=16,
        ofs_dim=16,
        prompt="stored",
        in_channels=0,
        out_channels=0,
    )
    memory = dataclasses.replace(
        tiny.model.memory,
        encoder=DINOv2EncoderConfig(network=network),
        reader=dataclasses.replace(tiny.model.memory.reader, heads=8),
    )
    config = tiny.with_model(
        clip=dataclasses.replace(tiny.model.clip, frames=9, height=32, width=32),
        codec=vae,
        backbone=backbone,
        memory=memory,
        dtype="bfloat16",
    )
    return dataclasses.replace(config, train=dataclasses.replace(tiny.train, start="somewhere"))


LARGE = large().model


@functools.cache
def shapes(stage):
    return jax.eval_shape(functools.partial(state.create, large(), stage), jax.random.key(0))


@pytest.mark.parametrize("stage", STAGES[:3])
def test_every_leaf_of_every_network_has_its_place(stage):
    placed = tree.flatten(sharding.of_state(LARGE, MESH, shapes(stage)))
    for path, leaf in tree.flatten(shapes(stage)).items():
        spec = placed[path].spec
        assert len(spec) <= len(leaf.shape), path
        split = [axis for axis in spec if axis]
        big = leaf.size > 4096 and not path.endswith(("conv_out/kernel", "scale", "bias"))
        assert bool(split) or not big, f"{path} {leaf.shape} is whole"
        assert path.split("/")[-3:-2] != ["blocks"] or spec[:1] in ((), (None,)), path


def test_average_and_moments_lie_with_their_parameter():
    placed = {
        p: s.spec for p, s in tree.flatten(sharding.of_state(LARGE, MESH, shapes(ONE))).items()
    }
    name = "backbone/blocks/ff/up/kernel"
    assert placed[f"params/{name}"] == P(None, "fsdp", "tensor")
    alike = [spec for path, spec in placed.items() if path.endswith(name)]
    assert len(alike) == 4
    assert set(alike) == {P(None, "fsdp", "tensor")}
    assert placed["params/backbone/blocks/to_out/kernel"] == P(None, "tensor", "fsdp")


@pytest.mark.parametrize("part", ["backbone", "memory", "backbone/blocks", "text"])
def test_a_leaf_that_no_rule_knows_is_refused(part):
    alien = tree.unflatten({"step": 0, f"params/{part}/alien/kernel": 0})
    with pytest.raises(tree.TreeError, match=rf"sharding rules matches params/{part}/alien"):
        sharding.of_state(LARGE, MESH, alien)


def test_an_axis_that_does_not_divide_is_left_out():
    name = "backbone/blocks/to_q/kernel"
    like = tree.unflatten({f"params/{name}": jax.ShapeDtypeStruct((3, 6, 8), jnp.float32)})
    assert tree.flatten(sharding.of_state(LARGE, MESH, like))[f"params/{name}"].spec == P(
        None, None, "tensor"
    )


def test_frozen_weights_are_kept_in_half_precision_and_trained_ones_in_full():
    for path, leaf in tree.flatten(shapes(TWO).params).items():
        assert leaf.dtype == (jnp.float32 if path.startswith("memory/") else jnp.bfloat16), path
    assert {leaf.dtype.name for leaf in jax.tree.leaves(shapes(TWO).ema)} == {"float32"}
    for path, leaf in tree.flatten(shapes(ONE).params).items():
        assert leaf.dtype == (jnp.float32 if path.startswith("backbone/") else jnp.bfloat16), path


def test_heads_that_tensor_cannot_share_are_refused():
    config = fakes.config()
    mesh = jax.sharding.AbstractMesh(MeshConfig(tensor=5).shape(5), AXES)
    with pytest.raises(
        ConfigError, match=r"mesh\.tensor is 5, which does not divide backbone\.heads"
    ):
        sharding.require_divisible(config, ONE, mesh)


def test_weights_of_a_file_are_placed_from_the_file(tmp_path):
    values = {"a": {"kernel": np.arange(12, dtype=np.float32).reshape(3, 4)}}
    weights.save(tmp_path / "w.safetensors", values)
    mapped = weights.lazy(tmp_path / "w.safetensors")
    assert isinstance(mapped["a"]["kernel"], np.memmap)
    whole = sharding.replicated(sharding.make_mesh(jax.devices()[:1]))
    like = {"a": {"kernel": jax.ShapeDtypeStruct((3, 4), jnp.bfloat16, sharding=whole)}}
    placed = sharding.place(mapped, like)["a"]["kernel"]
    assert placed.dtype == jnp.bfloat16
    np.testing.assert_array_equal(np.asarray(placed, np.float32), values["a"]["kernel"])
    again = sharding.place({"a": {"kernel": placed}}, like)["a"]["kernel"]
    np.testing.assert_array_equal(again, placed)
