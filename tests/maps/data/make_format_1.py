"""Writes `format-1.engram`: run once, when the format came to be. Never run it again.

    python -m tests.maps.data.make_format_1 FILE

Two committed sessions (the second supersedes an edge of the first), and one that was interrupted.
"""

from __future__ import annotations

import socket
import sys

from tests.maps.maps import begin, edge, session, write_drive

from engram.graph.model import EdgeKind
from engram.maps import Map


def main(path: str) -> None:
    socket.gethostname = lambda: "example"
    with Map.create(path) as store:
        first = begin(store, session("robot-1"), message="the first")
        drive = write_drive(first, 4)
        ends = (drive.nodes[0].id, drive.nodes[3].id)
        first.add_edge(edge(*ends, EdgeKind.PROXIMITY, seed=1))
        first.put_statistics("basin", {"g": [0.94, 0.7, 0.4]})
        first.commit()
        second = begin(store, session("robot-2"), message="the second")
        write_drive(second, 3)
        second.add_edge(edge(*ends, EdgeKind.PROXIMITY, seed=2))
        second.commit()
        third = begin(store, session("robot-3"))
        write_drive(third, 2)
        third.checkpoint()


if __name__ == "__main__":
    main(sys.argv[1])
