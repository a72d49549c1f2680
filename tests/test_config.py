import dataclasses
import json

import pytest

import configs
from pewm_jax import config as configuration
from pewm_jax.config import (
    ActionConfig,
    ClipConfig,
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
        (lambda: ClipConfig(height=0), "positive"),
        (lambda: ActionConfig(step_m=0), "above 0"),
        (lambda: ActionConfig(turn_deg=0), "degrees"),
        (lambda: DiTConfig(head_dim=20), "multiple of 16"),
        (lambda: DiTConfig(layers=0), "at least 1"),
        (lambda: MemoryConfig(tokens=99, capacity=10), "raise capacity"),
        (lambda: MemoryConfig(heads=2), "at least 4 heads"),
        (lambda: MemoryConfig(head_dim=6), "multiple of 8"),
        (lambda: MemoryConfig(cell_m=(0.1, 0.0, 1.0)), "positive"),
        (lambda: DiffusionConfig(sample_steps=0), "use 1 to"),
        (lambda: DiffusionConfig(beta_start=0.5), "start < end"),
        (lambda: DataConfig(stride_min=3, stride_max=2), "min ≤ max"),
        (lambda: DataConfig(context=0), "at least 1"),
        (lambda: StageConfig(learning_rate=0), "above 0"),
        (lambda: TrainConfig(ema=1.0), "decay"),
        (lambda: TrainConfig(clip_norm=0), "above 0"),
        (lambda: EvalConfig(seeds=()), "at least one seed"),
        (lambda: Config(clip=ClipConfig(height=20)), "multiples of"),
    ],
)
def test_settings_that_cannot_work_are_refused_with_the_fix(build, sentence):
    with pytest.raises(ConfigError, match=sentence):
        build()


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
