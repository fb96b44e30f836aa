"""What the program does with errors that no verb foresees."""

import os
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE
from typing import IO

import pytest

from engram import _core
from engram.cli import app
from engram.cli.screen import screen


def test_a_core_of_another_version_is_told_in_one_line(engram, monkeypatch) -> None:
    def stale(**_: object) -> None:
        _core.a_kernel_that_is_not_built()

    monkeypatch.setattr(app, "app", stale)
    ran = engram("info", "map.engram")
    assert ran.status == 2
    assert "the compiled core is older" in ran.err
    assert "a_kernel_that_is_not_built" in ran.err


def test_other_faults_of_ours_are_not_hidden(engram, monkeypatch) -> None:
    def faulty(**_: object) -> None:
        object().nothing  # noqa: B018

    monkeypatch.setattr(app, "app", faulty)
    with pytest.raises(AttributeError):
        engram("info", "map.engram")


def test_a_mistyped_folder_does_not_become_a_centre(engram, tmp_path) -> None:
    ran = engram("centre", "jobs", tmp_path / "twon")
    assert ran.status == 2
    assert "there is no centre" in ran.err
    assert not (tmp_path / "twon").exists()


@pytest.mark.parametrize("verb", ["jobs", "code", "worker"])
def test_the_folder_of_something_else_does_not_become_a_centre(engram, tmp_path, verb) -> None:
    (tmp_path / "notes.txt").write_text("of another program")
    ran = engram("centre", verb, tmp_path)
    assert ran.status == 2
    assert "there is no centre" in ran.err
    assert [one.name for one in tmp_path.iterdir()] == ["notes.txt"]


def test_what_a_map_of_a_centre_is_not_told_stays(engram, tmp_path) -> None:
    town = tmp_path / "town"
    engram("centre", "map", town, "fleet", "--moves", "stable", "--quiet", "22-5", "--cap", "1.5GB")
    kept = engram("centre", "map", town, "fleet", "--set", "merge.rounds=8")
    assert kept.out == "fleet: gate none, moves stable, quiet 22-5, cap 1500 MB\n"
    nothing = ("--moves", "none", "--quiet", "none", "--cap", "none")
    cleared = engram("centre", "map", town, "fleet", *nothing)
    assert cleared.out == "fleet: gate none, moves none, quiet none, cap none\n"


def test_a_sweep_by_hand_says_what_it_removed_and_forgot(engram, tmp_path) -> None:
    town = tmp_path / "town"
    engram("centre", "map", town, "fleet", "--cap", "2GB")
    assert engram("centre", "sweep", town).out == "fleet: 0 bytes removed, 0 nodes forgotten\n"


def test_copies_of_a_map_take_stores_that_all_workers_reach(engram, tmp_path, monkeypatch) -> None:
    town = tmp_path / "town"
    (tmp_path / "parts").mkdir()
    refused = engram("centre", "map", town, "fleet", "--copies")
    assert refused.status == 2
    assert "set ENGRAM_DATABASE and ENGRAM_OBJECTS" in refused.err
    monkeypatch.setenv("ENGRAM_DATABASE", f"sqlite:///{tmp_path / 'tables.sqlite'}")
    monkeypatch.setenv("ENGRAM_OBJECTS", f"file://{tmp_path / 'parts'}")
    assert engram("centre", "map", town, "fleet", "--copies").status == 0
    assert engram("centre", "jobs", tmp_path / "copy").status == 0


def test_a_map_of_a_centre_takes_no_settings_with_which_every_merge_fails(engram, tmp_path) -> None:
    for given in (
        ["--moves", "head"], ["--moves", "My ref"], ["--gate", tmp_path / "no.framelog"],
        ["--cap", "much"], ["--cap", "0MB"],
    ):  # fmt: skip
        ran = engram("centre", "map", tmp_path / "town", "fleet", *given)
        assert ran.status == 2
        assert str(given[1]) in ran.err


def test_a_centre_where_no_folder_can_be_is_told_in_one_line(engram, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    ran = engram("centre", "serve", tmp_path / "file" / "town")
    assert ran.status == 2
    assert "cannot hold a centre: Not a directory" in ran.err
    engram("centre", "map", tmp_path / "town", "fleet")
    ran = engram("centre", "backup", tmp_path / "town", tmp_path / "file" / "backup")
    assert ran.status == 2
    assert "cannot be a folder" in ran.err
    ran = engram("centre", "jobs", tmp_path / "town", "--map", "flet")
    assert ran.status == 2
    assert "there is no map 'flet'" in ran.err


PROGRAM = "import sys; sys.argv[0] = 'engram'; from engram.cli import main; main()"


def printing_to(stream: int | IO[str]) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-c", PROGRAM, "--version"]
    return subprocess.run(command, stdout=stream, stderr=PIPE, check=False)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_output_that_cannot_be_written_is_one_line_and_a_reader_that_leaves_none() -> None:
    with Path("/dev/full").open("w") as full:
        ran = printing_to(full)
    assert ran.returncode == 2
    assert ran.stderr.decode().splitlines() == [
        "engram: the output cannot be written: No space left on device"
    ]
    read, write = os.pipe()
    os.close(read)
    ran = printing_to(write)
    os.close(write)
    assert (ran.returncode, ran.stderr) == (141, b"")


def test_a_stream_that_the_caller_closed_takes_everything(monkeypatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    with screen():
        print("nobody reads this")
    assert sys.stdout is None


def test_a_program_interrupted_while_it_starts_says_so(engram, monkeypatch) -> None:
    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "main", stopped)
    ran = engram("info", "map.engram")
    assert (ran.status, ran.err) == (130, "engram: interrupted\n")


def test_names_that_are_not_utf8_end_in_words(engram, street, tmp_path) -> None:
    ran = engram("map", tmp_path / "caf\udce9.engram", street, "--frames", "0:2")
    assert ran.status == 2
    assert "the path is not UTF-8; rename file or folder" in ran.err
    ran = engram("map", tmp_path / "r.engram", street, "--frames", "0:2", "--robot", "caf\udce9")
    assert ran.status == 2
    assert "the robot's name is 'caf\\udce9', must be Unicode text" in ran.err
    drive = tmp_path / "caf\udce9"
    drive.symlink_to(street)
    assert engram("map", tmp_path / "town.engram", drive, "--frames", "0:2").status == 0


def test_a_place_where_no_file_can_be_made_is_named(engram, street, tmp_path) -> None:
    ran = engram("record", street, tmp_path / "nowhere" / "a.framelog")
    assert ran.err == f"engram: {tmp_path}/nowhere is not a folder; make it first\n"
    (tmp_path / "link.engram").symlink_to("gone.engram")
    ran = engram("map", tmp_path / "link.engram", street, "--frames", "0:2")
    assert "link.engram is a link to gone.engram, which does not exist" in ran.err


def test_commands_to_run_next_are_quoted_as_a_shell_needs_them(engram, street, tmp_path) -> None:
    path = tmp_path / "my map.engram"
    assert f"engram plot '{path}' map.png" in engram("map", path, street, "--frames", "0:2").out
