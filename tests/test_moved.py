"""Modules of the earlier version are imported by their old names, with a warning."""

import importlib
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from pewm_jax import _moved

ROOT = Path(__file__).parents[1]


def path_of(module):
    return ROOT / "pewm_jax" / module.replace(".", "/")


def exists(module):
    path = path_of(module)
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def test_every_new_name_exists_and_no_old_one_does():
    assert [new for new in _moved.MOVED.values() if not exists(new)] == []
    assert [old for old in _moved.MOVED if exists(old)] == []


IMPLIED = """
commands.demo commands.evaluate commands.horizon commands.main commands.play commands.train
evaluation.codec_score evaluation.compare evaluation.gallery evaluation.horizon evaluation.intervals
evaluation.long_rollouts evaluation.metrics evaluation.metrics.perceptual
evaluation.metrics.revisits evaluation.metrics.sam2 evaluation.metrics.structure
evaluation.metrics.videos evaluation.mirror evaluation.preview evaluation.protocol
evaluation.reproject evaluation.scoring evaluation.seen evaluation.statistics evaluation.steering
scaling.hlo scaling.plan scaling.suggest training.checkpoint training.chips training.feed
training.loading training.log training.loop training.optimizer training.processes training.runs
training.sharding training.signals training.stages training.step training.watch
"""
"""Modules that are found by the row of their package."""


def test_every_module_below_a_renamed_package_exists():
    found = [
        _moved.new_name(f"pewm_jax.{old}").removeprefix("pewm_jax.") for old in IMPLIED.split()
    ]
    assert [new for new in found if not exists(new)] == []


def test_nothing_in_the_package_imports_an_old_name():
    found = []
    for path in (ROOT / "pewm_jax").rglob("*.py"):
        if path.name == "_moved.py":
            continue
        text = path.read_text()
        found += [(path.name, old) for old in _moved.MOVED if f"import pewm_jax.{old}\n" in text]
        found += [(path.name, old) for old in _moved.MOVED if f"from pewm_jax.{old} import" in text]
    assert found == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("models.pixel_codec", "codecs.pixel"),
        ("training", "train"),
        ("training.loop", "train.loop"),
        ("training.watch", "train.watch"),
        ("evaluation.metrics.structure", "eval.metrics.structure"),
        ("diffusion.schedule", "diffusion.ddpm"),
    ],
)
def test_an_old_name_is_the_module_itself(old, new):
    for name in list(sys.modules):
        if _moved.new_name(name):
            del sys.modules[name]
    wanted = importlib.import_module(f"pewm_jax.{new}")
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        found = importlib.import_module(f"pewm_jax.{old}")
    assert any(f"pewm_jax.{old} is now pewm_jax.{new};" in str(one.message) for one in seen)
    assert found is wanted
    assert wanted.__spec__.name == wanted.__name__ == f"pewm_jax.{new}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert importlib.import_module(f"pewm_jax.{old}") is wanted, "once is enough"


def test_the_warning_names_the_line_that_imports(tmp_path):
    (tmp_path / "mine.py").write_text("x = 1\nfrom pewm_jax.atomic import write_text\n")
    done = subprocess.run(
        [sys.executable, "-W", "always", "mine.py"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "mine.py:2: DeprecationWarning" in done.stderr


def test_classes_that_left_the_settings_are_found_there_with_a_warning():
    from pewm_jax import config
    from pewm_jax.codecs.pixel import PixelConfig
    from pewm_jax.models.cogvideox.backbone import DiTBackbone

    for name, wanted in (("PixelConfig", PixelConfig), ("DiTConfig", DiTBackbone)):
        with pytest.warns(DeprecationWarning, match=rf"config\.{name} is deprecated: import"):
            assert getattr(config, name) is wanted
    for name in config._MOVED:
        with pytest.warns(DeprecationWarning, match=rf"config\.{name} is deprecated"):
            getattr(config, name)
    with pytest.raises(AttributeError):
        config.nothing  # noqa: B018


def test_the_worlds_that_left_the_settings_are_the_same_classes():
    import pewm_jax
    from pewm_jax import config
    from pewm_jax.worlds.egowm.world import EgoWM
    from pewm_jax.worlds.pewm.world import PEWM

    with pytest.warns(DeprecationWarning, match=r"ModelConfig is deprecated: import PEWM from"):
        assert pewm_jax.ModelConfig is pewm_jax.PEWM is PEWM
    with pytest.warns(DeprecationWarning, match="import EgoWM from pewm_jax.worlds.egowm.world"):
        assert isinstance(EgoWM(), config.EgoWMConfig)
    sys.modules.pop("pewm_jax.config.model", None)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        from pewm_jax.config.model import ModelConfig
    assert ModelConfig is PEWM
    assert len(seen) >= 2, "of the module and of the class"
    assert isinstance(ModelConfig(), ModelConfig)


def test_an_unknown_module_is_not_found():
    with pytest.raises(ModuleNotFoundError, match="nowhere"):
        importlib.import_module("pewm_jax.nowhere")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ModuleNotFoundError, match=r"train\.nowhere"):
            importlib.import_module("pewm_jax.training.nowhere")
