"""The command line as a whole: its groups, names, spellings and size."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from engram import __version__
from engram.cli.app import GROUPS, LABORATORY, VERBS, app
from engram.cli.options import Drive
from engram.cli.settings import AllSettings, every_setting
from engram.drive_options import DriveOptions

COMMANDS = typer.main.get_command(app).commands
# The longest help that a person takes in at once.
SCREEN = 62
# Options that its help shows, --help among them, and arguments and options of all verbs.
MOST_OPTIONS = 12
MOST_ARGUMENTS = 327


def every_verb(commands: dict, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The words of each verb, those in groups and of the laboratory included."""
    for name, command in commands.items():
        inner = getattr(command, "commands", None)
        yield from [(*words, name)] if inner is None else every_verb(inner, (*words, name))


EVERY_VERB = sorted(every_verb(COMMANDS))


def command_of(words: tuple[str, ...]) -> Any:
    """The command that these words name."""
    command = COMMANDS[words[0]]
    for word in words[1:]:
        command = command.commands[word]
    return command


def test_help_lists_the_verbs_in_their_groups(engram) -> None:
    lines = engram("--help").out.splitlines()
    places = {line.split()[0]: number for number, line in enumerate(lines) if line.strip()}
    for title, verbs in GROUPS.items():
        for verb in verbs:
            assert places[f"{title}:"] < places[verb]
    assert len(lines) <= SCREEN


def test_verbs_take_few_arguments_and_options() -> None:
    ours = [words for words in EVERY_VERB if words[0] not in LABORATORY]
    taken = {words: sum(one.name != "help" for one in command_of(words).params) for words in ours}
    assert max(taken.values()) <= 24, taken
    assert sum(taken.values()) <= MOST_ARGUMENTS, taken


@pytest.mark.parametrize("words", EVERY_VERB, ids=" ".join)
def test_help_shows_few_options_and_explains_the_others_on_request(
    engram, words: tuple[str, ...]
) -> None:
    options = [one for one in command_of(words).params if one.param_type_name == "option"]
    brief, full = (engram(*words, "--help", *more).out for more in ((), ("--all",)))
    usual, _, more = brief.partition("More options:")
    shown = re.findall(r"^  (?:-\w, )?(--[\w-]+)", usual.partition("Options:")[2], re.MULTILINE)
    assert len(shown) <= MOST_OPTIONS
    named = {*shown, *re.findall(r"--[\w-]+", more.partition("engram")[0])}
    assert named == {"--help", *(one.opts[0] for one in options)}
    for one in options:
        assert re.search(rf"^  (-\w, )?{one.opts[0]}\b.+", full, re.MULTILINE)
    if more:
        assert f"engram {' '.join(words)} --help --all explains them" in more


@pytest.mark.parametrize("words", EVERY_VERB, ids=" ".join)
def test_help_fits_a_screen_and_has_examples_that_the_verb_takes(
    engram, words: tuple[str, ...]
) -> None:
    lines = engram(*words, "--help").out.splitlines()
    assert len(lines) <= SCREEN
    assert [line for line in lines if re.search(r" <[a-z]", line)] == [], "names of types"
    command = command_of(words)
    summary = command.get_short_help_str(200)
    assert len(summary) <= 55, summary
    assert summary.endswith(".")
    first = lines.index("  Examples:") + 1
    examples = [shlex.split(line) for line in lines[first : lines.index("", first)]]
    assert examples
    for example in examples:
        assert tuple(example[1 : len(words) + 1]) == words
        line = example[len(words) + 1 :]
        given = line[: line.index(">")] if ">" in line else line
        command.make_context(" ".join(words), given)  # refuses what the verb does not take


def test_no_verb_takes_an_option_that_meant_two_things() -> None:
    taken = {option for name in VERBS for one in COMMANDS[name].params for option in one.opts}
    assert not taken & {"--start", "--policy", "--every", "--preload"}


