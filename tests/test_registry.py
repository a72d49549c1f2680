"""Kinds of parts: what may be registered, how a user's own are found, and what is refused."""

import contextlib
import dataclasses
import importlib
import json
import sys
import textwrap
import types

import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets, worlds
from pewm_jax import registry as kinds
from pewm_jax.cli import main as program
from pewm_jax.cli import parser as cli
from pewm_jax.cli import plugins as imports
from pewm_jax.cli import train as training
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import (
    ClipConfig,
    Config,
    ConfigError,
    Memory,
    Noise,
    World,
    register,
)
from pewm_jax.config.overlay import overlay
from pewm_jax.controls.camera import CameraConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import runtime
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.types import Camera, Frames, WorldState
from pewm_jax.worlds.pewm.world import PEWM
from pewm_jax.worlds.stages import Stage
from tests.examples import parts

TINY = presets.load("tiny")
PART = """
    import dataclasses

    from pewm_jax.config import Noise, register


    @register("noise", {name!r})
    @dataclasses.dataclass(frozen=True)
    class MineConfig(Noise):
        sample_steps: int = 3
        strength: float = 1.0
"""


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    """What a test registers or puts on the path is gone after it."""
    monkeypatch.setattr(kinds, "_KINDS", dict(kinds._KINDS))
    monkeypatch.setattr(kinds, "_ENTERED", set())
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.startswith("mine_"):
            del sys.modules[name]
    importlib.invalidate_caches()


def package(folder, module, text, *, entry=True):
    """A module, and what an installer writes beside it for an entry point."""
    (folder / f"{module}.py").write_text(textwrap.dedent(text))
    info = folder / f"{module}-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1\n")
    if entry:
        (info / "entry_points.txt").write_text(f"[pewm_jax.kinds]\nours = {module}\n")


