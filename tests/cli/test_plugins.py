"""``--plugin FILE``: which files are refused, and what is said of the one that fails."""

import sys

import pytest

from pewm_jax.cli import plugins
from pewm_jax.config import ConfigError


@pytest.mark.parametrize("name", ["random", "jax"])
def test_a_file_called_as_a_module_does_not_replace_it(tmp_path, name):
    file = tmp_path / f"{name}.py"
    file.write_text("")
    before = sys.modules.get(name)
    with pytest.raises(ConfigError, match=rf"called as the module '{name}'.*my_{name}\.py"):
        plugins.run(["--plugin", str(file)])
    assert sys.modules.get(name) is before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\n\nraise KeyError('mine')\n", r"\(line 3, KeyError: 'mine'\)\.$"),
        ("\nimport json\njson.loads('{')\n", r"\(line 3, JSONDecodeError: .*\)\.$"),
        ("def f(:\n", r"\(SyntaxError: invalid syntax \(broken_file\.py, line 1\)\)\.$"),
        (
            "from pewm_jax.registry import register\nregister('noise', 'mine', int)\n",
            r"cannot be imported: int cannot be registered.*\.$",
        ),
    ],
)
def test_a_file_that_fails_is_named_with_its_line(tmp_path, text, message):
    file = tmp_path / "broken_file.py"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        plugins.run(["--plugin", str(file)])
    assert "broken_file" not in sys.modules
