"""Changed files and names of strangers: every verb and reader ends as it should."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import sys
import time
from contextlib import closing, suppress

import cv2
import pytest
import typer
from sqlalchemy import Text
from tests.sequences.bag_maker import StereoBag, rectified_infos
from tests.sequences.synthetic import camera, picture, stamp_ns

from engram.cli import main
from engram.cli.app import app
from engram.maps.rows import sealed
from engram.maps.schema import metadata
from engram.sequences.framelog.file import log_digest, log_table
from engram_lab.checks.mutations import CHANGES, FAULTS, Harness
from engram_lab.mutations import forks
from engram_lab.mutations.case import make_samples
from engram_lab.mutations.forks import Limits, Outcome, tried


@pytest.fixture(scope="module")
def harness(tmp_path_factory):
    cv2.setNumThreads(0)
    return Harness(tmp_path_factory.mktemp("mutations"))


def test_a_few_changes_of_every_kind_do_no_harm(harness):
    for number in range(len(CHANGES)):
        kind, trial = harness.trial(number, seed=0)
        assert trial.outcome not in FAULTS, (kind, trial)


def test_a_case_is_its_number(harness):
    first, again = (harness.trial(3, seed=5)[1] for _ in range(2))
    assert (first.what, first.outcome) == (again.what, again.outcome)
    assert first.what != harness.trial(16, seed=5)[1].what


def crash(_):
    os.kill(os.getpid(), signal.SIGKILL)


def stumble(_):
    raise KeyError("a bug")


def bomb(_):
    return Outcome.READ, str(len(bytearray(3 * 2**30)))


def grow(_):
    return Outcome.READ, str(len(b"x" * (1100 * 2**20)))


def obey(_):
    os.system("true")
    return Outcome.READ, ""


def spin(_):
    while True:
        pass


def wait(_):
    time.sleep(100)


@pytest.mark.parametrize(
    ("work", "outcome"),
    [
        (lambda _: (Outcome.READ, ""), Outcome.READ),
        (crash, Outcome.CRASH),
        (stumble, Outcome.TRACEBACK),
        (bomb, Outcome.MEMORY),
        (grow, Outcome.MEMORY),
        (obey, Outcome.EXECUTED),
        (spin, Outcome.HANG),
        (wait, Outcome.HANG),
    ],
)
def test_each_outcome_is_told_apart(tmp_path, monkeypatch, work, outcome):
    limits = Limits(seconds=1.0) if work is spin else None
    if work is wait:
        monkeypatch.setattr(forks, "_STUCK_S", 0.5)
    assert tried(work, tmp_path, limits).outcome is outcome


def test_writing_outside_its_folder_is_a_deed(tmp_path):
    def write(_):
        (tmp_path / "elsewhere").write_text("owned")
        return Outcome.READ, ""

    inside = tmp_path / "inside"
    inside.mkdir()
    trial = tried(write, inside)
    assert trial.outcome is Outcome.EXECUTED
    assert "elsewhere" in trial.detail


# A terminal's title, a cleared screen, text from right to left; markup of bars, formulas of plots.
WILD = "\x1b]0;owned\x07\x1b[2J\u202e[/red]$\\frac{$"
# Texts that only one of a few values can be: others are refused by name, which is tested, too.
CLOSED = {
    ("revisions", "status"),
    ("revisions", "configuration"),
    ("revisions", "contents"),
    ("revisions", "writer"),
    ("frontends", "descriptor"),
    ("sessions", "clock"),
    ("sessions", "zone"),
    ("nodes", "status"),
    ("edges", "kind"),
    ("path_entries", "kind"),
    ("removals", "kind"),
    ("statistics", "body"),
    ("forgotten", "record"),
    ("receipts", "record"),
    ("hidden", "record"),
    ("amendments", "what"),
    ("cameras", "id"),
    ("cameras", "rectification"),
}
MAP_VERBS = [
    "amend MAP 0 --zone Europe/Prague",
    "amend MAP {wild} --zone Europe/Prague",
    "anchor MAP positions.csv",
    "check MAP",
    "check MAP --geometry",
    "check MAP --seal",
    "diff MAP 0 head",
    "diff MAP {wild} head",
    "download MAP out.engram",
    "download MAP tod.engram --select tod --depart 9:30",
    "dream MAP MAP",
    "export MAP out.csv",
    "forget MAP --pictures",
    "forget MAP --session {wild}",
    "forget MAP --erase",
    "goal list MAP",
    "goal add MAP {wild} --x 1 --y 2",
    "goal remove MAP {wild}",
    "info MAP",
    "info MAP --sessions",
    "log MAP",
    "log MAP --oneline",
    "merge fleet.engram MAP",
    "plot MAP out.png --by robot",
    "weak-spots MAP",
    "report MAP --out out.html",
    "revert MAP 1 --dry-run",
    "show MAP",
    "show MAP 1",
    "show MAP 0",
    "tag MAP",
    "tag MAP {wild}",
    "upgrade MAP",
    "vocabulary show MAP",
    "vocabulary use fleet.engram MAP",
    "localise MAP LOG",
    "localise MAP LOG --explain 1",
    "map MAP LOG",
    "live MAP --calibration nothing",
    "view MAP LOG --view out.rrd",
    "lab places MAP",
    "lab relocalise MAP LOG",
    "lab try MAP LOG",
]
DRIVE_VERBS = [
    "build new.engram LOG",
    "doctor LOG",
    "drive info LOG",
    "drive calibration LOG",
    "evaluate LOG --truth LOG",
    "record LOG out.framelog",
    "report LOG --out out.html",
]
# They show nothing of a map or a drive: their own files, or long work of the laboratory.
OWN = {
    "settings", "features", "try", "demo", "lab bench", "lab fleet-day", "lab simulate",
    "lab evaluate all", "lab evaluate budgets", "lab evaluate faults", "lab evaluate fleet",
    "lab evaluate peers", "lab evaluate public", "lab evaluate ranking", "lab evaluate scale",
}  # fmt: skip


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return make_samples(tmp_path_factory.mktemp("names"))


@pytest.fixture
def engram(monkeypatch, capsys, tmp_path):
    """Runs the program in a folder of its own; both streams together."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "positions.csv").write_text(f"node,x,y\n{WILD},1,2\n")

    def run(line: str, **places: object) -> str:
        words = [
            str(places.get(word, word.format(wild=WILD) if "{" in word else word))
            for word in line.split()
        ]
        monkeypatch.setattr(sys, "argv", ["engram", *words])
        capsys.readouterr()
        with suppress(SystemExit):
            main()
        return "".join(capsys.readouterr())

    return run