def one_sentence(refusal):
    text = str(refusal.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


def named_mine(name):
    return configuration.from_dict(Config, {"model": {"noise": {"kind": name, "strength": 2}}})


def test_an_installed_package_s_kind_is_found_by_its_entry_point(tmp_path, monkeypatch):
    package(tmp_path, "mine_installed", PART.format(name="installed"))
    monkeypatch.syspath_prepend(str(tmp_path))
    config = named_mine("installed")
    assert (type(config.model.noise).__name__, config.model.noise.strength) == ("MineConfig", 2.0)
    assert configuration.to_dict(config)["model"]["noise"]["kind"] == "installed"


def test_a_name_that_is_known_imports_no_one_s_module(tmp_path, monkeypatch):
    package(tmp_path, "mine_heavy", "raise RuntimeError('too early')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert kinds.named("noise", "ddpm").settings is DDPMConfig


def test_an_entry_point_that_cannot_be_imported_is_named_only_if_the_kind_is_not_found(
    tmp_path, monkeypatch
):
    package(tmp_path, "mine_broken", "import no_such_library")
    package(tmp_path, "mine_whole", PART.format(name="whole"))
    monkeypatch.syspath_prepend(str(tmp_path))
    assert named_mine("whole").model.noise.strength == 2
    with pytest.raises(ConfigError, match=r"mine_broken cannot be imported .*no_such_lib") as error:
        named_mine("absent")
    assert "'ours' of pewm_jax.kinds" in one_sentence(error)


WORLD = """
    import dataclasses

    from pewm_jax.config import World, register


    @register("world", "mine")
    @dataclasses.dataclass(frozen=True)
    class Mine(World):
        width: int = 3

        def init(self, key): ...
        def stages(self): ...
        def observe(self, params, state, frames): ...
        def imagine(self, params, state, control, key, **rest): ...
"""


def test_a_world_of_an_entry_point_is_trained_and_gets_a_protocol_by_its_name(
    tmp_path, monkeypatch
):
    package(tmp_path, "mine_broken", "import no_such_library")
    with pytest.raises(ConfigError, match=r"no preset 'mine'.*no world of kind 'mine'"):
        training.arguments(["mine"], "pewm-jax train")
    package(tmp_path, "mine_world", WORLD)
    monkeypatch.syspath_prepend(str(tmp_path))
    given = training.arguments(["mine"], "pewm-jax train")
    assert given.groups["config"][1].model.width == 3
    assert training.settings_of("mine", "preset or run")[0].model.width == 3
    with pytest.raises(ConfigError, match=r"no preset 'dmo' \(did you mean demo.*no_such_library"):
        training.arguments(["dmo"], "pewm-jax train")


def test_a_module_of_entry_points_is_imported_once(tmp_path, monkeypatch):
    package(tmp_path, "mine_once", "import pewm_jax\npewm_jax.times = pewm_jax.times + 1")
    monkeypatch.syspath_prepend(str(tmp_path))
    pewm_jax = sys.modules["pewm_jax"]
    monkeypatch.setattr(pewm_jax, "times", 0, raising=False)
    for _ in range(2):
        with pytest.raises(ConfigError, match="no noise of kind"):
            kinds.named("noise", "absent")
        sys.modules.pop("mine_once", None)
    assert pewm_jax.times == 1


def test_the_refusal_of_an_unknown_kind_names_both_ways():
    with pytest.raises(ConfigError, match=r"--plugin FILE, .* entry point .*pewm_jax\.kinds") as e:
        kinds.named("noise", "absent")
    one_sentence(e)


@pytest.mark.parametrize("spelling", [["--import", "mine_here"], ["--import=mine_here"]])
def test_a_file_in_the_current_folder_is_imported_for_training(spelling, tmp_path, monkeypatch):
    package(tmp_path, "mine_here", PART.format(name="here"), entry=False)
    monkeypatch.chdir(tmp_path)
    seen = []
    from pewm_jax.plan import plan

    monkeypatch.setattr(plan, "show", lambda config, launch: seen.append(config))
    chosen = ["--noise.kind", "here", "--noise.strength", "2"]
    program.execute(["train", "tiny", *spelling, *chosen, "--plan"])
    program.execute(["plan", *spelling, "tiny", *chosen])
    configuration.save(seen[0], tmp_path / "config.json")
    assert [type(config.model.noise).__name__ for config in seen] == ["MineConfig"] * 2
    assert seen[0].model.noise.strength == 2
    assert configuration.load(tmp_path / "config.json") == seen[0]


def test_evaluation_imports_before_it_opens_the_run(tmp_path, monkeypatch):
    package(tmp_path, "mine_first", PART.format(name="first"), entry=False)
    package(tmp_path, "mine_second", PART.format(name="second"), entry=False)
    monkeypatch.chdir(tmp_path)
    from pewm_jax.eval import evaluate as report

    seen = []
    monkeypatch.setattr(
        report, "evaluate", lambda run, **_: seen.append([run, *kinds.names("noise")])
    )
    monkeypatch.setattr(runtime, "cache_compilation", lambda folder: None)
    words = ["--import", "mine_first", "runs/x", "--import", "mine_second", "--clips", "1"]
    program.execute(["evaluate", *words])
    assert seen[0][0] == "runs/x"
    assert {"first", "second"} <= set(seen[0])


@pytest.mark.parametrize("command", ["train", "plan", "evaluate"])
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--import"], "--import needs the name of a module"),
        (["--import="], "--import needs the name of a module"),
        (["--import", "parts/mine.py"], "needs the name of a module, .* got 'parts/mine.py'"),
        (["--import", "mine.py"], "such as my_parts for my_parts.py"),
        (["--import", "mine_absent"], "--import: the module mine_absent cannot be imported"),
    ],
)
def test_what_cannot_be_imported_is_refused_in_a_sentence(command, words, sentence):
    with pytest.raises(ConfigError, match=sentence) as refusal:
        program.execute([command, "tiny", *words])
    one_sentence(refusal)


def test_a_module_that_is_broken_is_refused_in_a_sentence(tmp_path, monkeypatch):
    package(tmp_path, "mine_wrong", "raise ValueError('two\\nlines')", entry=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"mine_wrong .*ValueError: two lines") as refusal:
        imports.run(["tiny", "--import", "mine_wrong"])
    one_sentence(refusal)


def test_the_help_names_the_flag(capsys):
    for command in program.COMMANDS:
        with contextlib.suppress(SystemExit):
            program.execute([*command.split(), "--help"])
        assert "--plugin" in capsys.readouterr().out


def cell(module="__main__"):
    """What a notebook's cell defines each time it is run."""

    @dataclasses.dataclass(frozen=True)
    class Cell(Noise):
        sample_steps: int = 3

    Cell.__module__ = module
    return Cell


