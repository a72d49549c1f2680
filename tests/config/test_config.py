"""Settings: refused in a sentence when built, to JSON and back, and from earlier versions."""

import ast
import dataclasses
import functools
import inspect
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax import registry as kinds
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import (
    ActionConfig,
    ClipConfig,
    Config,
    ConfigError,
    DataConfig,
    EvalConfig,
    Settings,
    StageConfig,
    TrainConfig,
)
from pewm_jax.config.overlay import overlay
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.diffusion.flow import FlowConfig
from pewm_jax.encoders.simple import LatentsConfig, PatchColoursConfig
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.cosmos.backbone import CosmosBackbone
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.worlds.pewm.world import PEWM
from tests.properties import examples

VERSION_1 = Path(__file__).parent / "version_1"
"""Settings as they were written before there were versions."""


@pytest.mark.parametrize("name", presets.names())
def test_every_preset_goes_to_json_and_back(name, tmp_path):
    config = presets.load(name)
    configuration.save(config, tmp_path / "config.json")
    assert configuration.load(tmp_path / "config.json") == config
    assert presets.describe(name)


def model_of(memory, codec=None):
    return PEWM(memory=memory, codec=codec or PixelConfig())


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: ClipConfig(frames=1), "use 9"),
        (lambda: PEWM(clip=ClipConfig(frames=8)), r"use 4k \+ 1 frames \(5, 9, …\)"),
        (lambda: PEWM(ClipConfig(frames=13), codec=VAECodec()), r"8k \+ 1"),
        (lambda: ClipConfig(near_m=5, far_m=2), "below far"),
        (lambda: ClipConfig(height=0), "at least 12 pixels"),
        (lambda: ClipConfig(width=11), "window of 11"),
        (lambda: ActionConfig(step_m=0), "above 0"),
        (lambda: ActionConfig(turn_deg=0), "degrees"),
        (lambda: DiTBackbone(head_dim=20), "multiple of 16"),
        (lambda: DiTBackbone(layers=0), "at least 1"),
        (lambda: VoxelConfig(tokens=99, capacity=10), "raise capacity"),
        (lambda: model_of(VoxelConfig(reader=AttentionConfig(heads=2))), "use at least 4 heads"),
        (
            lambda: model_of(VoxelConfig(reader=AttentionConfig(heads=6)), PixelConfig(temporal=8)),
            "use at least 8 heads",
        ),
        (lambda: AttentionConfig(head_dim=6), "multiple of 8"),
        (lambda: VoxelConfig(cell_m=(0.1, 0.0, 1.0)), "positive"),
        (lambda: VoxelConfig(cells=(4096, 4096, 256)), "numbered"),
        (lambda: DDPMConfig(sample_steps=0), "use 1 to"),
        (lambda: DDPMConfig(beta_start=0.5), "start < end"),
        (lambda: DataConfig(stride_min=3, stride_max=2), "min ≤ max"),
        (lambda: DataConfig(context=0), "at least 1"),
        (lambda: DataConfig(workers=-1), "data.workers is -1"),
        (lambda: DDPMConfig(train_steps=1, sample_steps=1), "at least 2 noise levels"),
        (lambda: DDPMConfig(max_weight=0), "max_weight must be above 0"),
        (lambda: TrainConfig(image_noise_std=-1), "train.image_noise_std is -1: use 0"),
        (lambda: StageConfig(learning_rate=0), "above 0"),
        (lambda: StageConfig(warmup=-1), "warmup is -1"),
        (lambda: TrainConfig(seed=-1), "train.seed is -1"),
        (lambda: TrainConfig(weight_decay=-0.1), "train.weight_decay is -0.1"),
        (lambda: TrainConfig(preview_every=-1), "train.preview_every is -1"),
        (lambda: TrainConfig(stage1=StageConfig(steps=0)), "set train.stage1.steps at least 1"),
        (lambda: TrainConfig(ema=1.0), "decay"),
        (lambda: TrainConfig(clip_norm=0), "above 0"),
        (lambda: EvalConfig(seeds=()), "at least one seed"),
        (lambda: EvalConfig(seeds=(0, -1)), "0 or positive"),
        (lambda: PEWM(clip=ClipConfig(height=20)), "multiples of"),
        (lambda: model_of(ImagesConfig(snapshots=9, tokens=8)), "raise tokens or lower snapshots"),
        (lambda: model_of(VoxelConfig(encoder=PatchColoursConfig(patch=5))), "does not divide"),
        (lambda: DINOv2EncoderConfig(size=500), "use a multiple of memory.encoder.network.patch"),
        (lambda: EDMConfig(sigma_min=2, sigma_max=1), "0 < min < max"),
        (lambda: FlowConfig(shift=0), "noise.shift is 0"),
        (lambda: Config(version=1), "leave it out"),
    ],
)
def test_settings_that_cannot_work_are_refused_with_the_fix(build, sentence):
    with pytest.raises(ConfigError, match=sentence):
        build()


