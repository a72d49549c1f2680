"""What several files test: the sections of docs/planning.md on environments."""

import re
from pathlib import Path

PAGE = (Path(__file__).parents[2] / "docs" / "planning.md").read_text()


def section(title):
    """Return the text of a section."""
    (text,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    return text


def blocks(title, language):
    """Return the code of a section in a language."""
    return "\n".join(re.findall(rf"```{language}\n(.*?)```", section(title), re.DOTALL))
