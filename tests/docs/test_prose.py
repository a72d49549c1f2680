"""The text is plain English with one spelling: no phrase, name or spelling of the lists below.

Run by itself it checks the files named as arguments, or all of them: ``python
tests/docs/test_prose.py``.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLACES = ("README.md", "CHANGELOG.md", "docs", "pewm_jax", "configs", "examples", "notebooks")
SUFFIXES = (".md", ".py", ".ipynb", ".jinja")
OLD_NAMES = ("CHANGELOG.md", "pewm_jax/_moved.py", "pewm_jax/config/migrations.py")
"""Files that name what earlier versions called otherwise."""

PHRASES = (
    r"on no index",
    r"[Ff]rom nothing to the first",
    r"does not like",
    r"goes on where it was",
    r"born knowing",
    r"is scored, too",
    r"\bOut again\b",
    r"grows with the extent",
    r"beside a named peer",
    r"is told of",
    r"processes the first sends",
    r"\bRead are\b",
    r"\bCompared is\b",
    r"\bWhat needs an extra\b",
    r"\bthinks?\b",
    r"nobody looks",
    r"last lesson",
    r"\bDrive on\b",
    r"There is a wall",
    r"\b[Cc]hapters?\b(?! 13\))",
    r"\b(?:house|room) of (?:the )?code\b",
)
NAMES = (
    r"\bOpened\b",
    r"\bopened\.py\b",
    r"\bPartials\b",
    r"\bimport (?:kept|unfinished|recorded|rounds_file)\b",
    r"\b(?:kept|partials?|unfinished|recorded|rounds_file)\.py\b",
    r"\bshares\.share\b",
    r"\bfixed\.lay\b",
    r"\bwords\.py\b",
    r"\bimport words\b",
    r"\bErrand",
    r"\bMinds\b",
    r"(?<!\")\bJudged\b",
    r"\bAsked\b",
    r"\b(?:is|are|was|were|unless|be|never) (?:not |never )?told(?! apart)\b",
    r"\btold(?: =|=|: )",
    r"\blent(?:\b| =|=)",
    r"\.given\b|\bgiven=",
    r"\bwrong(?:=|\()",
    r"\bdef shown\b|\.shown\(",
    r"\bSight\b",
    r"\bsight(?:\.py|=|:|\()|\.sight\b",
    r"\bSpots\b",
    r"\bseat\b",
    r"\bhold(?:=|: [a-z]+$|\()|\.hold\b",
    r"\bdoubt(?:=|: [a-z]+\b)|\.doubt\b",
    r"\bfar_apart\b",
    r"\bcame_back\b",
    r"\bgrew\(",
    r"\bSHAKY\b",
    r"\bprocesses\.meet\b",
    r"\bentered_by_first\b",
    r"\bruns\.FREE\b|\bFREE = (?!.*\d)",
    r"\bPlaces\(",
    r"\.forgets\b|\bforgets[=:]",
    r"\b[Ss]trangers?\b",
    r"\bguests?\b",
    r"\bsay(?:=|: Callable|\()",
)
SPELLINGS = {
    r"behavior": "behaviour",
    r"neighbor": "neighbour",
    r"(?<!-)\bcolor(?!fully)": "colour",
    r"\bcenter": "centre",
    r"\bgray": "grey",
    r"\bfavor": "favour",
    r"\banalyz": "analyse",
    r"\bvisualiz": "visualise",
    r"\bnormaliz": "normalise",
    r"\blabeled": "labelled",
    r"\bmodeling": "modelling",
    r"\bcanceled": "cancelled",
    r"\brecogniz": "recognise",
    r"\bfulfills?\b": "fulfil",
    r"\bseperat": "separate",
    r"\boccured": "occurred",
    r"\brecieve": "receive",
    r"\blenght": "length",
    r"\bteh\b": "the",
    r"\bwich\b": "which",
    r"\bsucc?esful": "successful",
    r"\bneccess": "necessary",
    r"\bexistance": "existence",
    r"\bpersistant": "persistent",
    r"\bdependant": "dependent",
    r"\bindependant": "independent",
    r"\baccomodat": "accommodate",
    r"\binital": "initial",
    r"\bparamter": "parameter",
    r"\bwether\b": "whether",
}
"""A spelling that is not ours, and ours; looked for in comments, docstrings and pages."""


def files(names=()):
    """Return the text files of the project that are in version control, or those of ``names``."""
    listed = subprocess.run(
        ["git", "ls-files", "--", *(names or PLACES)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    paths = [ROOT / name for name in listed.stdout.splitlines()]
    return [path for path in paths if path.suffix in SUFFIXES and path.is_file()]


def found(patterns, text, name):
    """Return file, line and text of each match."""
    expression = re.compile("|".join(patterns))
    return [
        f"{name}:{number}: {match[0]}"
        for number, line in enumerate(text.splitlines(), 1)
        for match in expression.finditer(line)
    ]


def prose(path, text):
    """Return a file's text with everything but prose left empty, line by line."""
    if path.suffix == ".md":
        text = re.sub(r"(?ms)^```.*?^```", lambda match: "\n" * match[0].count("\n"), text)
        return re.sub(r"`[^`\n]*`|\]\([^)\n]*\)|<[^>\n]*>", "", text)
    if path.suffix != ".py":
        return ""
    lines = [""] * (text.count("\n") + 2)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            lines[token.start[0] - 1] = token.string
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            value = node.value
            if isinstance(value.value, str):
                for offset, line in enumerate(value.value.splitlines()):
                    lines[value.lineno - 1 + offset] = line
    return "\n".join(re.sub(r"``[^`]*``|`[^`]*`", "", line) for line in lines)


def problems(names=()):
    """Return what is wrong with the text of the project, or of the files of ``names``."""
    every = []
    for path in files(names):
        text, name = path.read_text(), path.relative_to(ROOT).as_posix()
        every += found(PHRASES if name in OLD_NAMES else (*PHRASES, *NAMES), text, name)
        every += found(SPELLINGS, prose(path, text), name)
    return every


def test_no_phrase_name_or_spelling_of_the_lists_is_left():
    assert not problems()


@pytest.mark.parametrize(
    "line", ["See chapter 3.", "Opened(run)", "def f(say: Callable)", "x.sight", "it thinks"]
)
def test_what_the_lists_forbid_is_found(line):
    assert found((*PHRASES, *NAMES), line, "x.md") == [
        f"x.md:1: {re.search('|'.join((*PHRASES, *NAMES)), line)[0]}"
    ]


def test_spellings_are_looked_for_in_prose_alone():
    page = prose(Path("x.md"), "A color.\n```\ncolor\n```\n`color` and center.")
    assert found(SPELLINGS, page, "x.md") == ["x.md:1: color", "x.md:5: center"]
    code = '"""A color."""\nx = "color"  # gray\n'
    assert found(SPELLINGS, prose(Path("x.py"), code), "x.py") == ["x.py:1: color", "x.py:2: gray"]


if __name__ == "__main__":
    wrong = problems(sys.argv[1:])
    print(*wrong, sep="\n")
    sys.exit(bool(wrong))