def test_what_the_files_of_a_drive_do_not_state_is_an_option_or_a_setting() -> None:
    settings = {one.key for one in every_setting(AllSettings())}
    assert {f"drive.{one.name}" for one in dataclasses.fields(DriveOptions)} <= settings
    for name in ("map", "record"):
        assert set(Drive.taken) <= {one.name for one in COMMANDS[name].params}


def test_an_option_of_a_drive_counts_before_the_setting(engram, street, tmp_path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text('[drive]\nrobot = "r1"\nframes = "0:4"\n')
    engram("map", tmp_path / "a.engram", street, "--config", file)
    engram("map", tmp_path / "b.engram", street, "--config", file, "--robot", "r2")
    for name, robot in (("a", "r1"), ("b", "r2")):
        found = engram("info", tmp_path / f"{name}.engram", "--sessions", "--json").json
        assert [one["robot"] for one in found["session_list"]] == [robot]


def test_version(engram) -> None:
    ran = engram("--version")
    assert ran.status == 0
    assert ran.out == f"engram {__version__}\n"


def test_other_spellings_work(engram, street: Path, tmp_path: Path) -> None:
    town = tmp_path / "town.engram"
    assert engram("map", town, street, "--set", "drive.channel=gray").status == 0
    assert engram("localize", town, street).status == 0
    # The plain layout has one rig; that it is refused by its name shows that it was understood.
    assert "'colour'" in engram("localise", town, street, "--set", "drive.rig=color").err


def test_every_setting_has_a_meaning() -> None:
    settings = list(every_setting(AllSettings()))
    assert len(settings) > 100
    assert [one.key for one in settings if len(one.description) < 5] == []


def test_settings_show_what_a_file_and_set_change(engram, tmp_path: Path) -> None:
    file = tmp_path / "engram.toml"
    file.write_text("[mapper]\nsave_every_m = 2.0\n[merge]\nrounds = 8\n")
    asked = ("--config", file, "--set", "merge.rounds=6", "--set", "frontend.descriptor=teblid")
    shown = engram("settings", "show", *asked, "--json").json
    assert shown["mapper"]["save_every_m"] == 2.0
    assert shown["merge"]["rounds"] == 6
    assert shown["frontend"]["descriptor"] == "teblid"
    text = engram("settings", "show", *asked).out
    assert "merge.rounds = 6  # >= 1" in text


def test_settings_as_toml_are_a_settings_file(engram, tmp_path: Path) -> None:
    file = tmp_path / "engram.toml"
    file.write_text(engram("settings", "show", "--set", "mapper.save_every_m=2", "--toml").out)
    again = engram("settings", "show", "--config", file, "--json").json
    assert again == engram("settings", "show", "--set", "mapper.save_every_m=2", "--json").json


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("mapper", "expected KEY=VALUE"),
        ("mapper.save_evry_m=2", "setting 'mapper.save_evry_m'; did you mean save_every_m? known"),
        ("mapper.save_every_m.x=2", "save_every_m"),
        ("mapper.save_every_m=-2", "save_every_m"),
        ("download.latitude_deg=91", "<= 90"),
    ],
)
def test_a_setting_that_does_not_exist_or_fit_is_refused(engram, change: str, says: str) -> None:
    ran = engram("settings", "show", "--set", change)
    assert ran.status == 2
    assert says in ran.err


def test_info_lists_sessions_and_nodes_by_ids_that_other_verbs_take(
    engram, street: Path, tmp_path: Path
) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street, "--robot", "r1", "--recorded-at", "2026-03-01T09:30:00Z")
    found = engram("info", town, "--sessions", "--nodes", "--json").json
    (session,) = found["session_list"]
    assert session["robot"] == "r1"
    assert len(found["node_list"]) == found["nodes"] == session["nodes"]
    node = found["node_list"][0]["node"]
    assert session["session"] in engram("info", town, "--sessions").out
    assert node in engram("info", town, "--nodes").out
    assert engram("show", town, node[:10], "--json").json["node"] == node
    out = tmp_path / "out.engram"
    asked = ("--select", "route", "--route", session["session"][:8])
    assert engram("download", town, out, *asked).status == 0


