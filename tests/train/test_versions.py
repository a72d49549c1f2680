"""What the version before wrote still loads and trains on: its settings, runs, checkpoints.

``version1`` holds settings as that version wrote them: of the presets ``tiny`` and ``pewm_2b``, of
a finished run (``finished``) and of the checkpoint of its last step (``checkpoint``).
"""

import dataclasses
import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ConfigError
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.io import tree, weights
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.memory.points import PointsConfig
from pewm_jax.memory.voxel_map import Map2DConfig, VoxelConfig
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.train import checkpoint_files, loop, runs, sharding, step
from pewm_jax.train.checkpoint import CONFIG_ITEM, Checkpoints
from pewm_jax.worlds.pewm.world import STAGES
from tests.train import fakes
from tests.train.test_loop import train

HERE = Path(__file__).parent / "version1"
KEY = jax.random.key(0)
MEMORIES = {
    "voxel": VoxelConfig,
    "map2d": Map2DConfig,
    "points": PointsConfig,
    "images": ImagesConfig,
    "none": NoMemoryConfig,
}
READER = ("positions", "frame", "looks", "heads", "head_dim", "mlp_ratio")
RENAMED = {
    "train.dtype": "model.dtype",
    "clip.": "model.clip.",
    "actions.": "model.actions.",
    "codec.vae.": "model.codec.",
    "codec.": "model.codec.",
    "dit.": "model.backbone.",
    "memory.depth": "model.clip.depth",
    "memory.encoder": "model.memory.encoder.kind",
    "memory.encoder_": "model.memory.encoder.",
    "memory.dinov2.": "model.memory.encoder.network.",
    **{f"memory.{name}": f"model.memory.reader.{name}" for name in READER},
    "memory.": "model.memory.",
    "diffusion.image_noise_": "train.image_noise_",
    "diffusion.": "model.noise.",
}
"""What a setting was called → how it is called now; the first that fits counts. Names that end in a
dot or a line stand for all that begin so."""


def written(name="finished"):
    return json.loads((HERE / f"{name}.json").read_text())


def parsed(values):
    return configuration.from_dict(configuration.Config, values)


def flat(node, prefix=""):
    if not isinstance(node, dict):
        return {prefix: node}
    parts = (flat(value, f"{prefix}.{name}".lstrip(".")) for name, value in node.items())
    return {path: leaf for part in parts for path, leaf in part.items()}


def with_leaf(values, path, leaf):
    """Return nested values with one of them changed."""
    first, _, rest = path.partition(".")
    return {**values, first: with_leaf(values[first], rest, leaf) if rest else leaf}


def now_called(path, memory, encoder, codec):
    """Return where a setting of version 1 is now; None where what it says is not used."""
    unused = {
        "memory.snapshots": memory != "images",
        "memory.encoder_patch": encoder == "dinov2",
        "memory.encoder_size": encoder != "dinov2",
        "memory.dinov2": encoder != "dinov2",
        "codec.vae": codec != "vae",
        "codec.spatial": codec == "vae",
        "codec.temporal": codec == "vae",
    }
    if any(unused[name] for name in unused if path == name or path.startswith(f"{name}.")):
        return None
    for old, new in RENAMED.items():
        if path == old or (old.endswith((".", "_")) and path.startswith(old)):
            return f"{new}{path.removeprefix(old)}"
    return path


@pytest.mark.parametrize("codec", ["pixel", "vae"])
@pytest.mark.parametrize("encoder", ["patch_colours", "dinov2"])
@pytest.mark.parametrize("memory", MEMORIES)
def test_every_value_moves_to_its_place_and_none_is_lost_or_invented(memory, encoder, codec):
    values = written()
    values["codec"]["kind"] = codec
    values["memory"] |= {"kind": memory, "encoder": encoder}
    before = flat(configuration.upgrade(values, "here"))
    # Version 1 knew one reader, unnamed, and one key for weights and noise.
    arrived = {"version", "model.memory.reader.kind", "train.noise_key"}
    for path in flat(values):
        there = now_called(path, memory, encoder, codec)
        if path in ("codec.kind", "memory.kind", "memory.encoder"):
            assert before[there] == flat(values)[path]
            arrived.add(there)
            continue
        changed = flat(configuration.upgrade(with_leaf(values, path, "changed"), "here"))
        expected = before | ({there: "changed"} if there else {})
        assert changed == expected, path
        arrived |= {there} - {None}
    assert before.keys() == arrived


@pytest.mark.parametrize("name", ["tiny", "pewm_2b"])
def test_the_settings_of_a_preset_are_those_of_now(name):
    now = presets.load(name)
    train = dataclasses.replace(now.train, noise_key="weights", beta2=0.999)  # as they were fixed
    assert parsed(written(name)) == dataclasses.replace(now, train=train)


