"""What a wheel holds, and that it works in a folder of its own, away from the repository."""

import configparser
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import pewm_jax
from pewm_jax import presets
from pewm_jax.cli import main as command

ROOT = Path(__file__).parents[1]
HELPERS = ("train.py", "evaluate.py", "configs", "tests", "benchmarks", "docs")
"""What of a checkout does not travel, at least not under its own name."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel, built without a network from a copy, so that nothing is left in the checkout."""
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("setuptools, which builds wheels, is not installed here")
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE", "configs", "pewm_jax"):
        if (ROOT / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source / name)
    out = tmp_path_factory.mktemp("dist")
    alone = ("--no-deps", "--no-build-isolation", "--no-index")
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", ".", "--quiet", *alone, "--wheel-dir", str(out)],
        cwd=source,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The wheel unpacked into a folder, as an installer does with pure Python."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def metadata(wheel, name):
    with zipfile.ZipFile(wheel) as archive:
        (path,) = [x for x in archive.namelist() if x.endswith(f".dist-info/{name}")]
        return archive.read(path).decode()


def test_it_holds_the_package_and_the_presets_and_nothing_beside_it(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"pewm_jax"}
    assert not tops & set(HELPERS)
    here = {str(path.relative_to(ROOT)) for path in (ROOT / "pewm_jax").rglob("*.py")}
    here |= {f"pewm_jax/presets/{path.name}" for path in (ROOT / "configs").glob("*.py")}
    assert {name for name in names if name.endswith(".py")} == here
    assert "pewm_jax/py.typed" in names


def test_its_metadata_say_the_version_the_command_and_what_it_needs(wheel):
    told = Parser().parsestr(metadata(wheel, "METADATA"))
    assert told["Version"] == pewm_jax.__version__
    scripts = configparser.ConfigParser()
    scripts.read_string(metadata(wheel, "entry_points.txt"))
    assert dict(scripts["console_scripts"]) == {"pewm-jax": f"{command.__name__}:main"}
    needs = told.get_all("Requires-Dist") or []
    plain = [need for need in needs if "extra ==" not in need]
    assert not [need for need in plain if re.match(r"(torch|ray|diffusers|transformers)\b", need)]
    (embree,) = [need for need in plain if need.startswith("embreex")]
    assert 'platform_machine == "x86_64"' in embree


def test_the_version_stands_in_one_place():
    text = (ROOT / "pyproject.toml").read_text()
    assert not re.search(r"^version = \"", text, re.MULTILINE)
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    version = pewm_jax.__version__
    if version.endswith(".dev0"):
        assert headings[0] == "Unreleased"
        assert _numbers(version.removesuffix(".dev0")) > _numbers(headings[1])
    else:
        assert version == headings[0]
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited
    assert cited[1] == version


def test_shipped_weights_stay_small():
    files = list((ROOT / "pewm_jax" / "shipped").rglob("*.safetensors"))
    assert files
    assert sum(file.stat().st_size for file in files) <= 60e6


def _numbers(version):
    return [int(number) for number in version.split(".")]


@pytest.mark.slow
def test_the_presets_are_found_away_from_the_repository(installed, tmp_path):
    code = (
        "import pewm_jax; from pewm_jax import presets; "
        "print(pewm_jax.__file__, *presets.names()); [presets.load(n) for n in presets.names()]"
    )
    out = run(installed, tmp_path, "-c", code)
    assert out.split() == [str(installed / "pewm_jax" / "__init__.py"), *presets.names()]
    assert "Absurdly small" in run(installed, tmp_path, "-m", "pewm_jax", "train", "--help")
    assert list(tmp_path.iterdir()) == []


def run(site, cwd, *argv):
    done = subprocess.run(
        [sys.executable, *argv],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_embree_collecting_is_refused_in_a_sentence(tmp_path):
    code = (
        "import sys; sys.modules['embreex'] = None\n"
        "from pewm_jax.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "data", "collect", str(tmp_path / "x"), "--train", "1"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: rendering needs embreex")
    assert "pip install embreex" in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
