"""Flags of an experiment: in short, by the names they once had, and with kinds of parts."""

import dataclasses
import json
from pathlib import Path

import pytest

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax import registry as kinds
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config, ConfigError
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.diffusion.flow import FlowConfig
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from tests.properties import cases

TINY = presets.load("tiny")
VERSION_1 = Path(__file__).parent / "version_1"


def parse(*argv, default=TINY):
    return cli.parse(Config, [str(word) for word in argv], default=default, prog="python train.py")


def leaves(table, prefix=""):
    for name, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def test_the_model_s_settings_have_short_names():
    world = ("--model.kind", "--version")
    full = [
        name for name, _ in cli.flags_of(TINY) if name.startswith("--model.") and name not in world
    ]
    short = [name.replace("--model.", "--") for name in full]
    assert len(full) > 50
    assert cli.full_names(short, TINY) == full
    assert cli.full_names(full, TINY) == full
    other = [
        name for name, _ in cli.flags_of(TINY) if not name.startswith("--model.") or name in world
    ]
    assert cli.full_names(other, TINY) == other


def test_a_short_name_a_full_one_and_one_with_hyphens_set_the_same():
    want = TINY.with_model(clip=dataclasses.replace(TINY.model.clip, near_m=0.5))
    for flag in ("clip.near_m", "model.clip.near_m", "clip.near-m", "model.clip.near-m"):
        assert parse(f"--{flag}", 0.5) == want
        assert parse(f"--{flag}=0.5") == want
    assert parse("--dtype", "bfloat16") == TINY.with_model(dtype="bfloat16")
    assert not parse("--clip.no_depth").model.clip.depth


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["--dit.layers", 3], ["--model.backbone.layers", 3]),
        (["--dit.remat"], ["--model.backbone.remat"]),
        (["--diffusion.sample_steps", 4], ["--model.noise.sample_steps", 4]),
        (["--diffusion.image_noise_std=0.1"], ["--train.image_noise_std", 0.1]),
        (["--train.dtype", "bfloat16"], ["--model.dtype", "bfloat16"]),
        (["--memory.heads", 5], ["--model.memory.reader.heads", 5]),
        (["--memory.head-dim", 16], ["--model.memory.reader.head_dim", 16]),
        (["--memory.positions", "sinusoid"], ["--model.memory.reader.positions", "sinusoid"]),
        (["--memory.encoder_patch", 4], ["--model.memory.encoder.patch", 4]),
        (["--memory.encoder", "dinov2"], ["--model.memory.encoder.kind", "dinov2"]),
        (["--memory.no_depth"], ["--model.clip.no_depth"]),
        (["--memory.read", "render"], ["--model.memory.reader.kind", "render"]),
        (["--model.memory.read=both"], ["--model.memory.reader.kind", "both"]),
        (["--memory.tokens", 8], ["--model.memory.tokens", 8]),
        (["--actions.step_m", 2], ["--model.actions.step_m", 2]),
    ],
)
def test_old_names_set_what_they_set(old, new):
    assert parse(*old) == parse(*new) != TINY


def test_a_kind_is_chosen_by_its_earlier_name_too_and_keeps_what_the_kinds_share():
    both = parse("--memory.read", "both", "--memory.reader.picture_width", 32)
    assert (both.model.memory.reader.heads, both.model.memory.reader.picture_width) == (4, 32)
    assert parse("--memory.reader.kind", "attention", default=both) == TINY


def test_every_flag_of_an_earlier_version_is_one_now():
    preset = presets.load("pewm_2b")
    old = [f"--{name}" for name in leaves(json.loads((VERSION_1 / "pewm_2b.json").read_text()))]
    now = set(cli.full_names(old, preset))
    known = {name for name, _ in cli.flags_of(preset)}
    of_other_kinds = {
        "--model.codec.spatial",
        "--model.memory.snapshots",
        "--model.memory.encoder.patch",
    }
    assert now - known == of_other_kinds
    assert len(now) > 90


@pytest.mark.parametrize("section", ["codec", "memory", "noise", "memory.encoder", "memory.reader"])
def test_every_kind_can_be_put_into_its_section(section):
    part = section.rsplit(".", 1)[-1]
    fitting = {"latents": ("--codec.kind", "learned")}
    for name in kinds.names(part):
        others = fitting.get(name, ())
        default = (
            presets.load("persist_tiny") if name == "grid" else Config()
        )  # of that world alone
        found = parse(f"--{section}.kind", name, *others, default=default).model
        for step in section.split("."):
            found = getattr(found, step)
        assert kinds.of(found).name == name


