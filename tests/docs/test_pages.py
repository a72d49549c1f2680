"""Links, code and commands of the documentation, and the pages of its site that are made."""

import ast
import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from docs.generate import code, links, pages
from pewm_jax.cli import main as program
from pewm_jax.cli import plugins
from pewm_jax.errors import ConfigError
from pewm_jax.studies import conditioning

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))
PAGES = sorted(
    str(path.relative_to(ROOT))
    for path in [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("pewm_jax/shipped/*/README.md"),
        *NOTEBOOKS,
    ]
)
PLACEHOLDERS = {"FOLDER", "RUN", "DATA", "PRESET", "DST", "SRC", "FILE", "PIPELINE"}
"""Words of commands that stand for something of the reader's."""
OPTIONAL = {"torch", "diffusers", "my_parts", "my_robot", "stable_baselines3"}
"""Modules in examples that need not be installed."""


def text_of(page):
    """Return a page's Markdown; of a notebook, that of its cells."""
    text = (ROOT / page).read_text("utf-8")
    if not page.endswith(".ipynb"):
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")


def blocks(text, *languages):
    found = re.findall(r"^```(\w*)[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [body for language, body in found if language in languages]


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    assert links.broken(page, text_of(page)) == []


def test_broken_links_are_seen():
    text = "# A b\n[x](nothing.md) [y](index.md#no) [z](#a-b) ![w](small.gif) `[v](no.md)`"
    assert len(links.broken("docs/x.md", text)) == 2
    assert links.broken("README.md", "[a](docs/play.md#controls)") == []


def defined(module):
    """Return the names at the top of a module of ours, without importing it; None if not ours."""
    if module.split(".")[0] != "pewm_jax":
        return None
    path = ROOT / module.replace(".", "/").replace("pewm_jax/presets", "configs")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    assert file.is_file(), f"there is no module {module}"
    names = {below.stem for below in path.glob("*")} if path.is_dir() else set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def imported(source):
    """List the module, name and alias of each import of a block of Python."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None, alias.asname or alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.module, one.name, one.asname or one.name) for one in node.names)


def absent(module, name):
    """Return a complaint where a module, or a name in it, does not exist."""
    top = module.split(".")[0]
    if top != "pewm_jax":
        there = top in OPTIONAL or importlib.util.find_spec(top) is not None
        return None if there else f"{module} is not installed"
    try:
        names = defined(module)
    except AssertionError as error:
        return str(error)
    return None if name is None or name in names else f"{module} has no {name}"


def missing(source):
    """List the modules and names of a block of Python that do not exist."""
    wrong = [absent(module, name) for module, name, _ in imported(source)]
    modules = {
        called: module if name is None else f"{module}.{name}"
        for module, name, called in imported(source)
        if module.split(".")[0] == "pewm_jax"
    }
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id, "")
            place = ROOT / module.replace(".", "/")
            if module and (place.is_dir() or place.with_suffix(".py").is_file()):
                wrong.append(absent(module, node.attr))
    return [complaint for complaint in wrong if complaint]


@pytest.mark.parametrize("page", [page for page in PAGES if page.endswith(".md")])
def test_python_in_pages_compiles_and_names_what_exists(page):
    for source in blocks(text_of(page), "python"):
        assert missing(source) == [], source


def test_python_in_notebooks_names_what_exists():
    for path in NOTEBOOKS:
        cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
        assert missing("\n".join("".join(cell["source"]) for cell in cells)) == [], path.name


def test_names_that_do_not_exist_are_seen():
    assert missing("from pewm_jax.planning import costs\ncosts.Pixels()") == []
    assert missing("from pewm_jax.planning import costs\ncosts.Picsels()") != []
    assert missing("import pewm_jax\npewm_jax.lode('small')") != []
    assert missing("from pewm_jax.nothing import x") != []


def commands(page):
    """List the commands in the blocks of a page, with lines that go on joined."""
    for body in blocks(text_of(page), "", "bash", "sh"):
        for line in re.sub(r"\\\n\s*", "", body).splitlines():
            words = line.split("  #")[0].strip()
            if re.match(r"([A-Z_]+=\S+ )*(pewm-jax|python|make|\S*pip) ", words):
                yield words


def arguments(command):
    """Return a command's words behind ``pewm-jax``, or None if it is another program."""
    words = shlex.split(re.sub(r"\$\w+", "0", command))  # variables of a shell are numbers
    words = [word for word in words if not re.match(r"[A-Z_]+=", word)]
    shells = {"train.py": ["train"], "evaluate.py": ["evaluate"]}
    if words[0] == "pewm-jax":
        return words[1:]
    if words[0] == "python" and words[1] in shells:
        return shells[words[1]] + words[2:]
    if words[:2] == ["python", "-m"] and words[2].startswith("pewm_jax."):
        return [words[2].removeprefix("pewm_jax."), *words[3:]]
    return None


def read(words):
    """Read the arguments of a command, and do not run it."""
    name, rest = program.find(plugins.run(words))
    assert name in program.COMMANDS, words
    if name in ("train", "plan") and rest and not rest[0].startswith("-"):
        rest[0] = rest[0] if (ROOT / "configs" / f"{rest[0]}.py").is_file() else "demo"
    return program.read(name, rest, f"pewm-jax {name}")


FOUND = sorted({command for page in PAGES for command in commands(page)})


def test_commands_can_be_read_by_their_own_parsers():
    assert len(FOUND) >= 40
    refused = []
    for command in FOUND:
        words = arguments(command)
        if words is None or "--help" in words:
            continue
        try:
            read(words)
        except Exception as error:  # noqa: BLE001 - whatever it is, the command is named
            refused.append(f"{command}: {error}")
    assert refused == []


def test_a_flag_that_does_not_exist_is_seen():
    with pytest.raises(ConfigError):
        read(["train", "demo", "--train.stepz", "3"])
    assert program.main(["--version"]) == 0


def test_other_programs_of_pages_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    targets = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for command in FOUND:
        words = shlex.split(command)
        if words[0] == "make":
            named = [w for w in words[1:] if "=" not in w]
            assert set(named) <= targets, command
        elif words[0] == "python" and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file(), command
        for extra in re.findall(r"(?:pewm-jax|\.)\[([a-z0-9,]+)\]", command):
            assert set(extra.split(",")) <= extras["optional-dependencies"].keys(), command


def test_every_extra_stands_in_the_tutorial():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    (table,) = re.findall(
        r"^\| extra .*?\n\n", text_of("docs/tutorial.md"), re.DOTALL | re.MULTILINE
    )
    named = set(re.findall(r"^\| `([\w-]+)`", table, re.MULTILINE))
    assert named == extras.keys() - {"test", "dev"}


@pytest.mark.parametrize("page", [page for page in PAGES if code.marks(text_of(page))])
def test_the_code_that_pages_show_exists(page):
    shown = code.expand(text_of(page))
    assert shown.count('```python title="') == len(code.marks(text_of(page)))
    for file, name in code.marks(text_of(page)):
        ast.parse(code.snippet(file, name).text)


def test_code_is_read_from_the_file_without_its_docstring():
    found = code.snippet("pewm_jax/geometry/cameras.py", "plucker")
    lines = (ROOT / found.file).read_text().splitlines()
    assert lines[found.first - 1].startswith("def plucker(")
    assert lines[found.last - 1] == found.text.splitlines()[-1]
    assert "Plücker coordinates" not in found.text
    with pytest.raises(KeyError, match="has no pluecker"):
        code.snippet("pewm_jax/geometry/cameras.py", "pluecker")


def test_the_reference_has_every_package_and_every_file():
    from tests.test_architecture import PACKAGES, PLACES

    made = pages.reference()
    order = [name for name, _ in links.packages()]
    assert order == [name for name in PACKAGES if name not in ("_moved", "__main__")]
    listed = set(re.findall(r"^::: pewm_jax\.(\S+)$", "".join(made.values()), re.MULTILINE))
    there = {place.removesuffix("/__init__").replace("/", ".") for place in PLACES}
    there = {name for name in there if name != "_moved"}
    assert listed == {name for name in there if not name.endswith("__main__")} - {"__init__"}


def test_the_glossary_has_the_letters_of_the_data_types():
    meanings = pages.letters()
    text = (ROOT / "pewm_jax" / "types.py").read_text()
    assert pages.suffixes(text) <= meanings.keys()
    assert meanings["B"] == "batch"
    assert meanings["H"] == meanings["W"] == "pixels"
    page = pages.glossary()
    for letter, meaning in meanings.items():
        assert f"| {letter} | {meaning} |" in page
    everywhere = {
        letter
        for path in (ROOT / "pewm_jax").rglob("*.py")
        for letter in pages.suffixes(path.read_text())
    }
    assert set(re.findall(r"^\| (\w) \|", page, re.MULTILINE)) == meanings.keys() | everywhere


def test_the_numbers_are_those_that_were_recorded():
    page = pages.numbers()
    found = json.loads((ROOT / "docs" / "table2" / "results.json").read_text())["rows"]
    for name, row in found.items():
        (line,) = re.findall(rf"^\| {re.escape(name)} \|.*$", page, re.MULTILINE)
        assert f"{row['sim']['mean']:.1f}" in line
    for line in (ROOT / "benchmarks" / "RESULTS.md").read_text().splitlines():
        assert line.startswith(("#", "<!--")) or line in page
    assert "with its memory | 24.60" in page


@pytest.mark.parametrize("name", ["egowm", "egowm-humanoid"])
def test_the_page_of_egowm_has_the_numbers_of_the_cards(name):
    """A row of the page has the mean of every score that the row of the card has, in its order."""

    def rows(path):
        found = {}
        for line in (ROOT / path).read_text().splitlines():
            name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
            if line.startswith("| ") and len(cells) > 4:
                found.setdefault(name, []).append([re.sub(r" \(.*", "", x) for x in cells])
        return found

    def within(some, whole):
        rest = iter(whole)
        return all(value in rest for value in some)

    card, page = rows(f"pewm_jax/shipped/{name}/README.md"), rows("docs/egowm.md")
    names = {"true actions", "another clip's actions", "the true clip"}
    assert names <= card.keys() & page.keys()
    for row in card.keys() & page.keys() - {name for name in card if "mean over" in name}:
        assert any(within(one, card[row][0]) for one in page[row]), row


@pytest.mark.parametrize("name", ["conditioning", "conditioning_humanoid"])
def test_the_page_of_egowm_has_the_tables_of_its_ablation(name):
    found = json.loads((ROOT / "docs" / "egowm" / f"{name}.json").read_text())
    table = conditioning.table_of(found["results"], found["about"]["rows"]).markdown()
    assert table in (ROOT / "docs" / "egowm.md").read_text()


def test_the_page_of_persist_has_the_numbers_of_the_card():
    def rows(path):
        lines = (ROOT / path).read_text().splitlines()
        cells = [[x.strip() for x in line.strip("|").split("|")] for line in lines]
        return {one[0]: one[1:] for one in cells if len(one) == 3}

    card, page = rows("pewm_jax/shipped/persist/README.md"), rows("docs/persist.md")
    for start in ("IoU of", "PSNR of a known grid", "PSNR of frames", "FVD over", "doorways seen"):
        (told,) = [cells for name, cells in card.items() if name.startswith(start)]
        assert any(cells[0] == told[0] for cells in page.values()), start


def test_a_notebook_becomes_a_page_with_its_pictures():
    text, pictures = pages.notebook(NOTEBOOKS[0])
    assert text.startswith("# A first rollout")
    assert pictures
    assert all(f"({name})" in text for name in pictures)


def test_links_are_moved_to_the_site():
    text = (
        "[a](../README.md) [b](../pewm_jax/worlds/pewm/world.py) [c](play.md#controls) "
        "[d](../Makefile)\n"
        "```\n[e](../README.md)\n```"
    )
    moved = links.moved("docs/x.md", "x.md", text)
    assert "[a](index.md)" in moved
    assert "[b](reference/worlds.md#pewm_jax.worlds.pewm.world)" in moved
    assert "[c](play.md#controls) d\n" in moved
    assert "[e](../README.md)" in moved
    assert "(../planning.md)" in links.moved(
        "notebooks/x.ipynb", "notebooks/x.md", "[p](../docs/planning.md)"
    )


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("material") is None:
        pytest.skip("MkDocs is not installed: pip install 'pewm-jax[docs]'")
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "--quiet",
            "--site-dir",
            tmp_path / "site",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site" / "paper" / "index.html").read_text()
    assert "geometry/cameras.py, lines" in page
    shutil.rmtree(tmp_path / "site")