@pytest.mark.parametrize("by", ["experience", "hour", "revision", "robot"])
def test_plot_draws_a_map(engram, street: Path, tmp_path: Path, by: str) -> None:
    town, picture = tmp_path / "town.engram", tmp_path / "town.svg"
    engram("map", town, street, "--robot", "r1", "--recorded-at", "2026-03-01T09:30:00Z")
    engram("goal", "add", town, "dock 5$", "--x", 1, "--y", 1)
    ran = engram("plot", town, picture, "--by", by)
    assert ran.status == 0
    assert "<!-- dock 5" in picture.read_text()
    nodes = engram("info", town, "--json").json["nodes"]
    assert f"{nodes} nodes by {by}" in ran.out
    assert picture.stat().st_size > 5000


def test_goals_that_move_or_are_far_from_the_map_are_named_and_exported(
    engram, street, tmp_path
) -> None:
    town, table = tmp_path / "town.engram", tmp_path / "town.csv"
    engram("map", town, street)
    assert not engram("goal", "add", town, "dock", "--x", 2, "--y", 1).err
    assert "from the nearest node" in engram("goal", "add", town, "far", "--x", 400, "--y", 1).err
    moved = engram("goal", "add", town, "dock", "--x", 3, "--y", 1).out.splitlines()
    assert "x      3.00" in moved[0]
    assert moved[1].startswith("moved from       x      2.00")
    assert engram(*moved[2].removeprefix("to undo: engram ").split()).status == 0
    listed = engram("goal", "list", town, "--json").json["goals"]
    assert {one["name"]: round(one["x_m"]) for one in listed} == {"dock": 2, "far": 400}
    nodes = engram("info", town, "--json").json["nodes"]
    assert f"{nodes} nodes, 2 goals" in engram("export", town, table).out
    assert "needs a name" in engram("goal", "remove", town).err
    assert "has no goal 'dok'; its goals: dock, far" in engram("goal", "remove", town, "dok").err
    assert "to undo: engram revert" in engram("goal", "remove", town, "far").out
    assert [one["name"] for one in engram("goal", "list", town, "--json").json["goals"]] == ["dock"]
    assert engram("export", town, tmp_path / "town.tum").out.strip().endswith(f"{nodes} nodes")
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("node,x,y\nffffffff,1,2\n")
    assert "wrong.csv: none of" in engram("anchor", town, wrong).err


def test_plot_refuses_what_it_cannot_write(engram, street: Path, tmp_path: Path) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street)
    for picture in ("no/folder/a.png", "a.xyz", "town"):
        ran = engram("plot", town, picture)
        assert ran.status == 2
        assert picture.removesuffix("/a.png") in ran.err


def test_map_says_what_became_of_every_frame_and_what_to_try_next(
    engram, street: Path, tmp_path: Path
) -> None:
    town = tmp_path / "town.engram"
    first = engram("map", town, street, "--robot", "r1")
    assert first.out.startswith("new area: ")
    assert "revision 1" in first.out
    assert "12 frames: " in first.out
    assert "next: engram localise" in first.out
    again = engram("map", town, street, "--robot", "r1")
    assert "nothing to do" in again.out
    assert "start after it with --frames" in again.out
    second = engram("map", town, street, "--robot", "r2")
    assert second.out.startswith("known area: 0 nodes saved")
    found = engram("localise", town, street)
    assert "12 frames: 12 localised, 0 dead reckoning, 0 lost, 0 no odometry" in found.out
    assert "ms per frame" in found.out


def test_the_limits_of_a_repair_are_settings(engram, street: Path, tmp_path: Path) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street)
    found = engram("check", town, "--geometry", "--set", "repair.gross_m=3", "--json")
    assert found.status == 0
    refused = engram("check", town, "--geometry", "--set", "repair.gross_m=-1")
    assert refused.status == 2
    assert "gross_m" in refused.err