def test_small_takes_noise_of_another_kind_with_its_rendered_memory():
    small = presets.load("small")
    flags = ["--noise.kind", "edm", "--noise.sigma_data", 1, "--noise.log_mean", -0.4]
    flags += ["--noise.sample_steps", 5, "--noise.rendered_until", 1, "--observed", "warped"]
    config = parse(*flags, "--train.memory_errors", 0.3, default=small)
    assert config.model.noise == EDMConfig(
        sigma_data=1.0, log_mean=-0.4, sample_steps=5, rendered_until=1.0
    )
    assert config.model.memory == small.model.memory
    assert (config.model.observed, config.train.memory_errors) == ("warped", 0.3)
    assert parse("--noise.max_weight", 5, default=small).model.noise.max_weight == 5


def test_another_kind_keeps_what_both_have_and_takes_settings_of_its_own():
    memory = parse("--memory.kind", "images", "--memory.snapshots", 3, "--memory.tokens=9")
    memory = memory.model.memory
    before = TINY.model.memory
    assert isinstance(memory, ImagesConfig)
    assert (memory.snapshots, memory.tokens) == (3, 9)
    assert (memory.cell_m, memory.capacity) == (before.cell_m, before.capacity)
    assert (memory.reader, memory.encoder) == (before.reader, before.encoder)
    noise = parse("--model.noise.kind=flow", "--noise.shift", 3).model.noise
    assert noise == FlowConfig(shift=3.0, sample_steps=TINY.model.noise.sample_steps)
    assert parse("--memory.kind", "voxel") == TINY
    few = parse("--memory.kind", "images", "--memory.snapshots", 2, "--memory.tokens", 2).model
    assert (few.memory.snapshots, few.memory.tokens) == (2, 2)
    edm = parse("--noise.kind", "edm").model.noise
    assert edm == EDMConfig(sample_steps=TINY.model.noise.sample_steps)


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (
            ["--memory.kind", "image"],
            "no memory of kind 'image'; the kinds are grid, images, map2d, .*none",
        ),
        (["--memory.kind"], "--model.memory.kind needs a value: grid, images, map2d"),
        (["--memory.snapshots", 3], "--model.memory.snapshots is not a setting"),
        (["--memory.reader.kind", "?"], "no reader of kind"),
        (["--clip.kind", "x"], "--model.clip.kind is not a setting"),
        (["--backbone.layer", 3], r"did you mean --model.backbone.layers\?"),
        (["--codec.kind", "vae"], "use 8k . 1 frames"),
        (["--codec.kind", "vae", "--clip.frames", 9, "--clip.height", 20], "multiples of"),
    ],
)
def test_wrong_kinds_and_names_are_refused(argv, sentence):
    with pytest.raises(ConfigError, match=sentence) as refusal:
        parse(*argv)
    assert "\n" not in str(refusal.value)


def test_the_help_names_the_kinds(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        parse("--memory.kind", "images", "--help")
    out = " ".join(capsys.readouterr().out.split())
    assert "several kinds" in out
    for section in ("model.codec", "model.memory", "model.memory.encoder", "model.noise"):
        there = ",".join(kinds.names(section.rsplit(".", 1)[-1]))
        assert f"--{section}.kind {{{there}}}" in out
    assert "(images)" in out
    assert "--model.memory.snapshots" in out


@pytest.mark.parametrize(
    ("table", "argv"),
    [
        ({"dit": {"layers": 3}, "train": {"dtype": "bfloat16"}},
         ["--backbone.layers", 3, "--dtype", "bfloat16"]),
        ({"memory": {"heads": 5, "encoder_patch": 4}},
         ["--memory.reader.heads", 5, "--memory.encoder.patch", 4]),
        ({"memory": {"kind": "images", "snapshots": 3}},
         ["--memory.kind", "images", "--memory.snapshots", 3]),
        ({"model": {"memory": {"kind": "images", "snapshots": 3}}, "train": {"seed": 3}},
         ["--memory.kind", "images", "--memory.snapshots", 3, "--train.seed", 3]),
        ({"version": 2, "model": {"noise": {"kind": "flow", "shift": 2}}},
         ["--noise.kind", "flow", "--noise.shift", 2]),
        ({"model": {"memory": {"encoder": {"kind": "dinov2", "size": 28}}}},
         ["--memory.encoder.kind", "dinov2", "--memory.encoder.size", 28]),
        ({"version": 1, "diffusion": {"image_noise_std": 0.1}}, ["--train.image_noise_std", 0.1]),
    ],
)  # fmt: skip
def test_a_file_of_settings_old_or_new_does_what_flags_do(table, argv, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(json.dumps(table))
    assert parse("--config", file) == parse(*argv) != TINY
    assert parse("--train.seed", 9, f"--config={file}") == parse(*argv, "--train.seed", 9)


DINO = TINY.with_model(memory=dataclasses.replace(TINY.model.memory, encoder=DINOv2EncoderConfig()))
VAE = TINY.with_model(clip=dataclasses.replace(TINY.model.clip, frames=9), codec=VAECodec())
IMAGES = TINY.with_model(memory=ImagesConfig(reader=TINY.model.memory.reader))


@pytest.mark.parametrize(
    ("under", "table", "argv"),
    [
        (IMAGES, {"memory": {"snapshots": 3}}, ["--memory.snapshots", 3]),
        (TINY, {"memory": {"snapshots": 3}}, []),
        (IMAGES, {"memory": {"kind": "voxel", "snapshots": 3}}, ["--memory.kind", "voxel"]),
        (TINY, {"codec": {"vae": {"groups": 4}}}, []),
        (VAE, {"codec": {"vae": {"groups": 4}}}, ["--codec.groups", 4]),
        (VAE, {"codec": {"spatial": 8}}, []),
        (VAE, {"codec": {"kind": "pixel", "spatial": 8}},
         ["--codec.kind", "pixel", "--codec.spatial", 8]),
        (TINY, {"codec": {"spatial": 2, "vae": {"groups": 4}}}, ["--codec.spatial", 2]),
        (DINO, {"memory": {"encoder_patch": 4}}, []),
        (TINY, {"memory": {"encoder_patch": 4}}, ["--memory.encoder.patch", 4]),
        (TINY, {"memory": {"encoder_size": 28, "dinov2": {"layers": 2}}}, []),
        (DINO, {"memory": {"encoder_size": 28, "dinov2": {"layers": 2}}},
         ["--memory.encoder.size", 28, "--memory.encoder.network.layers", 2]),
        (TINY, {"memory": {"encoder": "dinov2", "encoder_size": 28, "encoder_patch": 4}},
         ["--memory.encoder.kind", "dinov2", "--memory.encoder.size", 28]),
    ],
)  # fmt: skip
def test_a_part_of_an_old_file_does_over_any_kind_what_it_did(under, table, argv, tmp_path):
    """Version 1 kept the settings of all kinds side by side: those of others changed nothing."""
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"train": {"seed": 9}} | table))
    assert parse("--config", file, default=under) == parse(*argv, "--train.seed", 9, default=under)