SIZES = {
    PixelConfig: ("codec", "spatial temporal"),
    DiTBackbone: (
        "backbone",
        "layers heads head_dim patch text_length text_dim time_dim mlp_ratio",
    ),
    VoxelConfig: ("memory", "tokens"),
    ImagesConfig: ("memory", "snapshots"),
    AttentionConfig: ("memory.reader", "looks heads head_dim mlp_ratio"),
    PatchColoursConfig: ("memory.encoder", "patch"),
    EDMConfig: ("noise", "sample_steps"),
    FlowConfig: ("noise", "sample_steps"),
}


@pytest.mark.parametrize("value", [0, -16])
@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, (_, names) in SIZES.items() for name in names.split()]
)
def test_sizes_below_one_are_refused_by_name(kind, name, value):
    with pytest.raises(ConfigError, match=f"{SIZES[kind][0]}.{name} is {value}: use at least 1"):
        kind(**{name: value})


def test_what_the_checks_must_not_refuse():
    model_of(VoxelConfig(reader=AttentionConfig(heads=2, positions="sinusoid")))
    Config(model=PEWM(clip=ClipConfig(height=16, width=16)))
    Config(train=TrainConfig(stage2=StageConfig(steps=0)))
    model_of(VoxelConfig(reader=AttentionConfig(heads=1)), PixelConfig(temporal=1))
    seven = VoxelConfig(reader=AttentionConfig(heads=7))
    PEWM(clip=ClipConfig(frames=8), codec=PixelConfig(temporal=7), memory=seven)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"clipp": {}}, "no setting clipp"),
        ({"clip": {"framez": 9}}, "no setting framez; it has"),
        ({"clip": {"frames": "nine"}}, "config.json.model.clip.frames must be int"),
        ({"clip": {"frames": True}}, "must be int"),
        ({"clip": 3}, "table of settings"),
        ({"diffusion": {"target": "x1"}}, "choose one of"),
        ({"memory": {"cells": [1, 2]}}, "needs 3 values"),
        ({"memory": {"cells": 7}}, "must be a list"),
        *(
            ({name: 3}, f"{name} must be a table of settings")
            for name in ("model", "clip", "codec", "dit", "memory", "diffusion", "data", "train")
        ),
        ({"model": {"backbone": {"depth": 4}}}, "config.json.model.backbone has no setting depth"),
        ({"model": {"backbone": 4}}, "config.json.model.backbone must be a table of settings"),
        ({"model": {"noise": {"kind": "none"}}}, "noise.kind: There is no noise of kind 'none'"),
        (
            {"model": {"memory": {"kind": 3}}},
            "the kinds are grid, images, map2d, .*none, points, .*voxel",
        ),
        ({"model": {"memory": {"reader": {"kind": "?"}}}}, "memory.reader.kind: There is no"),
        ({"train": {"stage3": {}}}, "config.json.train has no setting stage3"),
        ({"codec": {"kind": "vae", "vae": 3}}, "codec.vae must be a table"),
        ({"codec": {"vae": 3}}, "codec.vae must be a table"),
        ({"memory": {"dinov2": 3}}, "memory.dinov2 must be a table"),
        ({"clip": 3, "memory": {"depth": False}}, "clip must be a table"),
        *(
            ({"model": {"backbone": {"kind": bad}}}, r"model.backbone.kind: There is no backbone")
            for bad in (["a"], {"a": 1}, None, 3, "", True)
        ),
        ({"model": {"kind": ["a"]}}, "model.kind: There is no world of kind"),
        ({"model": {"memory": {"reader": {"kind": []}}}}, "model.memory.reader.kind: There is no"),
        ({"codec": {"kind": ["a"]}}, "codec.kind: There is no codec"),
        ({"memory": {"kind": ["a"]}}, "memory.kind: There is no memory"),
        ({"memory": {"encoder": ["a"], "dinov2": {}}}, "encoder.kind: There is no encoder"),
        (
            {"model": {"codec": [1]}},
            "model.codec must be a table of settings, got list",
        ),
        ({"version": 6}, "of version 6, .* versions up to 5: install a newer pewm_jax"),
        *(({"version": v}, "must be a whole number from 1") for v in (0, -1, "2", 2.0, True, None)),
        ({"version": 2, "dit": {}}, "no setting dit"),
    ],
)
def test_a_wrong_file_is_refused_by_name(change, sentence, tmp_path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps(change))
    for read in (configuration.load, functools.partial(overlay, Config())):
        with pytest.raises(ConfigError, match=sentence) as refusal:
            read(path)
        assert "\n" not in str(refusal.value)


