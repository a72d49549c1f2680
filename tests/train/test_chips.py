"""The table of devices: known by the names of JAX and of people."""

import pytest

from pewm_jax.config import ConfigError
from pewm_jax.train import chips


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("h100", "h100"),
        ("NVIDIA H100 80GB HBM3", "h100"),
        ("H200", "h200"),
        ("NVIDIA H200", "h200"),
        ("b200", "b200"),
        ("NVIDIA B200", "b200"),
        ("v5p", "v5p"),
        ("tpu-v5p", "v5p"),
        ("TPU v5p", "v5p"),
        ("TPU v5", "v5p"),
        ("tpu_v6e", "v6e"),
        ("TPU v6 lite", "v6e"),
        ("a100", "a100"),
        ("NVIDIA A100-SXM4-80GB", "a100"),
        ("TPU v4", "v4"),
        ("TPU v5 lite", "v5e"),
        ("tpu-v5e", "v5e"),
        ("TPU7x", "tpu7x"),
    ],
)
def test_a_chip_is_known_by_what_jax_and_people_call_it(text, name):
    assert chips.named(text).name == name


@pytest.mark.parametrize(
    "text", ["cpu", "TPU v3", "NVIDIA H100 PCIe", "NVIDIA A100", "NVIDIA A100-SXM4-40GB", ""]
)
def test_others_are_not_taken_for_one_of_them(text):
    assert chips.find(text) is None


def test_an_unknown_chip_is_refused_with_the_known_ones():
    with pytest.raises(
        ConfigError, match="a100, rtx4090, h100, h200, b200, v4, v5e, v5p, v6e, tpu7x"
    ):
        chips.named("h900")


def test_figures_have_the_size_of_what_is_built():
    for chip in chips.CHIPS:
        assert 1e14 < chip.flops < 1e16, chip
        assert 1.6e10 < chip.memory < 1e12, chip
        assert 8e11 < chip.bandwidth < 1e13, chip
        assert chip.network < chip.link < chip.bandwidth, chip


def test_every_chip_is_found_by_its_name():
    for chip in chips.CHIPS:
        assert chips.named(chip.name) is chip
