"""SQLite files of ours: what is opened, and by whom."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.maps.maps import begin, session, write_drive

from engram.maps.map import Map

ROOT = Path(__file__).parents[1]
# A pipe, a device and a folder, by every way in; in a process of its own, for it might wait.
OPENS = """
import os, sys
from pathlib import Path
from engram.errors import EngramError
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.framelog.log_writer import FrameLogWriter
from tests.sequences.test_framelog import log_header

folder = Path(sys.argv[1])
for suffix in ("engram", "framelog"):
    os.mkfifo(folder / f"pipe.{suffix}")
    (folder / f"folder.{suffix}").mkdir()
    (folder / f"device.{suffix}").symlink_to("/dev/zero")
ways = {
    "engram": (Map.open, lambda path: Map.open(path, writes=True), check_file),
    "framelog": (FrameLog, lambda path: FrameLogWriter(path, log_header())),
}
for suffix, openers in ways.items():
    for kind in ("pipe", "device", "folder"):
        for opens in openers:
            try:
                opens(folder / f"{kind}.{suffix}")
            except EngramError as error:
                print(type(error).__name__, error)
"""


def run(script: str, *words: object) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_only_regular_files_are_opened_and_nobody_waits(tmp_path: Path) -> None:
    told = run(OPENS, tmp_path)
    devices = "is a pipe, a socket or a device, not a"
    expected = [*["NotAMapError"] * 9, *["SequenceError"] * 6]
    assert [line.split()[0] for line in told] == expected
    for at, line in enumerate(told):
        noun = "map" if at < 9 else "frame log"
        folder = "folder." in line
        assert (f"is a folder, not a {noun}" if folder else f"{devices} {noun}") in line


def test_who_reads_the_map_that_it_writes_keeps_its_locks(tmp_path: Path) -> None:
    """Otherwise the next process to leave the map takes its log along, and all that comes after."""
    path = tmp_path / "town.engram"
    looks = "import sys; from engram.maps.map import Map as m; print(m.open(sys.argv[1]).revision)"
    with Map.create(path) as store:
        writer = begin(store, session())
        write_drive(writer)
        writer.checkpoint()
        Map.open(path).close()
        assert run(looks, path) == ["0"]
        assert path.with_name("town.engram-wal").stat().st_size
        writer.commit()
        assert run(looks, path) == ["1"]
