"""The house rules: a chapter imports only chapters above it; heavy libraries live in few places."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CHAPTERS = [
    "atomic",
    "config",
    "types",
    "tree",
    "tensor_files",
    "weights",
    "cli",
    "geometry",
    "houses",
    "data",
    "models",
    "memory",
    "diffusion",
    "rollouts",
    "training",
    "scaling",
    "planning",
    "evaluation",
    "convert",
]
HOMES = {
    "flax": {"models"},
    "orbax": {"training/checkpoint"},
    "embreex": {"data"},
    "trimesh": {"data", "houses"},
    "ray": {"data/engines"},
    "torch": {"convert"},
    "transformers": {"convert"},
    "diffusers": set(),
    "pickle": set(),
}
FILES = sorted((ROOT / "pewm_jax").rglob("*.py"))


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


def chapter(parts):
    return parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_chapter_imports_only_chapters_above_it(path):
    inside = path.relative_to(ROOT / "pewm_jax")
    here = chapter(inside.parts)
    if here == "__init__":
        pytest.skip("the public surface may name everything")
    assert here in CHAPTERS, f"{here} is not in the reading order: add it to README and here"
    for name in imports(path):
        parts = name.split(".")
        if parts[0] == "pewm_jax" and len(parts) > 1 and parts[1] in CHAPTERS:
            assert CHAPTERS.index(parts[1]) <= CHAPTERS.index(here), f"{path} imports {name}"
        homes = HOMES.get(parts[0])
        if homes is not None:
            place = str(inside.with_suffix(""))
            assert any(place.startswith(home) for home in homes), f"{path} imports {name}"


def test_importing_the_package_loads_no_network_code():
    code = "import sys, pewm_jax; assert not {'jax', 'flax', 'orbax'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_every_public_name_exists():
    code = (
        "import pewm_jax\n"
        "import pewm_jax.rollouts, pewm_jax.models\n"
        "for name in pewm_jax.__all__: getattr(pewm_jax, name)\n"
        "assert callable(pewm_jax.rollout) and callable(pewm_jax.load)\n"
        "try: pewm_jax.nothing\n"
        "except AttributeError: pass\n"
        "else: raise SystemExit('an unknown name must not resolve')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
