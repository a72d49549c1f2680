"""The commands of docs/planning.md on environments run as written, and its settings exist.

Its Python runs in ``test_imagined``, which has compiled a world.
"""

import dataclasses
import re

import pytest

from pewm_jax.cli.main import main
from tests.planning.page import blocks, section

ROBOT = """
import gymnasium, pewm_jax.planning

def make():
    return gymnasium.make("pewm_jax/House-v0", height=16, width=16)

def act(observation):
    return int(observation["depth"].mean() < 2)
"""


def test_the_commands_run(monkeypatch, tmp_path, capsys):
    (tmp_path / "my_robot.py").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    lines = blocks("Your own environment as data", "bash").splitlines()
    assert len(lines) == 2
    for line in lines:
        words = [word.strip("'") for word in re.findall(r"'[^']*'|\S+", line)]
        assert words[0] == "pewm-jax"
        counts = ["--train", "1", "--validation", "0", "--test", "1", "--frames", "12"]
        assert main([*words[1:], *counts]) == 0
        assert main(["data", "validate", words[3]]) == 0
        assert "2 episodes, 24 frames, no problems" in capsys.readouterr().out


@pytest.mark.parametrize("title", ["House-v0", "WorldModelEnv", "Your own environment as data"])
def test_every_setting_the_page_names_exists(title):
    from pewm_jax.planning.house_config import HouseConfig

    known = {field.name for field in dataclasses.fields(HouseConfig)}
    for name in re.findall(r"`(\w+_(?:m|deg|steps|reward|distance_m))`", section(title)):
        assert name in known, name