def test_absent_and_broken_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        configuration.load(tmp_path / "config.json")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ConfigError, match="not valid JSON"):
        configuration.load(tmp_path / "config.json")
    (tmp_path / "config.json").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match="not valid JSON"):
        configuration.load(tmp_path / "config.json")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError, match=r"folder cannot be read \(Is a directory\)"):
        configuration.load(tmp_path / "folder")


def test_integers_are_welcome_where_floats_are_asked():
    assert configuration.from_dict(ActionConfig, {"step_m": 1}) == ActionConfig(step_m=1.0)


def ours(section):
    """The kinds of a section that come with the library."""
    found = [kinds.named(section, name) for name in kinds.names(section)]
    return [kind for kind in found if kind.settings.__module__.startswith("pewm_jax.")]


SECTIONS = ("world", "backbone", "codec", "control", "encoder", "reader", "memory", "noise")
KINDS = [kind for section in SECTIONS for kind in ours(section)]


def test_every_setting_is_documented():
    """`--help` shows the docstring below each field, so every field needs one."""
    sections = (kinds.usual(f) for f in dataclasses.fields(Config) if f.name != "version")
    for kind in {Config, TrainConfig, ClipConfig, *sections, *(kind.settings for kind in KINDS)}:
        classes = [one for one in kind.__mro__ if dataclasses.is_dataclass(one)]
        body = [node for one in classes for node in ast.parse(inspect.getsource(one)).body[0].body]
        for index, node in enumerate(body):
            if isinstance(node, ast.AnnAssign) and "ClassVar" not in ast.unparse(node.annotation):
                after = body[index + 1]
                documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                assert documented, f"{kind.__name__}.{node.target.id}"


def there_and_back(settings_, base):
    """Through JSON as a file holds it."""
    return configuration.from_dict(base, json.loads(json.dumps(configuration.to_dict(settings_))))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.section}-{kind.name}")
def test_every_kind_goes_to_json_and_back_by_its_name(kind):
    table = configuration.to_dict(kind.settings())
    assert table["kind"] == kind.name
    base = next(c for c in kind.settings.__mro__ if c.__dict__.get("SECTION") == kind.section)
    assert issubclass(base, Settings)
    assert there_and_back(kind.settings(), base) == kind.settings()
    assert there_and_back(kind.settings(), kind.settings) == kind.settings()


def some(section):
    """Kinds of a section, without those that one world alone takes."""
    alone = {"persist", "grid"}
    return st.sampled_from([kind.settings for kind in ours(section) if kind.name not in alone])


@st.composite
def experiments(draw):
    """An experiment of kinds of every section, with a few settings of each drawn."""
    names = {"backbone", "codec", "control", "noise"}
    parts = {name: draw(some(name))() for name in sorted(names)}
    if isinstance(parts["backbone"], CosmosBackbone):  # is told times in its own units alone
        flow = EDMConfig(target="flow", sigma_data=1.0)
        parts["noise"] = draw(st.sampled_from([flow, FlowConfig(scale=1.0)]))
    steps = dataclasses.replace(parts["noise"], sample_steps=draw(st.integers(1, 50)))
    reader = dataclasses.replace(draw(some("reader"))(), mlp_ratio=draw(st.integers(1, 4)))
    encoder = draw(some("encoder"))()
    if isinstance(encoder, LatentsConfig):  # fits the learned codec alone
        parts["codec"] = LearnedCodecConfig()
    reads = parts["backbone"].places is not None
    memory = dataclasses.replace(
        draw(some("memory"))() if reads else NoMemoryConfig(),
        cell_m=draw(st.tuples(*[st.floats(0.1, 2)] * 3)),
        encoder=encoder,
        reader=reader,
    )
    model = PEWM(**{**parts, "noise": steps}, memory=memory)
    train = TrainConfig(
        ema=draw(st.floats(0, 0.999)), fresh=tuple(draw(st.lists(st.sampled_from("abc"))))
    )
    return Config(model=model, train=train)


@examples(50)
@given(experiments())
def test_every_combination_of_kinds_goes_to_json_and_back(config):
    assert there_and_back(config, Config) == config