@pytest.mark.parametrize(
    ("setting", "new"),
    [
        ("memory.depth", "model.clip.no_depth"),
        ("clip.depth", "model.clip.no_depth"),
        ("model.clip.depth", "model.clip.no_depth"),
        ("diffusion.zero_terminal_snr", "model.noise.no_zero_terminal_snr"),
        ("dit.remat", "model.backbone.no_remat"),
        ("codec.vae.tiling", "model.codec.no_tiling"),
    ],
)
def test_a_flag_is_negated_in_every_spelling(setting, new):
    head, _, last = setting.rpartition(".")
    spellings = [f"no-{setting}", f"no_{setting}", f"{head}.no-{last}", f"{head}.no_{last}"]
    spellings += [name.replace("_", "-") for name in spellings]
    for name in cases(spellings, 3):
        (full,) = cli.full_names([f"--{name}"], VAE)
        assert full.replace("no-", "no_").replace("-terminal-snr", "_terminal_snr") == f"--{new}"
        assert parse(f"--{name}", default=VAE) == parse(f"--{new}", default=VAE)


def test_a_negated_old_flag_switches_off():
    assert TINY.model.clip.depth
    assert not parse("--no-memory.depth").model.clip.depth
    assert not parse("--no-diffusion.zero-terminal-snr").model.noise.zero_terminal_snr


@pytest.mark.parametrize("name", ["images", "pewm_2b"])
def test_a_whole_file_of_an_earlier_version_takes_the_place_of_any_preset(name):
    file = VERSION_1 / f"{name}.json"
    assert parse("--config", file, default=presets.load("pixels")) == configuration.load(file)


def test_a_kind_may_need_another_setting_to_fit(tmp_path):
    """The VAE does not fit the five frames of `tiny`; with nine it does, whatever comes first."""
    kind, frames = ["--codec.kind", "vae"], ["--clip.frames", 9]
    assert isinstance(parse(*kind, *frames).model.codec, VAECodec)
    assert parse(*frames, *kind) == parse(*kind, *frames)
    file = tmp_path / "mine.json"
    file.write_text('{"model": {"codec": {"kind": "vae"}, "clip": {"frames": 9}}}')
    assert parse("--config", file) == parse(*kind, *frames)


@pytest.mark.parametrize(
    ("flags", "log"),
    [
        (["--log", "none"], ("none",)),
        (["--log=rerun"], ("rerun",)),
        (["--train.log", "jsonl", "rerun"], ("jsonl", "rerun")),
        (["--log", "jsonl", "--train.log", "wandb:a"], ("jsonl", "wandb:a")),
        (["--train.wandb", "rooms"], ("jsonl", "tensorboard", "wandb:rooms")),
    ],
)
def test_logs_are_chosen_by_one_option(flags, log, capsys):
    assert parse(*flags).train.log == log
    assert ("deprecated" in capsys.readouterr().err) == ("--train.wandb" in flags)
