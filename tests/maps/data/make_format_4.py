"""Writes `format-4.engram`: run once, when the format came to be. Never run it again.

    python -m tests.maps.data.make_format_4 FILE

What format 3 could not hold: amendments of sessions.
"""

from __future__ import annotations

import socket
import sys

from tests.maps.maps import begin, session, write_drive

from engram.graph.model import Amendable
from engram.maps import Map


def main(path: str) -> None:
    socket.gethostname = lambda: "example"
    with Map.create(path) as store:
        first = begin(store, session("robot-1"), message="the first")
        write_drive(first, 3)
        first.commit()
        named = next(iter(store.sessions))
        store.amend(
            named, {Amendable.ROBOT: "robot-2", Amendable.ZONE: "Europe/London"}, author="tests"
        )


if __name__ == "__main__":
    main(sys.argv[1])