def assert_tame(shown: str) -> None:
    wild = {one for one in shown if not one.isprintable()} - {"\n", "\t"}
    assert not wild, shown[:2000]


def plant(path, *, closed: bool) -> None:
    """Puts escapes into every text, under right checksums."""
    with closing(sqlite3.connect(path)) as connection, connection:
        for table in metadata.sorted_tables:
            names = [one.name for one in table.columns]
            texts = [
                one.name
                for one in table.columns
                if isinstance(one.type, Text) and (closed or (table.name, one.name) not in CLOSED)
            ]
            for values in connection.execute(f"SELECT {', '.join(names)} FROM {table.name}"):
                row = dict(zip(names, values, strict=True))
                for name in texts:
                    if row[name] is not None:
                        row[name] = f"{row[name]}{WILD}"
                key = names[0]
                given = ", ".join(f"{name} = ?" for name in names)
                connection.execute(
                    f"UPDATE {table.name} SET {given} WHERE {key} = ?",
                    [*sealed(table, row).values(), row[key]],
                )


def plant_in_a_drive(path) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        found = connection.execute(f"SELECT header, complete FROM {log_table.name}")
        header, complete = found.fetchone()
        values = json.loads(header)
        for name in ("name", "robot", "source_format", "frontend", "odometry"):
            values[name] += WILD
        header = json.dumps(values, sort_keys=True)
        connection.execute(
            f"UPDATE {log_table.name} SET header = ?, digest = ?",
            [header, log_digest(header, complete)],
        )


@pytest.mark.parametrize("closed", [False, True])
def test_no_verb_shows_a_map_s_escapes(engram, samples, tmp_path, closed):
    path, log = tmp_path / "town.engram", shutil.copy(samples.framelog, tmp_path / "a.framelog")
    plant_in_a_drive(log)
    seen = ""
    for line in MAP_VERBS:
        shutil.copyfile(samples.town, path)
        plant(path, closed=closed)
        shown = engram(line, MAP=path, LOG=log)
        assert_tame(shown)
        seen += shown
    assert "�]0;owned�" in seen


def test_no_verb_shows_a_drive_s_escapes(engram, samples, tmp_path):
    logs = [samples.framelog, samples.flight]
    seen = ""
    for source in logs:
        log = shutil.copy(source, tmp_path / source.name)
        plant_in_a_drive(log)
        for line in DRIVE_VERBS:
            seen += engram(line, LOG=log)
            assert_tame(seen)
    assert "�]0;owned�" in seen


def test_no_verb_shows_a_bag_s_escapes(engram, tmp_path):
    pairs = [(stamp_ns(at), picture(at, 0), picture(at, 1)) for at in range(3)]
    topics = (f"/left{WILD}/image", f"/right{WILD}/image")
    folder = tmp_path / f"bag{WILD}".replace("/", "")
    path = StereoBag(pairs, rectified_infos(camera()), topics).write(folder, "ros1")
    seen = ""
    for line in (*DRIVE_VERBS, "map new.engram LOG", "drive info LOG --left {wild}"):
        seen += engram(line, LOG=path)
        assert_tame(seen)
    assert "�]0;owned�" in seen


def test_the_tables_name_every_verb():
    named = {" ".join(line.split()[:2]) for line in (*MAP_VERBS, *DRIVE_VERBS)}
    every = set(_verbs(typer.main.get_command(app)))
    bare = {one.split()[0] for one in named}
    missing = {
        verb
        for verb in every - OWN
        if verb not in named and verb not in bare and verb.split()[0] not in {"agent", "centre"}
    }
    assert not missing


def _verbs(group, before=()):
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _verbs(command, (*before, name))
        else:
            yield " ".join((*before, name))
