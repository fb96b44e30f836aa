"""What error texts tell people to type: every verb, option, setting and extra in them exists."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer

from engram.cli import wording
from engram.cli.app import LABORATORY, SPELLINGS, VERBS, app
from engram.cli.options import Drive, SettingsGiven
from engram.cli.settings import AllSettings, every_setting
from engram.errors import InputError, MissingExtraError, extra

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "engram"
COMMANDS = typer.main.get_command(app).commands

# `engram VERB`, not `import engram` or engram-lab; and the nouns that follow the name in prose.
_VERB = re.compile(r"(?<![\w/.-])engram ([a-z]+)(?: ([a-z]+)\b)?")
_PROSE = {"centre at", "token"}
_PIP = re.compile(r"pip install [^\n;]*")  # its options are its own
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
_EXTRA = re.compile(r"engram-localisation\[(\w+)\]")
_SETTING = re.compile(r"(?<![\w./-])([a-z_]+)\.([a-z_]+)(?![\w(/.])")
# Parts of the program whose texts stand under some verbs; those of others under any.
_OPENS_DRIVES = (
    ("map",),
    ("localise",),
    ("record",),
    ("doctor",),
    ("view",),
    ("drive", "info"),
    ("drive", "calibration"),
)
_SPOKEN_BY: dict[str, tuple[tuple[str, ...], ...]] = {
    "sequences/bags/fixes.py": (("anchor",),),
    "sequences": _OPENS_DRIVES,
    "calibration": _OPENS_DRIVES,
    "doctor": (("map",), ("localise",), ("doctor",)),
    "fleet/build": (("build",),),
    "fleet/download": (("download",),),
    "fleet/dream": (("dream",),),
    "robot/anchors.py": (("anchor",),),
    "robot/inspecting.py": (("export",),),
}


def texts() -> Iterator[tuple[str, int, str]]:
    """File, line and text of every string that is no docstring; values as `{}`."""
    for path in sorted(SOURCE.rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        passed = {
            id(node.body[0].value)
            for node in nodes
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and node.body
            and isinstance(node.body[0], ast.Expr)
        }
        for node in nodes:
            if isinstance(node, ast.JoinedStr):
                passed |= {id(part) for part in node.values}
        for node in nodes:
            if isinstance(node, ast.Call) and getattr(node.func, "id", None) == "extra":
                passed |= {id(part) for part in node.args}
                yield _place(path), node.lineno, _missing_extra(*map(_text, node.args))
        for node in nodes:
            text = _text(node)
            if text is not None and id(node) not in passed:
                yield _place(path), node.lineno, text


def _text(node: ast.AST) -> str | None:
    """What a string says, with values as `{}`; None of what is no string."""
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) or "{}" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _missing_extra(name: str, need: str) -> str:
    """What people read if the packages of an extra are missing."""
    with pytest.raises(MissingExtraError) as raised, extra(name, need):
        raise ImportError
    return str(raised.value)


def _place(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


@cache
def all_texts() -> list[tuple[str, int, str]]:
    return [one for one in texts() if not one[0].startswith("fleet/centre/pages")]


def command(words: tuple[str, ...]) -> Any:
    """The command of these words; None if there is none."""
    found: Any = COMMANDS.get(SPELLINGS.get(words[0], words[0]))
    for word in words[1:]:
        found = getattr(found, "commands", {}).get(word)
    return found


def options_of(found: Any) -> set[str]:
    taken = {one for each in found.params for one in (*each.opts, *each.secondary_opts)}
    return taken | {"--help"}


@cache
def every_option() -> frozenset[str]:
    """Those of every verb but the laboratory's."""

    def inside(commands: dict[str, Any]) -> Iterator[str]:
        for found in commands.values():
            yield from options_of(found)
            yield from inside(getattr(found, "commands", {}))

    ours = {name: found for name, found in COMMANDS.items() if name not in LABORATORY}
    return frozenset(inside(ours)) | {"--version"}


def named_commands(text: str) -> Iterator[tuple[Any, str, str]]:
    """Each command that a text names: what it is, its words, and the text until the next."""
    ends = [*_VERB.finditer(text)]
    for found, then in pairwise([*ends, None]):
        assert found is not None
        words = (found[1],) if found[2] is None else (found[1], found[2])
        if " ".join(words) in _PROSE or found[1] in _PROSE:
            continue
        whole = command(words) if len(words) == 2 else None
        head = command(words[:1])
        inner = hasattr(head, "commands") and found[2] is not None
        what = whole if inner else head
        rest = text[found.end() : then.start() if then else len(text)]
        yield what, " ".join(words if inner else words[:1]), rest


def test_the_texts_are_found() -> None:
    assert len(all_texts()) > 2000
    assert sum(bool(_VERB.search(text)) for _, _, text in all_texts()) > 50


def test_every_verb_that_a_text_names_exists() -> None:
    wrong = [
        f"{place}:{line}: engram {words}"
        for place, line, text in all_texts()
        for what, words, _ in named_commands(text)
        if what is None
    ]
    assert wrong == []