@pytest.mark.parametrize("kind", MEMORIES)
def test_a_memory_is_split_from_its_features_and_from_who_reads_it(kind):
    values = written()
    values["memory"] |= {
        "kind": kind,
        "depth": False,
        "cell_m": [0.5, 0.25, 1.0],
        "capacity": 300,
        "tokens": 20,
        "looks": 12,
        "positions": "sinusoid",
        "frame": "world",
        "snapshots": 5,
        "encoder_patch": 4,
        "heads": 5,
        "head_dim": 16,
        "mlp_ratio": 3,
    }
    reader = AttentionConfig("sinusoid", "world", looks=12, heads=5, head_dim=16, mlp_ratio=3)
    expected = {"cell_m": (0.5, 0.25, 1.0), "cells": (32, 32, 8), "capacity": 300, "tokens": 20}
    expected |= {"encoder": PatchColoursConfig(patch=4), "reader": reader}
    expected |= {"snapshots": 5} if kind == "images" else {}
    found = parsed(values)
    assert found.model.memory == MEMORIES[kind](**expected)
    assert found.model.clip == dataclasses.replace(presets.load("tiny").model.clip, depth=False)


def test_the_autoencoder_the_encoder_the_noise_and_the_dtype_arrive():
    values = written()
    values["codec"]["kind"] = "vae"
    values["codec"]["vae"] |= {"widths": [8, 16, 16, 16], "groups": 4, "scaling_factor": 0.7}
    network = {"layers": 2, "heads": 2, "width": 32, "registers": 4, "pretrained_size": 28}
    values["memory"] |= {"encoder": "dinov2", "encoder_size": 56}
    values["memory"]["dinov2"] |= network
    values["clip"] |= {"frames": 9, "height": 32, "width": 48}
    values["diffusion"] |= {"target": "v", "snr_shift": 3.0, "guidance": 2.0, "sampler": "dpm"}
    values["diffusion"] |= {"image_noise_mean": -2.0, "image_noise_std": 0.25}
    values["train"]["dtype"] = "bfloat16"
    found = parsed(values)
    model, train = found.model, found.train
    assert model.codec == VAECodec(widths=(8, 16, 16, 16), groups=4, scaling_factor=0.7)
    assert model.memory.encoder == DINOv2EncoderConfig(56, DINOv2Config(**network))
    assert model.noise == DDPMConfig(
        sample_steps=2, target="v", snr_shift=3.0, guidance=2.0, sampler="dpm"
    )
    assert (train.image_noise_mean, train.image_noise_std) == (-2.0, 0.25)
    assert model.dtype == "bfloat16"


def test_a_part_of_the_settings_is_as_good_as_all_of_them():
    found = parsed({"codec": {"spatial": 2}, "memory": {"heads": 8}, "train": {"seed": 3}})
    assert found.model.codec == PixelConfig(spatial=2)
    assert found.model.memory == VoxelConfig(reader=AttentionConfig(heads=8))
    assert found.train.seed == 3
    assert parsed({}) == configuration.Config()


def test_what_is_written_now_says_its_version_and_comes_back(tmp_path):
    config = parsed(written())
    configuration.save(config, tmp_path / "config.json")
    assert json.loads((tmp_path / "config.json").read_text())["version"] == configuration.VERSION
    assert configuration.load(tmp_path / "config.json") == config


@pytest.mark.parametrize("version", [99, configuration.VERSION + 1])
def test_a_newer_version_is_refused_in_a_sentence(tmp_path, version):
    (tmp_path / "config.json").write_text(json.dumps({"version": version, "world": {}}))
    with pytest.raises(ConfigError) as refused:
        pewm_jax.load(tmp_path)
    assert str(refused.value) == (
        f"config.json is of version {version}, and this pewm_jax reads versions up to "
        f"{configuration.VERSION}: install a newer pewm_jax."
    )


@pytest.mark.parametrize("version", [0, True, "2", None, 1.5])
def test_what_is_no_version_is_refused(tmp_path, version):
    (tmp_path / "config.json").write_text(json.dumps({"version": version}))
    with pytest.raises(ConfigError, match=r"config\.json says version .* whole number from 1"):
        configuration.load(tmp_path / "config.json")


def as_version_1(run):
    """Lay the settings that version 1 wrote over those of a run, its checkpoints too."""
    shutil.copy(HERE / "finished.json", run / "config.json")
    for checkpoint in run.glob("checkpoints/*/[0-9]*"):
        shutil.copy(HERE / "checkpoint.json", checkpoint / CONFIG_ITEM / "metadata")
        (checkpoint / checkpoint_files.MANIFEST).unlink()
        checkpoint_files.seal(checkpoint)