@pytest.mark.parametrize("version", [2, 3, 4, 5])
def test_a_reader_of_an_earlier_version_is_known_by_its_name_of_now(version):
    reader = {"kind": "attention" if version == 2 else "attend", "looks": 7}
    table = {"version": version, "model": {"memory": {"reader": reader}}}
    read = configuration.from_dict(Config, table).model.memory.reader
    assert read == AttentionConfig(looks=7)
    assert configuration.to_dict(read)["kind"] == "attend"


def test_a_section_without_a_kind_is_of_the_usual_one():
    read = configuration.from_dict(Config, {"model": {"memory": {"tokens": 7}, "noise": {}}})
    assert read.model.memory == VoxelConfig(tokens=7)
    assert read.model.noise == DDPMConfig()


def test_what_is_written_says_its_version(tmp_path):
    configuration.save(Config(), tmp_path / "config.json")
    assert json.loads((tmp_path / "config.json").read_text())["version"] == configuration.VERSION


def test_an_earlier_version_s_preset_is_the_preset():
    now = presets.load("pewm_2b")
    train = dataclasses.replace(now.train, noise_key="weights", beta2=0.999)  # as they were then
    assert configuration.load(VERSION_1 / "pewm_2b.json") == dataclasses.replace(now, train=train)


def test_every_setting_of_an_earlier_version_finds_its_place():
    read = configuration.load(VERSION_1 / "images.json")
    tiny = presets.load("tiny")
    memory = tiny.model.memory
    assert read == dataclasses.replace(
        tiny.with_model(
            clip=dataclasses.replace(tiny.model.clip, depth=False),
            memory=ImagesConfig(
                cell_m=memory.cell_m,
                cells=memory.cells,
                capacity=memory.capacity,
                tokens=memory.tokens,
                snapshots=3,
                reader=dataclasses.replace(memory.reader, positions="sinusoid"),
            ),
            dtype="bfloat16",
        ),
        train=dataclasses.replace(tiny.train, image_noise_mean=-2.0, image_noise_std=0.25),
    )


def test_an_upgrade_leaves_what_it_was_given_as_it_was():
    values = json.loads((VERSION_1 / "images.json").read_text())
    before = json.dumps(values)
    configuration.upgrade(values, "config.json")
    assert json.dumps(values) == before


def test_a_learned_table_of_an_earlier_version_does_what_it_did():
    table = {"positions": "rope_learned", "sample_height": 4, "sample_width": 4}
    read = configuration.from_dict(Config, {"dit": {**table, "sample_frames": 9}})
    assert read.model.backbone.learned == "reference"
    now = {"kind": "dit", **table, "sample_frames": 9}
    assert configuration.from_dict(Config, {"model": {"backbone": now}}).model.backbone.learned == (
        "exact"
    )


def test_runs_of_earlier_versions_keep_one_key_for_weights_and_noise():
    whole = configuration.to_dict(Config())
    whole["version"] = 3
    del whole["train"]["noise_key"]
    assert configuration.from_dict(Config, whole).train.noise_key == "weights"
    assert Config().train.noise_key == "own"
    overlay = {"version": 3, "model": {}, "train": {"seed": 3}}
    assert configuration.from_dict(Config, overlay).train.noise_key == "own"
    for name in ("tiny", "demo", "small"):  # published with the earlier derivation
        assert presets.load(name).train.noise_key == "weights"


@pytest.mark.parametrize(("name", "value"), [("beta1", 1.0), ("beta2", -0.1), ("epsilon", 0.0)])
def test_settings_of_adam_are_refused_outside_their_ranges(name, value):
    with pytest.raises(ConfigError, match=rf"train\.{name} is {value}: use a"):
        TrainConfig(**{name: value})


def test_large_presets_have_the_decays_of_their_sources():
    decays = {
        "pewm_2b": 0.95,
        "pewm_5b": 0.95,
        "pewm_5b_i2v": 0.95,
        "egowm_cosmos2b": 0.99,
        "egowm_cogvideox": 0.95,
        "persist_xl": 0.99,
        "egowm_svd": 0.999,
        "tiny": 0.999,
    }
    assert {name: presets.load(name).train.beta2 for name in decays} == decays


def test_a_project_of_wandb_becomes_a_log():
    whole = configuration.to_dict(Config())
    whole["version"] = 4
    del whole["train"]["log"]
    for project, log in (("", Config().train.log), ("a", ("jsonl", "tensorboard", "wandb:a"))):
        whole["train"]["wandb"] = project
        assert configuration.from_dict(Config, whole).train.log == log