def test_a_cell_that_is_run_again_takes_the_place_of_the_first():
    first, second = cell(), cell()
    assert register("noise", "cell", first) is first
    made = PEWM(noise=first())
    register("noise", "cell", second)
    assert kinds.named("noise", "cell").settings is second
    assert configuration.to_dict(made)["noise"]["kind"] == "cell"
    with pytest.raises(ConfigError, match="a noise 'cell' already"):
        register("noise", "cell", cell("elsewhere"))


def test_the_name_of_a_built_in_kind_is_taken():
    with pytest.raises(ConfigError, match=r"a noise 'edm' already \(EDMConfig\)"):
        register("noise", "edm", cell())


def test_a_default_is_made_when_a_value_is_needed():
    @dataclasses.dataclass(frozen=True)
    class Holder:
        noise: Noise = kinds.part("noise", "flow", sample_steps=4)
        memory: Memory = kinds.part("memory", "none", reader=kinds.part("reader", "render"))

    made = Holder()
    assert (made.noise.sample_steps, type(made.memory.reader).__name__) == (4, "RenderConfig")
    assert [kinds.usual(field).__name__ for field in dataclasses.fields(Holder)] == [
        "FlowConfig",
        "NoMemoryConfig",
    ]


def test_a_module_of_functions_goes_on_working_with_a_warning():
    mine = types.SimpleNamespace(
        shown=lambda config, x, time: (config.sample_steps * x, time),
        target=lambda config, x0, noise, time: noise,
    )
    old = cell()
    with pytest.warns(DeprecationWarning, match="make them methods of Cell"):
        register("noise", "old", old, mine)
    assert old().precondition(2.0, 1.0) == (6.0, 1.0)
    assert old().prediction_target(0.0, 5.0, 1.0) == 5.0
    with pytest.raises(NotImplementedError):
        old().draw(None, 1, 1)


def test_a_world_with_a_module_of_functions_goes_on_working_with_a_warning():
    @dataclasses.dataclass(frozen=True)
    class Former(World):
        size: int = 3

    frames = Frames(np.zeros((1, 2, 2, 3)), np.ones((1, 2, 2)), Camera(np.ones((1, 4)), np.eye(4)))
    mine = types.SimpleNamespace(
        init=lambda model, key: {"kernel": np.zeros(model.size)},
        stages=lambda model: (Stage("fit", 1, ((".*", "train"),), mine.init, print),),
        observe=lambda model, params, state, frames: WorldState(frames, params["kernel"]),
        imagine=lambda model, *given, **named: None,
    )
    with pytest.warns(DeprecationWarning, match="make them methods of Former"):
        register("world", "former", Former, mine)
    model = Former(size=4)
    params = worlds.init(model, None)
    assert params["kernel"].shape == (4,)
    assert [stage.name for stage in worlds.stages(model)] == ["fit"]
    assert model.start(params, frames).map is params["kernel"]
    assert worlds.sharding(model)[-1][0] == ".*"


def test_a_module_that_is_reloaded_registers_anew(tmp_path, monkeypatch):
    package(tmp_path, "mine_reloaded", PART.format(name="reloaded"), entry=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module("mine_reloaded")
    first = module.MineConfig
    importlib.reload(module)
    assert kinds.named("noise", "reloaded").settings is module.MineConfig is not first


class Plain(Noise):
    pass


class Undecorated(DDPMConfig):
    extra: int = 3


@dataclasses.dataclass
class Thawed(Noise):
    extra: int = 3


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (Plain, "Plain .* no frozen dataclass"),
        (Undecorated, "Undecorated .* no frozen dataclass"),
        (Thawed, r"Thawed .* write @dataclasses.dataclass\(frozen=True\)"),
        (PixelConfig, "PixelConfig cannot be registered as a noise: derive"),
        (ClipConfig, "ClipConfig cannot be registered as a noise: derive"),
        (DDPMConfig(), "cannot be registered as a noise: derive a class"),
    ],
)
def test_what_is_no_settings_of_a_section_cannot_be_registered(settings, sentence):
    with pytest.raises(ConfigError, match=sentence) as refusal:
        register("noise", "new", settings)
    one_sentence(refusal)
    assert "new" not in kinds.names("noise")


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: PEWM(noise=PixelConfig()), "model.noise is PixelConfig: .* DDPMConfig"),
        (lambda: PEWM(memory=None), "model.memory is NoneType"),
        (lambda: PEWM(control=CameraConfig), "model.control is the class CameraConfig"),
        (lambda: PEWM(noise=Plain()), "model.noise is Plain"),
        (lambda: PEWM(clip=None), "model.clip is NoneType: give it a ClipConfig"),
        (lambda: PEWM(actions=ClipConfig()), "model.actions is ClipConfig"),
        (
            lambda: PEWM(memory=VoxelConfig(encoder=AttentionConfig())),
            "model.memory.encoder is AttentionConfig",
        ),
        (lambda: Config(model=PixelConfig()), "model is PixelConfig: .* 'world'"),
        (lambda: Config(model=None), "model is NoneType"),
    ],
)
def test_what_does_not_belong_into_a_section_is_refused(build, sentence):
    with pytest.raises(ConfigError, match=sentence) as refusal:
        build()
    one_sentence(refusal)


