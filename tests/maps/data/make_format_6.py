"""Writes `format-6.engram`: run once, when the format came to be. Never run it again.

    python -m tests.maps.data.make_format_6 FILE

What format 5 could not hold: the tally of its tags.
"""

from __future__ import annotations

import socket
import sys

from tests.maps.maps import begin, session, write_drive

from engram.maps import Map


def main(path: str) -> None:
    socket.gethostname = lambda: "example"
    with Map.create(path) as store:
        first = begin(store, session("robot-1"), message="the first")
        write_drive(first, 3)
        first.commit()
        store.tag("good", 1, author="tests", message="it works")
        store.tag("best", author="tests")
        store.untag("good", author="tests")


if __name__ == "__main__":
    main(sys.argv[1])