def test_every_option_behind_a_verb_is_one_of_it() -> None:
    wrong = []
    for place, line, text in all_texts():
        for what, words, rest in named_commands(text):
            # What follows in another clause is said of the verb that speaks.
            typed = re.split(r"[;,]|: | or ", rest)[0]
            wrong += [
                f"{place}:{line}: engram {words} {option}"
                for option in _OPTION.findall(typed)
                if what is not None and option not in options_of(what)
            ]
    assert wrong == []


def test_every_option_is_one_of_the_verbs_that_speak() -> None:
    wrong = []
    for place, line, text in all_texts():
        verbs = next((_SPOKEN_BY[part] for part in _SPOKEN_BY if place.startswith(part)), ())
        ours = _PIP.sub("", _VERB.split(text)[0])
        for option in _OPTION.findall(ours):
            for words in verbs:
                known = option in options_of(command(words))
                wrong += [] if known else [f"{place}:{line}: {' '.join(words)} {option}"]
            if option not in every_option():
                wrong.append(f"{place}:{line}: {option}")
    assert wrong == []


def test_every_extra_that_a_text_names_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = {extra for _, _, text in all_texts() for extra in _EXTRA.findall(text)}
    assert len(named) > 5
    assert named <= project["optional-dependencies"].keys()


def test_every_setting_that_a_text_names_exists() -> None:
    known = {one.key for one in every_setting(AllSettings())}
    tables = {key.split(".")[0] for key in known}
    named = {
        (place, f"{table}.{key}")
        for place, _, text in all_texts()
        for table, key in _SETTING.findall(text)
        if table in tables and " " in text
    }
    assert len(named) > 3
    assert {(place, key) for place, key in named if key not in known} == set()


def test_what_the_laboratory_brings_is_named_as_its_own() -> None:
    wrong = [
        f"{place}:{line}: {text}"
        for place, line, text in all_texts()
        for found in _VERB.finditer(text)
        if found[1] in LABORATORY and "engram-lab" not in text
        if place != "cli/app.py"  # it asks whether the laboratory is installed
    ]
    assert wrong == []


def test_the_laboratorys_verbs_are_those_of_its_distribution() -> None:
    project = tomllib.loads((ROOT / "lab/pyproject.toml").read_text())["project"]
    assert set(LABORATORY) == project["entry-points"]["engram.verbs"].keys()


@pytest.mark.parametrize("line", ["demo", "lab simulate hamlet"])
def test_a_verb_of_the_laboratory_says_where_it_comes_from(line: str) -> None:
    without: Any = typer.main.get_command(app)
    without.commands = {name: COMMANDS[name] for name in VERBS}
    with pytest.raises(InputError, match=r"engram-lab, which is not installed.*pip install"):
        without.main(line.split(), standalone_mode=False)


def test_the_program_ends_with_commands_that_every_install_has(engram) -> None:
    ending = engram().err.strip().splitlines()[-1] or engram().out.strip().splitlines()[-1]
    named = [words for _, words, _ in named_commands(ending)]
    assert named == ["try", "map"]
    assert set(named) <= VERBS.keys()


def test_no_text_proposes_a_verb_whose_extra_may_be_missing() -> None:
    # Their texts depend on what is installed; `frame.py` only names what the picture shows.
    aware = {"cli/wording.py", "cli/trying.py", "cli/frame.py"}
    wrong = [
        f"{place}:{line}: {text}"
        for place, line, text in all_texts()
        for found in _VERB.finditer(text)
        if found[1] in {"plot", "view"} and place not in aware and _EXTRA.search(text) is None
    ]
    assert wrong == []


@pytest.mark.parametrize("drawn", [True, False])
def test_the_next_step_asks_for_nothing_that_is_not_installed(monkeypatch, drawn: bool) -> None:
    monkeypatch.setattr(wording, "find_spec", lambda name: object() if drawn else None)
    report = {
        "known": False, "share_localised": 0.0, "nodes_saved": 3, "resumed": False, "revision": 1,
        "interrupted": False, "findings": [], "statuses": {"lost": 3}, "frames": 3,
        "skipped_pairs": 0,
    }  # fmt: skip
    told = wording.mapped_text(report, "town.engram").splitlines()[-1]
    shown = "engram plot town.engram map.png" if drawn else "engram info town.engram"
    assert told == f"next: engram localise town.engram ANOTHER_DRIVE, or {shown}"


def test_options_of_a_drive_are_typed_as_they_were_given() -> None:
    given = Drive(**{name: ["a b"] if name == "motion" else "a b" for name in Drive.taken})
    words = given.typed()
    assert {one for one in words if one.startswith("--")} <= options_of(command(("map",)))
    assert len(words) == 2 * len(Drive.taken)
    assert Drive().typed() == []
    assert SettingsGiven(Path("a b"), ["c=1", "d=2"]).typed() == [
        "--config", "a b", "--set", "c=1", "--set", "d=2",
    ]  # fmt: skip
