"""No sentence in code or docs begins with a noun clause (unless a question) or a genitive."""

import ast
import io
import re
import tokenize

import pytest

from folders import ROOT

FOLDERS = ("adp_path_follower", "sim_unicycle", "bench", "examples", "launch", "test")
FILES = sorted(
    [
        *(file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")),
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "config").rglob("*.yaml"),
        *(ROOT / "adp_path_follower").rglob("*.j2"),
        ROOT / "Makefile",
    ]
)
# A capital letter tells the first word of a sentence, a heading, a label or a table's cell.
BEGINNING = re.compile(r"\b(What|Of)\s[^.!?|]*(?:[.!](?=\w)[^.!?|]*)*[.!?|]?")


def written(file):
    """Return what a file says in prose: strings with spaces and comments, or all of its text."""
    text = file.read_text(encoding="utf-8")
    if file.suffix != ".py":
        return [text]
    tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    comments, last = [], -2
    for token in tokens:
        if token.type == tokenize.COMMENT:
            words = token.string.lstrip("#:! ")
            if token.start[0] == last + 1:
                comments[-1] += f" {words}"  # the same comment goes on
            else:
                comments.append(words)
            last = token.start[0]
    strings = [
        node.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value
    ]
    return [*comments, *strings]


def awkward(text):
    """Return the sentences of a text that begin in a way that hides their subject."""
    found = (match.group() for match in BEGINNING.finditer(text))
    return [" ".join(item.split()) for item in found if not item.endswith("?")]


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_sentences_name_their_subject(file):
    assert [found for text in written(file) for found in awkward(text)] == []


def test_awkward_sentences_are_found():
    what, of = "What", "Of"  # whole sentences would be found in this file
    assert awkward(f"Start. {what} stays when it changes.") == [f"{what} stays when it changes."]
    assert awkward(f"name: {of} the robot.") == [f"{of} the robot."]
    assert awkward(f"# {what} stops it\n\nText.") == [f"{what} stops it Text."]
    assert awkward(f"{what} now? It stops; what is left of it stays. Offline. Whatever.") == []