def same(left, right):
    left, right = tree.flatten(left), tree.flatten(right)
    assert left.keys() == right.keys()
    for path in left:
        assert np.asarray(left[path]).tobytes() == np.asarray(right[path]).tobytes(), path


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A run of the real model with a file of weights and a checkpoint, and its parameters."""
    run = tmp_path_factory.mktemp("real")
    config, stage = parsed(written()), STAGES[1]
    state = step.initial_state(config, stage, sharding.make_mesh(jax.devices()[:1]))
    with Checkpoints(run, config, stage) as checkpoints:
        checkpoints.save(dataclasses.replace(state, step=state.step + 6))
    runs.publish(run, stage, 6, state.params)
    as_version_1(run)
    return run, jax.device_get(state.params)


def test_runs_checkpoints_and_exports_of_version_1_load(real, tmp_path):
    run, params = real
    expected = parsed(written())
    export = tmp_path / "export"
    export.mkdir()
    for name in ("config.json", "weights.safetensors"):
        shutil.copy(run / name, export)
    unfinished = Path(shutil.copytree(run, tmp_path / "unfinished"))
    (unfinished / "weights.safetensors").unlink()
    for folder in (run, run / "checkpoints" / "stage2" / "6", unfinished, export):
        config, found = pewm_jax.load(folder)
        assert config == expected, folder
        same(found, params)


@pytest.fixture
def trained(fake_model, tmp_path):
    """A run that was trained without disturbance, and its copy with the settings of version 1."""
    config = parsed(written())
    whole = fakes.with_train(config, run=str(tmp_path / "whole"))
    loop.train(whole, log=lambda _: None)
    old = Path(shutil.copytree(tmp_path / "whole", tmp_path / "old"))
    as_version_1(old)
    return tmp_path / "whole", old


def losses(run):
    entries = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    return [(e["stage"], e["step"], e["loss"], e["grad_norm"]) for e in entries]


def test_a_finished_run_of_version_1_is_known_as_finished(trained):
    _, old = trained
    said = []
    loop.train(fakes.with_train(parsed(written()), run=str(old)), log=said.append)
    assert said == [f"{old} is already trained: nothing to do."]


@pytest.mark.parametrize("stage", ["stage1", "stage2"])
def test_training_goes_on_from_a_run_of_version_1_to_the_same_end(trained, stage):
    whole, old = trained
    shutil.rmtree(old / "checkpoints" / stage / "6")
    (old / "weights.safetensors").unlink()
    if stage == "stage1":
        shutil.rmtree(old / "checkpoints" / "stage2")
    assert set(pewm_jax.load(old)[1]) == set(fakes.init(None, KEY, memory=stage == "stage2"))
    loop.train(fakes.with_train(parsed(written()), run=str(old)), log=lambda _: None)
    assert losses(old) == losses(whole)
    same(*(weights.load(run / "weights.safetensors") for run in (old, whole)))
    assert json.loads((old / "config.json").read_text())["version"] == configuration.VERSION


def test_another_configuration_than_that_of_version_1_is_refused_by_the_names_of_now(trained):
    _, old = trained
    config = fakes.with_train(parsed(written()), run=str(old))
    other = config.with_model(backbone=dataclasses.replace(config.model.backbone, layers=3))
    with pytest.raises(ConfigError, match=r"model\.backbone\.layers 2 there, 3 here"):
        loop.train(other, log=lambda _: None)


@pytest.mark.parametrize("noise_key", ["own", "weights"])
def test_weights_and_noise_have_keys_of_their_own_except_in_runs_of_earlier_versions(noise_key):
    config = fakes.with_train(fakes.config(), noise_key=noise_key)
    keys = [step.weights_key(config, stage) for stage in fakes.STAGES[:2]]
    keys += [step.noise_key(config, stage) for stage in fakes.STAGES[:2]]
    different = {tuple(np.asarray(jax.random.key_data(key)).tolist()) for key in keys}
    assert len(different) == (4 if noise_key == "own" else 2)
    old = jax.random.fold_in(jax.random.key(config.train.seed), fakes.STAGES[0].number)
    assert bool((old == keys[0]).all()) == (noise_key == "weights")


def test_a_run_of_an_earlier_version_is_resumed_with_its_own_settings(fake_model, tmp_path):
    """Its file names neither keys nor Adam's decays; the same command now has others."""
    run = tmp_path / "run"
    old = {"noise_key": "weights", "beta2": 0.999}
    begun = fakes.with_train(fakes.config(stage1=6, stage2=2), run=str(run), save_every=2, **old)
    train(begun)
    whole = losses(run)
    (run / "weights.safetensors").unlink()
    shutil.rmtree(run / "checkpoints" / "stage2")
    for folder in (run / "checkpoints" / "stage1").glob("[0-9]*"):
        if int(folder.name) > 4:
            shutil.rmtree(folder)
    values = json.loads((run / "config.json").read_text())
    values["version"] = 3
    for name in ("noise_key", "beta1", "beta2", "epsilon"):
        del values["train"][name]
    (run / "config.json").write_text(json.dumps(values))
    for _ in range(2):  # the second start finds what the first one wrote
        now = fakes.with_train(begun, noise_key="own", beta2=0.95)
        said = "\n".join(map(str, train(now)))
        assert "keeps the settings that it was started with: " in said
        assert "train.beta2 0.999" in said
    assert losses(run) == whole
