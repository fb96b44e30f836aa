"""Outputs are checked as the command line is read: no work is done for nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.cli.test_grammar import EVERY_VERB, command_of

# Where each verb writes: words, the argument or option, and what it is.
FILES = {
    ("map", "MAP"): "m.engram",
    ("map", "--view"): "m.rrd",
    ("localise", "--trajectory"): "t.tum",
    ("localise", "--view"): "v.rrd",
    ("live", "--view"): "v.rrd",
    ("record", "LOG"): "d.framelog",
    ("plot", "FILE"): "p.png",
    ("weak-spots", "--out"): "w.png",
    ("view", "--view"): "v.rrd",
    ("export", "FILE"): "e.csv",
    ("diff", "--picture"): "p.png",
    ("merge", "FLEET"): "f.engram",
    ("merge", "--picture"): "p.svg",
    ("download", "OUT"): "r.engram",
    ("build", "FLEET"): "f.engram",
    ("drive", "calibration", "--picture"): "c.png",
}
FOLDERS = {
    ("localise", "--pictures"),
    ("localise", "--recorder"),
    ("doctor", "--pictures"),
    ("check", "--pictures"),
    ("try", "--out"),
    ("centre", "backup", "TARGET"),
}
# What is read, or is made by a verb that does nothing before it.
OTHERS = {
    "DRIVE", "--calibration", "--mask", "--motion", "--config", "--grid", "--tls-certificate",
    "--tls-key", "FOLDER", "--socket", "--play", "SOURCE", "ROBOT", "--require-better", "--handed",
}  # fmt: skip
PLACES = {"FILE", "DIR", "PNG", "OUT", "TARGET", "LOG", "FOLDER", "PATH", "MAP", "FLEET", "RRD"}


def name_of(parameter) -> str:
    option = parameter.opts[0]
    return option if option.startswith("--") else parameter.metavar or ""


def written() -> set[tuple[str, ...]]:
    return {*FILES, *FOLDERS}


def looked_at() -> dict[tuple[str, ...], str]:
    """Every argument and option that names a place in the file system, with its help."""
    found = {}
    for words in EVERY_VERB:
        if words[0] == "lab":
            continue
        for one in command_of(words).params:
            metavar = (one.metavar or "").replace("window|", "").replace("FILE.", "")
            if set(metavar.upper().replace("|", " ").split()) & PLACES:
                found[*words, name_of(one)] = one.help or ""
    return found


def test_every_place_is_known_to_be_read_or_written():
    known = {key for key in looked_at() if key in written() or key[-1] in OTHERS}
    maps = {key for key in looked_at() if key[-1] in {"MAP", "FLEET"}}
    # `demo` makes its folder before anything else.
    read = {("anchor", "FILE"), ("demo", "--out"), ("evaluate", "--truth")}
    assert looked_at().keys() - known - maps == read
    assert written() <= looked_at().keys()


def typed(words: tuple[str, ...], value: Path) -> list[str]:
    """A command line whose other files are not there: reading them would be another fault."""
    *verb, name = words
    command = command_of(tuple(verb))
    needed = [one for one in command.params if one.required and not one.opts[0].startswith("-")]
    others = [str(value) if one.metavar == name else f"no-such-{one.name}" for one in needed]
    line = [*verb, *others]
    return [*line, name, str(value)] if name.startswith("--") else line


def told(answer) -> str:
    return " ".join(answer.err.replace("│", " ").split())


@pytest.mark.parametrize("words", FILES, ids=" ".join)
def test_a_file_in_no_folder_is_refused_before_the_work(engram, tmp_path, words):
    answer = engram(*typed(words, tmp_path / "none" / FILES[words]))
    assert answer.status == 2
    assert "none is not a folder; make it first" in told(answer)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("words", FILES, ids=" ".join)
def test_a_folder_is_no_file(engram, tmp_path, words):
    (tmp_path / FILES[words]).mkdir()
    answer = engram(*typed(words, tmp_path / FILES[words]))
    assert answer.status == 2
    assert "is a folder; give the name of a file in it" in told(answer)


@pytest.mark.parametrize("words", FILES, ids=" ".join)
def test_a_folder_that_takes_no_file_is_refused_before_the_work(engram, words):
    answer = engram(*typed(words, Path("/proc") / FILES[words]))
    assert answer.status == 2
    assert f"/proc/{FILES[words]} cannot be written" in told(answer)


@pytest.mark.parametrize("words", sorted(FOLDERS), ids=" ".join)
@pytest.mark.parametrize("place", ["file", "file/within", "/proc/x"])
def test_a_folder_that_cannot_be_made_is_refused_before_the_work(engram, tmp_path, words, place):
    (tmp_path / "file").write_text("taken")
    answer = engram(*typed(words, tmp_path / place))
    assert answer.status == 2
    assert "cannot be a folder" in told(answer) or "cannot be written to" in told(answer)


@pytest.mark.parametrize("words", [("plot", "FILE"), ("merge", "--picture"), ("diff", "--picture")])
def test_a_picture_of_an_unknown_kind_is_refused_before_the_work(engram, tmp_path, words):
    answer = engram(*typed(words, tmp_path / "p.xyz"))
    assert answer.status == 2
    assert ".xyz is not one of" in told(answer)


# `try` reads nothing that could be missing: it would go on and write.
@pytest.mark.parametrize("words", sorted(written() - {("try", "--out")}), ids=" ".join)
def test_a_place_that_takes_the_output_is_not_touched(engram, tmp_path, words):
    name = FILES.get(words, "folder")
    answer = engram(*typed(words, tmp_path / name))
    assert answer.status == 2
    assert str(tmp_path / name) not in told(answer)
    assert list(tmp_path.iterdir()) == []
