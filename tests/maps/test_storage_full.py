"""A disk that fills up: a clear error, the last checkpoint intact, and it can be tried again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from engram.maps.map import Map
from engram.maps.map_files import check_file

from .maps import node, session

# The file may not grow beyond a limit, which the system reports as it does a full disk.
WRITER = """
import resource, sys
from engram.errors import StorageFullError
from engram.maps.map import Map
from tests.maps.maps import Drive, begin, session

store = Map.create(sys.argv[1])
writer = begin(store, session())
drive = Drive(session())
for index in range(4):
    drive.write_node(writer, index)
writer.checkpoint()
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), hard))
index, refused = 4, 0
while not refused:
    for _ in range(4):
        drive.write_node(writer, index)
        index += 1
    try:
        writer.checkpoint()
        print("stored", index)
    except StorageFullError as error:
        refused += 1
        print("refused", index, error)
if sys.argv[3] == "try again":
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    writer.commit()
    print("committed", index)
"""


@pytest.mark.parametrize(
    "limit",
    [200_000, *(pytest.param(limit, marks=pytest.mark.long) for limit in (100_000, 400_000))],
)
@pytest.mark.parametrize("afterwards", ["try again", "give up"])
def test_a_full_disk_costs_nothing_that_was_checkpointed(tmp_path, limit, afterwards):
    path = tmp_path / "town.engram"
    done = subprocess.run(
        [sys.executable, "-c", WRITER, path, str(limit), afterwards],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split(" ", 2) for line in done.stdout.splitlines()]
    stored = max([4, *(int(line[1]) for line in lines if line[0] != "refused")])
    (refusal,) = (line[2] for line in lines if line[0] == "refused")
    assert "free some space" in refusal
    with Map.open(path, writes=True) as store:
        if afterwards == "give up":
            (interrupted,) = store.interrupted()
            assert interrupted.nodes == stored
            store.seal(session().id)
        contents = store.load()
    assert contents.nodes == tuple(node(session(), index) for index in range(stored))
    assert check_file(path).problems == ()
