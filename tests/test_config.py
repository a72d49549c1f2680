import dataclasses
import json

import pytest

from pewm_jax import config as configuration
from pewm_jax import presets as configs
from pewm_jax.config import (
    ActionConfig,
    ClipConfig,
    CodecConfig,
    Config,
    ConfigError,
    DataConfig,
    DiffusionConfig,
    DiTConfig,
    EvalConfig,
    MemoryConfig,
    StageConfig,
    TrainConfig,
)


@pytest.mark.parametrize("name", configs.names())
def test_every_preset_goes_to_json_and_back(name, tmp_path):
    config = configs.load(name)
    configuration.save(config, tmp_path / "config.json")
    assert configuration.load(tmp_path / "config.json") == config
    assert configs.describe(name)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: ClipConfig(frames=8), "use 9"),
        (lambda: ClipConfig(near_m=5, far_m=2), "below far"),
        (lambda: ClipConfig(height=0), "at least 12 pixels"),
        (lambda: ClipConfig(width=11), "window of 11"),
        (lambda: ActionConfig(step_m=0), "above 0"),
        (lambda: ActionConfig(turn_deg=0), "degrees"),
        (lambda: DiTConfig(head_dim=20), "multiple of 16"),
        (lambda: DiTConfig(layers=0), "at least 1"),
        (lambda: MemoryConfig(tokens=99, capacity=10), "raise capacity"),
        (lambda: Config(memory=MemoryConfig(heads=2)), "use at least 4 heads"),
        (
            lambda: Config(codec=CodecConfig(temporal=8), memory=MemoryConfig(heads=6)),
            "use at least 8 heads",
        ),
        (lambda: MemoryConfig(head_dim=6), "multiple of 8"),
        (lambda: MemoryConfig(cell_m=(0.1, 0.0, 1.0)), "positive"),
        (lambda: MemoryConfig(cells=(4096, 4096, 256)), "numbered"),
        (lambda: DiffusionConfig(sample_steps=0), "use 1 to"),
        (lambda: DiffusionConfig(beta_start=0.5), "start < end"),
        (lambda: DataConfig(stride_min=3, stride_max=2), "min ≤ max"),
        (lambda: DataConfig(context=0), "at least 1"),
        (lambda: DataConfig(workers=-1), "data.workers is -1"),
        (lambda: DiffusionConfig(train_steps=1, sample_steps=1), "at least 2 noise levels"),
        (lambda: DiffusionConfig(max_weight=0), "max_weight must be above 0"),
        (lambda: DiffusionConfig(image_noise_std=-1), "image_noise_std must be at least 0"),
        (lambda: StageConfig(learning_rate=0), "above 0"),
        (lambda: StageConfig(warmup=-1), "warmup is -1"),
        (lambda: TrainConfig(seed=-1), "train.seed is -1"),
        (lambda: TrainConfig(weight_decay=-0.1), "train.weight_decay is -0.1"),
        (lambda: TrainConfig(preview_every=-1), "train.preview_every is -1"),
        (lambda: TrainConfig(stage1=StageConfig(steps=0)), "give train.stage1.steps at least 1"),
        (lambda: TrainConfig(ema=1.0), "decay"),
        (lambda: TrainConfig(clip_norm=0), "above 0"),
        (lambda: EvalConfig(seeds=()), "at least one seed"),
        (lambda: EvalConfig(seeds=(0, -1)), "0 or positive"),
        (lambda: Config(clip=ClipConfig(height=20)), "multiples of"),
    ],
)
def test_settings_that_cannot_work_are_refused_with_the_fix(build, sentence):
    with pytest.raises(ConfigError, match=sentence):
        build()


SIZES = {
    CodecConfig: ("codec", ("spatial", "temporal")),
    DiTConfig: (
        "dit",
        (
            [
                "layers",
                "heads",
                "head_dim",
                "patch",
                "text_length",
                "text_dim",
                "time_dim",
                "mlp_ratio",
            ]
        ),
    ),
    MemoryConfig: (
        "memory",
        (["tokens", "looks", "encoder_patch", "heads", "head_dim", "mlp_ratio"]),
    ),
}


@pytest.mark.parametrize("value", [0, -16])
@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, (_, names) in SIZES.items() for name in names]
)
def test_sizes_below_one_are_refused_by_name(kind, name, value):
    with pytest.raises(ConfigError, match=f"{SIZES[kind][0]}.{name} is {value}: use at least 1"):
        kind(**{name: value})


def test_what_the_checks_must_not_refuse():
    Config(memory=MemoryConfig(heads=2, positions="sinusoid"))
    Config(clip=ClipConfig(height=16, width=16), train=TrainConfig(stage2=StageConfig(steps=0)))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"clipp": {}}, "no setting clipp"),
        ({"clip": {"framez": 9}}, "no setting framez; it has"),
        ({"clip": {"frames": "nine"}}, "config.json.clip.frames must be int"),
        ({"clip": {"frames": True}}, "must be int"),
        ({"clip": 3}, "table of settings"),
        ({"diffusion": {"target": "x1"}}, "choose one of"),
        ({"memory": {"cells": [1, 2]}}, "needs 3 values"),
        ({"memory": {"cells": 7}}, "must be a list"),
    ],
)
def test_a_wrong_file_is_refused_by_name(change, sentence, tmp_path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps(change))
    with pytest.raises(ConfigError, match=sentence):
        configuration.load(path)


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


def test_every_setting_is_documented():
    """`--help` shows the docstring below each field, so every field needs one."""
    import ast
    import inspect

    for kind in (Config, *(f.default.__class__ for f in dataclasses.fields(Config))):
        body = ast.parse(inspect.getsource(kind)).body[0].body
        for index, node in enumerate(body):
            if isinstance(node, ast.AnnAssign):
                after = body[index + 1]
                documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                assert documented, f"{kind.__name__}.{node.target.id}"
