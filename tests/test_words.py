"""Docstrings, help and messages are plain English: words that were carried over do not return."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ENGRAM = ROOT / "src/engram"
LAB = ROOT / "lab/src/engram_lab"

# A word, and what a maintainer writes instead.
PLAINER = {
    r"told": "reported, given, detected",
    r"tells?": "shows, reports, decides",
    r"said (?:of|to be|otherwise)": "reported",
    r"asked for": "requested",
    r"(?:came|comes?|become|became) of|what came": "result, outcome",
    r"lack(?:s|ed|ing)?": "is missing",
    r"(?<!there )(?:is|are) (?-i:none)(?! of)": "is invalid, is missing",
    r"(?<!there )(?:is|are) no (?:drive|map|name|lens|sequence|frame)": "is not a drive",
    r"way": "distance, path, route, direction, method",
    r"beside": "next to, with, in addition to",
    r"for good": "permanently",
    r"anew": "again",
    r"go(?:es|ing)? on|went on": "continues",
    r"by night": "at night",
    r"hung|hangs? (?:on|together)": "connected, disconnected, depends on",
    r"believe[sd]?": "accepts",
    r"knows|knew": "contains, accepts, uses",
    r"does not know": "does not contain, is unknown to",
    r"nobody|somebody": "no process, a person: name who",
    r"owes?": "is pending",
    r"hears?|heard": "receives",
    r"(?:take|takes|took|taken) away": "removes, revokes, subtracts",
    r"put back": "restored",
    r"liker|likest": "more similar, most similar",
    r"foretells?|foretold": "predicts",
    r"not serve": "fails, does badly",
}

# Idioms in which such a word is right.
ALLOWED = {
    r"which way up": "of an image: the idiom",
    r"\b(?:under|half|either|each|every|the same|one|gives) way\b": "no distance, but an idiom",
    r"\btells? (?:\w+ ){1,3}apart\b": "to distinguish",
    r"\bthere (?:is|are) none\b": "existence, as in 'None if there is none'",
}

_WORD = re.compile(r"\b(?:" + "|".join(PLAINER) + r")\b", re.IGNORECASE)
_IDIOM = re.compile("|".join(ALLOWED), re.IGNORECASE)
# Names of the code: `names`, ``--options``, and the entries of a section.
_CODE = re.compile(r"``.*?``|`[^`]*`|--[\w-]+|^ *[\w, *]+:(?= )", re.MULTILINE)
_DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def docstrings(tree: ast.AST) -> list[ast.Constant]:
    """The docstrings of a module, its classes and its functions."""
    return [
        node.body[0].value
        for node in ast.walk(tree)
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None
    ]


def messages(tree: ast.AST) -> list[ast.Constant]:
    """The texts of errors and of help."""
    spoken = [
        node.value if isinstance(node, ast.keyword) else node
        for node in ast.walk(tree)
        if isinstance(node, ast.Raise)
        or (isinstance(node, ast.keyword) and node.arg in {"help", "description"})
    ]
    return strings(spoken)


def strings(trees: Iterable[ast.AST]) -> list[ast.Constant]:
    """The string constants under some nodes that are more than a word."""
    return [
        node
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value
    ]


def found(text: str) -> list[str]:
    """The words of a text that have a plainer one."""
    if not _WORD.search(text):
        return []
    plain = _IDIOM.sub(" ", _CODE.sub(" ", text))
    return [hit.group(0) for hit in _WORD.finditer(plain)]


def instead(word: str) -> str:
    """What to write instead of a word."""
    return next(better for one, better in PLAINER.items() if re.fullmatch(one, word, re.IGNORECASE))


def hits(path: Path, lines: Iterable[tuple[int, str]]) -> Iterator[str]:
    """A report for each word in numbered lines of a file."""
    for number, line in lines:
        for word in found(line):
            yield f"{path.relative_to(ROOT)}:{number}: '{word}': write {instead(word)}"


def numbered(text: ast.Constant) -> Iterator[tuple[int, str]]:
    """The lines of a text with their numbers in its file."""
    return enumerate(text.value.splitlines(), text.lineno)


def test_every_text_of_the_package_uses_the_plainer_word():
    bad = []
    for path in sorted(ENGRAM.rglob("*.py")):
        for text in strings([ast.parse(path.read_text(encoding="utf-8"))]):
            bad += hits(path, numbered(text))
    assert not bad, "\n".join(bad)


def test_first_lines_and_messages_of_the_laboratory_use_the_plainer_word():
    bad = []
    for path in sorted(LAB.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for text in docstrings(tree):
            bad += hits(path, [next(numbered(text))])
        for text in messages(tree):
            bad += hits(path, numbered(text))
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("What became of a drive that hangs on nothing.", ["became of", "hangs on"]),
        ("The robot's name is none.", ["is none"]),
        ("The newest node; None if there is none.", []),
        ("Whether numbers tell the cameras apart.", []),
        ("told: the motion of `beside`, in ``way``.", []),
        ("Which way up, and by which way.", ["way"]),
        ("A map that lacks nodes; --beside adds them anew.", ["lacks", "anew"]),
    ],
)
def test_a_word_is_found_unless_it_is_code_or_an_idiom(text, words):
    assert found(text) == words