def test_functions_that_cannot_be_imported_are_refused_with_the_reason():
    gone = cell()
    with pytest.warns(DeprecationWarning, match="make them methods of Cell"):
        register("noise", "gone", gone, "no_such_module.noise")
    with pytest.raises(ConfigError, match=r"noise of kind 'gone': .*no_such_module") as refusal:
        gone().levels()
    assert "ModuleNotFoundError" in one_sentence(refusal)


@pytest.mark.parametrize(
    "words",
    [
        ["--codec.kind", "pixel", "--clip.frames", "5", "--memory.reader.heads", "4"],
        ["--clip.frames=5", "--memory.reader.heads=4", "--codec.kind=pixel"],
    ],
)
def test_a_kind_is_chosen_together_with_what_it_needs(words, tmp_path):
    default = parts.experiment()  # 4 frames, which the pixel codec cannot fold
    found = cli.parse(Config, words, default=default, prog="train.py").model
    assert (found.codec, found.clip.frames) == (PixelConfig(), 5)
    file = tmp_path / "mine.json"
    table = {"clip": {"frames": 5}, "codec": {"kind": "pixel"}, "memory": {"reader": {"heads": 4}}}
    file.write_text(json.dumps({"model": table}))
    assert overlay(default, file).model == found
    with pytest.raises(ConfigError, match=r"use 4k \+ 1"):
        cli.parse(Config, ["--codec.kind", "pixel"], default=default, prog="train.py")


@dataclasses.dataclass(frozen=True)
class Demanding(Noise):
    strength: float
    sample_steps: int = 3


def test_settings_without_a_default_are_asked_for():
    register("noise", "demanding", Demanding)
    found = configuration.from_dict(Noise, {"kind": "demanding", "strength": 2})
    assert found == Demanding(2.0)
    with pytest.raises(ConfigError, match="config lacks strength") as refusal:
        configuration.from_dict(Noise, {"kind": "demanding"})
    one_sentence(refusal)
    with pytest.raises(ConfigError, match="strength have no default") as refusal:
        cli.take_kinds(["--model.noise.kind", "demanding"], Config())
    one_sentence(refusal)


DDPM = DDPMConfig()


@dataclasses.dataclass(frozen=True)
class Other(World):
    noise: Noise = DDPM
    dtype: str = "float32"

    def init(self, key): ...

    def stages(self): ...

    def observe(self, params, state, frames): ...

    def imagine(self, params, state, control, key, *, remember=True, memory=True): ...


def test_a_world_is_chosen_before_its_parts(tmp_path):
    register("world", "other", Other)
    words = ["--model.noise.kind", "flow", "--model.kind", "other"]
    found, rest = cli.take_kinds(words, TINY)
    assert (type(found.model), type(found.model.noise).__name__, rest) == (Other, "FlowConfig", [])
    file = tmp_path / "mine.json"
    file.write_text('{"model": {"noise": {"kind": "flow", "shift": 2}, "kind": "other"}}')
    assert overlay(TINY, file).model.noise.shift == 2


def test_a_file_run_as_two_modules_registers_one_kind(tmp_path):
    path = tmp_path / "twice.py"
    path.write_text(
        "import dataclasses\n"
        "from pewm_jax.config.parts import Noise\n"
        "from pewm_jax.registry import register\n"
        "@register('noise', 'twice')\n"
        "@dataclasses.dataclass(frozen=True)\n"
        "class TwiceConfig(Noise):\n"
        "    pass\n"
    )
    for name in ("twice_by_name", "twice_by_file"):
        spec = importlib.util.spec_from_file_location(name, path)
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    by_name, by_file = (sys.modules.pop(f"twice_by_{how}") for how in ("name", "file"))
    assert by_name.TwiceConfig is by_file.TwiceConfig, "what one made equals what the other loads"
